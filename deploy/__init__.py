"""Data only: stacks, sensor heads, and what a host needs to run them."""
