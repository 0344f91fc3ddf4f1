r"""Contact models: parameters of MuJoCo's soft contact, in MuJoCo's terms and in N/m.

MuJoCo's contact acts on acceleration. Along the normal, with impedance d, penetration r < 0 and unconstrained
acceleration a_0, the acceleration becomes

    a_1 = (1 - d) a_0 - s b v - s^2 k r,        s = d / d_width,    k [1/s^2], b [1/s].

The impedance d = d(r) rises from d_0 at first touch to d_width at depth `width` and beyond, where s = 1. With
d_0 = d_width, s is 1 throughout; with d_0 near 0, spring and damper set in gradually.

For two bodies with effective mass m_eff along the normal, a spring K [N/m] and a damper B [N s/m] correspond to
k = K / m_eff, b = B / m_eff. One family covers the range of the study: d -> 0 is the penalty method, a spring added to
the other forces; d -> 1 is a constraint, which first cancels a_0. Under a static load the spring carries only the share
1 - d, so a resting contact has stiffness K / (1 - d).

MuJoCo encodes (k, b) as `solref`: negative numbers are (-k, -b); positive ones are a time constant and a damping ratio,
k = 1 / (timeconst dampratio)^2, b = 2 / timeconst. All are array leaves of `mjx.Model`, so sweeps over them compile
once.

Reference: MuJoCo documentation, Modeling, "Solver parameters".
"""

import dataclasses
import math
import warnings
from collections.abc import Sequence
from functools import partial

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from estimators.pytree import register_pytree
from mjx_study.choices import DEFAULT_SOLIMP, FAMILIES, MAX_IMPEDANCE, MIN_IMPEDANCE, unknown
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact_pair import ContactPair, contact_pairs
from mjx_study.simulation.law import Law, make_law, with_law
from mjx_study.simulation.scene import Scene
from mjx_study.table import percent


class ContactWarning(UserWarning):
    """Warns that MuJoCo would alter a contact model, or that the integrator cannot resolve it."""


@register_pytree
@dataclasses.dataclass(frozen=True)
class ContactModel:
    """Parameters for every contact of a scene; array leaves, so they can be traced and stacked.

    Attributes:
        solref: (-k [1/s^2], -b [1/s]) or (time constant [s], damping ratio), as in MuJoCo.
        solimp: impedance d_0, d_width, width [m], midpoint, power, as in MuJoCo.
        friction: sliding [1], torsional [m], rolling [m]; None keeps the MJCF's.
        margin: distance at which contact begins [m]; None keeps the MJCF's.
        backward: contact model whose derivatives replace this one's in a rollout (a surrogate gradient); None for exact
            derivatives.
        law: contact law; None for MuJoCo's.
    """

    solref: Float[Array, "*batch 2"]
    solimp: Float[Array, "*batch 5"]
    friction: Float[Array, "*batch 3"] | None = None
    margin: Float[Array, "*batch"] | None = None
    backward: "ContactModel | None" = None
    law: Law | None = None


def contact_model(
    solref: Sequence[float],
    solimp: Sequence[float] = DEFAULT_SOLIMP,
    friction: Sequence[float] | None = None,
    margin: float | None = None,
    *,
    scene: Scene,
) -> ContactModel:
    """Create a contact model in MuJoCo's terms, validated against a scene.

    Args:
        solref: (-k [1/s^2], -b [1/s]), both negative or zero; or (time constant [s], damping ratio), both positive.
        solimp: (d_0, d_width, width [m], midpoint, power), impedances in [1e-4, 0.9999].
        friction: (sliding, torsional [m], rolling [m]), nonnegative, or None for the MJCF's.
        margin: nonnegative margin [m], or None for the MJCF's.
        scene: scene with the timestep, integrator and flags.

    Raises:
        ValueError: MuJoCo would silently replace or clip a value.

    Warns:
        ContactWarning: `refsafe` would clip the time constant, or h^2 k exceeds the integrator's stability limit.
    """
    solref, solimp = tuple(map(float, solref)), tuple(map(float, solimp))
    _check_solref(solref)
    _check_solimp(solimp)
    if friction is not None and (len(friction) != 3 or not all(value >= 0 for value in friction)):
        raise ValueError(f"friction must be three numbers >= 0 (sliding, torsional, rolling), got {tuple(friction)}")
    if margin is not None and not margin >= 0:
        raise ValueError(f"margin must be >= 0 m, got {margin}")
    _warn_if_unstable(_as_clipped(solref, scene), scene.timestep)
    as_array = partial(jnp.asarray, dtype=scene.template.qpos.dtype)
    return ContactModel(
        as_array(solref),
        as_array(solimp),
        None if friction is None else as_array(friction),
        None if margin is None else as_array(margin),
    )


def family_model(
    name: str,
    scene: Scene,
    *,
    stiffness: float | None = None,
    damping: float | None = None,
    effective_mass: float,
    smoothing: float | None = None,
    edges: int = 1,
) -> ContactModel:
    """Create the member of a contact family with a given physical stiffness.

    Args:
        name: one of `FAMILIES` except "mjcf".
        scene: scene with the timestep, integrator and flags.
        stiffness: K [N/m], positive; None for single-point families.
        damping: B [N s/m], nonnegative; None for the family's damping ratio.
        effective_mass: effective mass of the contact along its normal [kg]; see `effective_mass`.
        smoothing: kappa of a law other than MuJoCo's [J]; None for the family's.
        edges: number of edges of the contact's cone, each a spring in laws other than MuJoCo's; see `cone_edges`.

    Raises:
        ValueError: unknown name, missing or superfluous stiffness, value out of range, or the family "mjcf", which has
            no contact model.
    """
    if name not in FAMILIES:
        raise ValueError(unknown("contact family", name, FAMILIES))
    family = FAMILIES[name]
    if not family.swept and (stiffness is not None or damping is not None):
        raise ValueError(f"contact family {name!r} is a single point and takes no stiffness or damping")
    if family.solimp is None:
        raise ValueError(f"contact family {name!r} keeps the model unchanged: use None instead of a contact model")
    law = make_law(name, family.smoothing if smoothing is None else smoothing) if family.smoothing else None
    if law is not None:
        law.check(scene)
    if family.solref is not None:
        solref = family.solref
    elif stiffness is None:
        raise ValueError(f"contact family {name!r} needs a stiffness in N/m")
    elif law is not None:
        solref_from_stiffness(stiffness, damping, effective_mass=effective_mass)  # checks them
        solref = law.solref(stiffness, damping, effective_mass=effective_mass, d_width=family.solimp[1], edges=edges)
    else:
        dampratio = family.dampratio if damping is None else None
        solref = solref_from_stiffness(stiffness, damping, effective_mass=effective_mass, dampratio=dampratio)
    return dataclasses.replace(contact_model(solref, family.solimp, scene=scene), law=law)


def solref_from_stiffness(
    stiffness: float, damping: float | None = None, *, effective_mass: float, dampratio: float | None = None
) -> tuple[float, float]:
    """Return the direct solref (-k, -b) of a spring K [N/m] with a damper B [N s/m] or a damping ratio.

    k = K / m_eff; b = B / m_eff, or 2 dampratio sqrt(k) for a damping ratio.

    Raises:
        ValueError: stiffness or effective mass not positive, damping negative, or damping given in both ways.
    """
    if not 0 < stiffness < math.inf:
        raise ValueError(f"stiffness must be positive and finite, in N/m; got {stiffness}")
    if not 0 < effective_mass < math.inf:
        raise ValueError(f"effective mass must be positive and finite, in kg; got {effective_mass}")
    if damping is not None and dampratio is not None:
        raise ValueError("give damping in N s/m or a damping ratio, not both")
    if damping is not None and not 0 <= damping < math.inf:
        raise ValueError(f"damping must be >= 0 and finite, in N s/m; got {damping}")
    if dampratio is not None and not 0 <= dampratio < math.inf:
        raise ValueError(f"damping ratio must be >= 0 and finite; got {dampratio}")
    k = stiffness / effective_mass
    b = 2 * (dampratio or 0.0) * math.sqrt(k) if damping is None else damping / effective_mass
    return -k, -b


def stiffness_from_solref(solref: Sequence[float], *, effective_mass: float) -> tuple[float, float]:
    """Return spring K [N/m] and damper B [N s/m] of a solref of either sign at full penetration (impedance d_width).

    The inverse of `solref_from_stiffness`; for positive solref K = m_eff / (timeconst dampratio)^2,
    B = 2 m_eff / timeconst.

    Raises:
        ValueError: mixed signs.
    """
    _check_solref(solref)
    first, second = map(float, solref)
    if first <= 0:
        return -first * effective_mass, -second * effective_mass
    return effective_mass / (first * second) ** 2, 2 * effective_mass / first


def contact_pair(scene: Scene, geom1: str | int, geom2: str | int) -> ContactPair:
    """The contact of two geoms given by names or indices, in either order.

    Raises:
        SceneError: unknown geom name.
        ValueError: the geoms are never tested for collision.
    """
    geoms = {scene.geom(geom) if isinstance(geom, str) else geom for geom in (geom1, geom2)}
    for pair in contact_pairs(scene.host):
        if {pair.first, pair.second} == geoms:
            return pair
    raise ValueError(
        f"geoms {geom1!r} and {geom2!r} never collide: they are excluded, fixed to each other, parent and child, or "
        "their contype and conaffinity have no bit in common"
    )


def effective_mass(scene: Scene, geom1: str, geom2: str) -> float:
    """Return the effective mass [kg] of the contact of two geoms along its normal, in the reference pose.

    MuJoCo scales contact forces by the inverse weights of the two bodies, m_eff = 1 / (w_1 + w_2). A pyramidal cone has
    2 (condim - 1) edges of weight 2 mu^2 (1 + mu^2) (w_1 + w_2) / impratio each, which together act like

        m_eff = 2 (condim - 1) impratio / (2 mu^2 (1 + mu^2) (w_1 + w_2))

    in the penalty limit, where mu is the sliding friction of the contact.

    Raises:
        SceneError: unknown geom name.
        ValueError: neither body can move, or the geoms never collide.
    """
    host = scene.host
    weight = float(sum(host.body_invweight0[host.geom_bodyid[scene.geom(name)], 0] for name in (geom1, geom2)))
    if not weight > 0:
        raise ValueError(f"geoms {geom1!r} and {geom2!r} are both fixed: their contact has no effective mass")
    pair = contact_pair(scene, geom1, geom2)
    if pair.condim == 1 or host.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        return 1 / weight
    mu = float(pair.friction[0])
    return 2 * (pair.condim - 1) * float(host.opt.impratio) / (2 * mu**2 * (1 + mu**2) * weight)


def cone_edges(scene: Scene, geom1: str, geom2: str) -> int:
    """Number of edges of the friction cone of two geoms' contact; 1 for elliptic and frictionless ones."""
    condim = contact_pair(scene, geom1, geom2).condim
    elliptic = scene.host.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    return 1 if condim == 1 or elliptic else 2 * (condim - 1)


def soften(contact: ContactModel, factor: float | Array) -> ContactModel:
    """Scale the stiffness of a contact model and its `backward` by a positive factor, at constant damping ratio."""
    first, second = contact.solref
    root = jnp.sqrt(factor)
    direct = jnp.stack([first * factor, second * root])
    solref = jnp.where(first > 0, jnp.stack([first / root, second]), direct)
    backward = None if contact.backward is None else soften(contact.backward, factor)
    return dataclasses.replace(contact, solref=solref, backward=backward)


def apply_contact(model: mjx.Model, contact: ContactModel | None) -> mjx.Model:
    """Apply a contact model to every geom and explicit pair; pure, and works on traced values.

    Both geoms of a pair are set, so MuJoCo's mixing by `solmix` and `priority` has no effect. None leaves the model
    unchanged.
    """

    def filled(name, value):
        leaf = getattr(model, name)
        return jnp.broadcast_to(value, leaf.shape).astype(jnp.result_type(leaf))

    applied = model.replace(**{name: filled(name, value) for name, value in _arrays_of(contact).items()})
    return applied if contact is None or contact.law is None else with_law(applied, contact.law)


def has_mujoco_law(contact: ContactModel | None) -> bool:
    """Whether `mjx.step` and the C engine have the law of a contact model, None for the MJCF's."""
    return contact is None or contact.law is None


def apply_to_host(host: mujoco.MjModel, contact: ContactModel | None) -> None:
    """`apply_contact` to a host model, in place."""
    for name, value in _arrays_of(contact).items():
        getattr(host, name)[:] = np.asarray(value)


def _arrays_of(contact: ContactModel | None) -> dict[str, Array]:
    """The model's arrays that a contact model sets, with the value of each of their rows."""
    if contact is None:
        return {}
    values = {f"{of}_{name}": getattr(contact, name) for of in ("geom", "pair") for name in ("solref", "solimp")}
    if contact.friction is not None:
        sliding, torsional, rolling = contact.friction
        pair = jnp.stack([sliding, sliding, torsional, rolling, rolling])
        values |= {"geom_friction": contact.friction, "pair_friction": pair}
    if contact.margin is not None:
        # MuJoCo adds the margins of two geoms
        values |= {"geom_margin": contact.margin / 2, "pair_margin": contact.margin}
    return values


def _check_solref(solref: Sequence[float]) -> None:
    if len(solref) != 2 or not all(math.isfinite(value) for value in solref):
        raise ValueError(f"solref must be two finite numbers, got {tuple(solref)}")
    first, second = solref
    if not ((first > 0 and second > 0) or (first <= 0 and second <= 0)):
        raise ValueError(
            f"solref {tuple(solref)} mixes signs and MuJoCo would fall back on its default: give (time constant, "
            "damping ratio), both positive, or (-k, -b), both negative or zero"
        )


def _check_solimp(solimp: Sequence[float]) -> None:
    if len(solimp) != 5 or not all(math.isfinite(value) for value in solimp):
        raise ValueError(f"solimp must be five finite numbers, got {tuple(solimp)}")
    for label, value in (("d_0", solimp[0]), ("d_width", solimp[1]), ("midpoint", solimp[3])):
        if not MIN_IMPEDANCE <= value <= MAX_IMPEDANCE:
            raise ValueError(
                f"solimp's {label} is {value}, and MuJoCo would clip it: it must lie in "
                f"[{MIN_IMPEDANCE}, {MAX_IMPEDANCE}]"
            )
    if not solimp[2] > 0:
        raise ValueError(f"solimp's width must be positive, in m; got {solimp[2]}")
    if not solimp[4] >= 1:
        raise ValueError(f"solimp's power must be at least 1, got {solimp[4]}")


def _as_clipped(solref: tuple[float, ...], scene: Scene) -> tuple[float, ...]:
    """The solref that acts, with a warning if `refsafe` clips it."""
    refsafe = not scene.host.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE
    if not (refsafe and 0 < solref[0] < 2 * scene.timestep):
        return solref
    warnings.warn(
        f"refsafe clips the time constant {solref[0]:g} s at two timesteps, {2 * scene.timestep:g} s; disable the "
        "flag refsafe in the MJCF, or give a negative solref (-k, -b), which is never clipped",
        ContactWarning,
        stacklevel=3,
    )
    return (2 * scene.timestep, solref[1])


def stable(solref: Sequence[float], timestep: float) -> bool:
    """Whether the contact step of h = `timestep` [s] is stable: for semi-implicit Euler, h^2 k < 4 - 2 h b."""
    k, b = stiffness_from_solref(solref, effective_mass=1.0)
    return bool(timestep**2 * k < 4 - 2 * timestep * b)


def _warn_if_unstable(solref: Sequence[float], timestep: float) -> None:
    if stable(solref, timestep):
        return
    k, b = stiffness_from_solref(solref, effective_mass=1.0)
    dampratio = b / (2 * math.sqrt(k)) if k > 0 else 0.0
    share = (2 * (math.sqrt(dampratio**2 + 1) - dampratio)) ** 2 / (timestep**2 * k) if k > 0 else 0.0
    warnings.warn(
        f"h^2 k = {timestep**2 * k:.3g} is not below 4 - 2 h b = {4 - 2 * timestep * b:.3g}: the step gains energy "
        f"while in contact; it is stable up to {percent(share)} of this stiffness at h = {timestep:g} s",
        ContactWarning,
        stacklevel=3,
    )
