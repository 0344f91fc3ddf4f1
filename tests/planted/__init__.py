"""Defects to plant one at a time, and a command that says what catches each: `python -m tests.planted`."""
