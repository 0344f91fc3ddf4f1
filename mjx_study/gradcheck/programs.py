"""Compiled programs of a check: values for finite differences, and derivatives in both modes.

There are three or four small programs for any number of states, contact models and directions. Steps and directions run
one by one (`lax.map`) rather than as a batch: jaxlib's batched Cholesky factorisations share a thread pool with the
program that waits for them, and two at once deadlock (seen with jaxlib 0.10.2 on two cores).
"""

import dataclasses
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_study.gradcheck.compiling import Compiler
from mjx_study.gradcheck.coordinates import Coordinates
from mjx_study.simulation import constraint
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact import ContactModel
from mjx_study.simulation.dynamics import State, exact_step, step
from mjx_study.simulation.engine import HostState
from mjx_study.simulation.integration import difference_position

BATCH: Final = 64
"""Steps per call of the value program."""
DIRECTIONS: Final = 96
"""Maximum number of directions, forwards or backwards, per call of a derivative program."""


@dataclasses.dataclass(frozen=True)
class Linear:
    """Value and derivatives of a step at one state.

    Attributes:
        forward: Jacobian (outputs, inputs) by forward mode.
        tape: reverse-mode Jacobian on the tape, if `reverse` uses the Jacobian program; else None.
    """

    qpos: Float[np.ndarray, " nq"]
    residual: float
    forward: Float[np.ndarray, "outputs inputs"]
    reverse: Float[np.ndarray, "outputs inputs"]
    tape: Float[np.ndarray, "outputs inputs"] | None


@dataclasses.dataclass(frozen=True)
class Exact:
    """A step with constraints solved to rounding.

    Attributes:
        after: state after the step, with the constrained acceleration as its warm start.
        stages: quantities of the step before the constraint solve, for comparison with the C engine.
        outputs: (position relative to a reference, velocity, activation) after each change.
    """

    after: HostState
    stages: dict[str, Any]
    outputs: Float[np.ndarray, "batch outputs"]


@dataclasses.dataclass(frozen=True, eq=False)
class Setting:
    """Arguments of the compiled programs that describe a contact model.

    Attributes:
        contact: the contact model, or None for the MJCF's own.
    """

    contact: ContactModel | None
    scales: Float[np.ndarray, " parameters"]


class Programs:
    """Compiled programs of one scene; contact models and states are arguments."""

    def __init__(self, layout: Coordinates, compiler: Compiler | None = None):
        self.layout = layout
        self.compiler = compiler or Compiler()

    def start(self, setting: Setting, base: HostState, *, stock: bool) -> None:
        """Start compiling the programs of `linear`, `exact`, `stock_step` and, on request, `stock`."""
        point, layout = _point(setting, base), self.layout
        rows = [_unit_rows(0, len(layout.inputs)), _unit_rows(0, len(layout.outputs))]
        if self._has_tape:
            self.compiler.start(self._tape, *point, *rows)
        if layout.scene.uses_jacobian:
            self.compiler.start(self._jacobian, *point, _unit_rows(0, layout.num_state), rows[1])
        self.compiler.start(self._exact, *point, jnp.asarray(base.qpos), np.zeros((BATCH, len(layout.inputs))))
        self.compiler.start(self._stock_step, *point)
        if stock:
            self.compiler.start(self._stock, *point, rows[0])

    def exact(
        self, setting: Setting, base: HostState, reference: Array, changes: Float[np.ndarray, "batch inputs"]
    ) -> Exact:
        """Take the converged step after each change, the first of which is zero; positions relative to `reference`."""
        rows = -(-len(changes) // BATCH) * BATCH
        padded = np.zeros((rows, len(self.layout.inputs)))
        padded[: len(changes)] = changes
        outputs, first = [], None
        for chunk in padded.reshape(-1, BATCH, padded.shape[1]):
            output, after, stages = self.compiler.run(self._exact, *_point(setting, base), reference, chunk)
            outputs.append(np.asarray(output))
            first = first or (after, stages)
        after, stages = jax.tree.map(lambda leaf: np.asarray(leaf)[0], first)
        return Exact(_host(after, base), stages, np.concatenate(outputs)[: len(changes)])

    def linear(self, setting: Setting, base: HostState) -> Linear:
        """Compute the value and derivatives of the project's own step at a state."""
        tape = self._derivatives(self._tape, setting, base) if self._has_tape else None
        if not self.layout.scene.uses_jacobian:
            assert tape is not None
            return Linear(*tape, None)
        qpos, residual, forward, reverse = self._derivatives(self._jacobian, setting, base)
        if tape is None:
            return Linear(qpos, residual, forward, reverse, None)
        # over parameters, both modes use the tape
        parameters = self.layout.columns("contact")
        forward = np.concatenate([forward, tape[2][:, parameters]], axis=1)
        reverse = np.concatenate([reverse, tape[3][:, parameters]], axis=1)
        return Linear(qpos, residual, forward, reverse, tape[3])

    def stock_step(self, setting: Setting, base: HostState) -> HostState:
        """Return the state after `mjx.step`, run to convergence from the warm start."""
        return _host(self.compiler.run(self._stock_step, *_point(setting, base)), base)

    def stock(self, setting: Setting, base: HostState) -> Float[np.ndarray, "outputs inputs"]:
        inputs, point = len(self.layout.inputs), _point(setting, base)
        pushes = [_unit_rows(first, inputs) for first in range(0, inputs, DIRECTIONS)]
        rows = [np.asarray(self.compiler.run(self._stock, *point, push)) for push in pushes]
        return np.concatenate(rows)[:inputs].T

    @property
    def _has_tape(self) -> bool:
        """Whether derivatives use the tape: for large scenes, and over contact parameters."""
        return len(self.layout.scales) > 0 or not self.layout.scene.uses_jacobian

    def _derivatives(self, program: Any, setting: Setting, base: HostState) -> tuple[Any, float, Any, Any]:
        """Position after the step, residual, and the Jacobian in forward and reverse mode."""
        layout, point = self.layout, _point(setting, base)
        inputs = len(layout.inputs) if program == self._tape else layout.num_state
        outputs, forward, reverse = len(layout.outputs), [], []
        qpos = residual = None
        for first in range(0, max(inputs, outputs), DIRECTIONS):
            rows = _unit_rows(first, inputs), _unit_rows(first, outputs)
            qpos, residual, pushed, pulled = self.compiler.run(program, *point, *rows)
            forward.append(np.asarray(pushed))
            reverse.append(np.asarray(pulled))
        forward, reverse = np.concatenate(forward)[:inputs].T, np.concatenate(reverse)[:outputs]
        return np.asarray(qpos), float(np.asarray(residual)), forward, reverse

    def _after(self, step_function, setting, state, control, change, parameters, reference=None):
        """Outputs after a change, relative to a given position or that after the step; and the state there."""
        layout = self.layout
        moved, moved_control = layout.state(state, control, change)
        after, *rest = step_function(
            layout.scene, layout.model(setting[0], setting[1], parameters), moved, moved_control
        )
        reference = jax.lax.stop_gradient(after.qpos) if reference is None else reference
        tangent = difference_position(layout.scene.host, reference, after.qpos)
        return jnp.concatenate([tangent, after.qvel, after.act]), (after, *rest)

    def _exact(self, setting, state, control, reference, changes):
        def one(change):
            parameters = change[self.layout.num_state :]
            output, (after, _, data) = self._after(exact_step, setting, state, control, change, parameters, reference)
            model = self.layout.model(setting[0], setting[1], parameters)
            return output, after, _stages(model, data)

        return jax.lax.map(one, changes)

    def _jacobian(self, setting, state, control, push_rows, pull_rows):
        still = jnp.zeros(len(self.layout.inputs))
        own, parameters = jnp.split(still, [self.layout.num_state])
        return _linearise(
            lambda change: self._after(step, setting, state, control, change, parameters), own, push_rows, pull_rows
        )

    def _tape(self, setting, state, control, push_rows, pull_rows):
        num_state = self.layout.num_state

        def output(change):
            return self._after(step, setting, state, control, change, change[num_state:])

        return _linearise(output, jnp.zeros(len(self.layout.inputs)), push_rows, pull_rows)

    def _stock(self, setting, state, control, push_rows):
        num_state = self.layout.num_state

        def output(change):
            return self._after(_mjx_step, setting, state, control, change, change[num_state:])[0]

        _, push = jax.linearize(output, jnp.zeros(len(self.layout.inputs)))
        return jax.lax.map(push, push_rows)

    def _stock_step(self, setting, state, control):
        scene, parameters = self.layout.scene, jnp.zeros(len(self.layout.scales))
        model = constraint.with_generous_budget(self.layout.model(setting[0], setting[1], parameters))
        return _mjx_step(scene, model, state, control)[0]


def _stages(model: mjx.Model, data: mjx.Data) -> dict[str, Any]:
    rows: Any = data._impl
    contacts = rows.contact
    return {
        "xpos": data.xpos,
        "ten_length": data.ten_length,
        "actuator_length": data.actuator_length,
        "qM": mjx.full_m(model, data),
        "qfrc_bias": data.qfrc_bias,
        "qfrc_passive": data.qfrc_passive,
        "qfrc_actuator": data.qfrc_actuator,
        "act_dot": data.act_dot,
        "qacc_smooth": data.qacc_smooth,
        "dist": contacts.dist,
        "margin": contacts.includemargin,
        "pos": contacts.pos,
        "frame": contacts.frame,
        "geom": jnp.asarray(contacts.geom),
        "efc_type": jnp.asarray(rows.efc_type),
        "efc_J": rows.efc_J,
        "efc_aref": rows.efc_aref,
        "efc_D": rows.efc_D,
        "efc_frictionloss": rows.efc_frictionloss,
    }


def _linearise(output, point, push_rows, pull_rows):
    """Position after the step, residual, and derivatives along rows, forwards and backwards."""
    _, push, (after, residual) = jax.linearize(output, point, has_aux=True)
    pull = jax.linear_transpose(push, point)
    return after.qpos, residual, jax.lax.map(push, push_rows), jax.lax.map(lambda row: pull(row)[0], pull_rows)


def _mjx_step(scene, model, state, control):
    data = scene.template.replace(
        qpos=state.qpos, qvel=state.qvel, act=state.act, ctrl=control, qacc_warmstart=state.warmstart
    )
    data = mjx.step(model, data)
    return State(data.qpos, data.qvel, data.act, data.qacc), jnp.zeros(())


def _point(setting: Setting, base: HostState) -> tuple[Any, State, Array]:
    arrays = (jnp.asarray(part) for part in (base.qpos, base.qvel, base.act, base.warmstart))
    return (setting.contact, setting.scales), State(*arrays), jnp.asarray(base.control)


def _host(after: State, base: HostState) -> HostState:
    qpos, qvel, act, qacc = map(np.asarray, (after.qpos, after.qvel, after.act, after.warmstart))
    return HostState(qpos, qvel, act, base.control, qacc)


def _unit_rows(first: int, size: int) -> Float[np.ndarray, "directions size"]:
    """Rows of the identity from `first` on, `DIRECTIONS` or `size` if fewer, padded with zeros."""
    rows = np.eye(size)[first : first + DIRECTIONS]
    return np.pad(rows, ((0, min(DIRECTIONS, size) - len(rows)), (0, 0)))
