"""Calibration as a task: capture board poses, solve, verify, report, export."""
