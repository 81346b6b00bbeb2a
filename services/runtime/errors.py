"""The one kind of error that is meant for the user."""

from __future__ import annotations


class UserError(Exception):
    """What is wrong; what to do. The command line prints it in one line and exits with code 2."""
