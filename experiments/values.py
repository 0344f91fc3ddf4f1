"""Table of docs/robots.md: native steps and their derivatives against stock MJX's steps and the C engine's.

    python -m experiments.values MODEL ...    # all of `MODELS` without names
    python -m experiments.values --page       # only the page

`SAMPLES` states of the C engine's trajectories, with a budget that ends no solver: one step of each from the same
state, and `PATH` steps of each on its own. Derivatives are along random directions, stock's as central differences of
its steps. Half a minute per model, most of it XLA compiling stock MJX.
"""

import argparse
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.mjx._src import math as mjx_math

import mjx_study
from experiments import DATA, DOCS, ROOT, append_line, read_lines
from experiments.drop_in import TESTED
from experiments.pages import write_tables
from experiments.robots import ROBOTS, loaded
from mjx_study.graph import scalars
from mjx_study.graph.native import native_summary
from mjx_study.simulation._mjx import mjx
from mjx_study.table import markdown_table

RESULTS: Final = DATA / "values.jsonl"
SAMPLES: Final = 16
PATH: Final = 100
LATEST: Final = 400  # steps of the C engine before a state, at most
INPUTS: Final = "qpos", "qvel", "act", "ctrl"
DIFFERENCES: Final = 1e-5, 1e-6, 1e-7  # steps of central differences, the best of which counts
LEFT_OUT: Final = {*(f"humanoid/{count:02}_humanoids" for count in range(3, 11)), "ray", "actuator/general_dyntype"}
"""Copies of a body, a model without a coordinate, and one with a singular inertia matrix."""
MODELS: Final[dict[str, Path]] = {
    **ROBOTS,
    "arm": ROOT / "models" / "arm.xml",
    **{
        name: path
        for path in sorted(TESTED.rglob("*.xml"))
        if (name := str(path.relative_to(TESTED).with_suffix(""))) not in LEFT_OUT and path not in ROBOTS.values()
    },
}
EDGES: Final = "barkour_v0, exact edges"  # that model with the closest points of edges computed without MJX's 1e-6
PAIRS: Final = "ours - stock", "ours - engine", "stock - engine"
HEADINGS: Final = (
    *("model", "DoF", "native - stock", "native - C", "stock - C"),
    *(f"{PATH} steps: {pair}" for pair in ("native - stock", "native - C", "stock - C")),
    "derivatives",
)
State = dict[str, Any]
Step = Callable[[State], State]


def states(host: mujoco.MjModel, count: int) -> State:
    """States of the C engine on its way from the first keyframe, after noise."""
    draw, data, found = np.random.default_rng(0), mujoco.MjData(host), []
    for _ in range(count):
        mujoco.mj_resetData(host, data)
        if host.nkey:
            mujoco.mj_resetDataKeyframe(host, data, 0)
        data.qvel += 0.1 * draw.standard_normal(host.nv)
        data.ctrl += 0.1 * draw.standard_normal(host.nu)
        mujoco.mj_step(host, data, int(draw.integers(1, LATEST)))
        found.append(data.__copy__())
    return {name: np.stack([getattr(each, name) for each in found]) for name in (*INPUTS, "qacc_warmstart")}


def by_engine(host: mujoco.MjModel) -> Step:
    """A step of the C engine."""
    data = mujoco.MjData(host)

    def after(state: State) -> State:
        found = []
        for at in range(len(state["qpos"])):
            mujoco.mj_resetData(host, data)
            for name in (*INPUTS, "qacc_warmstart"):
                getattr(data, name)[:] = state[name][at]
            mujoco.mj_step(host, data)
            found.append(data.__copy__())
        names = (*INPUTS, "qacc_warmstart")
        return {name: np.stack([getattr(each, name) for each in found]) for name in names} | {
            "contacts": np.array([each.ncon for each in found])
        }

    return after


def by_mjx(host: mujoco.MjModel, step: Callable[..., mjx.Data]) -> Step:
    """A step of MJX's or of this project."""
    model, data = mjx.put_model(host), mjx.make_data(host)

    def after(state: State) -> State:
        following = step(model, data.replace(**{name: state[name] for name in (*INPUTS, "qacc_warmstart")}))
        inside: Any = following._impl
        contact = inside.contact
        names = (*INPUTS, "qacc_warmstart")
        return {name: getattr(following, name) for name in names} | {
            "contacts": jnp.sum(contact.dist < contact.includemargin)
        }

    return jax.jit(jax.vmap(after))


def apart(one: Any, other: Any) -> np.ndarray:
    """Differences of rows, as shares of the largest entry of each row, or of 1."""
    one, other = np.asarray(one), np.asarray(other)
    return np.max(np.abs(one - other), axis=1, initial=0) / np.max(np.abs(other), axis=1, initial=1)


def slopes_apart(ours: Step, stock: Step, state: State) -> np.ndarray:
    """Differences of our derivatives of velocities along random directions from those of stock's steps."""
    draw = np.random.default_rng(1)
    ways = {name: draw.standard_normal(state[name].shape) for name in INPUTS}
    still = {"qacc_warmstart": np.zeros_like(state["qacc_warmstart"])}
    found = jax.jvp(lambda state: ours(state)["qvel"], (state,), (ways | still,))[1]
    errors = []
    for size in DIFFERENCES:
        low, high = (
            stock(state | {name: state[name] + end * way for name, way in ways.items()})["qvel"]
            for end in (-size, size)
        )
        errors.append(apart(found, (high - low) / (2 * size)))
    return np.min(errors, axis=0)


def compared(name: str, count: int = SAMPLES, path: int = PATH) -> dict[str, Any]:
    """Differences by state between native steps, stock MJX's and the C engine's."""
    if name == EDGES:
        with exact_edges():
            return _compared(MODELS["barkour_v0"], count, path)
    return _compared(MODELS[name], count, path)


def _compared(model: Path, count: int, path: int) -> dict[str, Any]:
    host = loaded(model)
    host.opt.tolerance = 1e-30
    state = states(host, count)
    steps = {"ours": by_mjx(host, mjx_study.step), "stock": by_mjx(host, mjx.step), "engine": by_engine(host)}
    if "native[" not in str(jax.make_jaxpr(steps["ours"])(state)):
        return {"DoF": host.nv, "left": native_summary().rpartition(": ")[2]}
    after = {who: step(state) for who, step in steps.items()}
    ends = dict.fromkeys(steps, state)
    for _ in range(path):
        ends = {who: step(ends[who]) for who, step in steps.items()}
    return {
        "DoF": host.nv,
        "contacts": {who: np.asarray(each["contacts"]).tolist() for who, each in after.items()},
        "step": {pair: apart(*(after[who]["qvel"] for who in pair.split(" - "))).tolist() for pair in PAIRS},
        "path": {pair: apart(*(ends[who]["qpos"] for who in pair.split(" - "))).tolist() for pair in PAIRS},
        "slopes": slopes_apart(steps["ours"], steps["stock"], state).tolist(),
    }


@contextmanager
def exact_edges() -> Generator[None]:
    """MJX's `closest_segment_point` is without the 1e-6 in its denominator."""

    def closest(a: Any, b: Any, point: Any) -> Any:
        along = b - a
        return a + jnp.clip(jnp.dot(point - a, along) / jnp.dot(along, along), 0.0, 1.0) * along

    stock, mjx_math.closest_segment_point = mjx_math.closest_segment_point, closest
    try:
        _forget()
        yield
    finally:
        mjx_math.closest_segment_point = stock
        _forget()


def _forget() -> None:
    """Drop what was traced with another function."""
    scalars._CAPTURED.clear()
    jax.clear_caches()


def main() -> None:
    """Compare models, and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("models", nargs="*", default=[*MODELS, EDGES])
    parser.add_argument("--page", action="store_true", help="only write the page")
    given = parser.parse_args()
    mjx_study.configure()
    for name in () if given.page else given.models:
        found = {"model": name} | compared(name)
        append_line(RESULTS, found)
        print(found, flush=True)
    write_page()


def write_page() -> None:
    """Write the table of docs/robots.md, from the last comparison of each model; tendons in one row."""
    found = {each["model"]: each for each in read_lines(RESULTS) if "left" not in each}
    groups = {f"`{name}`": [each] for name, each in found.items() if not name.startswith("tendon/")}
    tendons = [each for name, each in found.items() if name.startswith("tendon/")]
    groups[f"`tendon/*`, {len(tendons)} models"] = tendons
    lines = [[name, *_cells(group)] for name, group in groups.items()]
    write_tables(DOCS / "robots.md", {"values": markdown_table(lines, HEADINGS)})


def _cells(group: list[dict[str, Any]]) -> list[str]:
    """Degrees of freedom, and the largest differences of models."""
    largest = lambda *rows: f"{np.max(np.concatenate(rows)):.0e}".replace("0e+00", "0")  # noqa: E731
    cells = ["-".join(f"{end(each['DoF'] for each in group)}" for end in ((min, max) if len(group) > 1 else (min,)))]
    cells += [largest(*(each["step"][pair] for each in group)) for pair in PAIRS]
    cells += [largest(*(each["path"][pair] for each in group)) for pair in PAIRS]
    return [*cells, largest(*(each["slopes"] for each in group))]


if __name__ == "__main__":
    main()
