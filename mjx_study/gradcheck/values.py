"""Compare the steps of this project, `mjx.step` and the C engine; if they differ, report which, where and why.

The C engine's step differs in a quantity, the first of which explains later ones, in its contacts or constraint rows.
"""

import copy
import dataclasses
from collections import defaultdict
from functools import partial
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from mjx_study.gradcheck.coordinates import Coordinates, quaternions
from mjx_study.gradcheck.engine_step import EngineStep, forward, tangent_of
from mjx_study.simulation.contact_pair import geom_label
from mjx_study.simulation.engine import HostState

TOLERANCE: Final = 1e-8  # relative difference above which two implementations differ in a quantity
FAR: Final = 1e100
MIN_ROW: Final = 1e-12  # size below which a constraint row counts as zero
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
ROWS: Final = {"efc_J": "Jacobians", "efc_aref": "reference accelerations", "efc_D": "stiffnesses"}
ROUNDING: Final = 1e-14
MIN_TURNING: Final = 1e-8
"""Angular velocity [rad/s] below which, in every component, MJX treats the step of an orientation as zero."""

Found = tuple[str, bool]
"""Description of a difference, and whether it is documented."""


@dataclasses.dataclass(frozen=True)
class Values:
    """Differences between the states after one step, all solved to rounding, relative to the change that its forces
    cause, balanced or not.

    Attributes:
        stock, engine: difference of this project's state from that of `mjx.step`, and from the C engine's.
        verdict: value (this project and `mjx.step` differ), engine (they agree, and the C engine differs for no
            documented reason), engine_mismatch (for a documented reason), or None.
        coordinate: output that differs most, an index into the layout's outputs.
        numbers: change of this coordinate in this project and in the differing implementation.
    """

    stock: float
    engine: float
    verdict: str | None = None
    cause: str = ""
    coordinate: int = 0
    numbers: tuple[float, float] = (0.0, 0.0)

    @property
    def agrees_with_engine(self) -> bool:
        return self.engine <= TOLERANCE


def compare_values(
    layout: Coordinates,
    engine_step: EngineStep,
    state: HostState,
    ours: HostState,
    stock: HostState,
    stages: dict[str, Any],
    noise: Float[np.ndarray, " outputs"] | float = 0.0,
    unsteady: Float[np.ndarray, " outputs"] | float = 0.0,
) -> Values:
    """Compare one step across implementations.

    Args:
        ours, stock: next states of this project and `mjx.step`, with the step's acceleration as warm start.
        noise: rounding noise of each output; at rest, all of its change.
        unsteady: how far each output jumps by rounding, in MJX.
    """
    theirs = engine_step.after(state)
    apart = partial(_apart, layout, state, driven=largest(stages["qacc_smooth"]))
    gaps = [apart(ours, stock, noise=noise + unsteady), apart(ours, theirs, noise=noise)]
    from_stock, from_engine = (float(gap.max()) for gap in gaps)
    verdict, cause = None, ""
    if not np.all(np.isfinite(ours.warmstart)):
        return Values(from_stock, from_engine)
    if not from_stock <= TOLERANCE:
        verdict = "value"
        if from_engine <= TOLERANCE:
            cause = "mjx.step differs from the step of this project and the C engine"
        else:
            third = "mjx.step" if float(apart(stock, theirs, noise=noise).max()) <= TOLERANCE else "neither"
            cause = f"this project's step is not that of mjx.step; the C engine agrees with {third}"
    elif not from_engine <= TOLERANCE:
        cause, documented = difference_of_engines(engine_step.host, state, stages, ours.warmstart, theirs.warmstart)
        verdict = "engine_mismatch" if documented else "engine"
    gap, other = (gaps[0], stock) if verdict == "value" else (gaps[1], theirs)
    worst = int(np.argmax(np.nan_to_num(gap, nan=np.inf)))
    ours_there, other_there = (float(change(layout.scene.host, state, after)[worst]) for after in (ours, other))
    return Values(from_stock, from_engine, verdict, cause, worst, (ours_there, other_there))


def change(host: mujoco.MjModel, before: HostState, after: HostState) -> Float[np.ndarray, " outputs"]:
    """Change of position in the tangent space, velocity and activation."""
    tangent = tangent_of(host, before.qpos, after.qpos)
    return np.concatenate([tangent, after.qvel - before.qvel, after.act - before.act])


def _apart(
    layout: Coordinates,
    before: HostState,
    ours: HostState,
    theirs: HostState,
    *,
    driven: float,
    noise: Float[np.ndarray, " outputs"] | float,
) -> Float[np.ndarray, " outputs"]:
    """Difference of two next states beyond rounding, relative to the largest velocity, acceleration, activation.

    The acceleration is at least `driven`, which constraints balance at rest: solvers stop within a share of that.
    """
    host, timestep = layout.scene.host, layout.scene.timestep
    speed, force, activation = (
        max(largest(getattr(ours, name)), largest(getattr(theirs, name))) for name in ("qvel", "warmstart", "act")
    )
    force = max(force, driven)
    speed = max(speed, timestep * force)
    still = np.zeros(host.nv)  # angular velocities that MJX treats as zero
    for _, _, first in quaternions(host):
        turning = np.abs(ours.qvel[first : first + 3])
        still[first : first + 3] = np.where(turning.max() <= MIN_TURNING, turning, 0.0)
    unseen = (ROUNDING * max(1.0, largest(before.qpos)) + timestep * still, ROUNDING * speed, ROUNDING)
    scales = (timestep * speed, timestep * force, activation)
    parts = np.split(change(host, theirs, ours), [host.nv, 2 * host.nv])
    gaps = [np.abs(part) - rounding for part, rounding in zip(parts, unseen, strict=True)]
    sizes = [np.full(len(part), max(scale, 1e-10 * timestep)) for part, scale in zip(parts, scales, strict=True)]
    return np.maximum(np.concatenate(gaps) - noise, 0.0) / np.concatenate(sizes)


def largest(values: np.ndarray) -> float:
    return float(np.abs(values).max(initial=0.0))


def difference_of_engines(
    host: mujoco.MjModel,
    state: HostState,
    stages: dict[str, Any],
    ours: Float[np.ndarray, " nv"],
    theirs: Float[np.ndarray, " nv"],
) -> tuple[str, bool]:
    """Describe the differences between the steps of the C engine and MJX, and whether all are documented.

    Args:
        stages: MJX's intermediate quantities at the state.
        ours, theirs: constrained acceleration of MJX and of the engine [m/s^2 or rad/s^2].
    """
    found, data = [], forward(host, state)
    if text := _stage(host, data, stages):
        host = copy.copy(host)
        for kind in ("body", "geom", "site"):
            getattr(host, f"{kind}_sameframe")[:] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
        data = forward(host, state)
        remains = _stage(host, data, stages)
        same_frame = f"{text} (C takes frames less than 1e-6 apart for the same, MJX does not)"
        found = [(remains, False) if remains else (same_frame, True)]
    contacts = _contacts(host, data, stages)
    if not found and not contacts and _relative(ours, theirs) <= TOLERANCE:
        found = [_integration(host)]
    elif all(documented for _, documented in found):
        found += contacts + _rows(host, data, stages, contacts=not contacts)
    found = found or [("the solution of the constraints", False)]
    return "; ".join(text for text, _ in found), all(documented for _, documented in found)


def _relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    return largest(ours - theirs) / max(largest(theirs), largest(ours), 1e-10)


def _stage(host: mujoco.MjModel, data: mujoco.MjData, stages: dict[str, Any]) -> str | None:
    """Return the first quantity that differs, which explains later ones; None if none differs."""
    inertia = np.zeros((host.nv, host.nv))
    mujoco.mj_fullM(host, data, inertia)
    for name, words in STAGES.items():
        theirs = inertia if name == "qM" else np.asarray(getattr(data, name))
        gap = _relative(np.asarray(stages[name]).reshape(theirs.shape), theirs)
        if not gap <= TOLERANCE:
            return f"{words} differ{'' if words.endswith('s') else 's'} by {gap:.1e}"
    return None


def _integration(host: mujoco.MjModel) -> Found:
    text = "the integration: the state after the step differs, its acceleration does not"
    fast = host.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    if fast and np.any(host.actuator_forcelimited | host.actuator_ctrllimited):
        return f"{text} (MJX's implicitfast damps as if no force or control were clamped)", True
    return text, False


def _contacts(host: mujoco.MjModel, data: mujoco.MjData, stages: dict[str, Any]) -> list[Found]:
    """Pairs of geoms whose contacts differ in number or position."""
    ours: dict[tuple[int, ...], list[np.ndarray]] = defaultdict(list)
    theirs: dict[tuple[int, ...], list[np.ndarray]] = defaultdict(list)
    for index in np.flatnonzero(stages["dist"] < stages["margin"]):
        geometry = np.concatenate([stages["dist"][[index]], stages["pos"][index], stages["frame"][index].ravel()])
        ours[tuple(sorted(stages["geom"][index].tolist()))].append(geometry)
    for contact in data.contact:
        if contact.exclude == 0:
            geometry = np.concatenate([[contact.dist], contact.pos, contact.frame])
            theirs[tuple(sorted(contact.geom.tolist()))].append(geometry)
    texts = []
    for pair in sorted(ours.keys() | theirs.keys()):
        mine, its = np.array(ours[pair]), np.array(theirs[pair])
        label = " and ".join(geom_label(host, geom) for geom in pair)
        if len(mine) != len(its):
            texts.append(f"{label} touch at {len(mine)} points in MJX, {len(its)} in C")
            continue
        order, match = _matched(cdist(mine[:, 1:4], its[:, 1:4]))
        gaps = np.abs(mine[order] - its[match]).max(axis=0)
        if not gaps.max() <= TOLERANCE:
            texts.append(
                f"contacts of {label} lie {gaps[1:4].max():.1e} m apart, their depths differ by {gaps[0]:.1e} m, their "
                f"normals by {gaps[4:7].max():.1e} and their tangents by {gaps[7:].max():.1e}"
            )
    return [(text, True) for text in texts]


def _rows(host: mujoco.MjModel, data: mujoco.MjData, stages: dict[str, Any], *, contacts: bool) -> list[Found]:
    """Kinds of constraint rows that differ, contact rows included on request.

    MJX sorts rows by kind and contacts by dimension, the C engine by objects and pairs of bodies; rows are therefore
    matched by their Jacobians, and those with equal Jacobians by the rest. Zero rows are ignored in both.
    """
    here = {name: stages[name] for name in ROWS}
    there = {"efc_J": _jacobian(host, data), "efc_aref": data.efc_aref, "efc_D": data.efc_D}
    live, alive = (np.abs(rows["efc_J"]).max(axis=1, initial=0.0) > MIN_ROW for rows in (here, there))
    kinds, labels = stages["efc_type"], _labels(host, data)
    found: list[Found] = []
    for kind in np.union1d(kinds[live], data.efc_type[alive]):
        if "contact" in _kind(kind) and not contacts:
            continue
        ours, theirs = np.flatnonzero(live & (kinds == kind)), np.flatnonzero(alive & (data.efc_type == kind))
        if len(ours) != len(theirs):
            found.append((f"there are {len(ours)} active {_kind(kind)} rows in MJX, {len(theirs)} in C", False))
            continue
        far, *rest = (_distances(here[name][ours], there[name][theirs]) for name in ROWS)
        order, match = _matched(far + 1e-3 * sum(rest))
        ours, theirs = ours[order], theirs[match]
        for label in dict.fromkeys(labels[theirs]):
            chosen = labels[theirs] == label
            for name, words in ROWS.items():
                gap = _relative(here[name][ours[chosen]], there[name][theirs[chosen]])
                known = name == "efc_aref" and label in ("connect equality", "weld equality")
                why = " (MJX leaves out -dJ/dt qvel, which the turning of the Jacobian adds)" if known else ""
                if not gap <= TOLERANCE:
                    found.append((f"{words} of {label} rows differ by {gap:.1e}{why}", known))
    return found


def _matched(distances: Float[np.ndarray, "ours theirs"]) -> tuple[np.ndarray, np.ndarray]:
    """Indices of pairs with the least total distance; nonfinite ones are matched last."""
    return linear_sum_assignment(np.nan_to_num(distances, nan=FAR, posinf=FAR))


def _distances(ours: np.ndarray, theirs: np.ndarray) -> Float[np.ndarray, "ours theirs"]:
    """Pairwise distances, relative to the largest magnitude."""
    mine, its = (rows.reshape(len(rows), -1) for rows in (ours, theirs))
    return cdist(mine, its, "chebyshev") / max(largest(mine), largest(its), MIN_ROW)


def _jacobian(host: mujoco.MjModel, data: mujoco.MjData) -> Float[np.ndarray, "rows nv"]:
    dense = np.zeros((data.nefc, host.nv))
    if not mujoco.mj_isSparse(host):
        return data.efc_J.reshape(dense.shape)
    mujoco.mju_sparse2dense(dense, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
    return dense


def _kind(kind: int | np.integer) -> str:
    return mujoco.mjtConstraint(int(kind)).name.removeprefix("mjCNSTR_").lower()


def _labels(host: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Kind of each of the engine's rows, with the type of equalities."""
    labels = np.array([_kind(kind) for kind in data.efc_type], dtype=object)
    for row in np.flatnonzero(labels == "equality"):
        labels[row] = f"{mujoco.mjtEq(int(host.eq_type[data.efc_id[row]])).name.removeprefix('mjEQ_').lower()} equality"
    return labels
