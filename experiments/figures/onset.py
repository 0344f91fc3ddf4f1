"""docs/onset-correction.png and docs/onset-stiffness.png: first-order gradients with and without the onset term."""

import numpy as np
from matplotlib.figure import Figure

from experiments.figures.rollouts import BLUE, GREEN, GREY, INK, ORANGE, contact_of, task_of
from experiments.onset import measured
from experiments.pages import DPI
from mjx_study.experiment.landscapes import Line, grid, means


def correction_figure() -> Figure:
    """Draw the slope of the mean cost and means of first-order gradients, with MuJoCo's default contact."""
    task = task_of("momentum_transfer")
    contact, position = contact_of(task, "mujoco_default", 1.0), np.linspace(0.05, 0.74, 47)
    points = grid(position[0], position[-1], task.sigma, 2000, task.noise)
    found = {
        onset: means(points, *Line(task.replace(onset=onset))(points, contact), position, task.sigma, task.noise)
        for onset in ("none", "linear", "shift")
    }
    figure = Figure(figsize=(9.0, 3.6), dpi=DPI, layout="constrained")
    wide, near = figure.subplots(1, 2)
    for axes in (wide, near):
        axes.plot(position, found["none"].slope, color=INK, linewidth=4, alpha=0.35, label="slope of the mean cost")
        for onset, colour, label in (
            ("none", ORANGE, "mean of FoBG"),
            ("linear", BLUE, "mean of FoBG with the linear onset term"),
            ("shift", GREEN, "mean of FoBG with shifts in time"),
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


def stiffness_figure() -> Figure:
    """Draw deviations of one gradient against stiffness: zeroth order, first order, the same with shifts."""
    task, angle, stiffness = task_of("momentum_transfer"), 0.5, np.geomspace(300, 1e5, 16)
    points = grid(angle, angle, task.sigma, 2000, task.noise)
    figure = Figure(figsize=(9.0, 3.4), dpi=DPI, layout="constrained")
    every = figure.subplots(1, 2, sharey=True)
    for axes, family, title in zip(
        every, ("penalty", "smooth_onset"), ("spring without damper", "MuJoCo, impedance from 0"), strict=True
    ):
        deviations = []
        for each in stiffness:
            contact = contact_of(task, family, each)
            (_, ((zeroth, plain),)), (_, ((_, shift),)) = (
                measured(task.replace(onset=onset), contact, points, np.array([angle])) for onset in ("none", "shift")
            )
            deviations.append([zeroth, plain, shift])
        labels = ("zeroth order", BLUE), ("first order", ORANGE), ("first order with shifts in time", GREEN)
        for (label, colour), each in zip(labels, np.array(deviations).T, strict=True):
            axes.loglog(stiffness, each, color=colour, marker="o", markersize=3, linewidth=1.5, label=label)
        axes.set_title(f"{title} ({family})", fontsize=10)
        axes.set_xlabel("contact stiffness [N/m]")
        axes.grid(alpha=0.25)
    every[0].set_ylabel("standard deviation of one gradient")
    every[1].legend(frameon=False, fontsize=8.5)
    return figure
