"""Measurements, tables and figures behind the pages of docs/, not installed and not imported by the library.

Each module runs from the root of a checkout as `python -m experiments.NAME`; its docstring gives the arguments.
"""
