"""Measure the missing cells of engines that are installed, each in a process of its own, or write the page.

python -m experiments.engines [--quick] [--only ENGINE]: appends to data/engines.jsonl a line per cell, so that the same
command resumes; --quick has a quarter of the rollouts, into build/engines/quick.jsonl, which no page is made of.
python -m experiments.engines page: writes the tables of docs/engines.md.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from experiments import ROOT
from experiments.engines.catalog import ENGINES, HOME, interpreter
from experiments.engines.page import CELLS, PAGE, SHOWN, cells, tables
from experiments.engines.scenes import TIMESTEPS
from experiments.pages import write_tables

LIMIT = 900
"""Seconds that a cell may take."""


def run(target: Path, names: list[str], *, quick: bool) -> int:
    """Measure what `target` lacks of the engines named, and return how many cells failed."""
    target.parent.mkdir(parents=True, exist_ok=True)
    found, failed = cells(target), 0
    for name in names:
        python = interpreter(ENGINES[name])
        if not python.exists():
            print(f"{name}: not installed, skipped: python -m experiments.engines.install {ENGINES[name].environment}")
            continue
        for scene, timestep in ((scene, timestep) for scene in SHOWN for timestep in TIMESTEPS):
            if (name, scene, timestep) in found:
                continue
            words = [python, "-m", "experiments.engines.worker", name, scene, str(timestep), *["quick"] * quick]
            try:
                done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT, check=True)
            except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
                failed += 1
                print(f"{name} {scene} {timestep}: FAILED: {str(error.stderr or error)[-500:]}", flush=True)
                continue
            line = done.stdout.splitlines()[-1]
            json.loads(line)
            with target.open("a") as file:
                file.write(line + "\n")
            print(f"{name} {scene} {timestep}: measured", flush=True)
    return failed


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.engines", description=__doc__)
    parser.add_argument("what", nargs="?", choices=("measure", "page"), default="measure")
    parser.add_argument("--quick", action="store_true", help="a quarter of the rollouts, kept apart from the data")
    parser.add_argument("--only", choices=tuple(ENGINES), help="one engine")
    arguments = parser.parse_args()
    if arguments.what == "page":
        write_tables(PAGE, tables(cells(CELLS)))
        return
    target = HOME / "quick.jsonl" if arguments.quick else CELLS
    sys.exit(bool(run(target, [arguments.only] if arguments.only else list(ENGINES), quick=arguments.quick)))


if __name__ == "__main__":
    main()
