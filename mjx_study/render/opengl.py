"""Rendering by MuJoCo itself, in a separate process, where OpenGL works."""

import copy
import functools
import math
import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Int, UInt8

from mjx_study.choices import RENDERERS, unknown
from mjx_study.disk import temporary_folder
from mjx_study.render.drawing import Drawing, geom_colours
from mjx_study.render.motion import depths

_WORKER: Final = Path(__file__).with_name("_opengl_worker.py")
_PIXELS: Final = 640  # length of the larger side
_LONGEST: Final = 3.0  # maximum ratio of the sides
_ELEVATION: Final = {"xz": -12.0, "yz": -12.0, "xy": -89.0}
_AZIMUTH: Final = {"xz": 90.0, "yz": 180.0, "xy": 90.0}
_FIELD_OF_VIEW: Final = 20.0  # [degrees]; close enough to orthographic that spheres look round
_SHADOW: Final = 2048  # maximum pixels of a shadow map; larger ones take seconds per image without a GPU
_PROBE_SECONDS: Final = 30.0
_PROBE: Final = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 16, 16)
renderer.update_scene(data)
assert renderer.render().any(), "it renders nothing"
renderer.close()
"""


class RenderError(ValueError):
    """A picture cannot be made on this machine or in this way."""


def resolve_renderer(name: str) -> str:
    """Resolve a renderer's name to `drawing` or `opengl`; auto is opengl if it works.

    Raises ValueError for an unknown name, RenderError if opengl was asked for and does not work here.
    """
    if name not in RENDERERS:
        raise ValueError(unknown("renderer", name, RENDERERS))
    if name == "drawing":
        return name
    backend, reason = _backend(_chosen())
    if backend is None and name == "opengl":
        raise RenderError(f"MuJoCo's renderer does not work here ({reason}); use the renderer drawing")
    return "drawing" if backend is None else "opengl"


def images(
    drawing: Drawing, indices: Int[np.ndarray, " frames"], renderer: str
) -> UInt8[np.ndarray, "frames height width 3"] | None:
    """Render a motion at some of its times with MuJoCo; return None if the renderer is `drawing`.

    Raises as `resolve_renderer`, also if opengl was asked for and fails on this model.
    """
    if resolve_renderer(renderer) == "drawing":
        return None
    try:
        return _render(drawing, indices)
    except RenderError:
        if renderer == "auto":
            return None
        raise


def _render(drawing: Drawing, indices: np.ndarray) -> np.ndarray:
    """Render with a free camera that has the drawing's view."""
    backend, _ = _backend(_chosen())
    assert backend is not None, "the renderer has been resolved"
    motion, view, shown = drawing.motion, drawing.view, drawing.bounds
    width, height = _image_size(shown.size)
    aspect, half_angle = width / height, math.radians(_FIELD_OF_VIEW) / 2
    lookat = np.zeros(3)
    lookat[view.plane] = (shown.low + shown.high) / 2
    far, near = depths(motion, view)
    lookat += (far + near) / 2 * view.towards
    distance = max(shown.size[1], shown.size[0] / aspect) / 2 / math.tan(half_angle) + (near - far) / 2
    model = copy.copy(motion.model)
    model.geom_rgba[:] = np.where(model.geom_matid[:, None] < 0, geom_colours(motion), model.geom_rgba)
    model.vis.global_.fovy = _FIELD_OF_VIEW
    model.vis.quality.shadowsize = min(int(model.vis.quality.shadowsize), _SHADOW)
    if model.nlight == 0:  # MuJoCo's headlight alone is dim
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.55, 0.45
    with temporary_folder() as name:
        folder = Path(name)
        mujoco.mj_saveModel(model, str(folder / "model.mjb"), None)
        request: dict[str, Any] = {"qpos": motion.qpos[indices], "width": width, "height": height, "lookat": lookat}
        request |= {"distance": distance, "azimuth": _AZIMUTH[view.name], "elevation": _ELEVATION[view.name]}
        np.savez(folder / "request.npz", **request)
        failure = _run([str(_WORKER), name], backend, timeout=None)
        if failure is not None:
            raise RenderError(f"MuJoCo's renderer failed ({failure}); use the renderer drawing")
        return np.load(folder / "images.npy")


def _chosen() -> str:
    return os.environ.get("MUJOCO_GL", "").strip().lower()


@functools.cache
def _backend(chosen: str) -> tuple[str | None, str]:
    """First backend that renders a small scene, or why there is none; `chosen` is the user's MUJOCO_GL."""
    reasons = []
    for backend in [chosen] if chosen else _candidates(os.environ):
        failure = _run(["-c", _PROBE], backend, timeout=_PROBE_SECONDS)
        if failure is None:
            return backend, ""
        reasons.append(f"{backend or 'default'}: {failure}")
    return None, "; ".join(reasons)


def _candidates(environment: Mapping[str, str]) -> list[str]:
    """Values of MUJOCO_GL to try; without a screen, only EGL and OSMesa can work on Linux."""
    if platform.system() != "Linux":
        return [""]
    screen = "DISPLAY" in environment or "WAYLAND_DISPLAY" in environment
    return ["egl", "glfw", "osmesa"] if screen else ["egl", "osmesa"]


def _run(arguments: list[str], backend: str, timeout: float | None) -> str | None:
    """Run Python quietly with an OpenGL backend; return a one-line error, or None."""
    command = [sys.executable, "-P", *arguments]
    try:
        done = subprocess.run(
            command,
            env=os.environ | {"MUJOCO_GL": backend},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout,
        )
    except subprocess.TimeoutExpired:
        return f"no answer in {timeout:g} s"
    if done.returncode < 0:
        return f"signal {-done.returncode}"
    lines = done.stderr.strip().splitlines()
    return None if done.returncode == 0 else (lines[-1] if lines else f"exit code {done.returncode}")


def _image_size(size: np.ndarray) -> tuple[int, int]:
    ratio = float(np.clip(size[0] / size[1], 1 / _LONGEST, _LONGEST))
    width, height = (_PIXELS, _PIXELS / ratio) if ratio >= 1 else (_PIXELS * ratio, _PIXELS)
    return 2 * round(width / 2), 2 * round(height / 2)
