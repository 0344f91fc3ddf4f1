"""Tables of docs/native.md: tasks as native code, in NumPy and through XLA, on this machine.

    python -m experiments.native TASK ...    # all of `TASKS` without names; each route in a process of its own
    python -m experiments.native --page      # only the page

Rates are those of the fastest of several calls, with the inputs on the device. Building is the time to the first
result of a process with empty caches, tracing included. What takes a route longer than `MOST_SECONDS` is
left out.
"""

import argparse
import itertools
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import jax
import numpy as np

from experiments import DATA, DOCS, append_line, read_lines
from experiments.pages import write_tables
from experiments.timing import interleaved
from mjx_study.graph.native import SWITCH, in_numpy
from mjx_study.graph.scans import with_native_scans
from mjx_study.objective import SamplePrograms
from mjx_study.runtime import configure
from mjx_study.simulation.contact import family_model
from mjx_study.table import markdown_table
from mjx_study.tasks import make_task

RESULTS: Final = DATA / "native.jsonl"
TASKS: Final = ("pusher", "sliding_box", "ball_wall", "momentum_transfer", "tennis", "gripper", "landing")
KINDS: Final = {"value": "rollouts", "gradient": "gradients", "corrected": "corrected gradients"}
SAMPLES: Final = {"cpu": 1000, "gpu": 98_304}
ROUTES: Final = {"native": "1", "NumPy": "0", "XLA": "xla"}  # settings of `SWITCH`
MOST_SECONDS: Final = 300  # maximum time for a route
REPEATS: Final = 7


def measure(name: str) -> None:
    """Measure a task by the route of this process: print, by kind, million steps per second and seconds to a result."""
    configure()
    if os.environ.get(SWITCH) == ROUTES["NumPy"] and not in_numpy():
        return
    task, platform = make_task(name), jax.default_backend()
    contact = family_model("mujoco_default", task.scene, effective_mass=task.effective_mass)
    size, found = SAMPLES[platform], dict[str, Any]()
    keys = jax.random.key_data(jax.random.split(jax.random.key(0), size))
    arguments = jax.device_put((task.theta, contact, np.asarray(task.sigma), keys, np.ones(size)))
    for kind in KINDS:
        begun = time.perf_counter()
        each = SamplePrograms(task).by_name[kind]
        program = jax.jit(jax.vmap(with_native_scans(each), (None, None, None, 0, 0)))
        call = partial(_finished, program, arguments)
        call()
        built = time.perf_counter() - begun
        best = min(interleaved({kind: call}, REPEATS)[kind])
        found[kind] = {"rate": size * task.horizon / best / 1e6, "built": built}
        print(json.dumps({"platform": platform, "found": found}), flush=True)


def _finished(program: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    jax.block_until_ready(program(*arguments))


def main() -> None:
    """Measure tasks, and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tasks", nargs="*", default=TASKS)
    parser.add_argument("--page", action="store_true", help="only write the page")
    parser.add_argument("--route", action="store_true", help="measure one task by the route of this process")
    parser.add_argument("--into", type=Path, default=RESULTS, help="file of results")
    given = parser.parse_args()
    if given.route:
        measure(*given.tasks)
        return
    for name, (route, switch) in itertools.product(() if given.page else given.tasks, ROUTES.items()):
        keep({"task": name, "route": route}, ("experiments.native", "--route", name), switch, MOST_SECONDS, given.into)
    if given.into == RESULTS:
        write_page()


def keep(route: dict[str, Any], command: Sequence[str], switch: str, limit: float, into: Path) -> None:
    """Append a route and the last line that a module prints as JSON to a file, if it prints any within the limit [s].

    It runs in a process of its own with an empty cache; this one leaves the accelerator to it.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {SWITCH: switch, "XDG_CACHE_HOME": folder}
        command = [sys.executable, "-m", *command]
        try:
            done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, timeout=limit)
            lines = done.stdout.splitlines()
        except subprocess.TimeoutExpired as error:
            lines = (error.stdout or b"").decode().splitlines()
    if lines:
        row = route | json.loads(lines[-1])
        append_line(into, row)
        print(row, flush=True)


def write_page() -> None:
    """Write the tables of docs/native.md, from the last measurement of each task, route and platform."""
    rows = {(each["platform"], each["task"], each["route"]): each["found"] for each in read_lines(RESULTS)}
    tables = {}
    for platform, route in (("cpu", "native"), ("gpu", "native"), ("cpu", "NumPy")):
        lines = []
        for name in dict.fromkeys(task for where, task, how in rows if (where, how) == (platform, route)):
            ours, theirs = (rows.get((platform, name, each), {}) for each in (route, "XLA"))
            cells = [f"`{name}`"]
            for kind in KINDS:
                own, other = (each[kind]["rate"] if kind in each else math.nan for each in (ours, theirs))
                cells.append(" / ".join(map(number, (own, other))) + f" = {own / other:.1f}")
            whole = (
                sum(each[kind]["built"] for kind in KINDS) if len(each) == 3 else math.nan for each in (ours, theirs)
            )
            lines.append([*cells, " / ".join(map(number, whole))])
        header = ["task", *KINDS.values(), "building [s]"]
        tables[f"{route}, {platform}"] = markdown_table(lines, header).replace(" / - = nan", "").replace(" / -", "")
    write_tables(DOCS / "native.md", tables)


def number(value: float) -> str:
    """Three digits; "-" for what is missing."""
    return "-" if math.isnan(value) else f"{value:.3g}" if value < 1000 else f"{value:.0f}"


if __name__ == "__main__":
    main()
