"""Stills of motions, strips of pictures or stroboscopic pictures; and films, GIFs by Pillow or MP4s by ffmpeg."""

import io
import math
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from mjx_study.choices import FILM_FORMATS, unknown
from mjx_study.disk import temporary_folder, write_whole
from mjx_study.render.drawing import Drawing
from mjx_study.render.motion import Motion, resolve_view
from mjx_study.render.opengl import RenderError, images

MAX_FILM_FRAMES: Final = 120  # maximum number of frames in a film; longer ones have fewer per second
FRAMES_PER_SECOND: Final = 25
LONGEST_FRAME: Final = 655_350  # longest duration of a frame in the GIF format [ms]
LAST_FRAME: Final = 0.5  # extra time for the last frame [s], so that a loop ends visibly
MAX_GIF_BYTES: Final = 1_000_000  # size of a GIF above which its pictures are made smaller [bytes]
_WIDTH: Final = 9.0  # of a strip [inches]
_GAP: Final = 0.14
_LEFT, _RIGHT, _BOTTOM, _TITLE = 0.68, 0.12, 0.5, 0.24
_TARGET_ASPECT: Final = 2.2
_FILM_SIDE, _FILM_TITLE, _DPI = 6.4, 0.3, 100  # largest width and height of a film [inches]
_LABEL: Final = 22  # pixels above a rendered frame; an even number
_WHITE: Final = 244
_DRAWN_COLOURS, _RENDERED_COLOURS = 64, 128
_SMALL: Final[dict[str, Any]] = {"fontsize": "small", "color": "0.2"}


def strip(motion: Motion, *, frames: int = 6, view: str = "auto", renderer: str = "auto") -> Figure:
    """Show a motion at evenly spaced times, first and last included, each picture labelled with its time.

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
    figure, label = Figure(figsize=total), time_label(motion.time[indices])
    FigureCanvasAgg(figure)
    for number, index in enumerate(indices):
        row, column = divmod(number, columns)
        x, y = left + column * (width + _GAP), total[1] - (row + 1) * (height + _TITLE)
        axes = _place(figure, total, x, y, width, height)
        axes.set_title(label(motion.time[index]), loc="left", pad=3, **_SMALL)
        if rendered is not None:
            axes.imshow(rendered[number])
            axes.set_axis_off()
            continue
        drawing.scenery(axes, int(index))
        drawing.trace(axes, strength=0.45)
        drawing.trace(axes, slice(0, int(index) + 1))
        drawing.pose(axes, int(index))
        _label(axes, drawing, below=number + columns >= len(indices), left=column == 0)
    return figure


def stroboscope(motion: Motion, *, poses: int = 9, view: str = "auto") -> Figure:
    """Draw the path and evenly spaced poses, first and last included, in one picture, earlier poses fainter.

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
    axes = _place(figure, total, _LEFT, _BOTTOM, width, total[1] - _BOTTOM - _TITLE)
    drawing.scenery(axes)
    for number, index in enumerate(indices, start=1):
        drawing.pose(axes, int(index), 0.12 + 0.88 * (number / len(indices)) ** 2)
    for line in drawing.trace(axes):
        line.set_zorder(4)
    apart = f", {motion.duration / (len(indices) - 1):.3g} s apart" if len(indices) > 1 else ""
    label = time_label(motion.time[indices])
    span = f"{label(motion.time[0])} to {label(motion.time[-1])[4:]}{apart}"
    axes.set_title(span, loc="left", pad=3, **_SMALL)
    _label(axes, drawing)
    return figure


def _place(figure: Figure, size: tuple[float, float], x: float, y: float, width: float, height: float) -> Axes:
    """All in inches."""
    return figure.add_axes((x / size[0], y / size[1], width / size[0], height / size[1]))


def _label(axes: Axes, drawing: Drawing, *, below: bool = True, left: bool = True) -> None:
    """Name the axes, and show their ticks, on the sides that are not shared with another picture."""
    axes.tick_params(labelbottom=below, labelleft=left)
    horizontal, vertical = drawing.view.name
    if below:
        axes.set_xlabel(f"{horizontal} [m]", labelpad=2, **_SMALL)
    if left:
        axes.set_ylabel(f"{vertical} [m]", labelpad=2, **_SMALL)


def time_label(times: np.ndarray) -> Callable[[Any], str]:
    """Return a formatter with enough decimals to distinguish the times: `t = 0.25 s`."""
    step = float(np.min(np.diff(times))) if len(times) > 1 else 0.01
    decimals = next((places for places in (1, 2, 3) if abs(step - round(step, places)) < 0.02 * step), 3)
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


def check_format(name: str) -> None:
    """Raise ValueError for an unknown format, RenderError for one that cannot be written here."""
    if name not in FILM_FORMATS:
        raise ValueError(unknown("format", name, FILM_FORMATS))
    if name == "mp4" and shutil.which("ffmpeg") is None:
        raise RenderError("mp4 needs ffmpeg, which is not on the PATH; use the format gif")


def frame_times(motion: Motion, slow: float = 1.0) -> tuple[Int[np.ndarray, " frames"], Int[np.ndarray, " frames"]]:
    """Indices of the times of the frames, and the duration of each [ms], in GIF's whole hundredths of a second.

    Together they last `slow` times the motion's duration, plus half a second for the last frame.

    Raises:
        ValueError: `slow` is not a positive number.
    """
    if not (slow > 0 and math.isfinite(slow)):
        raise ValueError(f"slow must be a positive number, got {slow}")
    shown = motion.duration * slow
    count = max(2, min(MAX_FILM_FRAMES, len(motion.time), round(shown * FRAMES_PER_SECOND) + 1))
    indices = motion.at(count)
    ends = np.round(100 * slow * (motion.time[indices] - motion.time[0])).astype(int)
    lengths = np.append(np.maximum(np.diff(ends), 2), round(100 * LAST_FRAME))
    return indices, 10 * lengths


def animate(motion: Motion, path: Path, *, slow: float = 1.0, view: str = "auto", renderer: str = "auto") -> Path:
    """Write a film of a motion to a path that ends in .gif or .mp4, and return the path; it is complete or absent.

    Args:
        slow: slow-motion factor; 1 for real time.
        view: xz, xy, yz, or auto for the one that shows most of the motion.
        renderer: drawing, opengl, or auto for opengl if it works.

    Raises:
        ValueError: unknown format, view or renderer, or invalid factor.
        RenderError: the format or renderer does not work here, or a frame lasts too long for the format.
    """
    kind = path.suffix.removeprefix(".").lower()
    check_format(kind)
    indices, lengths = frame_times(motion, slow)
    if kind == "gif" and lengths.max() > LONGEST_FRAME:
        seconds = LONGEST_FRAME // 1000
        raise RenderError(f"a frame of a GIF lasts at most {seconds} s: lower slow, or use the format mp4")
    drawing = Drawing(motion, resolve_view(motion, view))
    rendered = images(drawing, indices, renderer)
    frames = _drawn(drawing, indices) if rendered is None else _labelled(drawing, indices, rendered)
    colours = _DRAWN_COLOURS if rendered is None else _RENDERED_COLOURS
    content = _gif(frames, lengths, colours) if kind == "gif" else _mp4(frames, lengths)
    return write_whole(path, lambda file: file.write(content))


def _drawn(drawing: Drawing, indices: np.ndarray) -> np.ndarray:
    """Draw the frames; fixed parts are drawn once."""
    motion, label, ratio = drawing.motion, time_label(drawing.motion.time[indices]), _ratio(drawing)
    width = min(_FILM_SIDE - _LEFT - _RIGHT, (_FILM_SIDE - _BOTTOM - _FILM_TITLE) * ratio)
    total = (_LEFT + width + _RIGHT, _BOTTOM + width / ratio + _FILM_TITLE)
    figure = Figure(figsize=total, dpi=_DPI)
    canvas = FigureCanvasAgg(figure)
    axes = _place(figure, total, _LEFT, _BOTTOM, width, width / ratio)
    drawing.scenery(axes)
    drawing.trace(axes, strength=0.3)
    _label(axes, drawing)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    frames = []
    for index in indices:
        canvas.restore_region(background)
        title = axes.text(0, 1.0, label(motion.time[index]), transform=axes.transAxes, va="bottom", **_SMALL)
        artists = [*drawing.trace(axes, slice(0, int(index) + 1)), *drawing.pose(axes, int(index)), title]
        for artist in artists:
            axes.draw_artist(artist)
            artist.remove()
        frames.append(np.array(canvas.buffer_rgba())[:, :, :3])
    return np.stack(frames)


def _labelled(drawing: Drawing, indices: np.ndarray, rendered: np.ndarray) -> np.ndarray:
    label, font = time_label(drawing.motion.time[indices]), ImageFont.load_default(14)
    frames = np.pad(rendered, ((0, 0), (_LABEL, 0), (0, 0), (0, 0)), constant_values=255)
    for frame, index in zip(frames, indices, strict=True):
        image = Image.fromarray(frame[:_LABEL])
        ImageDraw.Draw(image).text((4, 2), label(drawing.motion.time[index]), (50, 50, 50), font)
        frame[:_LABEL] = np.asarray(image)
    return frames


def _gif(frames: np.ndarray, lengths: np.ndarray, colours: int) -> bytes:
    """Encode a looping GIF with one palette, scaled down until it is small enough."""
    images = [Image.fromarray(frame) for frame in frames]
    while True:
        content = _encode(images, lengths, colours)
        if len(content) <= MAX_GIF_BYTES or images[0].width < 200:
            return content
        factor = max(0.5, 0.95 * math.sqrt(MAX_GIF_BYTES / len(content)))
        size = tuple(max(1, round(factor * side)) for side in images[0].size)
        images = [image.resize(size, Image.Resampling.LANCZOS) for image in images]  # type: ignore[arg-type]


def _encode(images: Sequence[Image.Image], lengths: np.ndarray, colours: int) -> bytes:
    chosen = [np.asarray(images[index]) for index in sorted({0, len(images) // 2, len(images) - 1})]
    sheet = Image.fromarray(np.concatenate(chosen))
    palette = sheet.quantize(colours, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    entries = np.reshape(palette.getpalette() or [], (-1, 3))
    entries[entries.min(axis=1) > _WHITE] = 255  # nearly white entries become white
    palette.putpalette(entries.ravel().tolist())
    first, *rest = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    buffer = io.BytesIO()
    first.save(buffer, "GIF", save_all=True, append_images=rest, duration=lengths.tolist(), loop=0, optimize=False)
    return buffer.getvalue()


def _mp4(frames: np.ndarray, lengths: np.ndarray) -> bytes:
    """Encode an MP4 at constant frame rate, in H.264 or ffmpeg's default codec, with even width and height."""
    repeated = np.repeat(frames, np.maximum(np.round(lengths / np.median(lengths)).astype(int), 1), axis=0)
    rate = len(repeated) * 1000 / lengths.sum()
    height, width = 2 * (frames.shape[1] // 2), 2 * (frames.shape[2] // 2)
    with temporary_folder() as folder:
        path = Path(folder) / "film.mp4"
        command = ["ffmpeg", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
        command += ["-r", f"{rate:.6f}", "-i", "-", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path)]
        done = subprocess.run(command, input=repeated[:, :height, :width].tobytes(), capture_output=True)
        if done.returncode != 0:
            lines = done.stderr.decode(errors="replace").strip().splitlines() or [f"exit code {done.returncode}"]
            raise RenderError(f"ffmpeg cannot write an mp4 here ({lines[-1]}); use the format gif")
        return path.read_bytes()
