"""Import `mujoco.mjx` without its messages about NVIDIA Warp.

MJX reports a missing optional Warp backend on standard output, which would corrupt JSON output. Those lines are
dropped; anything else the import prints goes to standard error.
"""

import contextlib
import io
import sys

_printed = io.StringIO()
with contextlib.redirect_stdout(_printed):
    from mujoco import mjx

for _line in _printed.getvalue().splitlines():
    if not _line.startswith(("Failed to import warp", "Failed to import mujoco_warp")):
        print(_line, file=sys.stderr)

__all__ = ["mjx"]
