"""Tables of docs/robots.md: robots by native code, through XLA, by stock MJX and by the C engine, on this machine.

    python -m experiments.robots ROBOT ...    # all of `ROBOTS` without names; each route in a process of its own
    python -m experiments.robots quadruped --routes native stock --samples 256 --precision float32
    python -m experiments.robots --page       # only the page

Each route rolls out `STEPS` steps from states in contact, under the control that holds them there, solved to rounding
(`BUDGET`), but for stock MJX's gradients, which one iteration of its solver gives. Rates are those of the fastest of
several calls, with the inputs on the device. Gradients by the C engine are one rollout's on one thread, by centred
differences of every step (`mjd_transitionFD`) and an adjoint sweep, times the threads. Memory is XLA's plan
for a batch. Building is the time to the first result of a process with empty caches, tracing included: of rollouts,
then of their gradients. What takes a route longer than `MOST_SECONDS` is left out.
"""

import argparse
import itertools
import json
import math
import time
from functools import partial
from pathlib import Path
from typing import Any, Final

import jax
import mujoco
import mujoco.rollout
import numpy as np

import mjx_study
from experiments import DATA, DOCS, ROOT, read_lines
from experiments.drop_in import STEPS, TESTED, prepared, start_states
from experiments.native import keep, number
from experiments.pages import write_tables
from experiments.timing import interleaved
from mjx_study.bench import gradient_of_engine
from mjx_study.graph.linear_map import implicit_derivative
from mjx_study.graph.scalars import captured_once
from mjx_study.runtime import PRECISIONS, available_cores
from mjx_study.simulation import native_step
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.dynamics import equations
from mjx_study.simulation.linear_algebra import solve_positive_definite
from mjx_study.table import markdown_table

RESULTS: Final = DATA / "robots.jsonl"
ROBOTS: Final[dict[str, Path]] = {
    "quadruped": ROOT / "models" / "quadruped.xml",
    "humanoid": TESTED / "humanoid" / "humanoid.xml",
    "barkour_v0": TESTED / "barkour_v0" / "assets" / "barkour_v0_mjx.xml",
    "02_humanoids": TESTED / "humanoid" / "02_humanoids.xml",
    "shadow_hand": TESTED / "shadow_hand" / "scene_right.xml",
}
ROUTES: Final = "native", "xla", "stock", "engine"
COLUMNS: Final = {
    ("native", "rollouts"): ("native", "rollouts"),
    ("native", "gradients"): ("native", "gradients"),
    ("xla", "rollouts"): ("through XLA", "rollouts"),
    ("xla", "gradients"): ("through XLA", "gradients"),
    ("stock", "rollouts"): ("stock MJX", "rollouts"),
    ("stock", "gradients"): ("stock MJX", "gradients, one iteration"),
    ("engine", "rollouts"): ("C engine", "rollouts"),
    ("engine", "gradients"): ("C engine", "gradients by differences"),
}
BUDGET: Final = (100, 50)  # iterations of the solver and of its line search
SAMPLES: Final = {"cpu": 256, "gpu": 16_384}
MOST_SECONDS: Final = 900  # maximum time for a route
REPEATS: Final = 7


def loaded(path: Path) -> mujoco.MjModel:
    """A robot with a budget that does not end its solver."""
    host = mujoco.MjModel.from_xml_path(str(path))
    host.opt.iterations, host.opt.ls_iterations = BUDGET
    return host


def standing(host: mujoco.MjModel) -> np.ndarray:
    """Controls of the first keyframe, 0 without one."""
    return host.key_ctrl[0] if host.nkey else np.zeros(host.nu)


def measure(name: str, route: str, samples: int | None, precision: str) -> None:
    """Print, after each kind of program, million steps per second and seconds to the first result of all so far."""
    mjx_study.configure(precision=precision)
    host, platform = loaded(ROBOTS[name]), jax.default_backend()
    size, found = samples or SAMPLES[platform], dict[str, Any]()
    step = mjx.step if route == "stock" else mjx_study.step
    for kind in ("rollouts", "gradients"):
        begun, gradient = time.perf_counter(), kind == "gradients"
        if route == "engine":
            call, memory = differences_by_engine(host) if gradient else by_engine(host, size), None
        else:
            iterations = 1 if gradient and route == "stock" else BUDGET[0]
            call = prepared(host, step, iterations, gradient, size, standing(host))
            memory = call.args[0].memory_analysis().temp_size_in_bytes / size
        call()
        built = time.perf_counter() - begun
        best = min(interleaved({kind: call}, REPEATS)[kind])
        together = available_cores() if route == "engine" and gradient else size
        found[kind] = {"rate": together * STEPS / best / 1e6, "built": built, "bytes": memory}
        setting = {"platform": platform, "samples": size, "precision": precision}
        print(json.dumps({**setting, "found": found}), flush=True)


def by_engine(host: mujoco.MjModel, batch: int) -> partial[Any]:
    """The same rollouts in MuJoCo's C engine, on all of this process's cores."""
    data = [mujoco.MjData(host) for _ in range(available_cores())]
    qpos, qvel = start_states(host, batch)
    start = np.zeros((batch, mujoco.mj_stateSize(host, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    start[:, 1 : 1 + host.nq + host.nv] = np.concatenate([qpos, qvel], axis=1)
    controls = np.broadcast_to(standing(host), (batch, STEPS, host.nu))
    run = mujoco.rollout.Rollout(nthread=len(data))
    return partial(run.rollout, host, data, start, controls)


def differences_by_engine(host: mujoco.MjModel) -> partial[Any]:
    """The gradient of one such rollout by the C engine, on one thread."""
    qpos, qvel = start_states(host, 1)
    return partial(gradient_of_engine, host, (qpos[0], qvel[0]), np.tile(standing(host), (STEPS, 1)))


def sizes(name: str) -> dict[str, int]:
    """Degrees of freedom, constraint rows, and scalar operations of a robot's step and its transposed derivative."""
    host = loaded(ROBOTS[name])
    model, data = mjx.put_model(host), mjx.make_data(host)
    rows: Any = data._impl
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(data)]
    found = native_step.solved_graph(model, data)
    assert found is not None
    solved, layout = found
    _, kinds, used = layout
    left_sides = partial(equations, partial(native_step._forced, layout))
    qacc = jax.ShapeDtypeStruct((host.nv,), float)
    captured = captured_once(left_sides, model, *(kinds[place] for place in used), qacc)
    assert captured is not None
    moving = tuple(at for at, place in enumerate(used) if names[place] in native_step.MOVING)
    slope = implicit_derivative(captured, moving, solve_positive_definite)
    return {
        "DoF": host.nv,
        "rows": rows.efc_J.shape[0],
        "step": solved.size,
        "of these in loops": solved.size - len(solved.needed),
        "its transposed derivative": slope.transposed.push.size,
    }


def main() -> None:
    """Measure robots, and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("robots", nargs="*", default=ROBOTS)
    parser.add_argument("--page", action="store_true", help="only write the page")
    parser.add_argument("--routes", nargs="+", default=ROUTES, choices=ROUTES)
    parser.add_argument("--samples", type=int, help="rollouts at once, in place of the tables'")
    parser.add_argument("--precision", default="float64", choices=PRECISIONS)
    parser.add_argument("--here", action="store_true", help="measure one robot by one route in this process")
    parser.add_argument("--into", type=Path, default=RESULTS, help="file of results")
    given = parser.parse_args()
    if given.here:
        measure(given.robots[0], given.routes[0], given.samples, given.precision)
        return
    settings = ("--precision", given.precision, *(("--samples", str(given.samples)) if given.samples else ()))
    for name, route in itertools.product(() if given.page else given.robots, given.routes):
        command = "experiments.robots", name, "--routes", route, "--here", *settings
        keep({"robot": name, "route": route}, command, "1" if route == "native" else "xla", MOST_SECONDS, given.into)
    if given.into == RESULTS:
        mjx_study.configure()
        write_page()


def results() -> dict[tuple[Any, ...], dict[str, Any]]:
    """The last measurement of each platform, robot, route, number of samples and precision."""
    names, rows = ("platform", "robot", "route", "samples"), read_lines(RESULTS)
    return {(*(row[name] for name in names), row.get("precision", "float64")): row["found"] for row in rows}


def write_page() -> None:
    """Write the tables of docs/robots.md, from the last measurement of each robot, route and platform."""
    every = results()
    rows = {key[:3]: found for key, found in every.items() if key[3:] == (SAMPLES[key[0]], "float64")}
    header = [f"{what}: {kind}" for what, kind in (*COLUMNS.values(), ("building [s]", "native"))]
    tables = dict[str, str]()
    for platform in sorted({platform for platform, *_ in rows}):
        lines = []
        for name in ROBOTS:
            if (platform, name, "native") not in rows:
                continue
            found = {route: rows.get((platform, name, route), {}) for route in ROUTES}
            rates = [found[route].get(kind, {}).get("rate", math.nan) for route, kind in COLUMNS]
            built = " + ".join(number(each["built"]) for each in found["native"].values())
            lines.append([f"`{name}`", *map(number, rates), built or "-"])
        columns = [each for each in zip(["robot", *header], *lines, strict=True) if {*each[1:]} != {"-"}]
        names, *lines = map(list, zip(*columns, strict=True))
        tables[f"speed, {platform}"] = markdown_table(lines, names)
    lines = []
    for name in ROBOTS:
        found = [rows.get(("cpu", name, route), {}).get("gradients", {}) for route in ("native", "xla", "stock")]
        lines.append([f"`{name}`", *(number(each.get("bytes", math.nan) / 1e3) for each in found)])
    tables["memory"] = markdown_table(lines, ["robot", "native", "through XLA", "stock MJX, one iteration"])
    lines = []
    for samples, precision in sorted({key[3:] for key in every if key[:2] == ("gpu", "quadruped")}):
        found = [every.get(("gpu", "quadruped", route, samples, precision), {}) for route in ("native", "stock")]
        rates = [each.get(kind, {}).get("rate", math.nan) for each in found for kind in ("rollouts", "gradients")]
        lines.append([f"{samples:,}", precision, *map(number, rates)])
    columns = [": ".join(COLUMNS[route, kind]) for route in ("native", "stock") for kind in ("rollouts", "gradients")]
    tables["batches"] = markdown_table(lines, ["samples", "precision", *columns])
    found = {name: sizes(name) for name in ROBOTS}
    lines = [[f"`{name}`", *(f"{size:,}" for size in each.values())] for name, each in found.items()]
    write_tables(DOCS / "robots.md", tables | {"size": markdown_table(lines, ["robot", *found["quadruped"]])})


if __name__ == "__main__":
    main()
