"""Draws docs/tasks.png, docs/physics.png and docs/onset-correction.png: the tasks as MJX simulates them, what is known
of each without MJX, and first-order gradients with and without the onset term.

    python -m experiments.figures             all of them
    python -m experiments.figures physics     one of them: tasks, physics or onset-correction

It takes a minute or two, most of it to compile; compiled programs are kept between runs.
"""

import copy
import math
import sys
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.transforms import Affine2D

from experiments.pages import DOCS, DPI, save_figure
from mjx_study.experiment.quadrature import Line, grid, means
from mjx_study.objective import rollout_cost
from mjx_study.reference import (
    BallWall,
    DoublePendulum,
    MomentumTransfer,
    Pusher,
    SlidingBox,
    Tennis,
    draw_start,
    roll_out,
)
from mjx_study.render import VIEWS, Motion
from mjx_study.render.drawing import PALETTE, Drawing
from mjx_study.runtime import configure
from mjx_study.simulation.contact import ContactModel, contact_model, solref_from_stiffness
from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import family_grid
from mjx_study.tasks.task import Task

BLUE, ORANGE, GREEN, PINK, SKY, YELLOW = PALETTE
GREY, INK, WALL = "0.45", "0.2", "#B4B4B4"
TARGET = (0.0, 2.5)  # of tennis [m]
CRITICAL = math.exp(-2)  # restitution of a critically damped spring that lets go when its force ends
SLOW = 10.0  # tennis: a second of MJX is ten of the paper's and the reference's


# Simulation


class Runs(NamedTuple):
    """A batch of rollouts without noise; axes (rollout, time, coordinate)."""

    qpos: Any
    qvel: Any
    cost: Any


@cache
def task_of(name: str, **options: float) -> Task:
    """A task; one object for each set of options, so that each is compiled once."""
    return make_task(name, **options)


@cache
def program(task: Task) -> Callable[..., Runs]:
    """Compiled rollouts of a batch of (theta, start); the contact model is an argument too."""

    def one(theta, start, contact):
        cost, (states, *_) = rollout_cost(task, theta, contact, start, jnp.zeros(task.policy.noise_shape))
        return Runs(states.qpos, states.qvel, cost)

    return jax.jit(jax.vmap(one, in_axes=(0, 0, None)), compiler_options={"xla_backend_optimization_level": "0"})


def run(task: Task, thetas: np.ndarray, contact: ContactModel | None, starts: State | None = None) -> Runs:
    """Roll out a batch of thetas; from the task's start unless starts are given."""
    if starts is None:
        assert isinstance(task.start, State)
        starts = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(thetas), *leaf.shape)), task.start)
    return jax.device_get(program(task)(jnp.asarray(thetas, float), starts, contact))


def contact_of(task: Task, family: str, stiffness: float) -> ContactModel:
    """A contact model as `mjx-study compare` makes it."""
    ((cell,), _) = family_grid(task, [family], [stiffness])
    assert cell.contact is not None
    return cell.contact


def tennis_starts(task: Task, slow: np.ndarray) -> State:
    """Start states of MJX from (ball x, y, vx, vy, paddle x, y, angle), velocities in slow time."""

    def one(drawn):
        qvel = jnp.concatenate([SLOW * drawn[2:4], jnp.zeros(3)])
        return initial_state(task.scene, jnp.concatenate([drawn[:2], drawn[4:]]), qvel)

    return jax.vmap(one)(jnp.asarray(slow))


def returning_gains() -> np.ndarray:
    """A policy by hand: the paddle runs after the ball and turns a little."""
    gains = np.zeros((3, 7))
    gains[0, 0], gains[0, 4], gains[2, 0] = 1.5, -1.5, 0.05
    return gains


# Pictures of the tasks


class Panel(NamedTuple):
    """A picture of the gallery.

    Attributes:
        title, subtitle: the task's name, and what is decided.
        low, high: corners of what is shown [m].
        bar: length of the scale bar [m].
        draw: draws onto axes with these limits.
    """

    title: str
    subtitle: str
    low: tuple[float, float]
    high: tuple[float, float]
    bar: float
    draw: Callable[[Axes], None]

    @property
    def ratio(self) -> float:
        """Width over height."""
        return (self.high[0] - self.low[0]) / (self.high[1] - self.low[1])


def drawing_of(task: Task, qpos: np.ndarray, view: str, colours: dict[str | int, str] | None = None) -> Drawing:
    """A drawing of one rollout, some geoms in another colour than the MJCF's."""
    model = copy.copy(task.scene.host)
    for geom, colour in (colours or {}).items():
        model.geom(geom).rgba[:3] = to_rgb(colour)
    return Drawing(Motion(model, np.arange(len(qpos)) * task.scene.timestep, np.asarray(qpos, float)), VIEWS[view])


def strobe(axes: Axes, drawing: Drawing, steps: Sequence[int], *, faintest: float = 0.25) -> None:
    """The path, and poses at some steps, the earlier the fainter."""
    drawing.trace(axes, slice(steps[0], steps[-1] + 1))
    for rank, step in enumerate(steps):
        drawing.pose(axes, step, faintest + (1 - faintest) * ((rank + 1) / len(steps)) ** 1.5)


def note(axes: Axes, x: float, y: float, text: str, colour: str = INK, **options) -> None:
    """Text; a colour is darkened until it can be read."""
    shade = tuple(0.8 * part for part in to_rgb(colour))
    axes.text(x, y, text, color=shade, fontsize=8.5, **{"ha": "center", "va": "center", "zorder": 6} | options)


def pusher_panel() -> Panel:
    task = task_of("pusher")
    forces = np.where(np.arange(200) < 50, 2.0, -0.8)
    qpos = run(task, forces[None], contact_of(task, "mujoco", 550.0)).qpos[0]
    rows = ((0, "at rest"), (40, "pushed"), (140, "apart"))

    def draw(axes: Axes) -> None:
        drawing = drawing_of(task, qpos, "xz", {"pusher": ORANGE, "slider": BLUE})
        for row, (step, text) in enumerate(rows):
            down = -1.16 * row
            for added in drawing.pose(axes, step):
                added.set_transform(Affine2D().translate(0, down) + axes.transData)
            note(axes, -0.68, down, f"{step * task.scene.timestep:g} s\n{text}", ha="right")
            middle, force = qpos[step, 0], 0.2 * forces[step]
            arrow = {"arrowstyle": "-|>", "color": "white", "linewidth": 1.8, "mutation_scale": 13}
            ends = (middle - force / 2, down), (middle + force / 2, down)
            axes.annotate("", ends[1], ends[0], arrowprops=arrow | {"shrinkA": 0, "shrinkB": 0}, zorder=6)

    return Panel("pusher", "200 forces", (-1.5, -3.15), (2.6, 0.62), 0.5, draw)


def sliding_box_panel() -> Panel:
    task = task_of("sliding_box")
    qpos = run(task, np.full((1, 400), 0.6), contact_of(task, "mujoco", 500.0)).qpos[0]
    landed = int(np.argmax(qpos[:, 1] < -0.1))  # the floor is only drawn; there the picture ends
    steps = np.linspace(0, landed, 7).round().astype(int).tolist()

    def draw(axes: Axes) -> None:
        drawing = drawing_of(task, qpos, "xz")
        drawing.scenery(axes)
        strobe(axes, drawing, steps, faintest=0.3)
        note(axes, 0.03, 0.105, "too hard a push: the block slips forward and drags the box along ...", ha="left")
        note(axes, 0.495, 0.055, "... until it falls\noff the edge", ha="right")

    return Panel("sliding_box", "400 forces on the block", (-0.13, -0.12), (0.51, 0.13), 0.1, draw)


def thrown_panel(variant: str, throws: Sequence[tuple[float, str, float]], labels, **corners) -> Panel:
    """Several throws: (angle, colour, seconds)."""
    task = task_of("ball_wall" if variant == "box" else f"ball_wall:{variant}")
    runs = run(task, np.array([[angle] for angle, *_ in throws]), contact_of(task, "mujoco", 10000.0))

    def draw(axes: Axes) -> None:
        for rank, (_, colour, seconds) in enumerate(throws):
            drawing = drawing_of(task, runs.qpos[rank], "xz", {"ball": colour, "wall": WALL, "dome": WALL})
            if rank == 0:
                drawing.scenery(axes)
            last = round(seconds / task.scene.timestep)
            strobe(axes, drawing, list(range(last % 20, last + 1, 20)), faintest=0.35)
        for x, y, text, colour in labels:
            note(axes, x, y, text, colour)

    return Panel(task.name, "launch angle", bar=0.1, draw=draw, **corners)


def momentum_panel() -> Panel:
    task = task_of("momentum_transfer")
    shots = ((0.25, GREEN, 300), (0.6, ORANGE, 330), (0.87, PINK, 300))
    runs = run(task, np.array([[angle] for angle, *_ in shots]), contact_of(task, "penalty", 10000.0))

    def draw(axes: Axes) -> None:
        for rank, (_, colour, last) in enumerate(shots):
            qpos = runs.qpos[rank].copy()
            if colour != ORANGE:
                qpos[:, 2] = 0  # the bar is seen turning after one of the hits only
            drawing = drawing_of(task, qpos, "xy", {"ball": colour})
            if rank == 0:
                drawing.scenery(axes)
            strobe(axes, drawing, list(range(0, last + 1, 30)), faintest=0.3)
        note(axes, 0.8, 0.86, "misses", PINK, ha="left")
        note(axes, 0.86, 0.48, "long lever", ORANGE, ha="left")
        note(axes, 0.86, 0.17, "short lever", GREEN, ha="left")

    return Panel("momentum_transfer", "launch angle", (-0.1, -0.09), (1.12, 0.97), 0.1, draw)


def tennis_panel() -> Panel:
    task = task_of("tennis")
    gains = returning_gains()
    gains[2, 0], gains[2, 2] = 0.0, 0.325
    start = np.array([[-1.2, 2.0, 0.45, -0.5, -0.75, 0.0, 0.0]])
    thetas = np.stack([gains.ravel(), np.zeros(21)])
    runs = run(task, thetas, contact_of(task, "penalty", 10000.0), tennis_starts(task, start.repeat(2, axis=0)))

    def draw(axes: Axes) -> None:
        strobe(axes, drawing_of(task, runs.qpos[0], "xy"), list(range(0, 201, 25)), faintest=0.2)
        still = drawing_of(task, runs.qpos[1], "xy", {"ball": WALL, "paddle": WALL})
        strobe(axes, still, [85, 105], faintest=0.5)
        axes.plot(*TARGET, marker="x", color=INK, markersize=7, markeredgewidth=1.4, zorder=6)
        note(axes, TARGET[0] - 0.18, TARGET[1], "target", ha="right")
        note(axes, -1.9, 0.42, "a paddle at rest\nmisses the ball", GREY, ha="left")

    return Panel("tennis", "3 x 7 feedback gains", (-2.0, -1.0), (2.1, 2.95), 0.5, draw)


def robot_panel(name: str, seed: int, view: str, shown: Sequence[tuple[int, str]], apart: float, **corners) -> Panel:
    """One sample's rollout without noise, by the policy that a descent starts from: (step, text), side by side."""
    task = task_of(name)
    assert callable(task.start)
    start = jax.tree.map(lambda leaf: leaf[None], task.start(jax.random.key(seed)))
    qpos = run(
        task, np.asarray(task.theta)[None], contact_of(task, "mujoco", task.defaults.middle_stiffness), start
    ).qpos[0]

    def draw(axes: Axes) -> None:
        drawing = drawing_of(task, qpos, view)
        drawing.scenery(axes)
        for place, (step, text) in enumerate(shown):
            for added in drawing.pose(axes, step):
                added.set_transform(Affine2D().translate(place * apart, 0) + axes.transData)
            note(
                axes,
                place * apart,
                corners["high"][1] - 0.04 * apart,
                f"{step * task.scene.timestep:g} s: {text}",
                va="top",
            )

    return Panel(name, f"neural network, {task.policy.num_params} weights", bar=0.1, draw=draw, **corners)


def pendulum_panel() -> Panel:
    task = task_of("double_pendulum", horizon=4000)
    starts = np.asarray(task.theta) + np.array([[0.0, 0, 0, 0], [0.01, 0, 0, 0]])
    runs = run(task, starts, None)
    last = 2600

    def draw(axes: Axes) -> None:
        for qpos, colour in zip(runs.qpos, (BLUE, ORANGE), strict=True):
            drawing = drawing_of(task, qpos, "xz", dict.fromkeys(range(task.scene.host.ngeom), colour))
            tip = drawing.motion.poses.centre[:, 2][:, [0, 2]]
            axes.plot(*tip[: last + 1].T, color=colour, linewidth=1.1, zorder=2.5)
            drawing.pose(axes, 0, 0.25)
            drawing.pose(axes, last)
        axes.plot(0, 0, marker="o", color=INK, markersize=5, zorder=6)

        note(axes, 1.58, -0.3, "0.01 rad apart")
        note(axes, 1.0, 1.62, f"{last * task.scene.timestep:g} s later", ha="center")

    return Panel("double_pendulum", "the start", (-1.75, -1.75), (2.2, 1.85), 0.5, draw)


def tasks_figure() -> Figure:
    """One panel for each task, in rows that fill the page."""
    throws = [(0.25, GREEN, 0.2), (0.5, ORANGE, 0.46), (0.72, PINK, 0.4), (0.9, BLUE, 0.52)]
    meets = [(0.57, GREEN, 0.42), (0.65, ORANGE, 0.4), (0.7, PINK, 0.4), (0.75, BLUE, 0.5)]
    ends = [
        (0.305, 0.024, "short", GREEN),
        (0.42, 0.1, "at the wall", ORANGE),
        (0.48, 0.19, "on top", PINK),
        (0.52, 0.285, "over", BLUE),
    ]
    turns = [(0.625, 0.345, "the higher it meets the round top,\nthe less it is thrown back", INK)]
    knocks = ((0, "apart"), (10, "hit"), (99, "let go"))
    lands = ((0, "falling"), (45, "landed"), (119, "at rest"))
    rows = [
        [pusher_panel(), sliding_box_panel()],
        [
            thrown_panel("box", throws, ends, low=(-0.06, -0.05), high=(1.1, 0.4)),
            thrown_panel("dome", meets, turns, low=(0.3, -0.05), high=(0.95, 0.4)),
        ],
        [momentum_panel(), tennis_panel(), pendulum_panel()],
        [
            robot_panel("gripper", 0, "xy", knocks, 0.2, low=(-0.1, -0.03), high=(0.5, 0.3)),
            robot_panel("landing", 0, "xz", lands, 0.7, low=(-0.4, -0.05), high=(1.8, 0.65)),
        ],
    ]
    width, gap, title, margin = 10.0, 0.16, 0.36, 0.06
    heights = [(width - 2 * margin - gap * (len(row) - 1)) / sum(panel.ratio for panel in row) for row in rows]
    total = sum(heights) + title * len(rows) + margin
    figure = Figure(figsize=(width, total), dpi=DPI)
    FigureCanvasAgg(figure)
    top = total
    for row, height in zip(rows, heights, strict=True):
        left = margin
        for panel in row:
            size = panel.ratio * height
            axes = figure.add_axes((left / width, (top - title - height) / total, size / width, height / total))
            panel.draw(axes)
            axes.set(xlim=(panel.low[0], panel.high[0]), ylim=(panel.low[1], panel.high[1]), xticks=[], yticks=[])
            axes.set_aspect("equal")
            for spine in axes.spines.values():
                spine.set(color="0.75", linewidth=0.6, visible=True)
            _scale_bar(axes, panel)
            x, y = left / width, (top - title + 0.07) / total
            name = figure.text(x, y, panel.title, fontsize=11, fontweight="bold", color="black")
            end = name.get_window_extent(figure.canvas.get_renderer()).x1 / (width * figure.dpi)  # type: ignore[attr-defined]
            figure.text(end, y, f":  {panel.subtitle}", fontsize=10, color=INK)
            left += size + gap
        top -= title + height
    return figure


def _scale_bar(axes: Axes, panel: Panel) -> None:
    """A length in metres, in the lower right corner."""
    span = panel.high[1] - panel.low[1]
    x, y = panel.high[0] - 0.04 * span, panel.low[1] + 0.055 * span
    axes.plot([x - panel.bar, x], [y, y], color=INK, linewidth=1.5, solid_capstyle="butt", zorder=7)
    note(axes, x - panel.bar - 0.03 * span, y, f"{panel.bar:g} m", ha="right")


# Physics against closed forms


def closed_form(axes: Axes, x, y, colour: str = INK, label: str | None = None) -> None:
    axes.plot(x, y, color=colour, linewidth=1.3, label=label, zorder=2)


def simulated(axes: Axes, x, y, colour: str, marker: str = "o", label: str | None = None, size: float = 3.6) -> None:
    axes.plot(x, y, linestyle="none", marker=marker, markersize=size, color=colour, label=label, zorder=3)


def pusher_force(axes: Axes) -> None:
    task = task_of("pusher")
    forces = np.full(200, 0.1)
    time = np.arange(201) * task.scene.timestep
    for stiffness, colour in ((10.0, GREEN), (100.0, BLUE), (1000.0, ORANGE)):
        qpos = run(task, forces[None], contact_of(task, "penalty", stiffness)).qpos[0]
        exact = roll_out(Pusher(stiffness), np.array([0.0, 1.0, 0.0, 0.0]), forces[:, None]).states
        force, found = (stiffness * np.maximum(0, 1 - (x[:, 1] - x[:, 0])) for x in (exact, qpos))
        shown = slice(0, 81)
        closed_form(axes, time[shown], force[shown], colour)
        simulated(axes, time[shown][::2], found[shown][::2], colour, label=f"{stiffness:g}", size=3)
    axes.set(title="pusher: force of the contact", xlabel="time [s]", ylabel="force [N]", ylim=(-0.005, 0.13))
    axes.legend(loc="upper center", ncols=3, title="K [N/m]")


def sliding_box_displacement(axes: Axes) -> None:
    task = task_of("sliding_box")
    forces = (0.1, 0.3, 0.6)
    thetas = np.tile(np.array(forces)[:, None], (1, 400))
    time = np.arange(401) * task.scene.timestep
    penalty, stiff = (run(task, thetas, contact_of(task, family, 500.0)) for family in ("penalty", "mujoco"))
    for rank, (force, colour) in enumerate(zip(forces, (GREEN, BLUE, ORANGE), strict=True)):
        exact = roll_out(SlidingBox(), np.zeros(4), thetas[rank][:, None]).states
        closed_form(axes, time, exact[:, 1], colour)
        simulated(axes, time[::20], penalty.qpos[rank, ::20, 2], colour, label=f"{force:g} N")
        simulated(axes, time[10::20], stiff.qpos[rank, 10::20, 2], colour, "+", size=5)
    simulated(axes, [], [], GREY, label="penalty")
    simulated(axes, [], [], GREY, "+", "mujoco", size=5)
    axes.set(title="sliding_box: displacement of the box", xlabel="time [s]", ylabel="displacement [m]")
    axes.legend(loc="upper left")


def landing(axes: Axes, name: str) -> None:
    task = task_of(name)
    fine, coarse = np.linspace(0, 1.5, 1501), np.linspace(0.01, 1.5, 150)
    axes.axhspan(0.62, 0.72, color="0.9", zorder=0)
    axes.text(0.03, 0.67, "wall", fontsize=8, color=GREY, va="center")
    closed_form(axes, fine, 10 * BallWall().landing(fine[:, None]))
    for stiffness, colour, marker in ((3000.0, SKY, "o"), (30000.0, ORANGE, "o")):
        qpos = run(task, coarse[:, None], contact_of(task, "mujoco", stiffness)).qpos
        simulated(axes, coarse, qpos[:, -1, 0], colour, marker, label=f"K = {stiffness:,.0f} N/m", size=2.4)
    axes.set(title=f"{name}: end of the flight", xlabel="launch angle [rad]", ylabel="distance [m]", ylim=(-0.05, 1.4))
    axes.legend(loc="upper right")


def transferred(axes: Axes) -> None:
    task = task_of("momentum_transfer")
    fine, coarse = np.linspace(0, 1, 1001), np.linspace(0.025, 1, 40)
    for family, restitution, colour, label in (
        ("penalty", 1.0, BLUE, "penalty, e = 1"),
        ("mujoco", CRITICAL, ORANGE, "mujoco, e = exp(-2)"),
    ):
        exact = MomentumTransfer(restitution=restitution, inertia_ratio=0.1).value(fine[:, None])
        closed_form(axes, fine, np.sqrt(-exact), colour)
        cost = run(task, coarse[:, None], contact_of(task, family, 10000.0)).cost
        simulated(axes, coarse, np.sqrt(-cost), colour, label=label, size=3)
    axes.plot(
        fine,
        np.where(fine <= math.pi / 4, np.sin(fine), 0),
        color=GREY,
        linewidth=1,
        linestyle=":",
        label="inelastic, rigid bar: sin(angle)",
    )
    axes.set(
        title="momentum_transfer: the bar",
        xlabel="launch angle [rad]",
        ylabel="angular momentum / (m v d)",
        ylim=(-0.06, 1.85),
    )
    axes.legend(loc="upper left")


def deflection(axes: Axes) -> None:
    task = task_of("tennis")
    fine, coarse = np.linspace(-1.2, 1.2, 481), np.linspace(-1.2, 1.2, 49)

    def starts(offset: np.ndarray, tilt: float) -> np.ndarray:
        drawn = np.zeros((len(offset), 7))
        drawn[:, 0], drawn[:, 1], drawn[:, 3], drawn[:, 6] = offset, 2.0, -0.4, tilt
        return drawn

    for tilt, colour in ((0.0, BLUE), (0.3, ORANGE)):
        still = np.zeros((len(fine), task.horizon, 3))
        end = roll_out(Tennis(), starts(fine, tilt), still, np.zeros((3, 7))).states[:, -1]
        closed_form(axes, fine, _direction(end[:, 2:4]), colour)
        qvel = run(
            task,
            np.zeros((len(coarse), 21)),
            contact_of(task, "penalty", 10000.0),
            tennis_starts(task, starts(coarse, tilt)),
        ).qvel[:, -1]
        simulated(axes, coarse, _direction(qvel), colour, label=f"tilt {tilt:g} rad", size=3)
    axes.set(
        title="tennis: direction after the bounce",
        xlabel="ball right of the paddle's middle [m]",
        ylabel="angle from straight up [deg]",
        yticks=(0, 45, 90, 135, 180),
    )
    axes.legend(loc="upper center")


def _direction(velocity: np.ndarray) -> np.ndarray:
    return np.degrees(np.abs(np.arctan2(velocity[:, 0], velocity[:, 1])))


def separation(axes: Axes) -> None:
    task = task_of("double_pendulum", horizon=4000)
    offsets = (0.0, 1e-8, 0.01)
    starts = np.asarray(task.theta) + np.array([[offset, 0, 0, 0] for offset in offsets])
    qpos = run(task, starts, None).qpos
    exact = roll_out(DoublePendulum(), starts[0], np.zeros((task.horizon, 0))).states[:, :2]
    time = np.arange(task.horizon + 1) * task.scene.timestep
    lines = [
        (np.linalg.norm(qpos[rank] - qpos[0], axis=1), colour, f"starts {offsets[rank]:g} rad apart")
        for rank, colour in ((2, ORANGE), (1, BLUE))
    ]
    lines.append((np.linalg.norm(qpos[0] - exact, axis=1), GREY, "MJX and reference"))
    for distance, colour, text in lines:
        axes.plot(time[1:], distance[1:], color=colour, linewidth=1.3)
        note(axes, 3.95, distance[-1] / 20, text, colour, ha="right", va="top")
    axes.set(title="double_pendulum: two rollouts", xlabel="time [s]", ylabel="distance [rad]")
    axes.set(yscale="log", ylim=(1e-16, 1e3))


def convergence(axes: Axes) -> None:
    for label, colour, marker, stiffnesses, errors in (thrown_errors(), shot_errors(), played_errors()):
        for step, (error, face) in enumerate(zip(errors, (colour, "none"), strict=True)):
            shown = label if step == 0 else None
            axes.plot(
                stiffnesses,
                error,
                color=colour,
                marker=marker,
                markersize=4,
                markerfacecolor=face,
                label=shown,
                linewidth=1.2 if step == 0 else 0,
            )
    axes.plot(
        [], [], color=GREY, marker="o", markersize=4, markerfacecolor="none", linewidth=0, label="the task's own step"
    )
    guide = np.array([4e3, 1e5])
    axes.plot(guide, 9 * guide**-0.5, color=GREY, linewidth=1, linestyle="--")
    axes.text(2.5e4, 9 * 2.5e4**-0.5, "1 / sqrt(K)", color=GREY, fontsize=8.5, va="bottom")
    axes.set(
        ylim=(1e-3, 0.4),
        title="error against stiffness",
        xlabel="stiffness K [N/m]",
        ylabel="relative error",
        xscale="log",
        yscale="log",
    )
    axes.legend(loc="lower left")


def thrown_errors():
    """Of where a ball lands that meets no wall."""
    angles = np.array([0.15, 0.2, 0.25, 0.85, 0.9, 0.95, 1.0])[:, None]
    exact = 10 * BallWall().landing(angles)
    stiffnesses = np.geomspace(1000, 100000, 7)
    errors = []
    for task in (task_of("ball_wall", timestep=0.001, horizon=800), task_of("ball_wall")):
        # Semi-implicit Euler lands one step early.
        flown = exact - task.scene.timestep * 10**0.5 * np.cos(angles[:, 0])
        found = [run(task, angles, contact_of(task, "mujoco", stiffness)).qpos[:, -1, 0] for stiffness in stiffnesses]
        errors.append([np.mean(np.abs(landed / flown - 1)) for landed in found])
    return "ball_wall: landing", BLUE, "o", stiffnesses, errors


def shot_errors():
    """Of the momentum that an elastic hit transfers."""
    angles = np.array([0.1, 0.3, 0.5, 0.7])[:, None]
    exact = np.sqrt(-MomentumTransfer(restitution=1.0, inertia_ratio=0.1).value(angles))
    stiffnesses = np.geomspace(2000, 100000, 7)
    errors = []
    for task in (task_of("momentum_transfer", timestep=0.0005, horizon=1400), task_of("momentum_transfer")):
        found = [np.sqrt(-run(task, angles, contact_of(task, "penalty", stiffness)).cost) for stiffness in stiffnesses]
        errors.append([np.mean(np.abs(momentum / exact - 1)) for momentum in found])
    return "momentum_transfer", ORANGE, "s", stiffnesses, errors


def played_errors():
    """Of the way from start to end of a ball that a policy returns; the median of 64."""
    drawn = np.asarray(jax.vmap(draw_start)(jax.random.split(jax.random.key(3), 64)))
    gains = returning_gains()
    stiffnesses = np.geomspace(500, 40000, 7)
    errors = []
    for split in (5, 1):
        task = task_of("tennis", timestep=0.005 / split, horizon=200 * split)
        exact = roll_out(
            Tennis(timestep=0.05 / split, damping=0.999 ** (1 / split)), drawn, np.zeros((64, task.horizon, 3)), gains
        ).states[:, -1, :2]
        way = np.linalg.norm(exact - drawn[:, :2], axis=1)
        row = []
        for stiffness in stiffnesses:
            thetas = np.tile(gains.ravel(), (64, 1))
            found = run(task, thetas, contact_of(task, "penalty", stiffness), tennis_starts(task, drawn)).qpos[
                :, -1, :2
            ]
            row.append(np.median(np.linalg.norm(found - exact, axis=1) / way))
        errors.append(row)
    return "tennis: end of the ball's flight", GREEN, "^", stiffnesses, errors


def impedance(axes: Axes) -> None:
    task = task_of("pusher")
    forces = np.full(200, 0.1)
    impedances = np.geomspace(1e-4, 1e-1, 7)
    for stiffness, colour, marker in ((10.0, GREEN, "o"), (100.0, BLUE, "s"), (1000.0, ORANGE, "^")):
        exact = roll_out(Pusher(stiffness), np.array([0.0, 1.0, 0.0, 0.0]), forces[:, None]).states[:, :2]
        solref = solref_from_stiffness(stiffness, 0.0, effective_mass=task.effective_mass)
        errors = []
        for d in impedances:
            contact = contact_model(solref, (d, d, 0.001, 0.5, 2.0), scene=task.scene)
            errors.append(np.abs(run(task, forces[None], contact).qpos[0] - exact).max())
        axes.plot(impedances, errors, color=colour, marker=marker, markersize=4, label=f"K = {stiffness:,.0f} N/m")
    guide = np.array([3e-3, 1e-1])
    axes.plot(guide, 1e-5 * guide, color=GREY, linewidth=1, linestyle="--")
    axes.text(0.1, 6e-8, "proportional to d", color=GREY, fontsize=8.5, ha="right", va="top")
    axes.set(
        title="pusher: error against impedance",
        xlabel="impedance d",
        ylabel="largest error [m]",
        xscale="log",
        yscale="log",
    )
    axes.legend(loc="upper left")


def physics_figure() -> Figure:
    figure = Figure(figsize=(10.4, 9.4), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(3, 3)
    drawers = (
        pusher_force,
        sliding_box_displacement,
        lambda axes: landing(axes, "ball_wall"),
        lambda axes: landing(axes, "ball_wall:dome"),
        transferred,
        deflection,
        separation,
        convergence,
        impedance,
    )
    for axes, draw in zip(panels.flat, drawers, strict=True):
        draw(axes)
        axes.set_title(axes.get_title(), fontsize=10.5, color="black")
        for label in (axes.xaxis.label, axes.yaxis.label):
            label.set_fontsize(9.5)
        axes.tick_params(labelsize=9)
        axes.grid(alpha=0.25)
        if (legend := axes.get_legend()) is not None:
            legend.set_frame_on(False)
            for text in (*legend.get_texts(), legend.get_title()):
                text.set_fontsize(8.5)
    return figure


# The onset term


def correction_figure() -> Figure:
    """momentum_transfer, MuJoCo's default contact: slope of the mean cost, and means of first-order gradients."""
    task = task_of("momentum_transfer")
    contact, position = contact_of(task, "mujoco_default", 1.0), np.linspace(0.05, 0.74, 47)
    points = grid(position[0], position[-1], task.sigma, 2000, task.noise)
    found = {
        onset: means(points, *Line(task.replace(onset=onset))(points, contact), position, task.sigma, task.noise)
        for onset in ("none", "linear", "jump")
    }
    figure = Figure(figsize=(9.0, 3.6), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    wide, near = figure.subplots(1, 2)
    for axes in (wide, near):
        axes.plot(position, found["none"].slope, color=INK, linewidth=4, alpha=0.35, label="slope of the mean cost")
        for onset, colour, label in (
            ("none", ORANGE, "mean of FoBG"),
            ("linear", BLUE, "mean of FoBG with the linear onset term"),
            ("jump", GREEN, "mean of FoBG with the jump"),
        ):
            axes.plot(position, found[onset].first, color=colour, linewidth=1.5, label=label)
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        axes.set_xlabel("launch angle [rad]")
        axes.grid(alpha=0.25)
    near.set_ylim(-1.05, 0.15)
    wide.set_ylabel("derivative by the launch angle [1/rad]")
    wide.set_title("momentum_transfer, MuJoCo's default contact", fontsize=10)
    wide.legend(frameon=False, fontsize=8.5)
    near.set_title("enlarged around the slope of the mean cost", fontsize=10)
    return figure


FIGURES = {"tasks": tasks_figure, "physics": physics_figure, "onset-correction": correction_figure}


def main(names: list[str]) -> None:
    if unknown := sorted(set(names) - set(FIGURES)):
        sys.exit(f"no figure {', '.join(unknown)}; there are {', '.join(FIGURES)}")
    configure(cpu_devices=1)
    for name in names or list(FIGURES):
        path = DOCS / f"{name}.png"
        save_figure(FIGURES[name](), path)
        print(f"written: {path}, {path.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
