"""Kinds of inputs at random: each writes a file and gives the command that reads it, and whether it must be refused."""

import functools
import json
import math
import os
import random
import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from hypothesis import strategies as st

from mjx_study.simulation.scene import models_folder
from tests.faults import put_no_file
from tests.fuzz import strategies

POLICY: Final = {
    "task": "pusher", "estimator": "fobg", "seed": 0, "cost": 1.0, "contact": "mujoco", "stiffness": 1000.0,
    "damping": None, "cone": None, "model": None, "horizon": 4, "network": None, "theta": [0.0] * 4,
}  # fmt: skip
Case = tuple[list[str], bool | None]
"""A command, and whether it must refuse; None if it may."""


def command_line(folder: Path, data: st.DataObject) -> Case:
    return data.draw(strategies.command_lines()), None


def toml(folder: Path, data: st.DataObject) -> Case:
    (folder / "study.toml").write_bytes(data.draw(strategies.toml_files()))
    return ["sweep", "--config", "study.toml", "--output", "out"], None


def theta(folder: Path, data: st.DataObject) -> Case:
    content = data.draw(strategies.texts([0.0] * 4))
    (folder / "theta.json").write_bytes(content)
    return ["compare", "pusher", "--horizon", "4", "--theta", "theta.json"], not _are_numbers(content, 4)


def _are_numbers(content: bytes, count: int) -> bool:
    """Whether a JSON file is a list of so many finite numbers."""
    try:
        found = json.loads(content)
        numbers = isinstance(found, list) and all(type(each) in (int, float) for each in found)
        return numbers and len(found) == count and all(math.isfinite(float(each)) for each in found)
    except (ValueError, OverflowError, RecursionError):
        return False


def array(folder: Path, data: st.DataObject) -> Case:
    (folder / "theta.npy").write_bytes(data.draw(strategies.arrays()))
    return ["compare", "pusher", "--theta", "theta.npy"], None


def policy(folder: Path, data: st.DataObject) -> Case:
    (folder / "policy.json").write_bytes(data.draw(strategies.texts(POLICY)))
    return ["rollout", "pusher", "--theta", "policy.json", "--output", "out"], None


def _of_file(data: st.DataObject) -> list[str]:
    """A command that reads mine.xml, mostly the fastest."""
    command = data.draw(st.sampled_from(["rollout"] * 12 + ["gradcheck", "diagnose", "compare", "bench"]))
    return [command, "mine.xml"] + ["--output", "out"] * (command == "rollout")


def mjcf(folder: Path, data: st.DataObject) -> Case:
    (folder / "mine.xml").write_bytes(data.draw(strategies.mjcf_files()))
    return _of_file(data), None


HOSTILE: Final = (
    b"nan", b"-inf", b"1e400", b"1e308", b"0", b"-1", b"99999999999", b"", b"x", b"\xff", b"&", b"<", b"'\"", b"&#0;",
    b"<!--", b"]]>", b"<![CDATA[", b"<replicate count='300'>", b"<include file='mine.xml'/>", b"\0",
    b"<model name='m' file='mine.xml'/>", b"<!DOCTYPE a [<!ENTITY b '&b;&b;'>]>", b"<?xml encoding='klingon'?>",
)  # fmt: skip
"""What is put into an MJCF: text of any kind."""
ENDLESS: Final = HOSTILE[:3]
"""Numbers that are not finite."""


@functools.cache
def _texts() -> list[bytes]:
    """Shipped models, without comments."""
    return [re.sub(rb"<!--.*?-->", b"", path.read_bytes(), flags=re.DOTALL) for path in models_folder().glob("*.xml")]


def mutated_mjcf(folder: Path, data: st.DataObject) -> Case:
    """Cut, repeat, replace and insert in a shipped model; a number that is not finite must be refused."""
    draw = random.Random(data.draw(st.integers(0, 2**32)))
    content, refuse = draw.choice(_texts()), None
    for _ in range(draw.randint(1, 3)):
        first = draw.randrange(len(content))
        last = min(len(content), first + draw.choice([1, 3, 30, 300]))
        middle = draw.choice([b"", 2 * content[first:last], draw.choice(HOSTILE), draw.randbytes(1)])
        content = content[:first] + middle + content[last:]
    if draw.random() < 0.3:  # one number of a text that is whole
        content = draw.choice(_texts())
        places = [each.span(1) for each in re.finditer(rb'(?:size|pos|friction|damping|mass)="(\S+?)[ "]', content)]
        if places:
            first, last = draw.choice(places)
            content, refuse = content[:first] + draw.choice(ENDLESS) + content[last:], True
    (folder / "mine.xml").write_bytes(content)
    return _of_file(data), refuse


def assets(folder: Path, data: st.DataObject) -> Case:
    """Meshes, textures, height fields and skins of which bytes are cut, changed or added."""
    draw = random.Random(data.draw(st.integers(0, 2**32)))
    name, content = draw.choice(_assets())
    for _ in range(draw.randint(0, 4)):
        first = draw.randrange(len(content)) if content else 0
        last = first + draw.choice([0, 1, 4, 50])
        content = content[:first] + draw.choice([b"", draw.randbytes(4), b"nan ", b"\xff" * 4]) + content[last:]
    (folder / name).write_bytes(content)
    tag = {"hf": "hfield size='1 1 1 1'", "png": "texture type='2d'"}.get(name[-3:].strip("."), "mesh")
    kind = tag.partition(" ")[0]
    used = {"mesh": "<geom type='mesh' mesh='m'/>", "hfield": "<geom type='hfield' hfield='m'/>"}.get(kind, "")
    asset = f"<deformable><skin file='{name}'/></deformable>" if name.endswith("skn") else ""
    asset = asset or f"<asset><{tag} name='m' file='{name}'/></asset>"
    body = "<body><freejoint/><geom size='.1'/></body>"
    (folder / "mine.xml").write_text(f"<mujoco>{asset}<worldbody>{used}{body}</worldbody></mujoco>")
    return _of_file(data), None


@functools.cache
def _assets() -> list[tuple[str, bytes]]:
    """A valid file of each format, less the image, which is empty."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "f4")
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], "i4")
    text = "".join("v {} {} {}\n".format(*each) for each in corners) + "".join(
        "f {} {} {}\n".format(*each) for each in faces + 1
    )
    triangles = b"".join(struct.pack("<12fH", 0, 0, 0, *corners[face].ravel(), 0) for face in faces)
    return [
        ("m.obj", text.encode()),
        ("m.stl", bytes(80) + struct.pack("<I", len(faces)) + triangles),
        ("m.msh", struct.pack("<4i", 4, 0, 0, 4) + corners.tobytes() + faces.tobytes()),
        ("m.hf", struct.pack("<2i4f", 2, 2, 0, 1, 2, 3)),
        ("m.skn", struct.pack("<4i", 4, 0, 4, 0) + corners.tobytes() + faces.tobytes()),
        ("m.png", b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", 60000, 60000, 8, 2, 0, 0, 0)),
    ]


NO_FILES: Final = ("fifo", "socket", "folder", "device", "loop", "empty", "missing", "endless name")
REFERENCES: Final = (
    "<include file='{}'/>", "<asset><mesh name='m' file='{}'/></asset>", "<asset><model name='m' file='{}'/></asset>",
    "<asset><texture name='t' type='2d' file='{}'/></asset>", "<deformable><skin file='{}'/></deformable>",
    "<asset><texture name='t' type='cube' fileright='{}'/></asset>", "<compiler assetdir='{}'/><include file='{}'/>",
    "<asset><hfield name='h' size='1 1 1 1' file='{}'/></asset>",
    "<compiler meshdir='.'/><asset><mesh file='{}'/></asset>",
    "<worldbody><flexcomp name='f' type='mesh' file='{}'/></worldbody>",
)  # fmt: skip


def _put(path: Path, kind: str) -> None:
    """One of `NO_FILES` at a path."""
    if kind == "loop":
        path.symlink_to(path)
    elif kind == "empty":
        path.touch()
    elif kind in ("fifo", "socket", "folder", "device"):
        put_no_file(path, kind)


def _emptied(place: Path) -> Path:
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    return place


def no_files(folder: Path, data: st.DataObject) -> Case:
    """Pipes, sockets, devices, folders, loops of links and nothing at all, wherever a file may be named."""
    kind = data.draw(st.sampled_from(NO_FILES))
    place = _emptied(folder / "place")
    name = "x" * 300 if kind == "endless name" else "file"
    suffix = data.draw(st.sampled_from(["", ".json", ".npy", ".toml", ".xml", ".stl", ".png"]))
    path = place / f"{name}{suffix}"
    _put(path, kind)
    reader = data.draw(st.integers(0, 9))
    at = os.path.relpath(path, folder)
    commands = {
        0: ["compare", "pusher", "--theta", at],
        1: ["rollout", "pusher", "--theta", at, "--output", "out"],
        2: ["sweep", "--config", at, "--output", "out"],
        3: ["plot", at, "--output", "out"],
        4: ["report", at, "--output", "out/page.html"],
        5: ["gradcheck", f"{at}.xml" if suffix != ".xml" else at],
    }
    if reader in commands:
        return commands[reader], None if (kind, reader) == ("empty", 2) else True  # a TOML file may be empty
    reference = data.draw(st.sampled_from(REFERENCES)).replace("{}", at)
    body = "<worldbody><body><freejoint/><geom size='.1'/></body></worldbody>"
    (folder / "mine.xml").write_text(f"<mujoco>{reference}{body}</mujoco>")
    return _of_file(data), None if "model" in reference or "assetdir" in reference else True


def outputs(folder: Path, data: st.DataObject) -> Case:
    """Folders for the output that are none, or whose names are odd."""
    kind = data.draw(st.sampled_from([*NO_FILES, "not UTF-8", "new line", "surrogate", "null", "dots"]))
    place = _emptied(folder / "out")
    names = {"not UTF-8": os.fsdecode(b"\xff\xfe"), "new line": "a\nb", "surrogate": "\ud800", "null": "a\0b"}
    names |= {"endless name": "x" * 300, "dots": ".."}
    path = place / names.get(kind, "file")
    _put(path, kind)
    at = "out" if kind == "dots" else f"out/{path.name}"
    commands = "compare pusher", "sweep pusher", "optimise pusher", "landscape ball_wall", "rollout pusher", "claims"
    command = data.draw(st.sampled_from([*commands, "plot study", "report study"])).split()
    refuse = kind in ("fifo", "socket", "device", "loop", "empty", "endless name", "surrogate", "null")
    return [*command, "--output", at], True if refuse and command[0] != "report" else None


def study(folder: Path, data: st.DataObject) -> Case:
    path = folder / "study" / "study.json"
    path.write_bytes(data.draw(strategies.texts(json.loads(path.read_text()))))
    command = data.draw(st.sampled_from(["plot study --output out", "report study --output out/a"]))
    return command.split(), None


CASES: Final[dict[str, Callable[[Path, st.DataObject], Case]]] = {
    "options of every command": command_line,
    "TOML files": toml,
    "theta, JSON": theta,
    "theta, .npy": array,
    "policies": policy,
    "MJCFs, generated": mjcf,
    "MJCFs, mutated": mutated_mjcf,
    "meshes, textures, height fields, skins": assets,
    "pipes, devices, folders, links for files": no_files,
    "folders for output": outputs,
    "study.json, altered": study,
}
"""By kind."""
