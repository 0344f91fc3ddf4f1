"""Measure the missing cells of engines that are installed, each in a process of its own, or write the page.

python -m experiments.engines [--only ENGINE ...] [--scene SCENE ...] [--timestep H] [--quick]: appends to
data/engines.jsonl a line per cell, so that the same command resumes; a cell that takes longer than --limit has this as
its reason, and is measured again only with a higher one. --quick has a quarter of the rollouts, at the longer timestep,
into build/engines/quick.jsonl, which no page is made of. --jobs N measures N cells at a time, each on
one core. --here runs all in this interpreter in place of the engines' environments, and --into FILE keeps what is new
apart: so a machine without a network measures what its PYTHONPATH has, and `merge FILE ...` adds that to the data.
python -m experiments.engines check: repeats accusing cells under half the noise, and tosses from higher, into
data/engines_checks.jsonl.
python -m experiments.engines page: writes the tables of docs/engines.md.
"""

import argparse
import itertools
import json
import math
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import Final

from experiments import ROOT, append_line
from experiments.engines.catalog import ENGINES, HOME, interpreter
from experiments.engines.page import CELLS, CHECKS, PAGE, cells, tables
from experiments.engines.scenes import SCENES, TIMESTEPS, VARIANTS
from experiments.pages import write_tables

LIMIT: Final = 900.0  # seconds that a cell may take if `--limit` gives no others
ONE_CORE: Final = {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false", "OMP_NUM_THREADS": "1"}
"""Of cells of which several are measured at a time."""
TRIAL: Final = ("toss",)  # scenes of `--quick`
HALF, HIGH = VARIANTS
CHECKED: Final = (
    *itertools.product(("mjx", "brax_positional", "drake_sap"), (HALF,), TIMESTEPS),
    *itertools.product(("brax_spring", "brax_positional"), (HIGH,), TIMESTEPS),
)
"""Cells of `check`."""


def run(arguments: argparse.Namespace, target: Path) -> int:
    """Measure what the data and `target` lack, and return how many cells failed."""
    target.parent.mkdir(parents=True, exist_ok=True)
    apart = arguments.quick or arguments.what == "check"
    found = {**({} if apart else cells(CELLS)), **cells(target)}
    done = {key for key, cell in found.items() if cell.get("limit", math.inf) >= arguments.limit}
    todo = []
    for name in arguments.only or ENGINES:
        python = Path(sys.executable) if arguments.here else interpreter(ENGINES[name])
        if not python.exists():
            print(f"{name}: not installed, skipped: python -m experiments.engines.install {ENGINES[name].environment}")
            continue
        steps = arguments.timestep or TIMESTEPS[: 1 if arguments.quick else None]
        scenes = arguments.scene or (TRIAL if arguments.quick else SCENES)
        every = CHECKED if arguments.what == "check" else itertools.product((name,), scenes, steps)
        todo += [(python, *key[:2], str(key[2])) for key in every if key[0] == name and key not in done]
    writing, cores = Lock(), SimpleQueue()
    pin = arguments.jobs > 1 and shutil.which("taskset") is not None
    for core in itertools.islice(itertools.cycle(sorted(os.sched_getaffinity(0)) if pin else [0]), arguments.jobs):
        cores.put(core)

    def measure(cell: tuple[Path, str, str, str]) -> bool:
        core = cores.get()
        python, *words = cell
        pinned = ["taskset", "-c", str(core)] * pin
        how = ["quick"] * arguments.quick
        command = [*pinned, python, "-m", "experiments.engines.worker", *words, *how]
        environment = {**os.environ, **ONE_CORE} if arguments.jobs > 1 else None
        said, line, began = "measured", {}, time.perf_counter()
        try:
            printed = subprocess.run(
                command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=arguments.limit, check=True
            )
            line = json.loads(printed.stdout.splitlines()[-1]) | {"seconds": time.perf_counter() - began}
        except subprocess.TimeoutExpired:
            said = f"no result within {arguments.limit / 60:g} minutes"
            line = dict(zip(("engine", "scene"), words, strict=False)) | {"timestep": float(words[2])}
            line |= {"error": said, "limit": arguments.limit}
        except subprocess.CalledProcessError as error:
            said = f"FAILED: {error.stderr[-500:]}"
        if line:
            with writing:
                append_line(target, line)
        print(*words, said, flush=True)
        cores.put(core)
        return not line

    with ThreadPoolExecutor(arguments.jobs) as pool:
        return sum(pool.map(measure, todo))


def merge(files: list[Path]) -> None:
    """Append the cells of other files that the data lack."""
    found = cells(CELLS)
    for file in files:
        new = {key: cell for key, cell in cells(file).items() if key not in found}
        for cell in new.values():
            append_line(CELLS, cell)
        found = {**found, **new}
        print(f"{file}: {len(new)} cells added")


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.engines", description=__doc__)
    parser.add_argument("what", nargs="?", choices=("measure", "check", "page", "merge"), default="measure")
    parser.add_argument("files", nargs="*", type=Path, help="of merge")
    parser.add_argument(
        "--quick", action="store_true", help="a scene at a timestep, a quarter of the rollouts, apart from the data"
    )
    parser.add_argument("--only", nargs="+", choices=tuple(ENGINES), help="these engines", metavar="ENGINE")
    parser.add_argument("--scene", nargs="+", choices=tuple(SCENES), help="these scenes", metavar="SCENE")
    parser.add_argument("--timestep", nargs="+", type=float, choices=TIMESTEPS, help="[s]")
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds that a cell may take, 900 by default")
    parser.add_argument("--jobs", type=int, default=1, help="cells at a time")
    parser.add_argument("--here", action="store_true", help="in this interpreter, not in the engines' environments")
    parser.add_argument("--into", type=Path, help="file in place of the data")
    arguments = parser.parse_args()
    if arguments.what == "page":
        write_tables(PAGE, tables(cells(CELLS), cells(CHECKS)))
    elif arguments.what == "merge":
        merge(arguments.files)
    else:
        usual = HOME / "quick.jsonl" if arguments.quick else CHECKS if arguments.what == "check" else CELLS
        sys.exit(bool(run(arguments, arguments.into or usual)))


if __name__ == "__main__":
    main()
