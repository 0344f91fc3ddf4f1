"""Stills of motions: strips of pictures, or stroboscopic pictures."""

import math
from typing import Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mjx_study.render.drawing import Drawing
from mjx_study.render.framing import resolve_view
from mjx_study.render.motion import Motion
from mjx_study.render.opengl import images

_WIDTH: Final = 9.0  # of a strip [inches]
_GAP: Final = 0.14
_LEFT, _RIGHT, _BOTTOM, _TITLE = 0.68, 0.12, 0.5, 0.24
_TARGET_ASPECT: Final = 2.2


def strip(motion: Motion, *, frames: int = 6, view: str = "auto", renderer: str = "auto") -> Figure:
    """Show a motion at evenly spaced times, first and last included, each picture labelled with its time.

    Args:
        frames: number of pictures; fewer if the motion has fewer times.

    Raises:
        ValueError: fewer than one picture, or an unknown view or renderer.
        RenderError: opengl does not work here.
    """
    if frames < 1:
        raise ValueError(f"frames must be at least 1, got {frames}")
    drawing = Drawing(motion, resolve_view(motion, view))
    indices = motion.at(frames)
    rendered = images(drawing, indices, renderer)
    ratio = _ratio(drawing) if rendered is None else rendered.shape[2] / rendered.shape[1]
    columns = _columns(len(indices), ratio)
    rows = math.ceil(len(indices) / columns)
    left, bottom = (_LEFT, _BOTTOM) if rendered is None else (_RIGHT, _RIGHT)
    width = min((_WIDTH - left - _RIGHT - (columns - 1) * _GAP) / columns, 4.5)
    height = width / ratio
    total = (left + columns * width + (columns - 1) * _GAP + _RIGHT, bottom + rows * (height + _TITLE))
    figure = Figure(figsize=total)
    FigureCanvasAgg(figure)
    label = time_label(motion.time[indices])
    for number, index in enumerate(indices):
        row, column = divmod(number, columns)
        x, y = left + column * (width + _GAP), total[1] - (row + 1) * (height + _TITLE)
        axes = figure.add_axes((x / total[0], y / total[1], width / total[0], height / total[1]))
        axes.set_title(label(motion.time[index]), loc="left", fontsize="small", color="0.2", pad=3)
        if rendered is not None:
            axes.imshow(rendered[number])
            axes.set_axis_off()
            continue
        drawing.scenery(axes, int(index))
        drawing.trace(axes, strength=0.45)
        drawing.trace(axes, slice(0, int(index) + 1))
        drawing.pose(axes, int(index))
        last_row = number + columns >= len(indices)
        axes.tick_params(labelbottom=last_row, labelleft=column == 0)
        if last_row:
            axes.set_xlabel(f"{drawing.view.name[0]} [m]", fontsize="small", color="0.2", labelpad=2)
        if column == 0:
            axes.set_ylabel(f"{drawing.view.name[1]} [m]", fontsize="small", color="0.2", labelpad=2)
    return figure


def stroboscope(motion: Motion, *, poses: int = 9, view: str = "auto") -> Figure:
    """Draw the path and evenly spaced poses in one picture, earlier poses fainter.

    Args:
        poses: number of poses, first and last included.

    Raises:
        ValueError: fewer than one pose, or an unknown view.
    """
    if poses < 1:
        raise ValueError(f"poses must be at least 1, got {poses}")
    drawing = Drawing(motion, resolve_view(motion, view))
    indices, ratio = motion.at(poses), _ratio(drawing)
    width = min(_WIDTH - _LEFT - _RIGHT, 4.5 * max(ratio, 0.6))
    total = (_LEFT + width + _RIGHT, _BOTTOM + width / ratio + _TITLE)
    figure = Figure(figsize=total)
    FigureCanvasAgg(figure)
    axes = figure.add_axes(
        (_LEFT / total[0], _BOTTOM / total[1], width / total[0], (total[1] - _BOTTOM - _TITLE) / total[1])
    )
    drawing.scenery(axes)
    for number, index in enumerate(indices, start=1):
        drawing.pose(axes, int(index), 0.12 + 0.88 * (number / len(indices)) ** 2)
    for line in drawing.trace(axes):
        line.set_zorder(4)
    apart = f", {motion.duration / (len(indices) - 1):.3g} s apart" if len(indices) > 1 else ""
    label = time_label(motion.time[indices])
    span = f"{label(motion.time[0])} to {label(motion.time[-1])[4:]}{apart}"
    axes.set_title(span, loc="left", fontsize="small", color="0.2", pad=3)
    axes.set_xlabel(f"{drawing.view.name[0]} [m]", fontsize="small", color="0.2", labelpad=2)
    axes.set_ylabel(f"{drawing.view.name[1]} [m]", fontsize="small", color="0.2", labelpad=2)
    return figure


def time_label(times: np.ndarray):
    """Return a formatter with enough decimals to distinguish the times: `t = 0.25 s`."""
    step = float(np.min(np.diff(times))) if len(times) > 1 else 0.01
    decimals = next((n for n in (1, 2, 3) if abs(step - round(step, n)) < 0.02 * step), 3)
    decimals = max(decimals, min(6, math.ceil(-math.log10(step))))
    return lambda time: f"t = {time:.{decimals}f} s"


def _ratio(drawing: Drawing) -> float:
    return float(drawing.bounds.size[0] / drawing.bounds.size[1])


def _columns(count: int, ratio: float) -> int:
    """Number of pictures per row for a well-proportioned page without gaps."""

    def badness(columns: int) -> float:
        rows = math.ceil(count / columns)
        empty = rows * columns - count
        return abs(math.log(columns * ratio / rows / _TARGET_ASPECT)) + 0.4 * empty

    return min(range(1, count + 1), key=badness)
