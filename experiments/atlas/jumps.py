"""Why means are off under laws whose force does not jump: quadrature of cells in which theta is one launch angle.

The slope of the mean cost is an integral over the angle, so it can be told where in angle it comes from. What the mean
of first-order gradients lacks must lie where the cost changes but its derivative does not show it.
"""

import itertools
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.ndimage import median_filter

from estimators import NOISES
from experiments import DATA, append_line, read_lines
from experiments.atlas.design import LAWS, PROGRAMS, Cell, contact_of, law_cells, task_of
from experiments.atlas.run import RESULTS
from experiments.atlas.table import LAUNCHED, TOLERANCE, Table, bodies_meet, read
from mjx_study.experiment.quadrature import Line, grid, means
from mjx_study.objective.cost import simulate
from mjx_study.simulation.contact import ContactModel
from mjx_study.tasks.task import Task

JUMPS: Final = DATA / "atlas_jumps.jsonl"
POINTS: Final = 16_000
WORST, PARTS, AROUND = 64, 4, 7
"""Intervals of the grid that are searched for jumps, those across which the cost changes most unlike as across the
median one around; and parts into which each is split in one call."""
STEEP, NARROW = 1e-6, 1e-9  # widths of what counts as steep and as a jump [rad]
APART: Final = 1e-6  # distance from which paths have parted [m, rad]
Intervals = tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]
"""Both ends [rad], and the costs there."""


def judged(laws: Table) -> Table:
    """Return the decided cells of one launch angle where bodies meet, in the order of their programs."""
    kept = laws[bodies_meet(laws) & laws.task.isin(LAUNCHED) & laws.fobg_off.notna()]
    kept = kept[(kept.fobg_off == 1) | (kept.task == "ball_wall")]
    return kept.sort_values(["program", "contact", "smoothing", "index"])


def searched(line: Line, contact: ContactModel, found: Intervals, width: float) -> Intervals:
    """Split intervals until they are no wider than this, and keep the part across which the cost changes most."""
    angles, costs = found
    rows = np.arange(len(angles))[:, None]
    while np.max(np.diff(angles)) > width:
        inner = np.linspace(angles[:, 0], angles[:, 1], PARTS + 1, axis=1)
        between = line(inner[:, 1:-1].ravel(), contact)[0].reshape(len(angles), PARTS - 1)
        costs = np.column_stack([costs[:, 0], between, costs[:, 1]])
        kept = np.argmax(np.abs(np.diff(costs)), axis=1)[:, None] + np.arange(2)
        angles, costs = inner[rows, kept], costs[rows, kept]
    return angles, costs


def faces(task: Task, contact: ContactModel, angles: Float[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """Roll out without noise; return every path, and at each state the face of the box that is nearest to the centre of
    the ball inside it, by index; -1 while the centre is outside."""
    assert task.contact_pair is not None
    ball, box = (mujoco.mj_name2id(task.scene.host, mujoco.mjtObj.mjOBJ_GEOM, name) for name in task.contact_pair)
    roll = jax.vmap(
        lambda angle, contact: simulate(task, angle[None], contact, jax.random.key(0), 0.0)[0].qpos, (0, None)
    )
    paths, data = np.asarray(jax.jit(roll)(jnp.asarray(angles), contact)), mujoco.MjData(task.scene.host)
    nearest = np.full(paths.shape[:2], -1)
    for at in np.ndindex(nearest.shape):
        data.qpos[:] = paths[at]
        mujoco.mj_kinematics(task.scene.host, data)
        centre = data.geom_xmat[box].reshape(3, 3).T @ (data.geom_xpos[ball] - data.geom_xpos[box])
        depth = task.scene.host.geom_size[box] - np.abs(centre)
        if depth.min() > 0:
            axis = int(depth.argmin())
            nearest[at] = 2 * axis + (centre[axis] > 0)
    return paths, nearest


def switches(task: Task, contact: ContactModel, at: float) -> bool:
    """Whether the paths at both sides of a jump part because the face that pushes the ball out is another one."""
    paths, nearest = faces(task, contact, np.array([at, at + 2 * NARROW]))
    unlike = (nearest[0] != nearest[1]) & (nearest.min(axis=0) >= 0)
    apart = np.abs(paths[0] - paths[1]).max(axis=1) > APART
    return bool(unlike.any() and (not apart.any() or unlike.argmax() <= apart.argmax()))


def measured(task: Task, line: Line, cell: Cell, contact: ContactModel) -> dict[str, Any]:
    """Slope of a cell's mean cost, mean of its derivative, and the part of the slope that jumps make up.

    Returns:
        `slope`, `first`, their errors of quadrature; `steep` and `jumps`, the parts of the slope within `STEEP` and
        `NARROW`; of the largest jump its part, the angle `at` [rad], the costs at both sides, and
        if it is large whether the contact's face `switches`.
    """
    points = grid(cell.theta, cell.theta, cell.sigma, POINTS, task.noise)
    values, slopes = line(points, contact)
    found = means(points, values, slopes, np.array([cell.theta]), cell.sigma, task.noise)
    density = NOISES[task.noise].density((points - cell.theta) / cell.sigma)
    density /= density.sum() * (points[1] - points[0])
    change = np.diff(values)
    unlike = np.abs(change - median_filter(change, AROUND)) * density[1:]
    at = np.argsort(-unlike)[:WORST, None] + np.arange(2)
    steep = searched(line, contact, (points[at], values[at]), STEEP)
    jumps = searched(line, contact, steep, NARROW)
    parts = [np.diff(costs)[:, 0] * np.interp(angles[:, 0], points, density) for angles, costs in (steep, jumps)]
    largest = int(np.argmax(np.abs(parts[1])))
    before, after = jumps[1][largest]
    saved = {name: float(getattr(found, name)[0]) for name in ("slope", "slope_error", "first", "first_error")}
    saved |= {"steep": parts[0].sum(), "jumps": parts[1].sum(), "largest": parts[1][largest]}
    saved |= {"at": jumps[0][largest, 0], "before": before, "after": after}
    large = abs(saved["largest"]) > TOLERANCE * abs(saved["slope"])
    return {"index": cell.index} | saved | {"switches": switches(task, contact, saved["at"]) if large else None}


def measure_jumps(into: Path = JUMPS) -> None:
    """Measure the cells that a file lacks."""
    done = {each["index"] for each in read_lines(into)}
    wanted = [row for _, row in judged(read(RESULTS, laws=True)).iterrows() if int(row["index"]) not in done]
    for program, rows in itertools.groupby(wanted, lambda row: int(row.program)):
        task = task_of(*PROGRAMS[program])
        line, cells = Line(task), {cell.index: cell for law in LAWS for cell in law_cells(program, law)}
        for row in rows:
            cell = cells[int(row["index"])]
            found = measured(task, line, cell, contact_of(task, cell))
            append_line(into, found)
            print(found, flush=True)


def results(laws: Table, path: Path = JUMPS) -> Table:
    """Return the measured cells of a table with what quadrature says: `verdict`, 1 where the mean is off, 0 where it is
    right, NaN where the errors allow either; and whether one jump is `large`, beyond the tolerance alone."""
    table = laws.drop(columns="slope").merge(pd.DataFrame(read_lines(path)), on="index")
    slope = table.slope.abs()
    bias, error = (table["first"] - table.slope).abs(), table.first_error + table.slope_error
    verdict = np.where(bias + error <= TOLERANCE * slope, 0.0, np.nan)
    table["verdict"] = np.where(bias - error > TOLERANCE * slope, 1.0, verdict)
    table["large"] = table.largest.abs() > TOLERANCE * slope
    table["unexplained"] = (table["first"] + table.jumps - table.slope).abs() / slope
    return table
