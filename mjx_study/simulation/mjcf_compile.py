"""Compile an MJCF that may be anybody's: its files are checked first, and MuJoCo reads them in a process of its own."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import mujoco

from mjx_study.limits import MOST_GIB
from mjx_study.runtime import print_warning
from mjx_study.simulation.mjcf_files import check_files

SECONDS: Final = 60
"""Maximum time for compiling a model [s]."""
_WORKER: Final = Path(__file__).with_name("_compile_worker.py")


def compile_file(path: Path) -> mujoco.MjModel:
    """Compile an MJCF in another process, with limits on time and memory; the model is the same to the bit.

    Raises:
        RefusedFileError: see `check_files`.
        ValueError: MuJoCo does not accept the file, crashes on it, or exceeds `SECONDS` or `MOST_GIB`.
    """
    check_files(path)
    package = Path(mujoco.__file__).parent
    (library,) = package.glob("libmujoco*")
    limits = [str(SECONDS), str(int(MOST_GIB * 2**30))]
    command = [sys.executable, "-I", "-S", str(_WORKER), str(library), str(package / "plugin"), *limits]
    try:
        done = subprocess.run(
            [*map(os.fsencode, command), os.fsencode(path)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=SECONDS,
        )
    except subprocess.TimeoutExpired:
        raise ValueError(f"MuJoCo does not compile it within {SECONDS} s") from None
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        raise ValueError(f"MuJoCo crashes on it ({name}), or needs more than {MOST_GIB:g} GiB or {SECONDS} s")
    report = _report(done.stderr)
    for warning in report["warnings"]:
        print_warning(warning)
    if report["error"] is not None:
        raise ValueError(report["error"])
    name = "model.mjb"
    return mujoco.MjModel.from_binary_path(name, {name: done.stdout})


def _report(lines: bytes) -> dict[str, Any]:
    """The worker's report, which libraries may print before."""
    last = lines.decode(errors="replace").strip().rpartition("\n")[2]
    try:
        return json.loads(last)
    except json.JSONDecodeError:
        return {"error": last or "MuJoCo does not compile it", "warnings": []}
