"""The compiled programs of a check: values to take differences of, and derivatives in both modes.

Compiled with little optimisation: a check runs each program a few times, so that compiling is most of its cost. Steps
and directions go one by one (`lax.map`), not as a batch: jaxlib's batched Cholesky factorisations share a pool of
threads with the program that waits for them, and two at once wait for ever (seen with jaxlib 0.10.2 on two cores).
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_study._mjx import mjx
from mjx_study.contact import ContactModel
from mjx_study.dynamics import State, exact_step, smooth_stages, step, uses_jacobian
from mjx_study.engine import HostState
from mjx_study.gradcheck.coordinates import Coordinates
from mjx_study.integration import difference_position

BATCH: Final = 64
"""Steps in one call of the program of values."""
DIRECTIONS: Final = 96
"""Most directions, forwards or backwards, in one call of a program of derivatives."""


@dataclasses.dataclass(frozen=True)
class Linear:
    """A step's value and derivative at one state.

    Attributes:
        qpos: position after the step.
        value: velocity and activation after the step.
        qacc: the acceleration that the solver found [m/s^2 or rad/s^2].
        residual: relative, of the solver.
        forward: the Jacobian (outputs, inputs) by forward mode.
        reverse: the same by reverse mode.
        tape: the same by reverse mode on the tape, where `reverse` is that of the Jacobian program; else None.
    """

    qpos: Float[np.ndarray, " nq"]
    value: Float[np.ndarray, " nv_na"]
    qacc: Float[np.ndarray, " nv"]
    residual: float
    forward: Float[np.ndarray, "outputs inputs"]
    reverse: Float[np.ndarray, "outputs inputs"]
    tape: Float[np.ndarray, "outputs inputs"] | None


@dataclasses.dataclass(frozen=True, eq=False)
class Setting:
    """What is varied between contact models; all arguments of the compiled programs.

    Attributes:
        contact: the contact model, or None for the MJCF's own.
        scales: units of its parameters.
    """

    contact: ContactModel | None
    scales: Float[np.ndarray, " parameters"]


class Programs:
    """What is compiled for one scene; contact models and states are arguments."""

    def __init__(self, layout: Coordinates):
        self.layout = layout
        self._compiled: dict[Any, Callable[..., Any]] = {}

    def values(
        self,
        setting: Setting,
        base: HostState,
        reference: Array,
        changes: Float[np.ndarray, "batch inputs"],
    ) -> tuple[Float[np.ndarray, "batch outputs"], float, Float[np.ndarray, " nv"]]:
        """The converged step after each change, positions relative to `reference`.

        Returns:
            (position, velocity, activation) after each; the largest residual; the acceleration after the first change.
        """
        state, control = _device(base)
        traced = (setting.contact, setting.scales)
        padded = np.zeros((-(-len(changes) // BATCH) * BATCH, len(self.layout.inputs)))
        padded[: len(changes)] = changes
        outputs, residuals, accelerations = [], [], []
        for chunk in padded.reshape(-1, BATCH, padded.shape[1]):
            program = self._compile(self._values, traced, state, control, reference, chunk)
            output, residual, qacc = program(traced, state, control, reference, chunk)
            outputs.append(np.asarray(output))
            residuals.append(float(np.max(residual)))
            accelerations.append(np.asarray(qacc))
        return np.concatenate(outputs)[: len(changes)], max(residuals), accelerations[0][0]

    def linear(self, setting: Setting, base: HostState) -> Linear:
        """Value and derivatives of the project's own step at a state."""
        state, control = _device(base)
        traced = (setting.contact, setting.scales)
        inputs, outputs, num_state = len(self.layout.inputs), len(self.layout.outputs), self.layout.num_state
        parts: dict[str, list[np.ndarray]] = {}
        value: Any = None
        for first in range(0, max(num_state, outputs), DIRECTIONS):
            push, pull = _unit_rows(first, num_state), _unit_rows(first, outputs)
            program = self._compile(self._linear, traced, state, control, push, pull)
            value, rows = program(traced, state, control, push, pull)
            for name, array in rows.items():
                parts.setdefault(name, []).append(np.asarray(array))
        whole = {name: np.concatenate(arrays) for name, arrays in parts.items()}
        forward = np.zeros((outputs, inputs))
        forward[:, :num_state] = whole["forward"][:num_state].T
        reverse, tape = whole["reverse"][:outputs], whole.get("tape")
        if inputs > num_state:
            forward[:, num_state:] = np.asarray(whole["over_parameters"])[: inputs - num_state].T
        if tape is not None:
            tape = tape[:outputs]
            reverse = np.concatenate([reverse, tape[:, num_state:]], axis=1)
        qpos, after, qacc, residual = (np.asarray(part) for part in value)
        return Linear(qpos, after, qacc, float(residual), forward, reverse, tape)

    def stock(self, setting: Setting, base: HostState) -> Float[np.ndarray, "outputs inputs"]:
        """The derivative that `jax.jvp` takes through `mjx.step`."""
        state, control = _device(base)
        traced = (setting.contact, setting.scales)
        inputs = len(self.layout.inputs)
        rows = []
        for first in range(0, inputs, DIRECTIONS):
            push = _unit_rows(first, inputs)
            program = self._compile(self._stock, traced, state, control, push)
            rows.append(np.asarray(program(traced, state, control, push)))
        return np.concatenate(rows)[:inputs].T

    def stages(self, setting: Setting, base: HostState) -> dict[str, Any]:
        """Quantities of a step up to the constraint solve, for the comparison with the C engine."""
        state, control = _device(base)
        traced = (setting.contact, setting.scales)
        program = self._compile(self._stages, traced, state, control)
        return jax.tree.map(np.asarray, program(traced, state, control))

    def _compile(self, function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
        shapes = jax.tree.map(lambda leaf: (jnp.shape(leaf), str(jnp.result_type(leaf))), arguments)
        key = (function.__name__, str(jax.tree.structure(arguments)), str(shapes))
        if key not in self._compiled:
            self._compiled[key] = compile_quickly(function, *arguments)
        return self._compiled[key]

    def _after(self, step_function, traced, state, control, reference, change, parameters=None):
        """Outputs after a change; `parameters` apart, where a derivative is not to see them."""
        layout = self.layout
        moved, moved_control = layout.state(state, control, change)
        parameters = change[layout.num_state :] if parameters is None else parameters
        model = layout.model(traced[0], traced[1], parameters)
        after, residual = step_function(layout.scene, model, moved, moved_control)
        tangent = difference_position(layout.scene.host, reference, after.qpos)
        return jnp.concatenate([tangent, after.qvel, after.act]), after, residual

    def _values(self, traced, state, control, reference, changes):
        def one(change):
            output, after, residual = self._after(exact_step, traced, state, control, reference, change)
            return output, residual, after.warmstart

        return jax.lax.map(one, changes)

    def _linear(self, traced, state, control, push_rows, pull_rows):
        num_state = self.layout.num_state
        still = jnp.zeros(len(self.layout.inputs))
        after, residual = step(
            self.layout.scene, self.layout.model(traced[0], traced[1], still[num_state:]), state, control
        )

        def output(change, parameters=None):
            return self._after(step, traced, state, control, after.qpos, change, parameters)[0]

        rows = {}
        push, pull = _linearise(lambda change: output(change, still[num_state:]), still[:num_state])
        rows["forward"] = jax.lax.map(push, push_rows)
        if len(still) > num_state:
            push, pull_all = _linearise(output, still)
            over = jnp.eye(len(still))[num_state:]
            rows["over_parameters"] = jax.lax.map(push, over)
            if uses_jacobian(self.layout.scene):
                rows["tape"] = jax.lax.map(pull_all, pull_rows)
            else:
                pull = pull_all
        rows["reverse"] = jax.lax.map(pull, pull_rows)
        value = (after.qpos, jnp.concatenate([after.qvel, after.act]), after.warmstart, residual)
        return value, rows

    def _stock(self, traced, state, control, push_rows):
        def output(change):
            return self._after(_stock_step, traced, state, control, reference, change)[0]

        still = jnp.zeros(len(self.layout.inputs))
        model = self.layout.model(traced[0], traced[1], still[self.layout.num_state :])
        reference = _stock_step(self.layout.scene, model, state, control)[0].qpos
        _, push = jax.linearize(output, still)
        return jax.lax.map(push, push_rows)

    def _stages(self, traced, state, control):
        scene = self.layout.scene
        model = self.layout.model(traced[0], traced[1], jnp.zeros(len(traced[1])))
        data = smooth_stages(scene, model, state, control)
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
            "normal": contacts.frame[:, 0],
            "geom": jnp.asarray(contacts.geom),
            "efc_J": rows.efc_J,
            "efc_aref": rows.efc_aref,
            "efc_D": rows.efc_D,
            "efc_frictionloss": rows.efc_frictionloss,
        }


def compile_quickly(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """The function compiled for these arguments with little optimisation where the backend is a CPU."""
    lowered = jax.jit(function).lower(*arguments)
    if jax.default_backend() != "cpu":
        return lowered.compile()
    return lowered.compile(compiler_options={"xla_backend_optimization_level": "0"})


def _linearise(function, point):
    _, push = jax.linearize(function, point)
    pull = jax.linear_transpose(push, point)
    return push, lambda row: pull(row)[0]


def _stock_step(scene, model, state, control):
    data = scene.template.replace(
        qpos=state.qpos, qvel=state.qvel, act=state.act, ctrl=control, qacc_warmstart=state.warmstart
    )
    data = mjx.step(model, data)
    return State(data.qpos, data.qvel, data.act, data.qacc), jnp.zeros(())


def _device(base: HostState) -> tuple[State, Array]:
    arrays = (jnp.asarray(part) for part in (base.qpos, base.qvel, base.act, base.warmstart))
    return State(*arrays), jnp.asarray(base.control)


def _unit_rows(first: int, size: int) -> Float[np.ndarray, "directions size"]:
    """Rows of the identity from `first` on, `DIRECTIONS` of them or as many as there are in all, padded by zeros."""
    count = min(DIRECTIONS, size)
    rows = np.zeros((count, size))
    for row in range(min(count, max(size - first, 0))):
        rows[row, first + row] = 1.0
    return rows
