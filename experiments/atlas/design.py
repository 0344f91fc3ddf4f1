"""The design of the atlas: which tasks, timesteps, contact models, noises and thetas its cells have.

The contact models, sigmas and thetas of each family are a scrambled Sobol sequence, so any prefix covers them evenly: a
run that ends early gives a coarser atlas, not a partial one.
"""

import dataclasses
import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from scipy.stats import qmc

from mjx_study.simulation.contact import ContactModel
from mjx_study.simulation.dynamics import initial_state
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import family_grid
from mjx_study.tasks.task import Task

FAMILIES: Final = ("penalty", "impedance", "mujoco", "mujoco_stiff", "smooth_onset")
UNDAMPED: Final = ("penalty", "impedance")
"""Families that keep the task's damping; the others' damping ratio varies."""
POINTS: Final = 128
"""Number of cells of each family at each task and timestep."""
DAMPRATIO: Final = (0.1, 2.0)
WIDTH: Final = (3e-4, 3e-2)
"""Depths over which the impedance of `smooth_onset` rises [m]."""
NOISE: Final = (0.1, 3.0)
"""Factors on the task's sigma."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """Ranges of a task.

    Attributes:
        timesteps: timesteps [s].
        stiffness: least and largest stiffness [N/m].
        theta: least and largest t, of theta = t direction.
        cost: rough computing time of one step of a cell, all samples together [s]; it orders and splits jobs.
    """

    timesteps: tuple[float, ...]
    stiffness: tuple[float, float]
    theta: tuple[float, float]
    cost: float


TASKS: Final = {
    "momentum_transfer": Setting((0.001, 0.002, 0.004), (500.0, 3e5), (0.05, 0.8), 1e-3),
    "ball_wall": Setting((0.001, 0.002, 0.004), (500.0, 3e5), (0.1, 1.3), 1e-3),
    "pusher": Setting((0.0025, 0.005, 0.01), (10.0, 1e4), (0.02, 0.4), 6e-4),
    "pusher_apart": Setting((0.0025, 0.005, 0.01), (10.0, 1e4), (0.1, 0.6), 6e-4),
    "sliding_box": Setting((0.005, 0.01), (20.0, 5e3), (0.0, 0.4), 1.5e-3),
    "tennis": Setting((0.005, 0.01), (200.0, 5e4), (0.0, 0.3), 3e-3),
}
"""`pusher_apart` is the pusher whose bodies start 10 cm apart, so that they meet."""
GAP: Final = 0.1
"""Gap of `pusher_apart` at the start [m]."""
PROGRAMS: Final = tuple((name, timestep) for name, setting in TASKS.items() for timestep in setting.timesteps)
CELLS: Final = len(PROGRAMS) * POINTS * len(FAMILIES)
COLUMNS: Final = ("program", "family", "stiffness", "dampratio", "width", "sigma", "theta")


@dataclasses.dataclass(frozen=True)
class Cell:
    """One cell; `index` is unique and gives its random numbers.

    Attributes:
        program: index into `PROGRAMS`.
        family: index into `FAMILIES`.
        stiffness: [N/m].
        dampratio: of the contact; NaN for the task's own damping.
        width: of the impedance's rise [m].
        sigma: standard deviation of the noise.
        theta: t, of theta = t direction.
    """

    index: int
    program: int
    family: int
    stiffness: float
    dampratio: float
    width: float
    sigma: float
    theta: float


def cells_of(program: int) -> Iterator[Cell]:
    """Yield the cells of a task and timestep, cycling through the families."""
    name, timestep = PROGRAMS[program]
    setting, sigma, own = TASKS[name], task_of(name, timestep).sigma, 0.001
    ranges = [setting.stiffness, DAMPRATIO, WIDTH, [factor * sigma for factor in NOISE]]
    low, high = np.log(ranges).T
    drawn = [
        qmc.Sobol(5, rng=program * len(FAMILIES) + family).random_base2(round(math.log2(POINTS)))
        for family in range(len(FAMILIES))
    ]
    for point in range(POINTS):
        for family, label in enumerate(FAMILIES):
            *unit, along = drawn[family][point]
            stiffness, dampratio, width, noise = np.exp(low + (high - low) * unit)
            yield Cell(
                (program * POINTS + point) * len(FAMILIES) + family,
                program,
                family,
                stiffness,
                math.nan if label in UNDAMPED else dampratio,
                width if label == "smooth_onset" else own,
                noise,
                setting.theta[0] + (setting.theta[1] - setting.theta[0]) * along,
            )


def task_of(name: str, timestep: float) -> Task:
    """Return a task at another timestep, with its duration kept."""
    base = make_task(name.removesuffix("_apart"))
    steps = round(base.horizon * base.scene.timestep / timestep)
    task = make_task(name.removesuffix("_apart"), timestep=timestep, horizon=steps)
    if name.endswith("_apart"):
        qpos = task.start.qpos.at[0].add(-GAP)
        task = task.replace(name=name, start=initial_state(task.scene, qpos))
    return task


def contact_of(task: Task, cell: Cell) -> ContactModel:
    """Return the contact model of a cell."""
    damping = None
    if not math.isnan(cell.dampratio):
        damping = 2 * cell.dampratio * math.sqrt(cell.stiffness * task.effective_mass)
    (point,), _ = family_grid(task, [FAMILIES[cell.family]], [cell.stiffness], damping)
    assert point.contact is not None
    return dataclasses.replace(point.contact, solimp=point.contact.solimp.at[2].set(cell.width))
