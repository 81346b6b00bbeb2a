"""Who does it: one short file per service, its devices, its runtime and the command line."""
