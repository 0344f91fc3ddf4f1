"""Films of motions: GIFs by Pillow, or MP4s by ffmpeg if installed."""

import io
import math
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Int
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from mjx_study.choices import FILM_FORMATS, unknown
from mjx_study.disk import write_whole
from mjx_study.render.drawing import Drawing
from mjx_study.render.figures import time_label
from mjx_study.render.framing import resolve_view
from mjx_study.render.motion import Motion
from mjx_study.render.opengl import RenderError, images

MOST_FRAMES: Final = 120
FRAMES_PER_SECOND: Final = 25
LAST_FRAME: Final = 0.5
"""Extra time for the last frame [s], so that a loop ends visibly."""
MOST_BYTES: Final = 1_000_000
_WIDTH, _TALLEST, _DPI = 6.4, 6.4, 100
_LABEL: Final = 22  # pixels above a rendered frame; an even number
_WHITE: Final = 244
_DRAWN_COLOURS, _RENDERED_COLOURS = 64, 128


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
    count = max(2, min(MOST_FRAMES, len(motion.time), round(shown * FRAMES_PER_SECOND) + 1))
    indices = motion.at(count)
    ends = np.round(100 * slow * (motion.time[indices] - motion.time[0])).astype(int)
    lengths = np.append(np.maximum(np.diff(ends), 2), round(100 * LAST_FRAME))
    return indices, 10 * lengths


def animate(motion: Motion, path: Path, *, slow: float = 1.0, view: str = "auto", renderer: str = "auto") -> Path:
    """Write a film of a motion, in real time for `slow` = 1; the file is complete or absent.

    Args:
        path: file name ending in .gif or .mp4.
        slow: slow-motion factor.
        view: xz, xy, yz, or auto for the one that shows most of the motion.
        renderer: drawing, opengl, or auto for opengl if it works.

    Returns:
        The path.

    Raises:
        ValueError: unknown format, view or renderer, or invalid factor.
        RenderError: the format or renderer does not work here.
    """
    kind = path.suffix.removeprefix(".").lower()
    check_format(kind)
    indices, lengths = frame_times(motion, slow)
    drawing = Drawing(motion, resolve_view(motion, view))
    rendered = images(drawing, indices, renderer)
    frames = _drawn(drawing, indices) if rendered is None else _labelled(drawing, indices, rendered)
    colours = _DRAWN_COLOURS if rendered is None else _RENDERED_COLOURS
    content = _gif(frames, lengths, colours) if kind == "gif" else _mp4(frames, lengths)
    return write_whole(path, lambda file: file.write(content))


def _drawn(drawing: Drawing, indices: np.ndarray) -> np.ndarray:
    """Draw the frames; fixed parts are drawn once."""
    motion, label = drawing.motion, time_label(drawing.motion.time[indices])
    left, right, bottom, top = 0.68, 0.12, 0.5, 0.3
    ratio = float(drawing.bounds.size[0] / drawing.bounds.size[1])
    width = min(_WIDTH - left - right, (_TALLEST - bottom - top) * ratio)
    total = (left + width + right, bottom + width / ratio + top)
    figure = Figure(figsize=total, dpi=_DPI)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((left / total[0], bottom / total[1], width / total[0], width / ratio / total[1]))
    drawing.scenery(axes)
    drawing.trace(axes, strength=0.3)
    axes.set_xlabel(f"{drawing.view.name[0]} [m]", fontsize="small", color="0.2", labelpad=2)
    axes.set_ylabel(f"{drawing.view.name[1]} [m]", fontsize="small", color="0.2", labelpad=2)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    frames = []
    for index in indices:
        canvas.restore_region(background)
        title = axes.text(
            0, 1.0, label(motion.time[index]), transform=axes.transAxes, fontsize="small", color="0.2", va="bottom"
        )
        artists = [*drawing.trace(axes, slice(0, int(index) + 1)), *drawing.pose(axes, int(index)), title]
        for artist in artists:
            axes.draw_artist(artist)
            artist.remove()
        frames.append(np.array(canvas.buffer_rgba())[:, :, :3])
    return np.stack(frames)


def _labelled(drawing: Drawing, indices: np.ndarray, rendered: np.ndarray) -> np.ndarray:
    """Frames from MuJoCo's renderer, with the time above each."""
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
        if len(content) <= MOST_BYTES or images[0].width < 200:
            return content
        factor = max(0.5, 0.95 * math.sqrt(MOST_BYTES / len(content)))
        size = tuple(max(1, round(factor * side)) for side in images[0].size)
        images = [image.resize(size, Image.Resampling.LANCZOS) for image in images]  # type: ignore[arg-type]


def _encode(images: Sequence[Image.Image], lengths: np.ndarray, colours: int) -> bytes:
    chosen = [images[index] for index in sorted({0, len(images) // 2, len(images) - 1})]
    sheet = Image.new("RGB", (chosen[0].width, chosen[0].height * len(chosen)))
    for row, image in enumerate(chosen):
        sheet.paste(image, (0, row * image.height))
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
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        command = ["ffmpeg", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
        command += ["-r", f"{rate:.6f}", "-i", "-", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path)]
        done = subprocess.run(command, input=repeated[:, :height, :width].tobytes(), capture_output=True)
        if done.returncode != 0:
            lines = done.stderr.decode(errors="replace").strip().splitlines() or [f"exit code {done.returncode}"]
            raise RenderError(f"ffmpeg cannot write an mp4 here ({lines[-1]}); use the format gif")
        return path.read_bytes()
