"""Inputs of a step's derivative: a flat vector of small changes of state, control and contact parameters.

Positions change in the tangent space, so quaternions stay normalised; their lengths are separate coordinates, which
together with the tangent space cover every change of a raw quaternion. Parameters change in every geom and pair at
once, each in units of its own size.
"""

import dataclasses
from collections.abc import Sequence
from typing import Final

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact import ContactModel, apply_contact
from mjx_study.simulation.dynamics import State
from mjx_study.simulation.integration import integrate_position
from mjx_study.simulation.scene import Scene

PARAMETERS: Final = (
    *("solref[0]", "solref[1]"),
    *("solimp[d_0]", "solimp[d_width]", "solimp[width]", "solimp[midpoint]", "solimp[power]"),
    *("friction[sliding]", "friction[torsional]", "friction[rolling]"),
)
LENGTH: Final = "quaternion length"
PAIR_FRICTION: Final = np.array([0, 0, 1, 2, 2])
"""Index of the geom's friction coefficient (of three) for each of a pair's five."""
_BALL, _FREE = int(mujoco.mjtJoint.mjJNT_BALL), int(mujoco.mjtJoint.mjJNT_FREE)


@dataclasses.dataclass(frozen=True)
class Coordinate:
    """An entry of the flat vector or of a step's output.

    Attributes:
        block: qpos, quaternion length, qvel, act, ctrl or contact.
        joint: index of the joint, or -1.
    """

    block: str
    name: str
    joint: int = -1

    def __str__(self) -> str:
        return self.name if self.block == "contact" else f"{self.block}[{self.name}]"


@dataclasses.dataclass(frozen=True, eq=False)
class Coordinates:
    """Layout of the flat vector for one scene and contact model.

    Attributes:
        inputs: entries in the order position, quaternion lengths, velocity, activation, control, and contact parameters
            if the scene has contacts.
        outputs: a step's outputs: position, velocity, activation.
        scales: size of each contact parameter; empty if there are none.
    """

    scene: Scene
    inputs: tuple[Coordinate, ...]
    outputs: tuple[Coordinate, ...]
    scales: Float[np.ndarray, " parameters"]

    @property
    def num_state(self) -> int:
        """Number of inputs other than contact parameters."""
        return len(self.inputs) - len(self.scales)

    def columns(self, *blocks: str) -> list[int]:
        return [index for index, coordinate in enumerate(self.inputs) if coordinate.block in blocks]

    def blocks(self) -> list[str]:
        """The nonempty blocks of inputs, in order."""
        return list(dict.fromkeys(coordinate.block for coordinate in self.inputs))

    def state(
        self, base: State, control: Float[Array, " nu"], change: Float[Array, " changes"]
    ) -> tuple[State, Float[Array, " nu"]]:
        """Apply a change of the first `num_state` entries to state and control."""
        host = self.scene.host
        starts = np.cumsum([host.nv, len(quaternions(host)), host.nv, host.na])
        tangent, stretch, qvel, act, ctrl = jnp.split(change[: self.num_state], starts)
        qpos = integrate_position(host, base.qpos, tangent, 1.0)
        for index, (_, first) in enumerate(quaternions(host)):
            qpos = qpos.at[first : first + 4].multiply(1 + stretch[index])
        return dataclasses.replace(base, qpos=qpos, qvel=base.qvel + qvel, act=base.act + act), control + ctrl

    def model(
        self, contact: ContactModel | None, scales: Float[Array, " parameters"], change: Float[Array, " parameters"]
    ) -> mjx.Model:
        """Apply a contact model with its parameters changed in units of `scales`.

        Parameters set by the contact model are changed there, so that derivatives pass through `apply_contact`; others
        are changed in every geom and pair.
        """
        model = self.scene.model
        if not len(scales):
            return apply_contact(model, contact)
        solref, solimp, friction = jnp.split(change * scales, [2, 7])
        geoms = {"geom_friction": model.geom_friction + friction}
        geoms["pair_friction"] = model.pair_friction + friction[PAIR_FRICTION]
        if contact is None:
            geoms |= {"geom_solref": model.geom_solref + solref, "geom_solimp": model.geom_solimp + solimp}
            geoms |= {"pair_solref": model.pair_solref + solref, "pair_solimp": model.pair_solimp + solimp}
        else:
            own = None if contact.friction is None else contact.friction + friction
            contact = dataclasses.replace(
                contact, solref=contact.solref + solref, solimp=contact.solimp + solimp, friction=own
            )
        return apply_contact(model.replace(**geoms), contact)


def coordinates(scene: Scene, contact: ContactModel | None) -> Coordinates:
    host = scene.host
    dofs = dof_names(host)
    activations = _activation_names(host)
    inputs = [
        *(Coordinate("qpos", *dof) for dof in dofs),
        *(Coordinate(LENGTH, joint_name(host, joint), joint) for joint, _ in quaternions(host)),
        *(Coordinate("qvel", *dof) for dof in dofs),
        *(Coordinate("act", name) for name in activations),
        *(Coordinate("ctrl", _name(host, mujoco.mjtObj.mjOBJ_ACTUATOR, "actuator", i)) for i in range(host.nu)),
    ]
    scales = _parameter_scales(scene, contact)
    if len(scales):
        inputs += [Coordinate("contact", name) for name in PARAMETERS]
    outputs = [*(Coordinate("qpos", *dof) for dof in dofs), *(Coordinate("qvel", *dof) for dof in dofs)]
    outputs += [Coordinate("act", name) for name in activations]
    return Coordinates(scene, tuple(inputs), tuple(outputs), scales)


def quaternions(host: mujoco.MjModel) -> list[tuple[int, int]]:
    """Joint and first qpos index of each quaternion."""
    pairs = enumerate(zip(host.jnt_type.tolist(), host.jnt_qposadr.tolist(), strict=True))
    return [(joint, first + 3 * (kind == _FREE)) for joint, (kind, first) in pairs if kind in (_FREE, _BALL)]


def dof_names(host: mujoco.MjModel) -> list[tuple[str, int]]:
    """Name and joint of each degree of freedom."""
    moves = [f"translation {axis}" for axis in "xyz"]
    turns = [f"rotation {axis}" for axis in "xyz"]
    names: list[tuple[str, int]] = []
    for joint, kind in enumerate(host.jnt_type):
        name = joint_name(host, joint)
        parts: Sequence[str] = {_FREE: [*moves, *turns], _BALL: turns}.get(int(kind), [""])
        names += [(f"{name}, {part}" if part else name, joint) for part in parts]
    return names


def joint_name(host: mujoco.MjModel, joint: int) -> str:
    """A joint's name, or its body's if it is unnamed."""
    name = mujoco.mj_id2name(host, mujoco.mjtObj.mjOBJ_JOINT, joint)
    if name:
        return name
    body = mujoco.mj_id2name(host, mujoco.mjtObj.mjOBJ_BODY, int(host.jnt_bodyid[joint]))
    return f"joint {joint} of {body}" if body else f"joint {joint}"


def geom_label(host: mujoco.MjModel, geom: int) -> str:
    """A geom's name, or its body's and its type if it is unnamed."""
    name = mujoco.mj_id2name(host, mujoco.mjtObj.mjOBJ_GEOM, geom)
    if name:
        return name
    body = mujoco.mj_id2name(host, mujoco.mjtObj.mjOBJ_BODY, int(host.geom_bodyid[geom])) or "body"
    kind = mujoco.mjtGeom(int(host.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
    return f"the {kind} of {body}"


def _name(host: mujoco.MjModel, kind: mujoco.mjtObj, noun: str, index: int) -> str:
    return mujoco.mj_id2name(host, kind, index) or f"{noun} {index}"


def _activation_names(host: mujoco.MjModel) -> list[str]:
    names = [""] * host.na
    for index, (first, count) in enumerate(zip(host.actuator_actadr, host.actuator_actnum, strict=True)):
        for entry in range(max(int(count), 0) if first >= 0 else 0):
            names[first + entry] = _name(host, mujoco.mjtObj.mjOBJ_ACTUATOR, "actuator", index)
    return names


def _parameter_scales(scene: Scene, contact: ContactModel | None) -> Float[np.ndarray, " parameters"]:
    """Largest size of each parameter over all geoms, 1 if all are 0."""
    rows = scene.template._impl
    if rows.contact.dim.size == 0:  # pyright: ignore[reportAttributeAccessIssue]
        return np.zeros(0)
    model = apply_contact(scene.model, contact)
    leaves = [np.asarray(leaf) for leaf in (model.geom_solref, model.geom_solimp, model.geom_friction)]
    largest = np.concatenate([np.abs(leaf).max(axis=0) for leaf in leaves])
    return np.where(largest > 0, largest, 1.0)
