"""Prints the table of times of docs/diagnose.md: `mjx-study diagnose` of MJCFs, without and with compiled programs.

    python -m experiments.diagnose_times FILE.xml ...

Each file is diagnosed twice, in processes of their own; the first starts with an empty compilation cache.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import mujoco


def run(path: Path, cache: str) -> tuple[float, float, subprocess.CompletedProcess[str]]:
    """Minutes of the wall clock and of the processor."""
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "mjx_study", "diagnose", str(path), "--devices", "1", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"XDG_CACHE_HOME": cache})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    computed = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return (time.perf_counter() - begun) / 60, computed / 60, done


def row(path: Path) -> str:
    """A line of the table; what came of it is the advice, or the refusal.

    Raises:
        RuntimeError: it ended with a traceback.
    """
    with tempfile.TemporaryDirectory() as cache:
        cold = run(path, cache)
        if "Traceback" in cold[2].stderr:
            raise RuntimeError(cold[2].stderr)
        if not cold[2].stdout:
            return f"| `{path.name}` | | | | | {cold[2].stderr.strip().splitlines()[-1]} |"
        *warm, done = run(path, cache)
    times = [f"{computed:.1f} ({wall:.1f})" for wall, computed in (cold[:2], warm)]
    found, dof = json.loads(done.stdout), mujoco.MjModel.from_xml_path(str(path)).nv
    return f"| `{path.name}` | {dof} | {' | '.join(times)} | {found['samples']} | {found['advice'][0]} |"


def main() -> None:
    print("| MJCF | DoF | cold | warm | samples | advice |")
    print("| --- " * 6 + "|")
    for name in sys.argv[1:]:
        print(row(Path(name)), flush=True)


if __name__ == "__main__":
    main()
