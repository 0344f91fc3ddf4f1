"""Imports matplotlib whatever MPLBACKEND says: figures need no backend, and a wrong one would be an error here."""

import os
import sys

try:
    import matplotlib
except ValueError:
    for _name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        del sys.modules[_name]  # what is half imported
    _backend = os.environ.pop("MPLBACKEND", "")
    try:
        import matplotlib
    finally:
        os.environ["MPLBACKEND"] = _backend

__all__ = ["matplotlib"]
