"""Measures what docs/scaling.md says, and draws docs/scaling.png.

    python -m experiments.scaling engine --workers 20 --cells 10000 --seconds 0.1
    python -m experiments.scaling workers --workers 1 2 4 --cells 200
    python -m experiments.scaling cost --seconds 600 --output experiments/data/scaling_cpu.json
    python -m experiments.scaling devices --tasks pusher tennis --samples 100000 1000000
    python -m experiments.scaling busy
    python -m experiments.scaling figure experiments/data/scaling_cpu.json --output docs/scaling.png

`engine` runs cells that sleep, on as many local workers as asked for: what a cell computes is replaced by sleep; the
client, Dask, the transfer of arrays and the folder are those of a sweep.

`workers` runs a sweep of the pusher's stiffness on more and more local workers, on each number twice: the first run
compiles, the second counts. A worker is busy while it computes a cell, by Dask's task stream.

`cost` times rollouts and gradients against samples, horizon, degrees of freedom, contacts and devices, on whatever JAX
finds (leave JAX_PLATFORMS unset on an accelerator). Each measurement alternates with one of the same rollouts, so that
a machine that gets slower slows both; ratios to these are what counts. It prints as it goes, leaves out what does not
fit into `--seconds`, and goes on where the file ends.

`devices` runs gradients and rollouts of tasks on one device and on all, in turn, and compares the results bit for bit.

`busy` sweeps contact models on an accelerator and prints the share of a cell's time in which a kernel runs, by JAX's
profiler.
"""

import argparse
import json
import math
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final
from unittest import mock

KINDS: Final = ("value", "gradient")
REPEATS: Final = 7
LONG: Final = 3.0
"""Measurements are repeated until they have taken so long [s]."""
BASE: Final = "pusher"
HORIZON: Final = 20
AXES: Final[dict[str, dict[str, tuple[int, ...]]]] = {
    "cpu": {"samples": (100, 1000, 10_000, 100_000), "chunk": (25, 100, 256)},
    "gpu": {"samples": (100, 1000, 10_000, 100_000, 1_000_000), "chunk": (512, 4096, 32_768)},
}
HORIZONS, CONTACTS, DOF, BODIES = (20, 60, 200), (1, 2, 4, 8), (2, 4, 8, 16), (2,)
COUNTS: Final = (1, 2, 4, 8, 16)
SPREAD_HORIZON: Final = 200
"""Steps of what is spread over devices: a call must outlast the launch of the others."""


# Models


def feet(contacts: int) -> str:
    """A free body on a plane with so many spheres for feet: six degrees of freedom, one contact a foot."""
    ring = [2 * math.pi * index / contacts for index in range(contacts)]
    geoms = "".join(
        f'<geom size="0.05" mass="0.1" pos="{0.3 * math.cos(at):.6f} {0.3 * math.sin(at):.6f} 0"/>' for at in ring
    )
    return _mjcf(f'<body pos="0 0 0.049"><freejoint/>{geoms}</body>')


def chain(dof: int) -> str:
    """A hanging chain of so many hinges whose last link touches a plane below: one contact."""
    body, length = '<geom size="0.05" pos="0 0 -0.1" mass="0.1"/>', 0.1 * dof
    for index in reversed(range(dof)):
        at = f"0 0 {length + 0.049:.6f}" if index == 0 else "0 0 -0.1"
        link = '<geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.1" mass="0.1" contype="0" conaffinity="0"/>'
        body = f'<body pos="{at}"><joint axis="0 1 0" damping="0.01"/>{link}{body}</body>'
    return _mjcf(body)


def bodies(count: int) -> str:
    """So many free spheres beside each other on a plane: six degrees of freedom and one contact each."""
    return _mjcf(
        "".join(
            f'<body pos="{index} 0 0.049"><freejoint/><geom size="0.05" mass="0.1" conaffinity="0"/></body>'
            for index in range(count)
        )
    )


def _mjcf(world: str) -> str:
    return f"""<mujoco><option timestep="0.005"/><worldbody>
<geom name="floor" type="plane" size="5 5 0.1" contype="0" conaffinity="1"/>{world}</worldbody></mujoco>"""


def task_of(mjcf: str, horizon: int) -> Any:
    """Its task: the displacement after some steps, by the initial velocities."""
    from mjx_study.tasks.mjcf import mjcf_task

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.xml"
        path.write_text(mjcf)
        return mjcf_task(path, horizon=horizon)


# Measurements


class Programs:
    """What is compiled, and rollouts of the base."""

    def __init__(self) -> None:
        from mjx_study.runtime import local_devices

        self.devices = local_devices()
        self.on_cpu = self.devices[0].platform == "cpu"
        self.chunk = 256 if self.on_cpu else 32_768
        self._simulators: dict[tuple[Any, ...], Any] = {}
        self._tasks: dict[tuple[str, int], Any] = {}

    def task(self, model: str, horizon: int) -> Any:
        """A task of the package, or of an MJCF."""
        from mjx_study.tasks import make_task

        if (model, horizon) not in self._tasks:
            made = task_of(model, horizon) if "<" in model else make_task(model, horizon=horizon)
            self._tasks[model, horizon] = made
        return self._tasks[model, horizon]

    def run(
        self,
        kind: str,
        samples: int,
        chunk: int | None = None,
        model: str = BASE,
        horizon: int = HORIZON,
        devices: int = 1,
        wall: bool = False,
    ) -> tuple[dict[str, Any], Callable[[], float]]:
        """What is run, and a call that runs it and returns seconds, on a CPU the processor's unless `wall`."""
        import jax
        import numpy as np

        from mjx_study.objective import Simulator, spread
        from mjx_study.simulation.scene import num_constraint_rows

        task, chunk = self.task(model, horizon), chunk or min(samples, self.chunk)
        key = model, horizon, chunk
        if key not in self._simulators:
            self._simulators[key] = Simulator(task, chunk_size=chunk)
        simulator = self._simulators[key]
        keys = np.resize(jax.random.key_data(jax.random.split(jax.random.key(0), min(samples, 10_000))), (samples, 2))
        noise = np.ones(samples, task.scene.template.qpos.dtype)
        shared, program = (task.theta, None, np.asarray(task.sigma, noise.dtype)), simulator._programs[kind]
        clock = time.process_time if self.on_cpu and not wall else time.perf_counter

        def call() -> float:
            begun = clock()
            spread(program, shared, (keys, noise), chunk, self.devices[:devices])
            return clock() - begun

        sizes = {"dof": int(task.scene.host.nv), "constraints": num_constraint_rows(task.scene.template)}
        told = {"kind": kind, "samples": samples, "chunk": chunk, "devices": devices, "steps": horizon}
        return told | sizes, call


def plan(programs: Programs) -> list[tuple[str, int, dict[str, Any]]]:
    """Axis, place on it, and arguments of `Programs.run`, what matters most first."""
    axes, chunk = AXES["cpu" if programs.on_cpu else "gpu"], programs.chunk
    found: list[tuple[str, int, dict[str, Any]]] = []
    for kind in KINDS:
        found += [("samples", at, {"kind": kind, "samples": at}) for at in axes["samples"]]
        found += [("chunk", at, {"kind": kind, "samples": at, "chunk": at}) for at in axes["chunk"]]
        counts = [at for at in COUNTS if at <= len(programs.devices)]
        batch = {"kind": kind, "samples": 4 * max(counts) * chunk, "horizon": SPREAD_HORIZON, "wall": True}
        found += [("devices", at, batch | {"devices": at}) for at in counts]
    found += [("horizon", at, {"kind": kind, "samples": chunk, "horizon": at}) for at in HORIZONS for kind in KINDS]
    others = ("corrected", "steps", "step_gradient", "linearisation")
    found += [("kind", at, {"kind": kind, "samples": chunk}) for at, kind in enumerate(KINDS + others)]
    for axis, model, places in (("contacts", feet, CONTACTS), ("dof", chain, DOF), ("bodies", bodies, BODIES)):
        found += [(axis, at, {"kind": kind, "samples": chunk, "model": model(at)}) for at in places for kind in KINDS]
    return found


def measure_cost(seconds: float, output: Path, axes: list[str]) -> None:
    """Time everything that the file does not have; written after each measurement.

    Args:
        seconds: after which nothing more is begun, of a CPU the processor's.
        axes: which to measure, and again where the file has them; all that the file lacks by default.
    """
    import jax

    from mjx_study.runtime import configure, environment

    configure()
    jax.config.update("jax_compilation_cache_dir", None)  # so that everything is compiled
    programs = Programs()
    clock = time.process_time if programs.on_cpu else time.perf_counter
    begun = clock()
    document: dict[str, Any] = {"environment": environment(), "measured": [], "left_out": []}
    if output.exists():
        document |= {"measured": [r for r in json.loads(output.read_text())["measured"] if r["axis"] not in axes]}
    _, base = programs.run("value", programs.chunk)
    per_step = programs.chunk * HORIZON
    base()  # compile
    bases: list[float] = []
    for axis, at, arguments in plan(programs):
        known = ((row["axis"], row["at"], row["kind"]) for row in document["measured"])
        if (axes and axis not in axes) or (axis, at, arguments["kind"]) in known:
            continue
        if clock() - begun > seconds:
            document["left_out"].append([axis, at, arguments["kind"]])
            continue
        told, call = programs.run(**arguments)
        found = {"axis": axis, "at": at} | told | {"first call": call()}
        pairs = [(base(), call())]
        while len(pairs) < REPEATS and sum(own for _, own in pairs) < LONG:
            pairs.append((base(), call()))
        # in steps of a rollout of the base
        found["ratio"] = statistics.median(own / other for other, own in pairs) * per_step
        found["seconds"] = min(own for _, own in pairs)
        document["measured"].append(found)
        bases += [other / per_step for other, _ in pairs]
        document["base"] = {"task": BASE, "steps": HORIZON, "samples": programs.chunk, "step": statistics.median(bases)}
        output.write_text(json.dumps(document, indent=1) + "\n")
        print(
            f"{clock() - begun:6.0f} s  {axis:9} {at:8} {told['kind']:14} {found['seconds']:9.4g} s, a step "
            f"{found['ratio'] / told['samples'] / told['steps']:8.3g} of a rollout of {BASE}; "
            f"traced in {found.get('tracing', 0):.2g} s, compiled in {found.get('compiling', 0):.2g} s",
            flush=True,
        )
    print(f"{len(document['left_out'])} left out for lack of time")


def measure_devices(tasks: list[str], samples: list[int]) -> None:
    """Print the throughput of gradients and rollouts on one device and on all of them; the same chunks on both."""
    import jax
    import numpy as np

    from mjx_study.objective import Simulator, spread
    from mjx_study.runtime import configure, environment, local_devices
    from mjx_study.tasks import make_task

    configure()
    devices = local_devices()
    print(json.dumps(environment()))
    for name in tasks:
        task = make_task(name)
        for count in samples:
            # So many calls on each device that the ends of the last ones do not count.
            chunk = math.ceil(count / len(devices))
            chunk = math.ceil(chunk / math.ceil(chunk / 50_000))
            keys = np.resize(jax.random.key_data(jax.random.split(jax.random.key(0), 10_000)), (count, 2))
            rows = keys, np.ones(count, task.scene.template.qpos.dtype)
            simulator = Simulator(task, chunk_size=chunk)
            shared = task.theta, None, np.asarray(task.sigma, rows[1].dtype)
            for kind in KINDS:
                program: Any = simulator._programs[kind]
                taken: dict[int, list[float]] = {1: [], len(devices): []}
                results: dict[int, Any] = {}
                for repeat in range(REPEATS + 1):
                    for number in taken:
                        begun = time.perf_counter()
                        results[number] = jax.block_until_ready(spread(program, shared, rows, chunk, devices[:number]))
                        taken[number] += [time.perf_counter() - begun] if repeat else []
                alone, together = (jax.tree.leaves(jax.device_get(each)) for each in results.values())
                same = all(np.array_equal(a, b, equal_nan=True) for a, b in zip(alone, together, strict=True))
                one, every = (statistics.median(each) for each in taken.values())
                told = {"task": name, "samples": count, "chunk": chunk, "kind": kind, "devices": len(devices)}
                rates = {number: count * task.horizon / at / 1e6 for number, at in ((1, one), (len(devices), every))}
                told |= {"million steps per second": rates, "ratio": one / every, "bitwise identical": same}
                print(json.dumps(told), flush=True)


def measure_busy(cells: int, samples: int, seeds: int) -> None:
    """Print what a sweep takes, cold and compiled, and the share of the latter in which the accelerator runs a kernel.

    The kernels' time is that of a third run, under JAX's profiler, which slows their launches.
    """
    import jax
    import numpy as np

    from mjx_study.execution.run import run_study
    from mjx_study.experiment.configuration import StudyConfig
    from mjx_study.experiment.plan import plan_study
    from mjx_study.runtime import configure, environment

    configure()
    stiffness = tuple(float(each) for each in np.geomspace(10.0, 1e4, cells))
    config = StudyConfig(tasks=("pusher",), contact=("penalty",), stiffness=stiffness, samples=(samples,), seeds=seeds)
    told: dict[str, Any] = {"cells": cells}
    with tempfile.TemporaryDirectory() as name:

        def run(which: str) -> None:
            starts: list[float] = []
            run_study(plan_study(config), Path(name) / which, lambda *_: starts.append(time.perf_counter()))
            told[f"{which} [s]"] = time.perf_counter() - starts[0]
            told[f"{which}, a cell [s]"] = statistics.median(np.diff(starts[:-1]))

        run("cold")
        run("compiled")
        with jax.profiler.trace(str(Path(name) / "trace")):
            run("profiled")
        (written,) = Path(name).rglob("*.xplane.pb")
        profile = jax.profiler.ProfileData.from_file(str(written))
    spans = sorted(
        (event.start_ns, event.start_ns + event.duration_ns)
        for plane in profile.planes
        if plane.name.startswith("/device:")
        for line in plane.lines
        if line.name.startswith("Stream")
        for event in line.events
    )
    busy, end = 0.0, 0.0
    for start, stop in spans:
        busy, end = busy + max(0.0, stop - max(start, end)), max(end, stop)
    told |= {"kernels and copies": len(spans), "kernels, a cell [s]": busy / 1e9 / cells}
    told["busy"] = told["kernels, a cell [s]"] / told["compiled, a cell [s]"]
    print(json.dumps(environment() | told))


# Figure


PANELS: Final = {
    "samples": "samples of a call",
    "horizon": "steps of a rollout",
    "dof": "degrees of freedom",
    "contacts": "contacts",
    "devices": "devices (CPU: cores)",
}
"""Axes of the figure's panels, with their labels."""


def draw(documents: list[dict[str, Any]], output: Path) -> None:
    """One row of panels: lines of the second machine are dashed, of the third dotted; gradients are wide and hollow."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    from mjx_study.disk import write_whole
    from mjx_study.plots.style import STYLE

    figure = Figure(figsize=(2.6 * len(PANELS), 3.2), layout="constrained")
    panels = dict(zip(PANELS, figure.subplots(1, len(PANELS)), strict=True))
    names = {"gradient": ("gradients", *STYLE["fobg"]), "value": ("rollouts", *STYLE["zobg"])}
    wide = {"ms": 7.5, "markerfacecolor": "none", "linewidth": 3.0, "alpha": 0.6}
    units: list[str] = []
    for document, line in zip(documents, ("-", "--", ":"), strict=False):
        environment = document["environment"]
        on_cpu = environment["backend"] == "cpu"
        device = "one core" if on_cpu else environment["device_kind"].removeprefix("NVIDIA ").split(" ")[0]
        base = document["base"]
        units.append(f"{base['samples']:,} at once on {device}")
        for axis, label in PANELS.items():
            for kind, (name, colour, marker) in names.items():
                rows = [row for row in document["measured"] if row["axis"] == axis and row["kind"] == kind]
                if not rows:
                    continue
                axes, each = panels[axis], [row["ratio"] / row["samples"] / row["steps"] for row in rows]
                if axis == "devices":
                    each = [rows[0]["seconds"] / row["seconds"] for row in rows]
                places, told = [row["at"] for row in rows], f"{name}, {device}"
                style = {"ms": 4} if kind == "value" else wide
                axes.plot(places, each, line, color=colour, marker=marker, label=told, **style)
                axes.set(xlabel=label)
    for axis, axes in panels.items():
        places = sorted({row["at"] for each in documents for row in each["measured"] if row["axis"] == axis})
        axes.set(xscale="log", yscale="log")
        if axis == "devices":
            axes.plot(places, places, color="0.7", linewidth=0.8, zorder=0)
            axes.set(ylabel="speedup over one device")
            axes.set_yticks(places, [str(at) for at in places])
        else:
            low, high = axes.get_ylim()
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 20 * low else (1, 3), numticks=12))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.grid(alpha=0.25)
        if axis != "samples":
            axes.set_xticks(places, [str(at) for at in places])
        axes.minorticks_off()
    next(iter(panels.values())).set_ylabel("time of a step, over the unit")
    unit = f"unit: a step of a rollout of {BASE} of {documents[0]['base']['steps']} steps"
    figure.supxlabel(f"{unit}, {', '.join(units)}", fontsize="small")
    next(iter(panels.values())).legend(fontsize=7)
    write_whole(output, lambda file: figure.savefig(file, format="png", dpi=130))


# The engine


def measure_engine(workers: int, cells: int, seconds: float, programs: int, numbers: int) -> dict[str, Any]:
    """Run the cells and write them; rates of all of it, and of its parts."""
    import numpy as np

    from mjx_study.execution import cluster
    from mjx_study.execution.cells import Cells
    from mjx_study.experiment.study import Work
    from mjx_study.progress import silent
    from mjx_study.storage.folder import Store

    def sleep(study: bytes, index: int, kept: Any, unit: int) -> Any:
        import time

        import numpy

        time.sleep(seconds)
        return {"values": numpy.full(numbers, float(index))}

    class Plan:
        """As much of a plan as hands out cells."""

        def __init__(self) -> None:
            self.cells = range(cells)

        def program_of(self, cell: int) -> int:
            return cell % programs

        def label(self, cell: int) -> str:
            return str(cell)

    class Computation:
        """Cells of one work unit."""

        def begin(self, cell: int, checkpoint: Any) -> Work:
            return Work()

    index = {"cells": [{"label": str(cell), "at": {}} for cell in range(cells)], "config": {}}
    replaced = {"_compute": sleep, "_packed": lambda plan: b""}
    with tempfile.TemporaryDirectory() as name, mock.patch.multiple(cluster, **replaced):
        store, writing = Store(Path(name), index), 0.0
        (Path(name) / "cells").mkdir()
        with cluster.connected(f"local:{workers}") as client:
            client.wait_for_workers(workers)
            begun, processor = time.perf_counter(), time.process_time()
            given = Cells(Plan(), Computation(), silent)  # type: ignore[arg-type]
            for done, arrays in cluster.compute_there(client, given, range(cells)):
                assert isinstance(arrays, dict) and np.all(arrays["values"] == done)
                before = time.perf_counter()
                store.write(done, arrays)
                writing += time.perf_counter() - before
            wall = time.perf_counter() - begun
            processor = time.process_time() - processor
        size = store.path(0).stat().st_size
        claimed = time.perf_counter()
        with store.claims() as claim:
            assert all(map(claim, range(cells)))
            claimed = time.perf_counter() - claimed
    return {
        "workers": workers,
        "cells": cells,
        "wall [s]": wall,
        "cells per second": cells / wall,
        "busy": cells * seconds / (workers * wall),
        "client's processor [ms/cell]": 1e3 * processor / cells,
        "writing [ms/cell]": 1e3 * writing / cells,
        "file [bytes]": size,
        "claiming [us/cell]": 1e6 * claimed / cells,
    }


def measure_workers(workers: list[int], cells: int, samples: int) -> None:
    """Print rates of a sweep, and the share of their time that the workers computed, by their number."""
    import numpy as np
    from distributed import get_task_stream

    from mjx_study.execution import cluster
    from mjx_study.execution.run import run_study
    from mjx_study.experiment.configuration import StudyConfig
    from mjx_study.experiment.plan import plan_study
    from mjx_study.runtime import configure

    configure(cpu_devices=1)
    stiffness = tuple(float(each) for each in np.geomspace(10.0, 1e4, cells))
    plan = plan_study(
        StudyConfig(tasks=("pusher",), contact=("penalty",), stiffness=stiffness, samples=(samples,), seeds=1)
    )
    for count in workers:
        with cluster.connected(f"local:{count}") as client, tempfile.TemporaryDirectory() as name:
            client.wait_for_workers(count)
            run_study(plan, Path(name) / "cold", cluster=client)
            with get_task_stream(client) as stream:
                begun = time.perf_counter()
                run_study(plan, Path(name) / "warm", cluster=client)
                wall = time.perf_counter() - begun
        tasks = stream.data  # type: ignore[attr-defined]  # a coroutine on an asynchronous client only
        spans = [part for task in tasks for part in task["startstops"] if part["action"] == "compute"]
        computed = sum(part["stop"] - part["start"] for part in spans)
        told = {"workers": count, "cells": len(plan.cells), "cells per second": len(plan.cells) / wall}
        print(json.dumps(told | {"seconds per cell": computed / len(spans), "busy": computed / (count * wall)}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    engine = commands.add_parser("engine", help="print the figures of the engine as JSON")
    engine.add_argument("--workers", type=int, default=20)
    engine.add_argument("--cells", type=int, default=10_000)
    engine.add_argument("--seconds", type=float, default=0.1, help="that a cell sleeps")
    engine.add_argument("--programs", type=int, default=20)
    engine.add_argument("--numbers", type=int, default=1000, help="in the arrays of a cell")
    swept = commands.add_parser("workers", help="print rates of a sweep on local workers, each number's as JSON")
    swept.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    swept.add_argument("--cells", type=int, default=200)
    swept.add_argument("--samples", type=int, default=1000)
    cost = commands.add_parser("cost", help="time rollouts and gradients")
    cost.add_argument(
        "--seconds", type=float, default=600, help="after which nothing is begun, of a CPU the processor's"
    )
    cost.add_argument("--axes", nargs="+", default=[], help="to measure, anew if the file has them; all by default")
    cost.add_argument("--output", type=Path, required=True)
    spread_over = commands.add_parser("devices", help="print throughput on one device and on all, as JSON")
    spread_over.add_argument("--tasks", nargs="+", default=["pusher", "tennis"])
    spread_over.add_argument("--samples", type=int, nargs="+", default=[100_000, 1_000_000])
    profiled = commands.add_parser("busy", help="print the share of a sweep's time in which kernels run, as JSON")
    profiled.add_argument("--cells", type=int, default=65)
    profiled.add_argument("--samples", type=int, default=4000)
    profiled.add_argument("--seeds", type=int, default=10)
    drawn = commands.add_parser("figure", help="draw")
    drawn.add_argument("measured", type=Path, nargs="+")
    drawn.add_argument("--output", type=Path, required=True)
    options = vars(parser.parse_args())
    command = options.pop("command")
    if command == "engine":
        print(json.dumps(measure_engine(**options)))
    elif command == "workers":
        measure_workers(**options)
    elif command == "cost":
        measure_cost(**options)
    elif command == "devices":
        measure_devices(**options)
    elif command == "busy":
        measure_busy(**options)
    else:
        draw([json.loads(path.read_text()) for path in options["measured"]], options["output"])


if __name__ == "__main__":
    main()
