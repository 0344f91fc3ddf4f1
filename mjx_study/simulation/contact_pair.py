"""Pairs of geoms that may touch, and the parameters that MuJoCo gives their contact."""

import dataclasses
import sys
from collections.abc import Iterator
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_study.simulation._mjx import mjx

NO_FRICTION: Final = mujoco.mjMINMU
"""Sliding friction that MuJoCo assigns to a contact whose geoms have none."""
_driver: Any = sys.modules[mjx.collision.__module__]  # its collision candidates are not public


@dataclasses.dataclass(frozen=True, eq=False)
class ContactPair:
    """Two geoms that are tested for collision, and the parameters of their contact.

    Attributes:
        first: index of the geom whose type has the smaller number.
        second: index of the other geom.
        condim: dimension of the contact: 1, 3, 4 or 6.
        friction: sliding (two directions) [1], torsional [m], rolling (two) [m].
        solref: (-k [1/s^2], -b [1/s]) or (time constant [s], damping ratio).
        solimp: d_0, d_width, width [m], midpoint, power.
        margin: distance at which contact begins [m].
    """

    first: int
    second: int
    condim: int
    friction: Float[np.ndarray, " 5"]
    solref: Float[np.ndarray, " 2"]
    solimp: Float[np.ndarray, " 5"]
    margin: float

    @property
    def slides(self) -> bool:
        """Whether the contact has friction."""
        return self.condim > 1 and bool(self.friction[0] > NO_FRICTION)


def contact_pairs(host: mujoco.MjModel) -> Iterator[ContactPair]:
    """Every pair of geoms that MJX tests for collision, with the parameters of an explicit <pair> or mixed ones."""
    for *both, index in _driver.geom_pairs(host):
        first, second = map(int, both)
        if index < 0:
            yield _mixed(host, first, second)
            continue
        friction, margin = np.maximum(host.pair_friction[index], NO_FRICTION), float(host.pair_margin[index])
        solref, solimp = host.pair_solref[index].copy(), host.pair_solimp[index].copy()
        yield ContactPair(first, second, int(host.pair_dim[index]), friction, solref, solimp, margin)


def frictionless_pair(host: mujoco.MjModel) -> ContactPair | None:
    """The first pair whose contact has tangential dimensions, but no friction; None without one."""
    if not any((friction[:, 0] <= NO_FRICTION).any() for friction in (host.geom_friction, host.pair_friction)):
        return None  # without a look at every pair
    return next((pair for pair in contact_pairs(host) if pair.condim > 1 and not pair.slides), None)


def _mixed(host: mujoco.MjModel, first: int, second: int) -> ContactPair:
    """Two geoms, of which the one with the higher priority decides.

    At equal priority MuJoCo takes the larger friction and condim, and mixes solref and solimp by solmix.

    Reference: MuJoCo documentation, Modeling, "Contact parameters".
    """
    both = np.array([first, second])
    ruling = both[host.geom_priority[both] == host.geom_priority[both].max()]
    condim, friction = host.geom_condim[ruling].max(), host.geom_friction[ruling].max(axis=0)[[0, 0, 1, 2, 2]]
    share, solref = _shares(host.geom_solmix[ruling]), host.geom_solref[ruling]
    solref = share @ solref if (solref[:, 0] > 0).all() else solref.min(axis=0)
    solimp, margin = share @ host.geom_solimp[ruling], host.geom_margin[both].sum()
    return ContactPair(first, second, int(condim), np.maximum(friction, NO_FRICTION), solref, solimp, float(margin))


def _shares(solmix: Float[np.ndarray, " geoms"]) -> Float[np.ndarray, " geoms"]:
    """Weights of geoms in their mixture."""
    solmix = np.where(solmix < mujoco.mjMINVAL, 0.0, solmix)
    return solmix / solmix.sum() if solmix.any() else np.full(len(solmix), 1 / len(solmix))


def geom_label(host: mujoco.MjModel, geom: int) -> str:
    """A geom's name, or its body's and its type if it is unnamed."""
    body = host.body(host.geom_bodyid[geom]).name or "body"
    kind = mujoco.mjtGeom(int(host.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
    return host.geom(geom).name or f"the {kind} of {body}"
