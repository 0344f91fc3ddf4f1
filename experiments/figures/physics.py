"""docs/physics.png: the tasks against closed forms and references without MJX."""

import math
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.figures.rollouts import (
    BLUE,
    CRITICAL,
    GREEN,
    GREY,
    INK,
    ORANGE,
    SKY,
    contact_of,
    note,
    returning_gains,
    run,
    task_of,
    tennis_starts,
)
from experiments.pages import DPI
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
from mjx_study.simulation.contact import contact_model, solref_from_stiffness


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
    rigid = np.where(fine <= math.pi / 4, np.sin(fine), 0)
    axes.plot(fine, rigid, color=GREY, linewidth=1, linestyle=":", label="inelastic, rigid bar: sin(angle)")
    axes.set(title="momentum_transfer: the bar", xlabel="launch angle [rad]", ylim=(-0.06, 1.85))
    axes.set_ylabel("angular momentum / (m v d)")
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
        thrown, contact = tennis_starts(task, starts(coarse, tilt)), contact_of(task, "penalty", 10000.0)
        qvel = run(task, np.zeros((len(coarse), 21)), contact, thrown).qvel[:, -1]
        simulated(axes, coarse, _direction(qvel), colour, label=f"tilt {tilt:g} rad", size=3)
    axes.set(title="tennis: direction after the bounce", yticks=(0, 45, 90, 135, 180))
    axes.set(xlabel="ball right of the paddle's middle [m]", ylabel="angle from straight up [deg]")
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
    hollow: dict[str, Any] = {"markersize": 4, "markerfacecolor": "none", "linewidth": 0}
    for label, colour, marker, stiffnesses, errors in (thrown_errors(), shot_errors(), played_errors()):
        finer, own = errors
        axes.plot(stiffnesses, finer, color=colour, marker=marker, markersize=4, label=label, linewidth=1.2)
        axes.plot(stiffnesses, own, color=colour, marker=marker, **hollow)
    axes.plot([], [], color=GREY, marker="o", label="the task's own step", **hollow)
    guide = np.array([4e3, 1e5])
    axes.plot(guide, 9 * guide**-0.5, color=GREY, linewidth=1, linestyle="--")
    axes.text(2.5e4, 9 * 2.5e4**-0.5, "1 / sqrt(K)", color=GREY, fontsize=8.5, va="bottom")
    axes.set(title="error against stiffness", xlabel="stiffness K [N/m]", ylabel="relative error")
    axes.set(xscale="log", yscale="log", ylim=(1e-3, 0.4))
    axes.legend(loc="lower left")


def thrown_errors():
    """Return errors of the landing point of a ball that meets no wall."""
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
    """Return errors of the momentum that an elastic hit transfers."""
    angles = np.array([0.1, 0.3, 0.5, 0.7])[:, None]
    exact = np.sqrt(-MomentumTransfer(restitution=1.0, inertia_ratio=0.1).value(angles))
    stiffnesses = np.geomspace(2000, 100000, 7)
    errors = []
    for task in (task_of("momentum_transfer", timestep=0.0005, horizon=1400), task_of("momentum_transfer")):
        found = [np.sqrt(-run(task, angles, contact_of(task, "penalty", stiffness)).cost) for stiffness in stiffnesses]
        errors.append([np.mean(np.abs(momentum / exact - 1)) for momentum in found])
    return "momentum_transfer", ORANGE, "s", stiffnesses, errors


def played_errors():
    """Return errors of the end of a returned ball's flight, over its length; medians of 64."""
    drawn = np.asarray(jax.vmap(draw_start)(jax.random.split(jax.random.key(3), 64)))
    gains = returning_gains()
    stiffnesses = np.geomspace(500, 40000, 7)
    errors = []
    for split in (5, 1):
        task = task_of("tennis", timestep=0.005 / split, horizon=200 * split)
        system, still = Tennis(timestep=0.05 / split, damping=0.999 ** (1 / split)), np.zeros((64, task.horizon, 3))
        exact = roll_out(system, drawn, still, gains).states[:, -1, :2]
        way = np.linalg.norm(exact - drawn[:, :2], axis=1)
        thetas, starts, row = np.tile(gains.ravel(), (64, 1)), tennis_starts(task, drawn), []
        for stiffness in stiffnesses:
            found = run(task, thetas, contact_of(task, "penalty", stiffness), starts).qpos[:, -1, :2]
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
    axes.set(title="pusher: error against impedance", xlabel="impedance d", ylabel="largest error [m]")
    axes.set(xscale="log", yscale="log")
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
