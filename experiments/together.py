"""Table of docs/onset-correction.md: small bodies whose contacts and limits begin together, in turn or at corners.

    python -m experiments.together [PART OF A CASE'S NAME ...]    # cases missing in data/together.jsonl, then the page
    python -m experiments.together --page                         # only the page
    python -m experiments.together intervals                      # spread of the time between two events

Each case starts a body with a number that has noise; its slope and the means are by quadrature over that number. Few
start in contact, which has no term.
"""

import dataclasses
import json
import sys
from collections.abc import Callable
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from estimators import NOISES
from experiments import DATA, DOCS, read_lines
from experiments.onset import deviation
from experiments.pages import write_tables
from experiments.starts import task_of_start
from mjx_study.experiment.quadrature import Line, grid, means
from mjx_study.runtime import configure
from mjx_study.simulation.corners import SKIN
from mjx_study.simulation.dynamics import State, initial_state, rollout
from mjx_study.table import markdown_table, percent
from mjx_study.tasks.task import Task

RESULTS: Final = DATA / "together.jsonl"
POINTS: Final = 1600
TREATMENTS: Final = ("none", "linear", "shift")
FLOOR: Final = '<geom name="floor" type="plane" size="5 5 .1" friction=".6"/>'
SLIDES: Final = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
HINGE: Final = '<joint type="hinge" axis="0 1 0"/>'
BOX: Final = '<geom type="box" size=".2 .1 .1" mass="1" friction=".6"/>'
ARM: Final = (
    f'<geom type="plane" pos=".35 0 0" zaxis="-1 0 0" size="2 2 .1" friction=".5"/><body>{HINGE}'
    '<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5" contype="0" conaffinity="0"/>'
    f'<body pos="0 0 -.3">{HINGE}<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".3" contype="0"'
    ' conaffinity="0"/><geom pos="0 0 -.3" size=".04" mass=".2" friction=".5"/></body></body>'
)
LINKS: Final = (
    '<body pos="0 0 1"><joint type="hinge" axis="0 1 0" limited="true" range="-60 60"/>'
    '<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass="1" contype="0" conaffinity="0"/>'
    '<body pos="0 0 -.3"><joint type="hinge" axis="0 1 0" limited="true" range="-90 30"/>'
    '<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass=".5" contype="0" conaffinity="0"/></body></body>'
)
SLOPE: Final = '<geom type="plane" zaxis="-.3 0 1" size="5 5 .1" friction=".6"/>'
BALL: Final = '<geom size=".1" mass="1" friction=".6" {}/>'


@dataclasses.dataclass(frozen=True)
class Case:
    """A model, and how the number starts it.

    Attributes:
        bodies: text of the world.
        start: positions and velocities from the state at rest and the number.
        at, sigma: the number and the deviation of its noise.
        seconds: how long it moves.
        milliseconds: timesteps.
        option: more options.
        points: of the quadrature.
    """

    bodies: str
    start: Callable[[State, Any], State]
    at: float
    sigma: float
    seconds: float = 0.4
    milliseconds: tuple[float, ...] = (4.0, 2.0)
    option: str = ""
    points: int = POINTS


def thrown(*pose: float) -> Callable[[State, Any], State]:
    """Raise a body by the number and throw it forwards and down; the rest of its pose."""

    def start(state: State, number: Any) -> State:
        qpos = state.qpos.at[1].add(number[0]).at[2:].add(jnp.array(pose))
        return dataclasses.replace(state, qpos=qpos, qvel=state.qvel.at[:2].set(jnp.array([1.0, -1.0])))

    return start


def moving(*velocity: float) -> Callable[[State, Any], State]:
    """Start with a velocity, times the number."""
    return lambda state, number: dataclasses.replace(state, qvel=number[0] * jnp.array(velocity))


def box(height: str, joints: str, geom: str = BOX, floor: str = FLOOR) -> str:
    """Return a body above a floor."""
    return f'{floor}<body pos="0 0 {height}">{joints}{geom}</body>'


FINE: Final = (4.0, 2.0, 1.0)
CASES: Final = {
    "box lands flat": Case(box(".1", SLIDES), thrown(), 0.15, 0.05),
    "box lands tilted by 0.03 rad": Case(box(".1", SLIDES + HINGE), thrown(0.03), 0.15, 0.05, milliseconds=FINE),
    "tilted by 0.04 rad": Case(box(".1", SLIDES + HINGE), thrown(0.04), 0.15, 0.05, milliseconds=FINE),
    "capsule across a block's edge": Case(
        '<geom type="box" pos=".3 0 .1" size=".3 .3 .1" friction=".5"/>'
        + box(".25", SLIDES + HINGE, '<geom type="capsule" fromto="-.2 0 0 .2 0 0" size=".05" mass="1"/>', ""),
        thrown(0.2),
        0.2,
        0.03,
    ),
    "two hinges reach limits, 7 rad/s": Case(LINKS, moving(1, 1), 7.0, 0.2, 0.2, (2.0, 1.0)),
    **{
        f"arm hits a wall, {speed:g} rad/s": Case(
            ARM, moving(-1, -0.5), speed, speed / 20, option='gravity="0 0 0"', points=16_000
        )
        for speed in (2.0, 4.0, 8.0)
    },
    "ball with a margin": Case(box(".1", SLIDES, BALL.format('margin=".02" gap=".01"')), thrown(), 0.15, 0.05),
    **{
        f"ball on an incline, {cone} cone": Case(
            box(".1", SLIDES + HINGE, BALL.format(""), SLOPE), thrown(0.0), 0.25, 0.05, option=f'cone="{cone}"'
        )
        for cone in ("pyramidal", "elliptic")
    },
    "limit with friction loss": Case(
        '<body><joint type="slide" axis="1 0 0" limited="true" range="-1 .3" frictionloss="2"/>'
        '<geom size=".1" mass="1"/></body>',
        moving(1.0),
        2.0,
        0.2,
    ),
    "three balls in a row": Case(
        "".join(
            f'<body pos="{x} {y} 0"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
            '<geom size=".1" mass="1" condim="1"/></body>'
            for x, y in ((0, 0), (0.4, 0.08), (0.75, -0.05))
        ),
        moving(1, 0, 0, 0, 0, 0),
        2.0,
        0.2,
        0.6,
        option='gravity="0 0 0"',
    ),
}


def task_for(case: Case, milliseconds: float) -> Task:
    """Return the task of a case at a timestep."""
    option = f'<option timestep="{milliseconds / 1e3:g}" {case.option}/>'
    mjcf = f"<mujoco>{option}<worldbody>{case.bodies}</worldbody></mujoco>"

    def cost(state: State) -> jax.Array:
        return 10 * jnp.sum(state.qpos**2) + jnp.sum(state.qpos)

    return task_of_start("body", mjcf, round(1e3 * case.seconds / milliseconds), case.start, case.at, case.sigma, cost)


def measured(case: Case, milliseconds: float) -> dict[str, Any]:
    """Return the slope of the mean cost, the means of first-order gradients, with the quadrature's errors, and their
    deviations."""
    task = task_for(case, milliseconds)
    points, found = grid(case.at, case.at, case.sigma, case.points, task.noise), {}
    for onset in TREATMENTS:
        values, slopes = Line(task.replace(onset=onset))(points, None)
        each = means(points, values, slopes, np.array([case.at]), case.sigma, task.noise)
        weights = NOISES[task.noise].density((points - case.at) / case.sigma)
        found[onset] = float(each.first[0]), float(each.first_error[0]), deviation(slopes, weights)
        found["slope"] = float(each.slope[0]), float(each.slope_error[0])
    return {name: [float(f"{value:.6g}") for value in values] for name, values in found.items()}


def touches(distances: np.ndarray) -> np.ndarray:
    """Return when rows of distances first pass zero, in steps."""
    passes = (distances[:, :-1] > 0) & (distances[:, 1:] <= 0)
    rows, step = np.arange(len(distances)), passes.argmax(axis=1)
    before, after = distances[rows, step], distances[rows, step + 1]
    return np.where(passes.any(axis=1), step + before / (before - after), np.nan)


def positions(case: Case, milliseconds: float) -> np.ndarray:
    """Return positions in rollouts under the noise, `(samples, steps + 1, nq)`."""
    task = task_for(case, milliseconds)

    def states(number: jax.Array) -> State:
        start = case.start(initial_state(task.scene), number)
        return rollout(task.scene, task.scene.model, start, lambda *_: jnp.zeros(0), task.horizon)[0]

    draws = np.random.default_rng(0).standard_normal((2000, 1))
    return np.asarray(jax.jit(jax.vmap(states))(case.at + case.sigma * draws).qpos)


def intervals() -> None:
    """Print half the width of 68 % of when contact begins, when it does at a second place, and of the time between."""
    for name in ("box lands tilted by 0.03 rad", "two hinges reach limits, 7 rad/s"):
        for milliseconds in CASES[name].milliseconds:
            qpos = positions(CASES[name], milliseconds)
            if "hinges" in name:
                first, second = (touches(limit - qpos[..., at]) for at, limit in enumerate(np.deg2rad([60, 30])))
            else:
                height, tilt = qpos[..., 1] + 0.1 - 0.1 * np.cos(qpos[..., 2]), 0.2 * np.sin(qpos[..., 2])
                first, second = touches(height - tilt), touches(np.maximum(height + tilt, 2 * tilt - SKIN))
            between = (np.nanquantile(each, (0.16, 0.84)) for each in (first, second, second - first))
            spreads = [f"{np.ptp(each) / 2:.2f}" for each in between]
            print(f"{name}, {milliseconds:g} ms: first, second, between them {', '.join(spreads)} steps", flush=True)


def read() -> dict[str, dict[str, Any]]:
    """Return the results so far."""
    return {line.pop("case"): line for line in read_lines(RESULTS)}


def page(results: dict[str, dict[str, Any]]) -> None:
    """Write the table: errors as shares of the slope, and the quadrature's."""
    rows = []
    for name, each in results.items():
        slope, unsure = each["slope"]
        errors = ((abs(each[onset][0] / slope - 1), (each[onset][1] + unsure) / abs(slope)) for onset in TREATMENTS)
        off = [" ± ".join(percent(part, 1) for part in pair) for pair in errors]
        what, timestep = name.rsplit(", ", 1)
        deviations = ", ".join(f"{each[onset][2]:.2g}" for onset in TREATMENTS)
        rows.append((what, timestep, f"{slope:.4g} ± {unsure:.1g}", *off, deviations))
    kinds = "plain", "linear", "shift"
    header = "case", "timestep", "slope", *(f"off by: {name}" for name in kinds), f"deviation: {', '.join(kinds)}"
    write_tables(DOCS / "onset-correction.md", {"together": markdown_table(rows, header)})


def main() -> None:
    """Run the command line."""
    configure()
    if sys.argv[1:] == ["intervals"]:
        intervals()
        return
    chosen, results = sys.argv[1:], read()
    cases = {f"{name}, {step:g} ms": (case, step) for name, case in CASES.items() for step in case.milliseconds}
    for name, arguments in cases.items():
        if "--page" in chosen or name in results or (chosen and not any(part in name for part in chosen)):
            continue
        results[name] = measured(*arguments)
        print(name, results[name], flush=True)
        ordered = {each: results[each] for each in cases if each in results}
        RESULTS.write_text("".join(json.dumps({"case": each, **line}) + "\n" for each, line in ordered.items()))
    page({each: results[each] for each in cases if each in results})


if __name__ == "__main__":
    main()
