"""Pictures and films of motions; nothing here simulates.

Drawings need no OpenGL: every geom is projected along a coordinate axis. Where OpenGL works, MuJoCo's own renderer runs
instead, in a separate process.
"""

import mjx_study._matplotlib  # noqa: F401
from mjx_study.render.figures import animate, check_format, strip, stroboscope
from mjx_study.render.motion import VIEWS, Motion, choose_view, resolve_view
from mjx_study.render.opengl import RenderError, resolve_renderer

__all__ = [
    "VIEWS", "Motion", "RenderError", "animate", "check_format", "choose_view", "resolve_renderer", "resolve_view",
    "strip", "stroboscope",
]  # fmt: skip
