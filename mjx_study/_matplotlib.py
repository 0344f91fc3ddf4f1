"""Import matplotlib regardless of MPLBACKEND: figures need no backend, and an invalid one would raise here."""

import os
import sys

try:
    import matplotlib
except ValueError:
    for _name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        del sys.modules[_name]  # the half-imported modules
    _backend = os.environ.pop("MPLBACKEND", "")
    try:
        import matplotlib
    finally:
        os.environ["MPLBACKEND"] = _backend

__all__ = ["matplotlib"]
