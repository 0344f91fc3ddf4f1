"""Parts of a model's dynamics that a state exercises: contact by zone, limits, friction loss, equalities."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import mujoco
import numpy as np

from mjx_study.gradcheck.reach import NO_FRICTION, contact_parts
from mjx_study.simulation.scene import Scene

ZONES: Final = ("push", "stick", "slide", "separate")
"""Contact zones: push is frictionless; stick and slide have friction; separate is within the margin, without force."""
PARTS: Final = ("contact", *ZONES, "limit", "friction loss", "held", "slipping", "equality")
"""Parts that a state can exercise; friction loss is held, or slipping at its bound."""
_STATE, _KIND = mujoco.mjtConstraintState, mujoco.mjtConstraint
_LIMITS = (int(_KIND.mjCNSTR_LIMIT_JOINT), int(_KIND.mjCNSTR_LIMIT_TENDON))
_LOSSES = (int(_KIND.mjCNSTR_FRICTION_DOF), int(_KIND.mjCNSTR_FRICTION_TENDON))
_SATISFIED, _QUADRATIC = int(_STATE.mjCNSTRSTATE_SATISFIED), int(_STATE.mjCNSTRSTATE_QUADRATIC)


@dataclasses.dataclass(frozen=True)
class Coverage:
    """Number of states that exercise each part of a model.

    Attributes:
        counts: number of states by part, for the parts that the model has.
        missing: parts of the model that no state exercises.
        unreachable: contact, or zones of it, that no pair of geoms can reach, with the number of pairs.
    """

    states: int
    counts: dict[str, int]
    missing: tuple[str, ...]
    unreachable: dict[str, int] = dataclasses.field(default_factory=dict)

    def line(self) -> str:
        """Describe the coverage; empty if the model has nothing to exercise."""
        zones = [f"{zone} {self.counts[zone]}" for zone in (*ZONES, "held", "slipping") if zone in self.counts]
        of_contact = ", ".join(zone for zone in zones if zone.split()[0] in ZONES)
        of_loss = ", ".join(zone for zone in zones if zone.split()[0] not in ZONES)
        details = {"contact": of_contact, "friction loss": of_loss}
        parts = [
            f"{part} in {self.counts[part]}{f' ({details[part]})' if part in details else ''}"
            for part in ("contact", "limit", "friction loss", "equality")
            if part in self.counts
        ]
        parts += [
            f"{part} out of reach of {'the only pair' if pairs == 1 else f'all {pairs} pairs'} of geoms"
            for part, pairs in self.unreachable.items()
        ]
        return f"of {self.states} states, {'; '.join(parts)}" if parts else ""


def exercised(data: mujoco.MjData) -> frozenset[str]:
    """Parts active in a state of the C engine after its forward pass."""
    kinds, states = np.asarray(data.efc_type), np.asarray(data.efc_state)
    parts = {
        _zone(contact, kinds, states) for contact in data.contact if contact.exclude == 0 and contact.efc_address >= 0
    }
    if parts - {"separate"}:
        parts.add("contact")
    if np.any(np.isin(kinds, _LIMITS) & (states == _QUADRATIC)):
        parts.add("limit")
    losses = states[np.isin(kinds, _LOSSES)]
    if len(losses):
        parts |= {"friction loss"} | {"held" if state == _QUADRATIC else "slipping" for state in losses}
    if np.any(kinds == int(_KIND.mjCNSTR_EQUALITY)):
        parts.add("equality")
    return frozenset(parts)


def _zone(contact: Any, kinds: np.ndarray, states: np.ndarray) -> str:
    """Zone of a contact: its row's, or for a pyramid by whether all or some of its edges push."""
    first, dim = int(contact.efc_address), int(contact.dim)
    pyramid = kinds[first] == int(_KIND.mjCNSTR_CONTACT_PYRAMIDAL)
    found = set(states[first : first + (2 * (dim - 1) if pyramid else 1)].tolist())
    if found == {_SATISFIED}:
        return "separate"
    if dim == 1 or contact.friction[0] <= NO_FRICTION:
        return "push"
    return "stick" if found == {_QUADRATIC} else "slide"


def possible(scene: Scene, host: mujoco.MjModel) -> tuple[frozenset[str], dict[str, int]]:
    """Parts that a model has, from the constraint rows that MJX allocates; and `Coverage.unreachable`."""
    rows: Any = scene.template._impl
    parts, unreachable = contact_parts(host) if len(rows.contact.dim) else (set(), {})
    parts |= {"limit"} if rows.nl else set()
    parts |= {"friction loss", "held", "slipping"} if rows.nf else set()
    parts |= {"equality"} if rows.ne else set()
    return frozenset(parts), unreachable


OPTIONAL: Final = frozenset({"separate", "contact", "friction loss"})
"""Parts counted but not required: undamped contact never separates within its margin; the others have subparts."""


def coverage(
    parts: frozenset[str], states: Sequence[Collection[str]], unreachable: Mapping[str, int] = MappingProxyType({})
) -> Coverage:
    counts = {part: sum(part in state for state in states) for part in PARTS if part in parts}
    missing = [part for part, count in counts.items() if not count and part not in OPTIONAL]
    if "contact" in counts and not counts["contact"]:
        missing = ["contact", *(part for part in missing if part not in ZONES)]
    return Coverage(len(states), counts, tuple(missing), dict(unreachable))
