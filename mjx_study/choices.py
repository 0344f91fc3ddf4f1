"""Names that users choose from, with one-line descriptions; free of imports that compute."""

import dataclasses
import os
import re
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Final

from estimators.choices import unknown

PRECISIONS: Final = ("float64", "float32")
CONES: Final = ("pyramidal", "elliptic")
SOLVERS: Final = ("newton", "cg")
INTEGRATORS: Final = ("euler", "implicitfast", "rk4")
ONSETS: Final = ("none", "linear", "shift")
"""Treatment of the onset of contact in first-order gradients."""
KINDS: Final = {
    "gradients": "mjx_study.experiment.gradients",
    "descents": "mjx_study.experiment.descents",
    "landscapes": "mjx_study.experiment.landscapes",
}
"""Kinds of study, with the module whose `KIND` defines each."""
REFERENCE: Final = "reference"
"""Selects the task's analytic system, without MJX, among contact families."""
TASK_DESCRIPTIONS: Final = {
    "pusher": "push a body through stiff contact; 200 open-loop forces",
    "sliding_box": "drag a box by friction; 400 open-loop forces",
    "ball_wall": "throw a ball far, with a wall (box) in its way; one launch angle",
    "ball_wall:dome": "throw a ball far, with a wall (dome) in its way; one launch angle",
    "momentum_transfer": "hit a pivoting bar as hard as possible with a ball; one launch angle",
    "tennis": "return balls to a target with a paddle; linear feedback, 3 x 7",
    "gripper": "push and turn a box with two fingers; a neural network",
    "landing": "land softly on two legs and stay upright; a neural network",
    "double_pendulum": "chaos without contact; four numbers of the initial state (default)",
    "double_pendulum:published": "chaos without contact; four numbers of the initial state (published)",
}
CHECKED_STIFFNESS: Final = (10.0, 100.0, 1000.0)
"""Contact stiffnesses checked by gradcheck [N/m]."""
CHECKED_STATES: Final = 4
"""States checked by gradcheck per contact model."""
CHECKED_STEPS: Final = 200
"""Steps of the rollout from which a file's states are taken."""
FIGURE_FORMATS: Final = ("png", "pdf", "svg")
FIGURE_STYLES: Final = ("screen", "paper")
FILM_FORMATS: Final = ("gif", "mp4")
RENDERERS: Final = ("auto", "drawing", "opengl")
PLANES: Final = ("xz", "xy", "yz")
"""Planes of a picture: the axis to the right, and the axis upwards."""
MIN_IMPEDANCE: Final = 1e-4
"""MuJoCo's mjMINIMP."""
MAX_IMPEDANCE: Final = 0.9999
"""MuJoCo's mjMAXIMP."""
DEFAULT_SOLREF: Final = (0.02, 1.0)
DEFAULT_SOLIMP: Final = (0.9, 0.95, 0.001, 0.5, 2.0)
STIFF_SOLIMP: Final = (0.99, 0.9999, 0.001, 0.5, 2.0)

UNDAMPED: Final = re.compile("without damping|critically damped")
"""What descriptions of contact families say about damping that is not given."""


@dataclasses.dataclass(frozen=True)
class Family:
    """A family of contact models over stiffness, or a single point in MuJoCo's parameters.

    Attributes:
        name: name on the command line.
        description: one line for tables and help.
        solimp: impedance of all members; None for the MJCF's.
        dampratio: damping ratio used with a stiffness if no damping is given.
        solref: fixed reference of a single point; None for families over stiffness or the MJCF's.
        smoothing: default smoothing kappa of a law other than MuJoCo's, which has the name of the family; 0 for
            MuJoCo's.
    """

    name: str
    description: str
    solimp: tuple[float, float, float, float, float] | None
    dampratio: float = 0.0
    solref: tuple[float, float] | None = None
    smoothing: float = 0.0

    @property
    def swept(self) -> bool:
        """Whether the family takes a stiffness."""
        return self.solref is None and self.solimp is not None

    def described(self, given: float | None, defaults: Iterable[float]) -> str:
        """The description with the damping that is in force [N s/m]: the one given, or else of the tasks."""
        if given is None and self.dampratio:
            return self.description
        chosen = sorted(set(defaults)) if given is None else [given]
        told = f"damped by {' or '.join(f'{each:g}' for each in chosen)} N s/m" if any(chosen) else "without damping"
        return UNDAMPED.sub(told, self.description)


def _constant(impedance: float) -> tuple[float, float, float, float, float]:
    return (impedance, impedance, 0.001, 0.5, 2.0)


FAMILIES: Final = {
    family.name: family
    for family in (
        Family("penalty", "spring K without damping, impedance 1e-4: the penalty method", _constant(MIN_IMPEDANCE)),
        Family("impedance", "spring K without damping, impedance 0.5: half penalty, half constraint", _constant(0.5)),
        Family("mujoco", "MuJoCo's default impedance (0.9 to 0.95), K critically damped", DEFAULT_SOLIMP, 1.0),
        Family("mujoco_stiff", "impedance 0.99 to 0.9999, K critically damped", STIFF_SOLIMP, 1.0),
        Family(
            "smooth_onset",
            "impedance rising from 1e-4 to 0.95 over 1 mm, K critically damped: force without a jump",
            (MIN_IMPEDANCE, 0.95, 0.001, 0.5, 2.0),
            1.0,
        ),
        Family("mujoco_default", "MuJoCo's defaults: solref (0.02, 1)", DEFAULT_SOLIMP, 1.0, DEFAULT_SOLREF),
        Family("hunt_crossley", "spring K whose damper grows with penetration", DEFAULT_SOLIMP, smoothing=1e-5),
        Family("kelvin_voigt", "spring K and damper, critically damped; brakes early", DEFAULT_SOLIMP, 1.0, None, 1e-5),
        Family(
            "log_barrier", "rigid, with a force at a distance: a barrier", DEFAULT_SOLIMP, 1.0, DEFAULT_SOLREF, 1e-3
        ),
        Family("conic", "rigid: impulses complementary to velocities", DEFAULT_SOLIMP, 1.0, DEFAULT_SOLREF, 1e-5),
        Family("mjcf", "each contact as the MJCF has it", None),
    )
}


def laws_of(families: Iterable[str]) -> list[str]:
    """Those contact families whose law is not MuJoCo's."""
    return [family for family in families if family in FAMILIES and FAMILIES[family].smoothing]


def takes_stiffness(families: Iterable[str]) -> bool:
    """Whether any of the contact families, "reference" included, has a stiffness."""
    return any(family not in FAMILIES or FAMILIES[family].swept for family in families)


TASK_GROUP: Final = "mjx_study.tasks"
"""Entry point group in which installed packages register tasks."""


def is_file(name: str) -> bool:
    """Whether a task's name is the path of an MJCF."""
    return name.lower().endswith(".xml")


def registered_tasks() -> list[str]:
    """Names of the tasks that installed packages register."""
    return sorted({point.name for point in metadata.entry_points(group=TASK_GROUP)})


def unknown_task(name: str, reason: str = "") -> str | None:
    """Return an error message for a task name that is unknown, or unusable for a reason; None if it may be valid."""
    registered = registered_tasks()
    if (name in TASK_DESCRIPTIONS or name in registered or ":" in name or is_file(name)) and not reason:
        return None
    module = Path(name.removesuffix(".py") + ".py")
    if not reason and os.path.isfile(module):  # unlike Path's, False for names that no file can have
        tasks = re.findall(r"^def ([a-z]\w*)\(", module.read_text(errors="replace"), re.MULTILINE) or ["NAME"]
        return f"{name} is a module: choose a task in it, as {' or '.join(f'{module.stem}:{each}' for each in tasks)}"
    choices = dict.fromkeys([*TASK_DESCRIPTIONS, *registered])
    return unknown("task", name, choices, ", module:name of your own, or an MJCF") + reason
