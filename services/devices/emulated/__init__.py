"""Devices emulated at the wire, written from their protocols and not from the drivers that talk to them."""
