"""Inputs at random: command lines, and the contents of files that they may name."""

import dataclasses
import functools
import io
import json
import string
from collections.abc import Sequence
from typing import Any

import numpy as np
from hypothesis import strategies as st

from estimators import ESTIMATORS
from mjx_study import cli
from mjx_study.options.configuration import OPTIONS, StudyConfig
from mjx_study.simulation.contact import FAMILIES
from mjx_study.tasks import TASKS

COMMANDS = tuple(cli.COMMANDS)
OF_FOLDERS = ("plot", "report")
WITHOUT_TASK = ("claims", "tasks", "estimators")
FILES = ("theta.json", "policy.json", "theta.npy", "study.toml", "mine.xml")


@functools.cache
def flags_of(command: str) -> dict[str, Any]:
    """Every option of a command, by its flag."""
    (commands,) = (action.choices for action in cli.parser()._subparsers._group_actions)  # type: ignore[union-attr]
    return {flag: action for action in commands[command]._actions for flag in action.option_strings[-1:]}  # type: ignore[index]


NUMBERS = st.one_of(
    st.sampled_from(
        "0 1 2 3 10 100 -1 -0 1e3 1e5 1e12 1e26 1e308 1e999 -inf inf nan 0.1 1e-9 1e-308 .5 0x10 1_0 1e ٣ ½".split()
    ),
    st.integers(-(10**30), 10**30).map(str),
    st.floats().map(repr),
)
RANGES = st.one_of(
    st.builds("{}:{}:{}".format, NUMBERS, NUMBERS, NUMBERS),
    st.builds("{}:{}:{}:log".format, NUMBERS, NUMBERS, NUMBERS),
    st.sampled_from(["1:1e9:1000000000", "1:10:2000", "10:1e4:7:log", "1:2:3:4:5", "::", "1:1:2"]),
)
NAMES = st.one_of(
    st.sampled_from([*ESTIMATORS, *FAMILIES, *TASKS, "random", "adam", "clip", "freeze", "lbfgs", "max_deviation"]),
    st.sampled_from(["elliptic", "pyramidal", "newton", "rk4", "sys:exit", "os:abort", "a:b", "json:loads", *FILES]),
    st.text(string.printable + "é½\x00", max_size=12),
)
WORDS = st.one_of(NUMBERS, RANGES, NAMES, st.just("--"), st.lists(NUMBERS, max_size=5).map(",".join),
                  st.lists(NUMBERS, max_size=4).map(";".join), st.lists(NAMES, max_size=3).map(",".join))  # fmt: skip


@st.composite
def command_lines(draw: st.DrawFn) -> list[str]:
    """A command with a few of its options, most of whose values are of the right kind."""
    command = draw(st.sampled_from(COMMANDS))
    found = [command]
    if command in OF_FOLDERS:
        found += [draw(st.one_of(st.just("study"), NAMES)), "--output", f"out/{command}"]
    elif command not in WITHOUT_TASK:
        task = draw(st.one_of(st.sampled_from([*TASKS]), NAMES))
        found += [task] * (draw(st.integers(0, 9)) > 0)
    flags = flags_of(command)
    for flag in draw(st.lists(st.sampled_from(sorted(flags.keys() - {"--output"})), max_size=4, unique=True)):
        action = flags[flag]
        if action.nargs == 0:
            found.append(flag)
            continue
        value = draw(st.one_of(fitting(action.dest), WORDS))
        found += [f"{flag}={value}"] if value.startswith("-") or draw(st.booleans()) else [flag, value]
    return found


def fitting(name: str) -> st.SearchStrategy[str]:
    """Values of the kind that an option takes."""
    option = OPTIONS.get(name)
    if option is None or (option.kind is str and not option.choices):
        return NAMES
    if option.kind is str:
        return st.lists(st.sampled_from(list(option.choices)), min_size=1, max_size=3).map(",".join)
    return st.one_of(NUMBERS, RANGES, st.lists(NUMBERS, max_size=4).map(",".join))


def values(leaves: int = 12) -> st.SearchStrategy[Any]:
    """Anything that JSON or TOML can hold."""
    scalars = st.one_of(
        st.none(), st.booleans(), st.integers(-(10**30), 10**30), st.floats(), WORDS, st.sampled_from([[], {}, ""])
    )
    return st.recursive(
        scalars,
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(NAMES, inner, max_size=3),
        max_leaves=leaves,
    )


@st.composite
def altered(draw: st.DrawFn, document: Any) -> Any:
    """A document with a few of its values replaced, removed or added, at any depth."""
    document = json.loads(json.dumps(document))
    for _ in range(draw(st.integers(1, 3))):
        place, parent = document, None
        while isinstance(place, dict | list) and place and draw(st.integers(0, 4)):
            key = draw(st.sampled_from(sorted(place) if isinstance(place, dict) else range(len(place))))
            parent, place = (place, key), place[key]
        if parent is None:
            document = draw(st.one_of(st.just(document), values()))
            continue
        holder, key = parent
        if draw(st.booleans()) or not isinstance(holder, dict):
            holder[key] = draw(values(4))
        else:
            del holder[key]
    return document


def texts(document: Any) -> st.SearchStrategy[bytes]:
    """A JSON file: an altered document, and now and then no JSON at all."""
    whole = altered(document).map(lambda value: json.dumps(value).encode("utf-8", "surrogatepass"))
    deep = st.sampled_from([b"[" * 100_000, b'{"a":' * 5000, b"[1" + b"0" * 5000 + b"]", b"\xff\xfe", b""])
    cut = st.tuples(whole, st.integers(0, 400)).map(lambda pair: pair[0][: pair[1]])
    return st.one_of(whole, whole, whole, cut, st.binary(max_size=40), deep)


@st.composite
def arrays(draw: st.DrawFn) -> bytes:
    """A .npy file, whose header may promise anything."""
    file = io.BytesIO()
    dtype = draw(st.sampled_from(["f8", "f4", "i8", "U3", "?", "c16", "M8[s]", "f8,i4"]))
    np.save(file, np.zeros(draw(st.sampled_from([(), (0,), (1,), (200,), (3, 2)])), dtype))
    content = file.getvalue()
    shape = draw(
        st.sampled_from(["", "(10**12,)", "(1000000000000, 1000000)", "(-1,)", "(" * 90, "(1e9,)", "'a'", "None"])
    )
    if shape:
        header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
        content = content[:8] + len(header).to_bytes(2, "little") + header.encode() + bytes(8)
    return content[: draw(st.sampled_from([len(content), len(content), 5, 60]))]


@st.composite
def toml_files(draw: st.DrawFn) -> bytes:
    """A TOML file of sweep's options."""
    names = [*(field.name for field in dataclasses.fields(StudyConfig)), "colour"]
    lines = ['tasks = ["pusher"]'] * draw(st.integers(0, 1))
    for name in draw(st.lists(st.sampled_from(names), max_size=5, unique=draw(st.integers(0, 9)) > 0)):
        lines.append(f"{name} = {toml_of(draw(st.one_of(fitting(name), values(5))))}")
    whole = "\n".join(lines).encode("utf-8", "surrogatepass")
    odd = st.sampled_from(
        [b"a = " + b"[" * 50_000, b"seed = 1" + b"0" * 5000, b"[[a]]\n[a]", b"\xff", b"seed = 2020-13-01"]
    )
    return draw(odd) if draw(st.integers(0, 9)) == 0 else whole


def toml_of(value: Any) -> str:
    """A value as TOML has it, or nearly so."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml_of(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_of, value)) + "]"
    return str(value) if isinstance(value, float) else json.dumps(value)


SIZES = st.sampled_from([*"0 1 -1 nan inf 0.1 1e6 1000000 1000000000000 2147483648 1e308 x".split(), "1 2 3", ""])
OPTION = "timestep gravity iterations tolerance integrator cone solver impratio noslip_iterations".split()
SIZE = "memory nuserdata nkey njmax nconmax nstack nuser_body".split()
ASSETS = (
    '<custom><numeric name="n" size="{}"/></custom>',
    '<asset><hfield name="h" nrow="{}" ncol="{}" size="1 1 1 1"/></asset>',
    '<asset><texture name="t" type="2d" builtin="flat" width="{}" height="{}"/></asset>',
    '<asset><mesh name="m" builtin="sphere" params="{}"/></asset>',
)
JOINTS = ("", "<freejoint/>", '<joint type="hinge"/>', '<joint damping="{}"/>', '<joint range="{} {}"/>')
GEOMS = ('<geom size="0.1"/>', '<geom size="{}"/>', '<geom size="0.1" mass="{}"/>', '<geom size="0.1" solref="{} {}"/>')
ENDS = ("", "<actuator><motor/></actuator>", '<include file="mine.xml"/>', '<keyframe><key qpos="{}"/></keyframe>')


@st.composite
def mjcf_files(draw: st.DrawFn) -> bytes:
    """An MJCF of a body or two, with numbers that it may not have."""

    def some(names: Sequence[str]) -> str:
        return " ".join(f'{name}="{{}}"' for name in draw(st.lists(st.sampled_from(names), max_size=1)))

    body = f"<body>{draw(st.sampled_from(JOINTS))}{draw(st.sampled_from(GEOMS))}</body>"
    if draw(st.integers(0, 4)) == 0:
        body = f'<replicate count="{{}}" offset="1 0 0">{body}</replicate>'
    asset = draw(st.sampled_from(ASSETS)) if draw(st.integers(0, 2)) == 0 else ""
    text = (
        f"<mujoco><option {some(OPTION)}/><size {some(SIZE)}/>{asset}<worldbody>{body}</worldbody>"
        f"{draw(st.sampled_from(ENDS))}</mujoco>"
    )
    filled = text.format(*(draw(SIZES) for _ in range(text.count("{}"))))
    return filled.encode()[: draw(st.sampled_from([10**6] * 4 + [80]))]
