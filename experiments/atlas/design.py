"""The design of the atlas: which tasks, timesteps, contact models, noises and thetas its cells have.

The contact models, sigmas and thetas of each family are a scrambled Sobol sequence, so any prefix covers them evenly: a
run that ends early gives a coarser atlas, not a partial one. Contact laws other than MuJoCo's are a second block, whose
cells follow those of the first.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from scipy.stats import qmc

from mjx_study.choices import FAMILIES as CONTACTS
from mjx_study.choices import laws_of
from mjx_study.simulation.contact import ContactModel
from mjx_study.simulation.dynamics import initial_state
from mjx_study.tasks import task_with_options
from mjx_study.tasks.contact_grid import family_grid
from mjx_study.tasks.task import Task

FAMILIES: Final = ("penalty", "impedance", "mujoco", "mujoco_stiff", "smooth_onset")
UNDAMPED: Final = ("penalty", "impedance")  # families that keep the task's damping; the others' damping ratio varies
POINTS: Final = 128  # number of cells of each family at each task and timestep
DAMPRATIO: Final = (0.1, 2.0)
WIDTH: Final = (3e-4, 3e-2)  # depths over which the impedance of `smooth_onset` rises [m]
OWN_WIDTH: Final = 0.001  # that of the others [m]
NOISE: Final = (0.1, 3.0)  # factors on the task's sigma
LAWS: Final = tuple(laws_of(CONTACTS))
"""Families with a contact law other than MuJoCo's, which the extra `laws` has."""
SMOOTHING: Final = (0.01, 0.1, 1.0, 10.0)
"""Factors on a law's default smoothing; each has its own compiled programs."""


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
GAP: Final = 0.1  # gap of `pusher_apart` at the start [m]
PROGRAMS: Final = tuple((name, timestep) for name, setting in TASKS.items() for timestep in setting.timesteps)
CELLS: Final = len(PROGRAMS) * POINTS * len(FAMILIES)
"""Cells under MuJoCo's law; indices of the laws' cells start here."""
REFUSED: Final = frozenset(itertools.product(("ball_wall", "sliding_box"), ("log_barrier", "conic")))
"""Tasks with elliptic cones, which these laws do not have."""
COLUMNS: Final = ("program", "family", "stiffness", "dampratio", "width", "smoothing", "sigma", "theta")


@dataclasses.dataclass(frozen=True)
class Cell:
    """One cell; `index` is unique and gives its random numbers.

    Attributes:
        program: index into `PROGRAMS`.
        family: index into `FAMILIES + LAWS`.
        stiffness: [N/m]; NaN for a law without one.
        dampratio: of the contact; NaN for the task's own damping, or the law's.
        width: of the impedance's rise [m].
        smoothing: kappa of a law other than MuJoCo's [J]; NaN for MuJoCo's.
        sigma: standard deviation of the noise.
        theta: t, of theta = t direction.
    """

    index: int
    program: int
    family: int
    stiffness: float
    dampratio: float
    width: float
    smoothing: float
    sigma: float
    theta: float

    @property
    def contact(self) -> str:
        """Name of the contact family."""
        return (FAMILIES + LAWS)[self.family]


def drawn(program: int, seed: int) -> np.ndarray:
    """Points of a scrambled Sobol sequence (points, 6): stiffness, damping ratio, width, sigma and theta at a task and
    timestep, and the third in [0, 1) once more, for the smoothing of laws."""
    name, timestep = PROGRAMS[program]
    setting, sigma = TASKS[name], task_of(name, timestep).sigma
    low, high = np.log([setting.stiffness, DAMPRATIO, WIDTH, [factor * sigma for factor in NOISE]]).T
    unit = qmc.Sobol(5, rng=seed).random_base2(round(math.log2(POINTS)))
    along = setting.theta[0] + (setting.theta[1] - setting.theta[0]) * unit[:, 4]
    return np.column_stack([np.exp(low + (high - low) * unit[:, :4]), along, unit[:, 2]])


def cells_of(program: int) -> Iterator[Cell]:
    """Yield the cells of a task and timestep under MuJoCo's law, cycling through the families."""
    points = [drawn(program, program * len(FAMILIES) + family) for family in range(len(FAMILIES))]
    for point in range(POINTS):
        for family, label in enumerate(FAMILIES):
            stiffness, dampratio, width, noise, theta, _ = points[family][point]
            yield Cell(
                (program * POINTS + point) * len(FAMILIES) + family,
                program,
                family,
                stiffness,
                math.nan if label in UNDAMPED else dampratio,
                width if label == "smooth_onset" else OWN_WIDTH,
                math.nan,
                noise,
                theta,
            )


def law_cells(program: int, law: str) -> Iterator[Cell]:
    """Yield the cells of a task and timestep under another law than MuJoCo's."""
    at = program * len(LAWS) + LAWS.index(law)
    family = CONTACTS[law]
    points = drawn(program, len(PROGRAMS) * len(FAMILIES) + at)
    for point, (stiffness, dampratio, _, noise, theta, level) in enumerate(points):
        yield Cell(
            CELLS + at * POINTS + point,
            program,
            len(FAMILIES) + LAWS.index(law),
            stiffness if family.swept else math.nan,
            dampratio if family.swept and family.dampratio else math.nan,
            OWN_WIDTH,
            family.smoothing * SMOOTHING[int(level * len(SMOOTHING))],
            noise,
            theta,
        )


def task_of(name: str, timestep: float) -> Task:
    """Return a task at another timestep, with its duration kept."""
    task = task_with_options(name.removesuffix("_apart"), {"timestep": timestep})
    if name.endswith("_apart"):
        qpos = task.start.qpos.at[0].add(-GAP)
        task = task.replace(name=name, start=initial_state(task.scene, qpos))
    return task


def contact_of(task: Task, cell: Cell) -> ContactModel:
    """Return the contact model of a cell."""
    damping, law = None, cell.contact in LAWS
    if not math.isnan(cell.dampratio):
        damping = 2 * cell.dampratio * math.sqrt(cell.stiffness * task.effective_mass)
    (point,), _ = family_grid(task, [cell.contact], [cell.stiffness], damping, cell.smoothing if law else None)
    assert point.contact is not None
    if law:
        return point.contact
    return dataclasses.replace(point.contact, solimp=point.contact.solimp.at[2].set(cell.width))
