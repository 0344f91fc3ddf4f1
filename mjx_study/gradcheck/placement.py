"""Do MJX and the C engine compute the same step? If not, the first quantity that differs, and by how much."""

import dataclasses
from typing import Any, Final

import mujoco
import numpy as np

from mjx_study.contact import ContactModel
from mjx_study.engine import HostState, converged_host, host_data
from mjx_study.scene import Scene

TOLERANCE: Final = 1e-8
"""Relative difference of a quantity above which the two engines differ."""
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


@dataclasses.dataclass(frozen=True)
class Placement:
    """How a step in MJX differs from the C engine's.

    Attributes:
        step: relative difference of the acceleration, both solved to rounding.
        text: what differs first, and by how much; empty where nothing does.
    """

    step: float
    text: str


def compare_engines(
    scene: Scene, contact: ContactModel | None, state: HostState, stages: dict[str, Any], qacc: np.ndarray
) -> Placement:
    """Compare one step.

    Args:
        scene: the scene.
        contact: its contact model, or None.
        state: where.
        stages: MJX's quantities, from `Programs.stages`.
        qacc: MJX's acceleration, solved to rounding.
    """
    host = converged_host(scene, contact)
    data = host_data(host, state)
    mujoco.mj_forward(host, data)
    step = _relative(qacc, data.qacc)
    if step <= TOLERANCE or not np.all(np.isfinite(qacc)):
        return Placement(step, "")
    found = [*_stages(host, data, stages), *_contacts(host, data, stages)] or _rows(data, stages)
    return Placement(step, "; ".join(found) or "the solution of the constraints")


def _relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    scale = max(float(np.abs(theirs).max(initial=0.0)), float(np.abs(ours).max(initial=0.0)), 1e-10)
    return float(np.abs(ours - theirs).max(initial=0.0)) / scale


def _stages(host: mujoco.MjModel, data: mujoco.MjData, stages: dict[str, Any]) -> list[str]:
    """The first quantity that differs; those after it follow from it."""
    inertia = np.zeros((host.nv, host.nv))
    mujoco.mj_fullM(host, data, inertia)
    for name, words in STAGES.items():
        theirs = inertia if name == "qM" else np.asarray(getattr(data, name))
        gap = _relative(np.asarray(stages[name]).reshape(theirs.shape), theirs)
        if gap > TOLERANCE:
            return [f"{words} differ by {gap:.1e}" if words.endswith("s") else f"{words} differs by {gap:.1e}"]
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


def _rows(data: mujoco.MjData, stages: dict[str, Any]) -> list[str]:
    """Kinds of constraint rows that differ, where the two engines have as many of them."""
    active = np.flatnonzero(np.abs(stages["efc_J"]).max(axis=1, initial=0.0) > 0)
    kinds = [mujoco.mjtConstraint(int(kind)).name.removeprefix("mjCNSTR_").lower() for kind in data.efc_type]
    if len(active) != len(kinds):
        return [f"there are {len(active)} active constraint rows in MJX, {len(kinds)} in C"]
    words = {"efc_aref": "reference accelerations", "efc_D": "stiffnesses"}
    texts = []
    for name, what in words.items():
        ours, theirs = stages[name][active], np.asarray(getattr(data, name))
        gaps = np.abs(ours - theirs) / np.maximum(np.abs(theirs), 1e-10)
        for kind in dict.fromkeys(kinds):
            gap = max(gap for gap, other in zip(gaps, kinds, strict=True) if other == kind)
            if gap > TOLERANCE:
                texts.append(f"{what} of {kind} rows differ by {gap:.1e}")
    return texts


def geom_label(host: mujoco.MjModel, geom: int) -> str:
    """A geom's name, or its body's and its type."""
    name = mujoco.mj_id2name(host, mujoco.mjtObj.mjOBJ_GEOM, geom)
    if name:
        return name
    body = mujoco.mj_id2name(host, mujoco.mjtObj.mjOBJ_BODY, int(host.geom_bodyid[geom])) or "body"
    kind = mujoco.mjtGeom(int(host.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
    return f"the {kind} of {body}"
