"""Measure how long a first answer about one's own model takes, and the next one: docs/performance.md.

    python -m experiments.first_answers [--page docs/performance.md] [--only SESSION]

A session is a list of commands on a task of one's own, an arm that swats a box, or on a quadruped's file. Each runs in
a process of its own; the caches are empty when a session begins. The processor time of tracing is that of the threads
in which JAX announces it, that of native code the C compiler's; XLA compiles in threads of its own, and so counts among
the rest.
"""

import argparse
import json
import os
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any, Final

import jax
from jax import monitoring

from experiments import DATA
from experiments.pages import write_tables
from mjx_study.cli.display import EVENTS
from mjx_study.table import markdown_table

TASK: Final = """
import jax.numpy as jnp
import mjx_study as study


def swat(horizon=100, model="arm.xml", **options):
    scene = study.load_scene(model, **options)
    controls = horizon * scene.host.nu
    return study.Task(
        name="swat", scene=scene, horizon=horizon, policy=study.OpenLoop(horizon, scene.host.nu),
        theta=jnp.zeros(controls), sigma=0.1, start=study.initial_state(scene), contact_pair=("hand", "box"),
        running_cost=lambda state, control: 0.001 * jnp.sum(control**2),
        final_cost=lambda state: (state.qpos[2] - 0.3) ** 2,
        defaults=study.StudyDefaults(families=("mjcf",)),
    )
"""
SESSIONS: Final = {
    "studies": (
        "compare swat:swat --samples 100",
        "compare swat:swat --samples 100 --seed 1",
        "compare swat:swat --samples 80",
        "landscape swat:swat --points 11",
        "sweep swat:swat --samples 30,100 --seeds 3 --output out",
        "optimise swat:swat --iterations 20 --learning-rate 0.1 --samples 20",
    ),
    "diagnosis": ("diagnose swat:swat", "diagnose swat:swat"),
    "quadruped": ("diagnose quadruped.xml", "diagnose quadruped.xml"),
}
MODELS: Final = DATA.parents[1] / "models"
HEADER: Final = ("command", "wall [s]", "processor [s]", "tracing", "C compiler", "rest", "programs", "load")
HIT: Final = "/jax/compilation_cache/cache_hits"


class Phases:
    """Processor seconds of tracing, and the number of programs that are compiled rather than read."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self.programs = 0
        self._begun = threading.local()

    def began(self, event: str, value: float, **details: str | int) -> None:
        if event in EVENTS:
            self._begun.__dict__.setdefault("stack", []).append(time.thread_time())

    def ended(self, event: str, duration_secs: float, **details: str | int) -> None:
        if event in EVENTS:
            begun = self._begun.stack.pop()
            if not self._begun.stack:
                self.seconds[EVENTS[event]] += time.thread_time() - begun
            self.programs += EVENTS[event] == "compiling"

    def read(self, event: str, **details: str | int) -> None:
        self.programs -= event == HIT

    def listen(self) -> None:
        monitoring.register_scalar_listener(self.began)
        monitoring.register_event_duration_secs_listener(self.ended)
        monitoring.register_event_listener(self.read)


def measured(command: str) -> dict[str, Any]:
    """Run a command in this process, and return its processor seconds by phase and the programs that it compiled."""
    from mjx_study.cli import main

    phases = Phases()
    phases.listen()
    code = main(shlex.split(command))
    ours, theirs = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    processor, compiler = ours.ru_utime + ours.ru_stime, theirs.ru_utime + theirs.ru_stime
    return dict(phases.seconds) | {
        "processor": processor,
        "compiler": compiler,
        "code": code,
        "programs": phases.programs,
    }


def in_a_process(command: str, folder: Path) -> dict[str, Any]:
    """Measure a command in a process of its own, which finds the task in a folder and keeps its caches there."""
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    report = folder / "report.json"
    begun = time.perf_counter()
    given = [sys.executable, "-m", "experiments.first_answers", "--measure", command, "--report", str(report)]
    done = subprocess.run(given, cwd=folder, env=environment, stdout=subprocess.DEVNULL)
    if done.returncode:
        raise RuntimeError(f"{command} failed with exit code {done.returncode}")
    return json.loads(report.read_text()) | {"wall": time.perf_counter() - begun, "load": os.getloadavg()[0]}


def row_of(command: str, found: dict[str, Any]) -> tuple[str, ...]:
    """A row of the table."""
    processor = found["processor"] + found["compiler"]
    phases = [found.get("tracing", 0.0), found["compiler"]]
    numbers = [found["wall"], processor, *phases, processor - sum(phases)]
    shown = command.replace("swat:swat ", "").replace(" --output out", "").removesuffix(" swat:swat")
    return f"`{shown}`", *(f"{number:.1f}" for number in numbers), str(found["programs"]), f"{found['load']:.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", type=Path, help="page whose table is replaced")
    parser.add_argument("--only", choices=SESSIONS, help="a single session")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    parser.add_argument("--report", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        options.report.write_text(json.dumps(measured(options.measure)))
        return
    rows = []
    for session in [options.only] if options.only else SESSIONS:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            (folder / "swat.py").write_text(TASK)
            shutil.copy(DATA / "arm.xml", folder)
            shutil.copy(MODELS / "quadruped.xml", folder)
            for command in SESSIONS[session]:
                rows.append(row_of(command, in_a_process(command, folder)))
                print(" ".join(rows[-1]), flush=True)
    lines = markdown_table(rows, HEADER)
    print(lines, f"JAX {jax.__version__}, {os.cpu_count()} cores", sep="\n")
    if options.page and not options.only:
        write_tables(options.page, {"first answers": lines})


if __name__ == "__main__":
    main()
