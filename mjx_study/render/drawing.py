"""Two-dimensional drawings of a motion from its model's geometry, with Matplotlib and without OpenGL."""

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from mjx_study.render.motion import DEFAULT_RGBA, Bounds, Motion, View, bounds, edges
from mjx_study.render.shapes import Shape, shape_of

# Okabe-Ito colours, ordered to keep neighbours distinct.
PALETTE: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
FIXED: Final = "#B4B4B4"
_MAX_TRACES: Final = 6
_FIXED_LAYER, _TRACE_LAYER, _MOVING_LAYER = 1, 2, 3


@dataclasses.dataclass(frozen=True, eq=False)
class Drawing:
    """Draws one view of a motion onto Matplotlib axes."""

    motion: Motion
    view: View

    @cached_property
    def bounds(self) -> Bounds:
        return bounds(self.motion, self.view)

    @cached_property
    def _shapes(self) -> dict[int, Shape]:
        motion, poses = self.motion, self.motion.poses
        depths = poses.centre[:, motion.moving] @ self.view.towards
        depth = float(depths.mean()) if depths.size else 0.0
        return {
            geom: shape.slice(poses.position[0, geom], poses.rotation[0, geom], self.view, depth)
            for geom in np.flatnonzero(motion.visible).tolist()
            if (shape := shape_of(motion.model, geom)) is not None
        }

    @cached_property
    def _colours(self) -> np.ndarray:
        return geom_colours(self.motion)

    @cached_property
    def _split(self) -> tuple[list[int], list[int]]:
        """Fixed and moving geoms with an outline."""
        moves = self.motion.moving_geoms
        return [geom for geom in self._shapes if not moves[geom]], [geom for geom in self._shapes if moves[geom]]

    @cached_property
    def _spokes(self) -> dict[int, np.ndarray]:
        """A radius of every rotating sphere, in its own frame, that makes the rotation visible."""
        model, rotation = self.motion.model, self.motion.poses.rotation
        up = np.eye(3)[self.view.up]
        return {
            geom: model.geom_size[geom, 0] * (rotation[0, geom].T @ up)
            for geom in self._split[1]
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE
            and np.abs(rotation[:, geom] - rotation[0, geom]).max() > 0.02
        }

    @cached_property
    def _paths(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Path (times, 2) and colour of each moving body, or of each mechanism if there are many bodies."""
        model, moving = self.motion.model, self.motion.moving
        bodies, centres = np.flatnonzero(moving), self.motion.poses.centre
        if len(bodies) > _MAX_TRACES:
            bodies, centres = np.flatnonzero(moving & ~moving[model.body_parentid]), self.motion.poses.subtree
        paths = []
        for body in bodies:
            tree = int(model.body_treeid[body])
            geoms = [(geom, model.geom_bodyid[geom]) for geom in self._split[1]]
            mine = [geom for geom, its in geoms if its == body]
            mine = mine or [geom for geom, its in geoms if model.body_treeid[its] == tree]
            colour = self._colours[mine[0], :3] if mine else np.array(to_rgb(PALETTE[0]))
            paths.append((centres[:, body][:, self.view.plane], _rim(colour)))
        return paths

    def scenery(self, axes: Axes, index: int = 0) -> None:
        """Set limits and labels in metres, and draw planes and fixed geoms."""
        low, high = self.bounds.low, self.bounds.high
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal")
        axes.set_facecolor("white")
        for axis, part in ((axes.xaxis, 0), (axes.yaxis, 1)):
            axis.set_major_locator(MaxNLocator(_ticks(axes, part), steps=[1, 2, 4, 5, 10]))
        axes.tick_params(length=2.5, width=0.6, labelsize="small", color="0.6", labelcolor="0.3")
        for spine in axes.spines.values():
            spine.set(color="0.75", linewidth=0.6)
        span = float(np.linalg.norm(self.bounds.size)) * 2
        for point, normal in edges(self.motion, self.view):
            along = np.array([-normal[1], normal[0]])
            middle = point + along * (((low + high) / 2 - point) @ along)
            ends = np.array([middle - span * along, middle + span * along])
            solid = np.concatenate([ends, ends[::-1] - span * normal])
            axes.add_collection(PolyCollection([solid], facecolors="0.93", edgecolors="none", zorder=0))
            axes.add_collection(LineCollection([ends], colors="0.45", linewidths=1.0, zorder=0.5))
        self._draw(axes, self._split[0], index, 1.0, _FIXED_LAYER)

    def pose(self, axes: Axes, index: int, strength: float = 1.0) -> list[PolyCollection | LineCollection]:
        """Draw the moving geoms at one time, faded from white by `strength` in (0, 1]; return the added artists."""
        return self._draw(axes, self._split[1], index, strength, _MOVING_LAYER)

    def trace(self, axes: Axes, indices: Sequence[int] | slice = slice(None), strength: float = 1.0) -> list[Line2D]:
        """Draw paths of the centres of mass over some of the times; return the added artists."""
        lines = []
        for path, colour in self._paths:
            shown = path[indices]
            if np.ptp(shown, axis=0).max() > 1e-3 * self.bounds.size.max():
                faded = _faded(colour, 0.65 * strength)
                lines += axes.plot(*shown.T, color=faded, linewidth=0.9, zorder=_TRACE_LAYER, solid_capstyle="round")
        return lines

    def _draw(
        self, axes: Axes, geoms: Sequence[int], index: int, strength: float, layer: int
    ) -> list[PolyCollection | LineCollection]:
        poses = self.motion.poses
        ordered = sorted(geoms, key=lambda geom: poses.position[index, geom] @ self.view.towards)
        outlines = [
            self._shapes[geom].outline(poses.position[index, geom], poses.rotation[index, geom], self.view)
            for geom in ordered
        ]
        faces = np.array([[*_faded(self._colours[geom, :3], strength), self._colours[geom, 3]] for geom in ordered])
        rims = np.array([_faded(_rim(self._colours[geom, :3]), strength**0.5) for geom in ordered])
        added: list[PolyCollection | LineCollection] = [
            PolyCollection(outlines, facecolors=faces, edgecolors=rims, linewidths=0.8, zorder=layer)
        ]
        turning = [geom for geom in ordered if geom in self._spokes]
        if turning:
            centres = poses.position[index, turning]
            ends = [poses.position[index, geom] + poses.rotation[index, geom] @ self._spokes[geom] for geom in turning]
            lines = np.stack([centres, ends], axis=1)[:, :, self.view.plane]
            colours = [_faded(_rim(self._colours[geom, :3]), strength) for geom in turning]
            added.append(LineCollection(list(lines), colors=colours, linewidths=0.8, zorder=layer))
        for collection in added:
            axes.add_collection(collection, autolim=False)
        return added


def _ticks(axes: Axes, part: int) -> int:
    """Number of label intervals that fit on an axis: one per 0.42 inch."""
    figure = axes.get_figure(root=True)
    inches = figure.get_size_inches()[part] * axes.get_position().size[part] if figure else 3.0
    return int(np.clip(inches / 0.42, 2, 8))


def geom_colours(motion: Motion) -> Float[np.ndarray, "ngeom 4"]:
    """Colours as in MuJoCo, except that geoms in its default grey are coloured by the body or mechanism they move with.

    Textures are replaced by their mean colours.
    """
    model = motion.model
    colours = np.array(model.geom_rgba, float)
    bodies = np.flatnonzero(motion.moving)
    by_tree = len(bodies) > len(PALETTE)
    order = {int(body): int(model.body_treeid[body]) if by_tree else rank for rank, body in enumerate(bodies)}
    for geom in np.flatnonzero(np.all(model.geom_rgba == DEFAULT_RGBA, axis=1)):
        if model.geom_matid[geom] >= 0:
            colours[geom] = _material_colour(model, int(model.geom_matid[geom]))
        elif (body := int(model.geom_bodyid[geom])) in order:
            colours[geom, :3] = _faded(np.array(to_rgb(PALETTE[order[body] % len(PALETTE)])), 0.85)
        else:
            colours[geom, :3] = to_rgb(FIXED)
    return np.clip(colours, 0, 1)


def _faded(colour: np.ndarray, strength: float) -> np.ndarray:
    """A mixture with white."""
    return strength * colour + (1 - strength)


def _rim(colour: np.ndarray) -> np.ndarray:
    """A darker tone for outlines and paths, or a lighter one for dark colours."""
    return 0.55 * colour if colour @ (0.3, 0.6, 0.1) > 0.22 else _faded(colour, 0.65)


def _material_colour(model: mujoco.MjModel, material: int) -> np.ndarray:
    """Colour of a material, with the mean colour of its texture."""
    rgba = np.array(model.mat_rgba[material], float)
    texture = int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB])
    if texture >= 0:
        channels, start = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
        count = int(model.tex_width[texture]) * int(model.tex_height[texture]) * channels
        pixels = model.tex_data[start : start + count].reshape(-1, channels)
        rgba[:3] *= np.resize(pixels[:, :3].mean(axis=0) / 255, 3)
    return rgba
