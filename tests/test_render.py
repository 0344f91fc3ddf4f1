"""Pictures of a motion: outlines against geometry, the right things in view, whole files, and clear refusals."""

import stat
import tracemalloc
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from PIL import Image, ImageSequence

from mjx_study.render import (
    VIEWS,
    Motion,
    RenderError,
    animate,
    choose_view,
    opengl,
    resolve_renderer,
    resolve_view,
    strip,
    stroboscope,
)
from mjx_study.render.drawing import Drawing
from mjx_study.render.figures import frame_times
from mjx_study.render.motion import View, bounds, edges
from mjx_study.render.shapes import CIRCLE, shape_of

XZ, XY, YZ = VIEWS["xz"], VIEWS["xy"], VIEWS["yz"]
TETRAHEDRON = '<asset><mesh name="tetrahedron" vertex="0 0 0 .3 0 0 0 .3 0 0 0 .4"/></asset>'
EVERY_TYPE = f"""
<mujoco>{TETRAHEDRON}
<asset><hfield name="hills" nrow="3" ncol="5" size="2 1 .4 .1"
  elevation="0 0 0 0 0  0 .5 1 .5 0  0 0 0 0 0"/></asset>
<worldbody>
  <geom name="floor" type="plane" size="1 1 .1" pos="0 0 -.2"/>
  <geom name="hills" type="hfield" hfield="hills" pos="0 3 0"/>
  <body pos="0 0 1" euler="20 40 60"><freejoint/>
    <geom name="sphere" size=".1" pos=".3 0 0"/>
    <geom name="capsule" type="capsule" size=".05 .2" euler="30 0 10"/>
    <geom name="box" type="box" size=".1 .2 .3" pos="0 .5 0" euler="10 20 30"/>
    <geom name="cylinder" type="cylinder" size=".1 .2" pos="-.4 0 0"/>
    <geom name="ellipsoid" type="ellipsoid" size=".1 .2 .3" pos="0 0 .5"/>
    <geom name="mesh" type="mesh" mesh="tetrahedron" pos="0 -.5 0"/>
  </body>
</worldbody></mujoco>"""
SPINNING = """<mujoco><worldbody><body pos="0 0 .1"><joint name="spin" axis="0 0 1"/>
<geom type="box" size=".2 .1 .1"/></body></worldbody></mujoco>"""
SLIDING = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .02"><freejoint name="puck"/>
<geom type="cylinder" size=".05 .02" friction=".01"/></body></worldbody></mujoco>"""


def still(source: str) -> Motion:
    """A model in its reference pose."""
    model = mujoco.MjModel.from_xml_string(source)
    return Motion(model, np.zeros(1), model.qpos0[None])


def moved(source: str | Path, seconds: float = 0.5, **speeds: Any) -> Motion:
    """A model's motion by the C engine, from its reference pose with some initial velocities by joint name."""
    load = mujoco.MjModel.from_xml_path if isinstance(source, Path) else mujoco.MjModel.from_xml_string
    model = load(str(source))
    data = mujoco.MjData(model)
    for name, speed in speeds.items():
        data.joint(name).qvel[:] = speed
    qpos = [data.qpos.copy()]
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        qpos.append(data.qpos.copy())
    return Motion(model, model.opt.timestep * np.arange(len(qpos)), np.array(qpos))


def throw(gravity: str = "0 0 -9.81", seconds: float = 0.5, **speeds: float) -> Motion:
    """A ball of radius 0.1 m that starts at (0, 0, 0.5), over a floor at z = 0."""
    joints = "".join(
        f'<joint name="{name}" type="slide" axis="{axis}"/>'
        for name, axis in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))
    )
    source = f"""<mujoco><option gravity="{gravity}" timestep=".005"/><worldbody>
      <geom name="floor" type="plane" size="1 1 .1"/>
      <body name="ball" pos="0 0 .5">{joints}<geom name="ball" size=".1"/></body></worldbody></mujoco>"""
    return moved(source, seconds, **speeds)


def place(motion: Motion) -> np.ndarray:
    """The thrown ball's centre in the x-z plane at each time."""
    return np.array([0, 0.5]) + motion.qpos[:, [0, 2]]


def outline(motion: Motion, name: str, view: View) -> np.ndarray:
    geom = motion.model.geom(name).id
    shape = shape_of(motion.model, geom)
    assert shape is not None
    return shape.outline(motion.poses.position[0, geom], motion.poses.rotation[0, geom], view)


def frame_of(motion: Motion, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, rotation and size of a geom, from the engine itself."""
    data = mujoco.MjData(motion.model)
    data.qpos[:] = motion.qpos[0]
    mujoco.mj_forward(motion.model, data)
    geom = data.geom(name)
    return geom.xpos, geom.xmat.reshape(3, 3), motion.model.geom(name).size


def support(points: np.ndarray, view: View) -> np.ndarray:
    """How far a cloud of points in space reaches along each direction of the circle, seen in a view."""
    return (points[:, view.plane] @ CIRCLE.T).max(axis=0)


def shapes_of(axes: Any, layer: int = 3) -> list[Any]:
    """Filled outlines on one layer of a picture: 1 holds what is fixed, 3 what moves."""
    return [item for item in axes.collections if isinstance(item, PolyCollection) and item.get_zorder() == layer]


def sphere_points(count: int = 4000) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.mark.parametrize("view", VIEWS.values(), ids=list(VIEWS))
@pytest.mark.parametrize("name", ["sphere", "capsule", "box", "mesh", "cylinder", "ellipsoid"])
def test_outlines_reach_as_far_as_the_geom(name: str, view: View) -> None:
    """In 96 directions: exactly, but for cylinders and ellipsoids, of which the test has a cloud of points."""
    motion, ball = still(EVERY_TYPE), sphere_points()
    position, rotation, size = frame_of(motion, name)
    rounding, radius = 1e-12, 0.0
    if name == "sphere":
        local, radius = np.zeros((1, 3)), size[0]
    elif name == "capsule":
        local, radius = np.array([[0, 0, -size[1]], [0, 0, size[1]]]), size[0]
    elif name == "box":
        local = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * size
    elif name == "mesh":
        local = motion.model.mesh_vert.astype(float)
    elif name == "cylinder":
        across = size[0] * ball[:, :2] / np.linalg.norm(ball[:, :2], axis=1, keepdims=True)
        local, rounding = np.column_stack([across, size[1] * np.sign(ball[:, 2])]), 2e-3 * max(size)
    else:
        local, rounding = ball * size, 2e-3 * max(size)
    drawn = outline(motion, name, view)
    expected = support(position + local @ rotation.T, view) + radius
    np.testing.assert_allclose((drawn @ CIRCLE.T).max(axis=0), expected, atol=rounding)
    x, y = drawn.T
    assert np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0  # counter-clockwise
    assert name != "box" or len(drawn) == 6


def test_a_mesh_of_many_vertices_keeps_its_outline() -> None:
    vertices = " ".join(f"{value:.6f}" for value in (sphere_points(3000) * (0.1, 0.2, 0.3)).ravel())
    asset = f'<asset><mesh name="egg" vertex="{vertices}"/></asset>'
    motion = still(f'<mujoco>{asset}<worldbody><geom name="egg" type="mesh" mesh="egg"/></worldbody></mujoco>')
    shape = shape_of(motion.model, 0)
    assert shape is not None and len(shape.points) <= 400
    position, rotation, _ = frame_of(motion, "egg")
    exact = support(position + motion.model.mesh_vert @ rotation.T, XZ)
    np.testing.assert_allclose((outline(motion, "egg", XZ) @ CIRCLE.T).max(axis=0), exact, atol=0.003)


def test_terrain_is_a_profile_where_the_bodies_are() -> None:
    motion = still(EVERY_TYPE)
    hills = motion.model.geom("hills").id
    shape = shape_of(motion.model, hills)
    assert shape is not None
    position, rotation = motion.poses.position[0, hills], motion.poses.rotation[0, hills]
    middle = shape.slice(position, rotation, XZ, depth=-3.0).outline(position, rotation, XZ)
    tops = {round(float(x), 6): float(z) for x, z in middle[2:]}
    assert tops == pytest.approx({-2.0: 0.0, -1.0: 0.2, 0.0: 0.4, 1.0: 0.2, 2.0: 0.0}, abs=1e-6)
    assert middle[:, 1].min() == pytest.approx(-0.1)
    edge = shape.slice(position, rotation, XZ, depth=-2.0).outline(position, rotation, XZ)
    assert edge[:, 1].max() == pytest.approx(0)


@pytest.mark.parametrize(
    ("motion", "view"),
    [
        pytest.param(throw(x=2.0, z=2.0), "xz", id="thrown along x"),
        pytest.param(throw(y=2.0, z=2.0), "yz", id="thrown along y"),
        pytest.param(throw(), "xz", id="falls"),
        pytest.param(throw(gravity="0 0 0", x=1.0), "xz", id="slides along x"),
        pytest.param(throw(gravity="0 0 0", y=1.0), "yz", id="slides along y"),
        pytest.param(throw(gravity="0 0 0", x=1.0, y=1.0), "xy", id="planar"),
        pytest.param(throw(x=1.5, y=1.0, z=1.0), "xz", id="oblique"),
        pytest.param(throw(gravity="0 -9.81 0", x=1.0, y=1.0), "xy", id="y is up"),
        pytest.param(moved(SPINNING, spin=3.0), "xy", id="spinning box"),
        pytest.param(moved(SLIDING, puck=[1, 1, 0, 0, 0, 0]), "xy", id="sliding puck"),
    ],
)
def test_the_view_in_which_most_happens(motion: Motion, view: str) -> None:
    assert choose_view(motion).name == view


def test_a_floor_is_seen_at_its_height_from_the_side_alone() -> None:
    motion = still(EVERY_TYPE)
    ((point, normal),) = edges(motion, XZ)
    assert point[1] == pytest.approx(-0.2) and normal.tolist() == pytest.approx([0, 1])
    assert edges(motion, XY) == []


def test_bounds_contain_the_motion_the_floor_and_focused_geoms() -> None:
    motion = throw(x=2.0, seconds=0.4)
    shown = bounds(motion, XZ)
    assert shown.low[0] < -0.1 and shown.high[0] > motion.qpos[:, 0].max() + 0.1
    assert shown.high[1] > 0.6 and shown.low[1] < 0
    assert np.all(shown.size < 2 * (np.ptp(motion.qpos[:, [0, 2]], axis=0) + 0.2))
    source = """<mujoco><option gravity="0 0 0"/><worldbody><geom name="far" type="box" size=".1 .1 .1" pos="5 0 0"/>
      <body><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    motion = still(source)
    assert bounds(motion, XZ).high[0] < 1
    focused = Motion(motion.model, motion.time, motion.qpos, focus=(0,))
    assert bounds(focused, XZ).high[0] > 5.1


def test_bounds_of_meshes_and_of_flat_or_empty_scenes() -> None:
    motion = still(EVERY_TYPE)
    shown = bounds(motion, XZ)
    for name in ("sphere", "capsule", "box", "cylinder", "ellipsoid", "mesh"):
        points = outline(motion, name, XZ)
        assert np.all(points > shown.low) and np.all(points < shown.high), name
    slide = throw(gravity="0 0 0", x=20.0, seconds=1.0)
    width, height = bounds(slide, XZ).size
    assert width / height <= 4.5 + 1e-9
    mass = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    empty = still(f"<mujoco><worldbody><body><joint/>{mass}</body></worldbody></mujoco>")
    assert np.all(bounds(empty, XZ).size > 0)
    assert len(strip(empty, renderer="drawing").axes) == 1


def test_geoms_hidden_by_mujoco_are_hidden() -> None:
    source = """<mujoco><asset><material name="clear" rgba="1 1 1 0"/></asset><worldbody><body><freejoint/>
      <geom name="shown" size=".1" group="2"/><geom name="collision" size=".5" group="3"/>
      <geom name="clear" size=".5" rgba="1 1 1 0"/><geom name="glass" size=".5" material="clear"/>
      </body></worldbody></mujoco>"""
    motion = still(source)
    assert motion.visible.tolist() == [True, False, False, False]
    axes = strip(motion, frames=1, renderer="drawing").axes[0]
    assert [len(item.get_paths()) for item in shapes_of(axes)] == [1]
    assert bounds(motion, XZ).size.max() < 0.3


def test_a_strip_has_labelled_pictures_at_even_times() -> None:
    motion = throw(x=1.0, seconds=0.5)
    figure = strip(motion, frames=6, renderer="drawing")
    assert [axes.get_title(loc="left") for axes in figure.axes] == [f"t = {0.1 * k:.1f} s" for k in range(6)]
    for index, axes in zip(np.arange(6) * 20, figure.axes, strict=True):
        (ball,) = shapes_of(axes)
        centre = ball.get_paths()[0].vertices[:-1].mean(axis=0)
        np.testing.assert_allclose(centre, place(motion)[index], atol=1e-9)
        assert axes.get_aspect() == 1


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda: resolve_view(throw(), "zx"), "unknown view 'zx'; choose from auto, xz, xy, yz"),
        (lambda: strip(throw(), renderer="povray"), "unknown renderer 'povray'; choose from auto, drawing, opengl"),
        (lambda: animate(throw(), Path("film.avi")), "unknown format 'avi'; choose from gif, mp4"),
        (lambda: strip(throw(), frames=0), "frames must be at least 1, got 0"),
        (lambda: stroboscope(throw(), poses=0), "poses must be at least 1, got 0"),
        *((lambda slow=slow: frame_times(throw(), slow), "slow must be a positive") for slow in (0.0, np.nan, np.inf)),
    ],
)
def test_invalid_arguments_are_refused(ask: Callable[[], Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        ask()


@pytest.mark.parametrize(
    ("time", "qpos", "says"),
    [
        ([0.0, 1.0], np.zeros((2, 4)), r"qpos has shape \(2, 4\); 2 times of this model need \(2, 3\)"),
        ([], np.zeros((0, 3)), r"qpos has shape \(0, 3\); 0 times of this model need \(1, 3\)"),
        ([0.0, 0.0], np.zeros((2, 3)), "the times of a motion must increase"),
        ([0.0, 0.5], np.array([[0, 0, 0], [0, np.nan, 0]]), "qpos is not finite at 0.5 s"),
    ],
    ids=["shape", "empty", "times", "nan"],
)
def test_a_motion_is_checked(time: list[float], qpos: np.ndarray, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        Motion(throw().model, np.array(time), qpos)


def test_even_times_are_the_nearest_there_are() -> None:
    model = throw().model
    motion = Motion(model, np.array([0.0, 0.4, 0.45, 1.0]), np.zeros((4, 3)))
    assert motion.at(3).tolist() == [0, 2, 3]
    assert motion.at(50).tolist() == [0, 1, 2, 3]
    assert Motion(model, np.zeros(1), np.zeros((1, 3))).at(6).tolist() == [0]


@pytest.mark.parametrize("slow", [1.0, 4.0, 0.5])
def test_a_gif_takes_the_time_it_shows(tmp_path: Path, slow: float) -> None:
    motion = throw(x=1.0, seconds=0.6)
    path = animate(motion, tmp_path / "ball.gif", slow=slow, renderer="drawing")
    with Image.open(path) as film:
        assert film.format == "GIF" and film.info["loop"] == 0
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(film)]
        assert film.convert("RGB").getpixel((1, 1)) == (255, 255, 255)
    assert len(durations) == round(0.6 * slow * 25) + 1
    assert sum(durations) == pytest.approx(1000 * 0.6 * slow + 500, abs=11)
    assert path.stat().st_size < 1_000_000


def test_a_gif_shows_the_motion(tmp_path: Path) -> None:
    """The ball's pixels are where its trajectory has it."""
    motion = throw(gravity="0 0 0", x=2.0, seconds=0.5)
    path = animate(motion, tmp_path / "ball.gif", view="xz", renderer="drawing")
    centres = []
    with Image.open(path) as film:
        for frame in ImageSequence.Iterator(film):
            pixels = np.asarray(frame.convert("RGB")).astype(int)
            blue = (pixels[:, :, 2] - pixels[:, :, 0]) > 100
            centres.append(np.argwhere(blue).mean(axis=0)[::-1])
    low, high = bounds(motion, XZ).low, bounds(motion, XZ).high
    scale = (6.4 - 0.68 - 0.12) * 100 / (high[0] - low[0])
    assert (centres[-1] - centres[0])[0] / scale == pytest.approx(1.0, abs=0.02)
    assert (centres[-1] - centres[0])[1] / scale == pytest.approx(0.0, abs=0.02)


def test_a_long_motion_has_a_bounded_number_of_frames() -> None:
    time = np.arange(0, 30, 0.01)
    motion = Motion(throw().model, time, np.zeros((len(time), 3)))
    indices, lengths = frame_times(motion)
    assert len(indices) == 120 and indices[0] == 0 and indices[-1] == len(time) - 1
    assert lengths.sum() == pytest.approx(1000 * motion.duration + 500, abs=11)


def test_times_are_the_nearest_ones_of_any_number() -> None:
    """As found one by one, and of a million without an array of all distances."""
    model = throw().model
    time = np.cumsum(np.random.default_rng(0).uniform(0.01, 1, 500))
    for times in (time, np.arange(41) / 4):
        nearest = {int(np.argmin(np.abs(times - each))) for each in np.linspace(times[0], times[-1], 120)}
        assert Motion(model, times, np.zeros((len(times), 3))).at(120).tolist() == sorted(nearest)
    many = Motion(model, np.arange(1e6), np.zeros((1_000_000, 3)))
    tracemalloc.start()
    assert len(many.at(120)) == 120 and tracemalloc.get_traced_memory()[1] < 1e8
    tracemalloc.stop()


def test_a_frame_that_is_too_long_for_a_gif_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RenderError, match="a frame of a GIF lasts at most 655 s: lower slow, or use the format mp4"):
        animate(throw(), tmp_path / "long.gif", slow=2e5)
    assert not list(tmp_path.iterdir())


def test_a_motion_of_one_state_is_a_film_of_one_frame(tmp_path: Path) -> None:
    motion = still(EVERY_TYPE)
    with Image.open(animate(motion, tmp_path / "still.gif", renderer="drawing")) as film:
        assert len(list(ImageSequence.Iterator(film))) == 1
    assert len(stroboscope(motion).axes) == 1


def fake_ffmpeg(folder: Path, body: str) -> None:
    folder.mkdir()
    script = folder / "ffmpeg"
    script.write_text(f"#!/bin/sh\n{body}\n")
    script.chmod(script.stat().st_mode | stat.S_IEXEC)


def test_mp4_is_what_ffmpeg_makes_of_the_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for ffmpeg writes the number of bytes that it was sent, and its arguments."""
    fake_ffmpeg(tmp_path / "bin", 'for last; do :; done; { wc -c; echo "$*"; } > "$last"')
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:/usr/bin:/bin")
    motion = throw(x=1.0, seconds=0.4)
    count, arguments = animate(motion, tmp_path / "film.mp4", renderer="drawing").read_text().splitlines()
    words = arguments.split()
    width, height = map(int, words[words.index("-s") + 1].split("x"))
    assert width % 2 == height % 2 == 0
    frames, remainder = divmod(int(count), 3 * width * height)
    assert remainder == 0
    assert frames / float(words[words.index("-r") + 1]) == pytest.approx(0.4 + 0.5, abs=0.011)


def test_ffmpegs_failure_is_one_line_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_ffmpeg(tmp_path / "bin", "cat > /dev/null; echo first >&2; echo no encoder >&2; exit 1")
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:/usr/bin:/bin")
    (tmp_path / "out").mkdir()
    with pytest.raises(RenderError, match=r"ffmpeg cannot write an mp4 here \(no encoder\); use the format gif"):
        animate(throw(seconds=0.1), tmp_path / "out" / "film.mp4", renderer="drawing")
    assert list((tmp_path / "out").iterdir()) == []


@pytest.fixture
def fresh_backend() -> Generator[None]:
    """What OpenGL can do here is found out anew, before and after."""
    opengl._backend.cache_clear()
    yield
    opengl._backend.cache_clear()


@pytest.mark.usefixtures("fresh_backend")
def test_drawing_replaces_missing_opengl(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert resolve_renderer("auto") == "drawing"
    with pytest.raises(RenderError, match=r"renderer does not work here \(disable: .*use the renderer drawing"):
        strip(throw(), renderer="opengl")
    assert strip(throw(), frames=2, renderer="auto").axes[0].get_xlabel() == "x [m]"
    assert capfd.readouterr() == ("", "")


@pytest.mark.usefixtures("fresh_backend")
@pytest.mark.parametrize(
    ("probe", "reason"),
    [
        ("import os; os.abort()", "signal 6"),
        ("import time; time.sleep(60)", "no answer in 1 s"),
        ("print('noise'); raise OSError('no library')", "OSError: no library"),
    ],
    ids=["aborts", "hangs", "raises"],
)
def test_a_library_that_fails_badly_does_no_harm(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], probe: str, reason: str
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(opengl, "_PROBE", probe)
    monkeypatch.setattr(opengl, "_PROBE_SECONDS", 1.0)
    with pytest.raises(RenderError, match=reason):
        resolve_renderer("opengl")
    assert capfd.readouterr() == ("", "")


def test_opengl_pictures(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Where OpenGL works, the ball is where it is in the drawing, on white, and the model is left as it was."""
    if resolve_renderer("auto") != "opengl":
        pytest.skip("no OpenGL here")
    motion = throw(gravity="0 0 0", x=2.0, seconds=0.3)
    motion.model.geom("floor").rgba[3] = 0
    colours = motion.model.geom_rgba.copy()
    images = opengl.images(Drawing(motion, XZ), np.array([0, -1]), "opengl")
    assert images is not None
    _, height, width, _ = images.shape
    low, high = bounds(motion, XZ).low, bounds(motion, XZ).high
    for image, centre in zip(images, place(motion)[[0, -1]], strict=True):
        dark = image.min(axis=2)
        assert np.any((dark > 180) & (dark < 250))  # the edge is smooth
        found = np.argwhere(dark < 250).mean(axis=0)[::-1]
        expected = (centre - low) / (high - low)
        np.testing.assert_allclose([found[0] / width, 1 - found[1] / height], expected, atol=0.04)
    np.testing.assert_array_equal(motion.model.geom_rgba, colours)
    with Image.open(animate(motion, tmp_path / "film.gif", renderer="opengl")) as film:
        assert len(list(ImageSequence.Iterator(film))) == len(frame_times(motion)[0])
    titles = [axes.get_title(loc="left") for axes in strip(motion, frames=2, renderer="opengl").axes]
    assert titles == ["t = 0.0 s", "t = 0.3 s"]
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "name", ["humanoid/humanoid", "convex", "pendula", "actuator/arm26", "barkour_v0/assets/barkour_v0_mjx"]
)
def test_models_of_others_can_be_drawn(tmp_path: Path, name: str) -> None:
    path = Path(mujoco.__file__).parent / "mjx" / "test_data" / f"{name}.xml"
    if not path.exists():
        pytest.skip("this MuJoCo has no such model")
    motion = moved(path, 0.1)
    figure = strip(motion, frames=3, renderer="drawing")
    figure.savefig(tmp_path / "strip.png")
    for axes in figure.axes:
        moving = motion.visible & motion.moving[motion.model.geom_bodyid]
        assert sum(len(item.get_paths()) for item in shapes_of(axes)) == moving.sum()
