"""docs/onset-correction.png: first-order gradients with and without the onset term."""

import numpy as np
from matplotlib.figure import Figure

from experiments.figures.rollouts import BLUE, GREEN, GREY, INK, ORANGE, contact_of, task_of
from experiments.pages import DPI
from mjx_study.experiment.landscapes import Line, grid, means


def correction_figure() -> Figure:
    """Draw the slope of the mean cost and means of first-order gradients, with MuJoCo's default contact."""
    task = task_of("momentum_transfer")
    contact, position = contact_of(task, "mujoco_default", 1.0), np.linspace(0.05, 0.74, 47)
    points = grid(position[0], position[-1], task.sigma, 2000, task.noise)
    found = {
        onset: means(points, *Line(task.replace(onset=onset))(points, contact), position, task.sigma, task.noise)
        for onset in ("none", "linear", "jump")
    }
    figure = Figure(figsize=(9.0, 3.6), dpi=DPI, layout="constrained")
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
