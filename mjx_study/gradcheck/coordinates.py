"""Inputs of a step's derivative: a flat vector of small changes of state, control and contact parameters.

Positions change in the tangent space, so quaternions stay normalised; their lengths are separate coordinates, which
together with the tangent space cover every change of a raw quaternion. Parameters change in every geom and pair at
once, each in units of its own size.
"""

import dataclasses
from typing import Any, Final

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact import ContactModel, apply_contact
from mjx_study.simulation.dynamics import State
from mjx_study.simulation.integration import integrate_position
from mjx_study.simulation.names import joint_name
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
    """An entry of the flat vector or of a step's output; `block` is qpos, quaternion length, qvel, act, ctrl or
    contact, and `joint` its joint's index, if it has one."""

    block: str
    name: str
    joint: int | None = None

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
        for index, (_, first, _) in enumerate(quaternions(host)):
            qpos = qpos.at[first : first + 4].multiply(1 + stretch[index])
        return dataclasses.replace(base, qpos=qpos, qvel=base.qvel + qvel, act=base.act + act), control + ctrl

    def model(
        self, contact: ContactModel | None, scales: Float[Array, " parameters"], change: Float[Array, " parameters"]
    ) -> mjx.Model:
        """Apply a contact model with its parameters changed in units of `scales`: those set by the contact model there,
        so that derivatives pass through `apply_contact`, others in every geom and pair."""
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


def make_coordinates(scene: Scene, contact: ContactModel | None, *, parameters: bool = True) -> Coordinates:
    """Lay out the inputs and outputs of a step, with the contact parameters or without."""
    host = scene.host
    dofs = [(name, joint) for joint in range(host.njnt) for name in _dof_names(host, joint)]
    actuators = [host.actuator(index).name or f"actuator {index}" for index in range(host.nu)]
    spans = zip(host.actuator_actadr.tolist(), host.actuator_actnum.tolist(), actuators, strict=True)
    activations = sorted((first + entry, name) for first, count, name in spans for entry in range(count))
    positions = [Coordinate("qpos", *dof) for dof in dofs]
    velocities = [Coordinate("qvel", *dof) for dof in dofs]
    acts = [Coordinate("act", name) for _, name in activations]
    lengths = [Coordinate(LENGTH, joint_name(host, joint), joint) for joint, *_ in quaternions(host)]
    scales = _parameter_scales(scene, contact) if parameters else np.zeros(0)
    inputs = [*positions, *lengths, *velocities, *acts, *(Coordinate("ctrl", name) for name in actuators)]
    inputs += [Coordinate("contact", name) for name in PARAMETERS[: len(scales)]]
    return Coordinates(scene, tuple(inputs), (*positions, *velocities, *acts), scales)


def quaternions(host: mujoco.MjModel) -> list[tuple[int, int, int]]:
    """Joint, first qpos index and first degree of freedom of each quaternion."""
    joints = enumerate(zip(host.jnt_type.tolist(), host.jnt_qposadr.tolist(), host.jnt_dofadr.tolist(), strict=True))
    moved = {_BALL: 0, _FREE: 3}
    return [(joint, qpos + moved[kind], dof + moved[kind]) for joint, (kind, qpos, dof) in joints if kind in moved]


def joints_above(host: mujoco.MjModel, body: int) -> set[int]:
    """Joints between a body and the world."""
    found: set[int] = set()
    while body:
        first = int(host.body_jntadr[body])
        found.update(range(first, first + int(host.body_jntnum[body])))
        body = int(host.body_parentid[body])
    return found


def _dof_names(host: mujoco.MjModel, joint: int) -> list[str]:
    name, kind = joint_name(host, joint), int(host.jnt_type[joint])
    parts = {_FREE: ("translation", "rotation"), _BALL: ("rotation",)}.get(kind)
    return [f"{name}, {part} {axis}" for part in parts for axis in "xyz"] if parts else [name]


def _parameter_scales(scene: Scene, contact: ContactModel | None) -> Float[np.ndarray, " parameters"]:
    """Largest size of each parameter over all geoms, 1 if all are 0; empty without contacts."""
    rows: Any = scene.template._impl
    if rows.contact.dim.size == 0:
        return np.zeros(0)
    model = apply_contact(scene.model, contact)
    leaves = [np.asarray(leaf) for leaf in (model.geom_solref, model.geom_solimp, model.geom_friction)]
    largest = np.concatenate([np.abs(leaf).max(axis=0) for leaf in leaves])
    return np.where(largest > 0, largest, 1.0)
