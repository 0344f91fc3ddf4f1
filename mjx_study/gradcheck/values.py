"""Do this project, `mjx.step` and the C engine compute the same step? If not, which of them differs, where, and why."""

import dataclasses
from collections.abc import Callable
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_study.gradcheck.coordinates import Coordinates, geom_label
from mjx_study.gradcheck.engine_step import EngineStep
from mjx_study.simulation.engine import HostState, host_data

TOLERANCE: Final = 1e-8
"""Relative difference of a quantity above which two implementations differ."""
ROUNDING: Final = 1e-14
STAGES: Final = {
    "xpos": "body positions",
    "ten_length": "tendon lengths",
    "actuator_length": "actuator lengths",
    "qM": "the inertia matrix",
    "qfrc_bias": "the bias force",
    "qfrc_passive": "passive forces",
    "act_dot": "the rate of activation",
    "qfrc_actuator": "actuator forces",
    "qacc_smooth": "the unconstrained acceleration",
}
INTEGRATION: Final = "the integration"
EQUALITY: Final = "equality"


def _clamped_under_implicitfast(host: mujoco.MjModel) -> bool:
    fast = host.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return bool(fast and np.any(host.actuator_forcelimited | host.actuator_ctrllimited))


KNOWN: Final[tuple[tuple[str, Callable[[mujoco.MjModel], bool], str], ...]] = (
    ("qM", lambda host: host.nmesh > 0, "MJX rounds inertias of meshes otherwise"),
    (INTEGRATION, _clamped_under_implicitfast, "MJX's implicitfast damps as if no force or control were clamped"),
    (EQUALITY, lambda host: True, "MJX refers equality rows to other accelerations"),
)
"""What MJX is known to compute in another way than C: the first quantity that differs, in which models, and how."""


@dataclasses.dataclass(frozen=True)
class Values:
    """How far apart the states after one step are, all solved to rounding, relative to the step's change.

    Attributes:
        stock: this project's from that of `mjx.step`.
        engine: this project's from the C engine's.
        verdict: value (this project's step and that of `mjx.step` differ), engine (they agree, and the C engine's is
            another for no documented reason), placement (for a documented one), or empty.
        cause: what differs.
        coordinate: where it shows most, an index into the layout's outputs.
        numbers: the change of this coordinate here, and in the implementation that differs.
    """

    stock: float
    engine: float
    verdict: str = ""
    cause: str = ""
    coordinate: int = 0
    numbers: tuple[float, float] = (0.0, 0.0)

    @property
    def agrees_with_engine(self) -> bool:
        """Whether the C engine computes the same step."""
        return self.engine <= TOLERANCE


def compare_values(
    layout: Coordinates,
    engine_step: EngineStep,
    state: HostState,
    ours: HostState,
    stock: HostState,
    stages: dict[str, Any],
) -> Values:
    """Compare one step.

    Args:
        layout: the scene.
        engine_step: the C engine's step.
        state: where.
        ours: this project's state after it; like the others with the acceleration that led there as warm start.
        stock: that of `mjx.step`.
        stages: MJX's quantities at `state`.
    """
    theirs = engine_step.after(state)
    from_stock, from_engine = (float(apart(layout, state, ours, other).max()) for other in (stock, theirs))
    verdict = cause = ""
    if not np.all(np.isfinite(ours.warmstart)):
        return Values(from_stock, from_engine)
    if not from_stock <= TOLERANCE:
        verdict = "value"
        if from_engine <= TOLERANCE:
            cause = "mjx.step computes another step than this project and the C engine"
        else:
            third = "mjx.step" if float(apart(layout, state, stock, theirs).max()) <= TOLERANCE else "neither"
            cause = f"this project's step is not that of mjx.step; the C engine agrees with {third}"
    elif not from_engine <= TOLERANCE:
        verdict, cause = _difference_of_engines(engine_step, state, ours, theirs, stages)
    other = stock if verdict == "value" else theirs
    worst = int(np.argmax(np.nan_to_num(apart(layout, state, ours, other), nan=np.inf)))
    numbers = (float(change(layout, state, ours)[worst]), float(change(layout, state, other)[worst]))
    return Values(from_stock, from_engine, verdict, cause, worst, numbers)


def change(layout: Coordinates, before: HostState, after: HostState) -> Float[np.ndarray, " outputs"]:
    """What a step changes: position in the tangent space, velocity, activation."""
    tangent = np.empty(layout.scene.host.nv)
    mujoco.mj_differentiatePos(layout.scene.host, tangent, 1.0, before.qpos, after.qpos)
    return np.concatenate([tangent, after.qvel - before.qvel, after.act - before.act])


def apart(layout: Coordinates, before: HostState, ours: HostState, theirs: HostState) -> Float[np.ndarray, " outputs"]:
    """Difference of two next states beyond rounding, relative to the largest velocity, acceleration, activation."""
    timestep = layout.scene.timestep
    tangent = np.empty(layout.scene.host.nv)
    mujoco.mj_differentiatePos(layout.scene.host, tangent, 1.0, theirs.qpos, ours.qpos)
    speed, force = (
        max(_largest(a), _largest(b)) for a, b in ((ours.qvel, theirs.qvel), (ours.warmstart, theirs.warmstart))
    )
    speed = max(speed, timestep * force)
    parts = (
        (tangent, max(1.0, _largest(before.qpos)), timestep * speed),
        (ours.qvel - theirs.qvel, speed, timestep * force),
        (ours.act - theirs.act, 1.0, max(_largest(ours.act), _largest(theirs.act))),
    )
    return np.concatenate(
        [np.maximum(np.abs(gap) - ROUNDING * size, 0.0) / max(scale, 1e-10 * timestep) for gap, size, scale in parts]
    )


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values).max(initial=0.0))


def _relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    return _largest(ours - theirs) / max(_largest(theirs), _largest(ours), 1e-10)


def _difference_of_engines(
    engine_step: EngineStep, state: HostState, ours: HostState, theirs: HostState, stages: dict[str, Any]
) -> tuple[str, str]:
    """Verdict and cause where the C engine computes another step."""
    host = engine_step.host
    data = host_data(host, state)
    mujoco.mj_forward(host, data)
    moved = _contacts(host, data, stages)
    found = dict(_stages(host, data, stages)) | ({"contact": "; ".join(moved)} if moved else {})
    if not found and _relative(ours.warmstart, theirs.warmstart) <= TOLERANCE:
        found[INTEGRATION] = "the state after the step differs, its acceleration does not"
    found = found or dict(_rows(data, stages)) or {"solution": "the solution of the constraints"}
    reasons = {name: why for name, applies, why in KNOWN if name in found and applies(host)}
    documented = bool(moved) or found.keys() <= reasons.keys()
    texts = [f"{text} ({reasons[name]})" if name in reasons else text for name, text in found.items()]
    return "placement" if documented else "engine", "; ".join(texts)


def _stages(host: mujoco.MjModel, data: mujoco.MjData, stages: dict[str, Any]) -> list[tuple[str, str]]:
    """The first quantity that differs; those after it follow from it."""
    inertia = np.zeros((host.nv, host.nv))
    mujoco.mj_fullM(host, data, inertia)
    for name, words in STAGES.items():
        theirs = inertia if name == "qM" else np.asarray(getattr(data, name))
        gap = _relative(np.asarray(stages[name]).reshape(theirs.shape), theirs)
        if gap > TOLERANCE:
            return [(name, f"{words} differ by {gap:.1e}" if words.endswith("s") else f"{words} differs by {gap:.1e}")]
    return []


def _contacts(host: mujoco.MjModel, data: mujoco.MjData, stages: dict[str, Any]) -> list[str]:
    """Pairs of geoms whose contacts are not as many, or not in the same place."""
    ours: dict[tuple[int, ...], list[np.ndarray]] = {}
    theirs: dict[tuple[int, ...], list[np.ndarray]] = {}
    for index in np.flatnonzero(stages["dist"] < stages["margin"]):
        place = np.concatenate([stages["dist"][[index]], stages["pos"][index], stages["normal"][index]])
        ours.setdefault(tuple(sorted(map(int, stages["geom"][index]))), []).append(place)
    for contact in data.contact:
        if contact.exclude == 0:
            place = np.concatenate([[contact.dist], contact.pos, contact.frame[:3]])
            theirs.setdefault(tuple(sorted(map(int, contact.geom))), []).append(place)
    texts = []
    for pair in sorted(ours.keys() | theirs.keys()):
        here, there = ours.get(pair, []), theirs.get(pair, [])
        label = " and ".join(geom_label(host, geom) for geom in pair)
        if len(here) != len(there):
            texts.append(f"{label} touch at {len(here)} points in MJX, {len(there)} in C")
            continue
        rest, gaps = list(there), np.zeros(7)
        for place in here:
            nearest = int(np.argmin([np.linalg.norm(place[1:4] - other[1:4]) for other in rest]))
            gaps = np.maximum(gaps, np.abs(place - rest.pop(nearest)))
        if gaps.max() > TOLERANCE:
            texts.append(
                f"contacts of {label} lie {gaps[1:4].max():.1e} m apart, their depths differ by {gaps[0]:.1e} m and "
                f"their normals by {gaps[4:].max():.1e}"
            )
    return texts


def _rows(data: mujoco.MjData, stages: dict[str, Any]) -> list[tuple[str, str]]:
    """Kinds of constraint rows that differ, where the two engines have as many of them."""
    active = np.flatnonzero(np.abs(stages["efc_J"]).max(axis=1, initial=0.0) > 0)
    kinds = [mujoco.mjtConstraint(int(kind)).name.removeprefix("mjCNSTR_").lower() for kind in data.efc_type]
    if len(active) != len(kinds):
        return [("rows", f"there are {len(active)} active constraint rows in MJX, {len(kinds)} in C")]
    words = {"efc_aref": "reference accelerations", "efc_D": "stiffnesses"}
    texts = []
    for name, what in words.items():
        ours, theirs = stages[name][active], np.asarray(getattr(data, name))
        gaps = np.abs(ours - theirs) / np.maximum(np.abs(theirs), 1e-10)
        for kind in dict.fromkeys(kinds):
            gap = max(gap for gap, other in zip(gaps, kinds, strict=True) if other == kind)
            if gap > TOLERANCE:
                texts.append((kind, f"{what} of {kind} rows differ by {gap:.1e}"))
    return texts
