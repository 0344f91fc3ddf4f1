"""Files of an MJCF that would make MuJoCo wait for ever, crash or fill the memory are refused before it reads them."""

import os
import struct
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjx_study.simulation import mjcf_compile
from mjx_study.simulation.mjcf_files import DEEPEST
from mjx_study.simulation.scene import SceneError, load_model, models_folder, put_scene
from tests.faults import deadline

BODY = "<worldbody><body name='b'><freejoint/><geom size='.1'/></body></worldbody>"
ASSET = "<asset>{}</asset>" + BODY
MESH = "<asset><mesh name='m' file='{}'/></asset><worldbody><geom type='mesh' mesh='m'/></worldbody>"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a pipe here and in a folder below."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sub").mkdir()
    for name in ("pipe", "sub/pipe"):
        os.mkfifo(tmp_path / name)
    return tmp_path


def refused(folder: Path, content: str | bytes, says: str) -> None:
    path = folder / "mine.xml"
    path.write_bytes(content if isinstance(content, bytes) else f"<mujoco>{content}</mujoco>".encode())
    with deadline(10), pytest.raises(SceneError, match=says) as error:
        load_model(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "body",
    [
        "<include file='pipe'/>", "<include file='sub/above.xml'/>", "<include file='sub/beside.xml'/>",
        r"<include file='sub\pipe'/>", "<include file='sub&#47;pipe'/>", "<include file = \n 'pipe'/>",
        "a & b <include file='pipe'/>",
        "<compiler meshdir='sub'/>" + ASSET.format("<mesh file='pipe'/>"),
        ASSET.format("<mesh file='pipe'/>") + "<compiler assetdir='sub/'/>",
        "<compiler assetdir='.' texturedir='sub'/>" + ASSET.format("<texture type='cube' fileup='pipe'/>"),
        "<compiler strippath='true'/>" + ASSET.format("<mesh file='nowhere/pipe'/>"),
        ASSET.format("<hfield name='h' size='1 1 1 1' file='pipe'/>"),
        ASSET.format("<model name='c' file='child.xml'/>"),
        "<deformable><skin file='pipe'/></deformable>",
        "<worldbody><flexcomp name='f' type='mesh' file='pipe'/></worldbody>",
        "<include file='/dev/zero'/>", "<include file='link.xml'/>",
        "<robot><link><visual><geometry><mesh filename='pipe'/></geometry></visual></link></robot>",
    ],
)  # fmt: skip
def test_non_regular_files_are_never_opened(folder: Path, body: str) -> None:
    """Wherever MuJoCo would look for it."""
    (folder / "sub" / "above.xml").write_text("<mujocoinclude><include file='pipe'/></mujocoinclude>")
    (folder / "sub" / "beside.xml").write_text("<mujocoinclude><include file='sub/pipe'/></mujocoinclude>")
    (folder / "child.xml").write_text("<mujoco><asset><mesh file='pipe'/></asset></mujoco>")
    (folder / "link.xml").symlink_to("pipe")
    refused(folder, body, "refers to .*(pipe|zero|link.xml), which is not a regular file")


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ("<asset><model name='m' file='mine.xml'/></asset><worldbody><attach model='m' prefix='a'/></worldbody>",
         "mine.xml contains itself: it is included or attached again inside of itself"),
        ("<include file='0.xml'/>", f"is the end of a chain of files, each in the one before, of over {DEEPEST}"),
        ("<asset><model name='m' file='0.attach'/></asset><worldbody><attach model='m'/></worldbody>",
         r"attach asks for \S+ elements, with those of <replicate>, <composite>, <flexcomp> and <attach>; the limit"),
        ("<include file='/proc/uptime'/>", "refers to /proc/uptime, which has 0 bytes; the limits are 1 and 10000000"),
        (MESH.format("large.stl"), "large.stl, which has 1000000001 bytes"),
        ("<include file='loop.xml'/>", "Error opening file 'loop.xml'"),
        ("<include file='sub'/>", "Empty file 'sub'"),
        (MESH.format("nan.obj"), r"vertex coordinate \d is not finite"),
        (ASSET.format("<hfield name='h' size='1 1 1 1' file='nan.hf'/>"), r"hfield_data\[0\] of the compiled model "),
    ],
)  # fmt: skip
def test_files_that_cannot_be_read(folder: Path, body: str, says: str) -> None:
    for index in range(DEEPEST + 1):
        (folder / f"{index}.xml").write_text(f"<mujocoinclude><include file='{index + 1}.xml'/></mujocoinclude>")
    for index in range(30):
        twice = "<attach model='m' prefix='a'/><attach model='m' prefix='b'/><geom size='1'/>"
        child = f"<asset><model name='m' file='{index + 1}.attach'/></asset>" * (index < 29)
        (folder / f"{index}.attach").write_text(f"<mujoco>{child}<worldbody>{twice}</worldbody></mujoco>")
    with (folder / "large.stl").open("wb") as file:
        file.truncate(1_000_000_001)
    (folder / "loop.xml").symlink_to("loop.xml")
    (folder / "nan.obj").write_text("v 0 nan 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    (folder / "nan.hf").write_bytes(struct.pack("<2i4f", 2, 2, np.nan, 1, 2, 3))
    refused(folder, body, says)


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ("<worldbody><geom size='.1' friction='nan 0 0'/></worldbody>", "friction of <geom> must be finite, got 'na"),
        ("<option gravity='0 0 1e400'/>", "gravity of <option> must be finite, got '0 0 1e400'"),
        ("<custom><numeric name='n' data='1 nan'/></custom>", "data of <numeric> must be finite"),
        ("<keyframe><key qpos='0 0 0 1 0 0 nan'/></keyframe>", "qpos of <key> must be finite"),
        ("<worldbody><body><freejoint/><geom size='1e308'/></body></worldbody>", "of the compiled model is not finite"),
    ],
)  # fmt: skip
def test_numbers_that_are_not_finite(folder: Path, body: str, says: str) -> None:
    refused(folder, body + BODY, says)


def test_names_may_look_like_numbers(folder: Path) -> None:
    body = "<body name='nan'><joint name='inf'/><geom size='.1' class='1e999'/></body>"
    more = "<custom><text name='infinity' data='nan'/></custom><default><default class='1e999'/></default>"
    (folder / "mine.xml").write_text(
        f"<mujoco model='nan'>{more}<worldbody>{body}</worldbody><actuator><motor joint='inf'/></actuator></mujoco>"
    )
    assert load_model("mine.xml").nu == 1


@pytest.mark.parametrize(
    ("body", "elements"),
    [
        ("<worldbody><flexcomp name='f' type='grid' count='50 50 50' spacing='.1 .1 .1'/></worldbody>", "1.25e+05"),
        ("<worldbody><replicate count='99'><flexcomp name='f' type='grid'/></replicate></worldbody>", "9.9e+04"),
        ("<worldbody><replicate count='99'><composite count='999 1 1'/></replicate></worldbody>", "9.89e+04"),
        ("<text data='a & b'/><worldbody><replicate count='99999'><body/></replicate></worldbody>", "1e+05"),
        ("<worldbody><replicate count='99'><attach model='m'/></replicate></worldbody>"
         "<asset><model name='m' file='other.xml'/></asset>", "9.91e+04"),
    ],
)  # fmt: skip
def test_elements_are_counted_with_their_copies(folder: Path, body: str, elements: str) -> None:
    (folder / "other.xml").write_text(
        "<mujoco><worldbody><replicate count='999'><site/></replicate></worldbody></mujoco>"
    )
    refused(folder, body + BODY, f"mine.xml asks for {elements}".replace("+", r"\+"))


@pytest.mark.parametrize(
    ("content", "accepted"),
    [
        (f"<?xml version='1.0' encoding='klingon'?><mujoco>{BODY}</mujoco>".encode(), True),
        (b"\xef\xbb\xbf<mujoco model='a & b'>" + BODY.encode() + b"</mujoco>\0<size nkey='1000000000'/>", True),
        (b"<!DOCTYPE a [<!ENTITY b '" + b"&b;" * 99 + f"'>]><mujoco>{BODY}</mujoco>".encode(), True),
        (b"<mujoco><!-- <size nkey='1000000000'/> -->" + BODY.encode() + b"</mujoco>", True),
        (b"<mujoco><custom><text name='t' data='<size/>'/></custom>" + BODY.encode() + b"</mujoco>", True),
        (f"<mujoco>{BODY}</mujoco>".encode("utf-16"), False),
        (b"<mujoco><worldbody>" + b"<body>" * 600, False), (b"<html/>", False), (b"", False),
    ],
)  # fmt: skip
def test_the_parser_is_as_lenient_as_mujocos(folder: Path, content: bytes, accepted: bool) -> None:
    if not accepted:
        refused(folder, content, "is not a valid MJCF")
    else:
        (folder / "mine.xml").write_bytes(content)
        assert load_model("mine.xml").nbody == mujoco.MjModel.from_xml_path("mine.xml").nbody == 2


@pytest.mark.parametrize("name", ["pusher", "gripper"])
def test_a_model_compiled_apart_is_the_same_to_the_bit(tmp_path: Path, name: str) -> None:
    path = tmp_path / "copy.xml"
    path.write_bytes((models_folder() / f"{name}.xml").read_bytes())
    apart, here = load_model(path), mujoco.MjModel.from_xml_path(str(path))
    sizes = [np.empty(mujoco.mj_sizeModel(model), np.uint8) for model in (apart, here)]
    for model, content in zip((apart, here), sizes, strict=True):
        mujoco.mj_saveModel(model, None, content)
    assert sizes[0].tobytes() == sizes[1].tobytes()


def test_a_crash_of_mujoco_costs_one_line(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model that attaches itself, which is otherwise refused before; and a compilation that takes too long."""
    monkeypatch.setattr(mjcf_compile, "check_files", lambda path: None)
    body = "<worldbody><body name='b'><attach model='m' body='b' prefix='a'/></body></worldbody>"
    itself = "<asset><model name='m' file='mine.xml'/></asset>" + body
    refused(folder, itself, r"is not a valid MJCF: MuJoCo crashes on it \(SIGSEGV\), or needs more than 16 GiB or 60 s")
    monkeypatch.setattr(mjcf_compile, "SECONDS", 1)
    begun = time.monotonic()
    refused(folder, "<include file='pipe'/>", "MuJoCo does not compile it within 1 s")
    assert time.monotonic() - begun < 5
    monkeypatch.setattr(mjcf_compile, "_WORKER", folder / "nowhere.py")
    refused(folder, BODY, "is not a valid MJCF: .*nowhere.py")


def test_warnings_of_the_compiler_are_printed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused(folder, "<include file='sub'/>", "Empty file 'sub'")
    assert capsys.readouterr().err.startswith("MuJoCo: ")
    assert not (folder / "MUJOCO_LOG.TXT").exists()


def test_a_name_that_is_not_utf_8(folder: Path) -> None:
    path = Path(os.fsdecode(b"mine\xff.xml"))
    path.write_text(f"<mujoco>{BODY}</mujoco>")
    with pytest.raises(SceneError, match=r"the path of an MJCF must be UTF-8, got 'mine\\udcff.xml': rename it"):
        load_model(path)


def test_a_model_that_mjx_has_no_memory_for(folder: Path) -> None:
    bodies = "<replicate count='1000' offset='1 0 0'><body><freejoint/><geom size='.1'/></body></replicate>"
    (folder / "mine.xml").write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    host = load_model("mine.xml")
    with pytest.raises(
        SceneError, match="MJX would allocate 89.6 GiB for mine, with 499500 pairs of geoms and 6000 degr"
    ):
        put_scene(host, "mine")
    host.geom_conaffinity[:] = 0
    host.geom_contype[:] = 0
    assert put_scene(host, "mine").host.nv == 6000
