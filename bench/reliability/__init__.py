"""Bad days: faults while scanning, and long runs. ``make faults``, ``make soak``; tables in docs/reliability.md."""
