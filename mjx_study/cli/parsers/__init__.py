"""The options of each command: `EPILOG` for its help, and `add`."""
