"""docs/tasks.png: the tasks as MJX simulates them."""

import copy
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.transforms import Affine2D

from experiments.figures.rollouts import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PINK,
    TARGET,
    WALL,
    contact_of,
    note,
    returning_gains,
    run,
    task_of,
    tennis_starts,
)
from experiments.pages import DPI
from mjx_study.render import VIEWS, Motion
from mjx_study.render.drawing import Drawing
from mjx_study.tasks.task import Task


class Panel(NamedTuple):
    """A panel of the figure.

    Attributes:
        title, subtitle: the task's name, and its parameters.
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
    """Return a drawing of one rollout, with some geoms recoloured."""
    model = copy.copy(task.scene.host)
    for geom, colour in (colours or {}).items():
        model.geom(geom).rgba[:3] = to_rgb(colour)
    return Drawing(Motion(model, np.arange(len(qpos)) * task.scene.timestep, np.asarray(qpos, float)), VIEWS[view])


def strobe(axes: Axes, drawing: Drawing, steps: Sequence[int], *, faintest: float = 0.25) -> None:
    """Draw the path, and poses at some steps, the earlier the fainter."""
    drawing.trace(axes, slice(steps[0], steps[-1] + 1))
    for rank, step in enumerate(steps):
        drawing.pose(axes, step, faintest + (1 - faintest) * ((rank + 1) / len(steps)) ** 1.5)


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
    """Return a panel of several throws: (angle, colour, seconds)."""
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
    """Return a panel of one rollout without noise, with the initial policy: poses (step, text) side by side."""
    task = task_of(name)
    assert callable(task.start)
    start = jax.tree.map(lambda leaf: leaf[None], task.start(jax.random.key(seed)))
    contact = contact_of(task, "mujoco", task.defaults.middle_stiffness)
    qpos = run(task, np.asarray(task.theta)[None], contact, start).qpos[0]

    def draw(axes: Axes) -> None:
        drawing = drawing_of(task, qpos, view)
        drawing.scenery(axes)
        for rank, (step, text) in enumerate(shown):
            for added in drawing.pose(axes, step):
                added.set_transform(Affine2D().translate(rank * apart, 0) + axes.transData)
            height, said = corners["high"][1] - 0.04 * apart, f"{step * task.scene.timestep:g} s: {text}"
            note(axes, rank * apart, height, said, va="top")

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
    """Draw one panel per task, in rows that fill the page."""
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
    """Draw a length in metres in the lower right corner."""
    span = panel.high[1] - panel.low[1]
    x, y = panel.high[0] - 0.04 * span, panel.low[1] + 0.055 * span
    axes.plot([x - panel.bar, x], [y, y], color=INK, linewidth=1.5, solid_capstyle="butt", zorder=7)
    note(axes, x - panel.bar - 0.03 * span, y, f"{panel.bar:g} m", ha="right")
