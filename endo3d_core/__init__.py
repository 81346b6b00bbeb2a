"""How it is computed: pure functions and classes over numpy arrays. No I/O, no clock, no transport."""
