"""Options of studies: declared once, and checked alike on the command line, in TOML files and in Python."""
