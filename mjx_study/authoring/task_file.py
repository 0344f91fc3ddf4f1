"""The text of a task file: Python that a user goes on with, with the reasons for its numbers (`task_file.jinja`)."""

import json
import keyword
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import jinja2
import mujoco

from mjx_study.authoring.proposal import HELD, ITERATIONS, PACE, SAMPLES, TRIALS, WEIGHT, Proposal
from mjx_study.authoring.trial import Touch
from mjx_study.simulation.contact_pair import geom_label
from mjx_study.simulation.names import coordinates
from mjx_study.table import number

IMPORTED: Final = frozenset({"Path", "jnp", "replace", "study"})  # names of the file's imports
_JOINT: Final = int(mujoco.mjtTrn.mjTRN_JOINT)
MOST_LISTED: Final = 8  # maximum number of contacts listed


def function_name(mjcf: Path) -> str:
    """A Python name for the task of an MJCF."""
    name = re.sub(r"\W", "_", mjcf.stem, flags=re.ASCII)
    usable = name.isidentifier() and not keyword.iskeyword(name) and name not in IMPORTED
    return name if usable else f"model_{name}"


def module_name(mjcf: Path) -> str:
    """Name of the module with the task of an MJCF."""
    return f"{function_name(mjcf)}_task"


def source_of_task(mjcf: Path, found: Proposal) -> str:
    """Python source of a module with a task, to be written beside the MJCF."""
    host, drive, aim, name = found.scene.host, found.drive, found.aim, function_name(mjcf)
    pages = jinja2.Environment(trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    pages.filters |= {"comment": _comment, "quoted": _quoted, "floats": _floats, "number": number, "g": "{:g}".format}
    body = None if aim.body is None else host.body(aim.body).name
    joint, unit = coordinates(host)[aim.axis] if body is None else ("", "m")
    unit = f" {unit}".rstrip()
    subject = joint or body or f"body {aim.body}"
    by_time = sorted(found.touches.items(), key=lambda item: item[1].first)
    return pages.from_string(Path(__file__).with_suffix(".jinja").read_text()).render(
        {"HELD": HELD, "ITERATIONS": ITERATIONS, "MOST_LISTED": MOST_LISTED, "SAMPLES": SAMPLES, "TRIALS": TRIALS},
        PACE=PACE,
        WEIGHT=WEIGHT,
        mjcf=mjcf,
        found=found,
        name=name,
        body=body,
        joint=joint,
        unit=unit,
        place=f"{module_name(mjcf)}:{name}",
        touches=[_touch(found, pair, touch) for pair, touch in by_time],
        actuators=[_actuator(host, index) for index in range(host.nu)],
        description=f"move {_comment(subject)} by {aim.side * aim.distance:g}{unit}"
        + (f" along {'xyz'[aim.axis]}; " if body is not None else "; ")
        + ("initial velocities" if drive.at_start else "open-loop controls"),
    )


def _touch(found: Proposal, pair: tuple[int, int], touch: Touch) -> str:
    names = " and ".join(geom_label(found.scene.host, geom) for geom in pair)
    after = touch.first * found.scene.timestep
    begin = f"touch after {number(after, 2)} s at {number(touch.speed, 2)} m/s"
    begin = "touch from the start" if touch.first <= 1 else begin
    often = "" if touch.share == 1 else f", in {touch.share:.0%} of the rollouts"
    return _comment(f"{names}: {begin}, up to {number(1e3 * touch.depth, 2)} mm deep{often}")


def _actuator(host: mujoco.MjModel, index: int) -> str:
    """An actuator's name, or else its joint's, or its number."""
    joint = host.joint(host.actuator_trnid[index, 0]).name if host.actuator_trntype[index] == _JOINT else ""
    return host.actuator(index).name or joint or f"actuator {index}"


def _floats(values: Iterable[float]) -> str:
    return str([float(value) for value in values])


def _quoted(text: str) -> str:
    """A string literal in double quotes."""
    return json.dumps(text, ensure_ascii=False)


def _comment(text: str) -> str:
    """A name in one line of a comment or docstring."""
    return " ".join(text.split()).replace("\\", "/").replace('"""', "'''")
