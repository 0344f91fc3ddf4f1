"""Table of docs/onset-correction.md on derivatives over the model.

    python -m experiments.over_model

`momentum_transfer` at 0.5 rad, by quadrature over the launch angle; five minutes on one core, most of it compiling.
"""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from experiments import DOCS
from experiments.pages import write_tables
from mjx_study.experiment.quadrature import grid
from mjx_study.objective import rollout_cost
from mjx_study.runtime import configure
from mjx_study.simulation.contact import ContactModel, family_model
from mjx_study.simulation.dynamics import initial_state
from mjx_study.table import markdown_table, percent
from mjx_study.tasks import make_task
from mjx_study.tasks.momentum_transfer import SIGMA
from mjx_study.tasks.task import Task

ANGLE, POINTS = 0.5, 2000  # [rad]
REACHES: Final = {"ball's radius": 0.004, "bar's distance": 0.004, "sideways gravity": 0.05, "damping ratio": 0.02}
"""Parameters and the half-widths of their differences [m, m, m/s^2, share]."""


def cost(task: Task, default: ContactModel, onset: str, moving: Mapping[str, Any], angle: Any) -> Any:
    """Cost of the throw at an angle, with changes of the model's parameters."""
    model = task.scene.model
    model = model.replace(
        geom_size=model.geom_size.at[0, 0].add(moving["ball's radius"]),
        body_pos=model.body_pos.at[2, 0].add(moving["bar's distance"]),
        opt=model.opt.replace(gravity=model.opt.gravity.at[0].add(moving["sideways gravity"])),
    )
    contact = dataclasses.replace(default, solref=default.solref.at[1].multiply(1 + moving["damping ratio"]))
    changed = task.replace(scene=dataclasses.replace(task.scene, model=model))
    noise = jnp.zeros(task.policy.noise_shape)
    return rollout_cost(changed, angle[None], contact, initial_state(task.scene), noise, onset)[0]


def slopes() -> dict[str, np.ndarray]:
    """Slope of the mean cost over each parameter, by differences over the same angles: from all, and from half."""
    (throw, points), still = _throw(), dict.fromkeys(REACHES, 0.0)
    values = jax.jit(jax.vmap(partial(throw, "none"), (None, 0)))
    ends = {name: [values({**still, name: at}, points) for at in (reach, -reach)] for name, reach in REACHES.items()}
    return {name: _means((above - below) / (2 * REACHES[name])) for name, (above, below) in ends.items()}


def mean_gradients(onset: str) -> dict[str, np.ndarray]:
    """Mean of the derivative over each parameter, likewise."""
    throw, points = _throw()
    gradient = jax.jit(jax.vmap(jax.grad(partial(throw, onset)), (None, 0)))
    return {name: _means(each) for name, each in gradient(dict.fromkeys(REACHES, 0.0), points).items()}


def _throw() -> tuple[Any, np.ndarray]:
    """The cost as a function of (onset, moving, angle), and the angles."""
    task = make_task("momentum_transfer")
    default = family_model("mujoco_default", task.scene, effective_mass=task.effective_mass)
    return partial(cost, task, default), grid(ANGLE, ANGLE, SIGMA, POINTS, "gaussian")


def _means(samples: Any) -> np.ndarray:
    """Means over Gaussian noise, from all points and from every second one."""
    weights = np.exp(-(((grid(ANGLE, ANGLE, SIGMA, POINTS, "gaussian") - ANGLE) / SIGMA) ** 2) / 2)
    return np.array([np.average(np.asarray(samples)[::step], weights=weights[::step]) for step in (1, 2)])


def main() -> None:
    """Write the table."""
    configure(cpu_devices=1)
    found = {"slope": slopes()} | {onset: mean_gradients(onset) for onset in ("none", "linear", "shift")}
    rows = []
    for name in REACHES:
        every = [means[name] for means in found.values()]
        (slope, _), *terms = every[0], every[2][0], every[3][0]
        cells = [f"{fine:.4f} ± {abs(fine - coarse):.1g}" for fine, coarse in every]
        rows.append([name, *cells, ", ".join(percent(abs(each / slope - 1), 2) for each in terms)])
    header = ("parameter", "slope", "E[FoBG]", "linear", "shift", "linear, shift: off by")
    write_tables(DOCS / "onset-correction.md", {"model": markdown_table(rows, header)})


if __name__ == "__main__":
    main()
