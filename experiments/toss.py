"""Table of docs/onset-correction.md on DiffMJX's scenes, rebuilt from their published numbers.

    python -m experiments.toss

Half an hour on two cores, most of it compiling. Paulus et al., arXiv 2506.14186: a point on a spring and a damper; a
ball and a cube thrown to the floor, whose cost is their final sideways position.
"""

import dataclasses
import itertools
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np

import mjx_study as study
from experiments.pages import markdown_row
from experiments.starts import task_of_start
from mjx_study.experiment.quadrature import Line, grid, means
from mjx_study.simulation.contact import ContactModel
from mjx_study.table import markdown_table

STIFFNESS, DAMPING, START, SPREAD, SECONDS = 50.0, 1.0, 1.0, 0.1, 2.0  # of the point: [1/s^2], [1/s], [m], [m], [s]
TOSSED: Final = """<mujoco>
  <option timestep="0.0005" gravity="0 0 -2"><flag refsafe="disable" eulerdamp="disable"/></option>
  <worldbody><geom name="floor" type="plane" size="20 20 1"/>
  <body pos="0 0 0.1"><freejoint/><geom name="thrown" {}/></body></worldbody></mujoco>"""
GEOMS: Final = {
    "ball": 'type="sphere" size="0.05" density="1"',
    "cube": 'type="box" size="0.05 0.05 0.05" density="100" euler="60 0 0"',
}
SOLIMP: Final = {"0": (0.0, 0.95, 0.001, 0.5, 2.0), "0.9, the default": (0.9, 0.95, 0.001, 0.5, 2.0)}
SOLREF: Final = (0.005, 1.0)
HEIGHT, DRIFT, SPEED, SIGMA, HORIZON, POINTS = 0.2, -0.1, -2.0, 0.05, 1000, 1600  # [m], [m/s], [m/s], [m/s], steps


def point(start: np.ndarray, timestep: float, *, pulls: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance to 1 m after two seconds, and its derivative through the steps.

    Args:
        start: heights, all at -1 m/s.
        timestep: [s].
        pulls: whether the force in contact may attract, as published; MuJoCo's may not.
    """
    q, v, over_q, over_v = start.copy(), -np.ones_like(start), np.ones_like(start), np.zeros_like(start)
    for _ in range(round(SECONDS / timestep)):
        force = -DAMPING * v - STIFFNESS * q
        touches = (q < 0) & (pulls | (force > 0))
        over_v = over_v + timestep * np.where(touches, -DAMPING * over_v - STIFFNESS * over_q, 0)
        v = v + timestep * np.where(touches, force, 0)
        q, over_q = q + timestep * v, over_q + timestep * over_v
    return np.abs(q - 1), np.sign(q - 1) * over_q


def tossed(geom: str, onset: str) -> study.Task:
    """Return the task of an object thrown to the floor: its final sideways position by the speed of the throw."""

    def start_at(start: study.State, parameters: jax.Array) -> study.State:
        qvel = start.qvel.at[1].set(DRIFT).at[2].set(parameters[0])
        return dataclasses.replace(start, qpos=start.qpos.at[2].set(HEIGHT), qvel=qvel)

    mjcf, cost = TOSSED.format(GEOMS[geom]), lambda state: state.qpos[1]
    task = task_of_start(geom, mjcf, HORIZON, start_at, SPEED, SIGMA, cost, ("thrown", "floor"))
    return task.replace(onset=onset)


def main() -> None:
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    print(markdown_table([], ("scene", "slope", "E[FoBG]", "with the linear term", "with shifts")))
    points = grid(START, START, SPREAD, 4000, "gaussian")
    for pulls, timestep in itertools.product((True, False), (0.1, 0.001)):
        found = means(points, *point(points, timestep, pulls=pulls), np.array([START]), SPREAD, "gaussian")
        what = "as published" if pulls else "without its pull"
        numbers = (_with_error(found.slope, found.slope_error), _with_error(found.first, found.first_error))
        print(markdown_row(f"point, {what}, h = {1e3 * timestep:g} ms", *numbers, "", ""))
    points = grid(SPEED, SPEED, SIGMA, POINTS, "gaussian")
    for geom in GEOMS:
        lines = [Line(tossed(geom, onset)) for onset in ("none", "linear", "shift")]
        for name, solimp in SOLIMP.items():
            contact = ContactModel(jnp.array(SOLREF), jnp.array(solimp))
            plain, *corrected = (
                means(points, *line(points, contact), np.array([SPEED]), SIGMA, "gaussian") for line in lines
            )
            numbers = [_with_error(plain.slope, plain.slope_error), _with_error(plain.first, plain.first_error)]
            numbers += [_with_error(each.first, each.first_error) for each in corrected]
            print(markdown_row(f"{geom}, solimp[0] = {name}", *numbers), flush=True)


def _with_error(value: np.ndarray, error: np.ndarray) -> str:
    return f"{value[0]:.3g} ± {error[0]:.1g}"


if __name__ == "__main__":
    main()
