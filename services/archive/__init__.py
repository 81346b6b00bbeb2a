"""The archive: MCAP files that are written at full rate, survive a crash and read back without a copy."""
