"""Compiled programs of a check: values for finite differences, and derivatives in both modes.

There are three or four small programs for any number of states, contact models and directions. Steps and directions run
one by one (`lax.map`) rather than as a batch.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_study.compiled import Builds, Compiled
from mjx_study.gradcheck.coordinates import Coordinates
from mjx_study.gradcheck.values import STAGES
from mjx_study.identity import code_of
from mjx_study.simulation import constraint
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact import ContactModel, has_mujoco_law
from mjx_study.simulation.dynamics import State, exact_step, step
from mjx_study.simulation.engine import HostState
from mjx_study.simulation.integration import difference_position
from mjx_study.watchdog import awaited

OPTIONS: Final = {"xla_backend_optimization_level": "0", "xla_cpu_use_fusion_emitters": False}
"""XLA options on CPUs: half the compile time of the default code generator, and fast enough for these checks."""
THREADS: Final = 2  # number of programs compiled at once; each takes a core and up to a gigabyte for large models
BATCH: Final = 64  # steps per call of the value program
DIRECTIONS: Final = 96  # maximum number of directions, forwards or backwards, per call of a derivative program


class Compiler(Builds):
    """Compiles programs fast, with little optimisation, in background threads."""

    def __init__(self) -> None:
        super().__init__(THREADS, OPTIONS if jax.default_backend() == "cpu" else None)

    def run(self, program: Compiled, *arguments: Any) -> Any:
        with awaited():
            self.start(program, *arguments)
            self.wait(program)
            return program(*arguments)


def compiled(name: str, function: Callable[..., Any], *made_of: Any) -> Compiled:
    """A program made of the code of checks and what else the function captures."""
    return Compiled(function, name, *made_of, code_of(__name__))


class ContactCase(NamedTuple):
    """A contact model, None for the MJCF's, and the units of its parameters."""

    contact: ContactModel | None
    scales: Float[np.ndarray, " parameters"]


@dataclasses.dataclass(frozen=True)
class Linear:
    """Value and derivatives of a step at one state; `tape` is the reverse-mode Jacobian on the tape, if `reverse` uses
    the Jacobian program."""

    qpos: Float[np.ndarray, " nq"]
    residual: float
    forward: Float[np.ndarray, "outputs inputs"]
    reverse: Float[np.ndarray, "outputs inputs"]
    tape: Float[np.ndarray, "outputs inputs"] | None = None


@dataclasses.dataclass(frozen=True)
class Exact:
    """A step with constraints solved to rounding.

    Attributes:
        after: with the constrained acceleration as its warm start.
        stages: quantities before the constraint solve.
        outputs: (position relative to a reference, velocity, activation) after each change.
    """

    after: HostState
    stages: dict[str, Any]
    outputs: Float[np.ndarray, "batch outputs"]


class Programs:
    """Compiled programs of one scene; contact models and states are arguments."""

    def __init__(self, layout: Coordinates, compiler: Compiler | None = None):
        self.layout = layout
        self.compiler = compiler or Compiler()
        # Small scenes have a Jacobian over the state; derivatives of large ones, and over parameters, use the tape.
        inputs = len(layout.inputs)
        self._sizes = sorted({layout.num_state if layout.scene.uses_graph else inputs, inputs})
        made_of = layout.scene, layout.inputs, layout.outputs
        self._linear = compiled("derivatives of a step", self._derivatives_along, *made_of)
        self._exact = compiled("converged steps", self._steps_after, *made_of)
        self._stock = compiled("derivatives of mjx.step", self._stock_derivatives, *made_of)
        self._stock_step = compiled("mjx.step", self._step_of_mjx, *made_of)
        self._random = np.random.default_rng(0)

    def start(self, case: ContactCase, base: HostState, *, stock: bool) -> None:
        point, inputs, outputs = _point(case, base), len(self.layout.inputs), len(self.layout.outputs)
        for size in reversed(self._sizes):
            self.compiler.start(self._linear, point, _unit_rows(0, size), _unit_rows(0, outputs))
        self.compiler.start(self._exact, point, jnp.asarray(base.qpos), np.zeros((BATCH, inputs)))
        if has_mujoco_law(case.contact):
            self.compiler.start(self._stock_step, point, self._shake())
        if stock:
            self.compiler.start(self._stock, point, _unit_rows(0, inputs))

    def exact(
        self, case: ContactCase, base: HostState, reference: Array, changes: Float[np.ndarray, "batch inputs"]
    ) -> Exact:
        """Take the converged step after each change, the first of which is zero; positions relative to `reference`."""
        point = _point(case, base)
        padded = np.pad(changes, ((0, -len(changes) % BATCH), (0, 0)))
        chunks = padded.reshape(-1, BATCH, padded.shape[1])
        found = [self.compiler.run(self._exact, point, reference, chunk) for chunk in chunks]
        after, stages = jax.tree.map(lambda leaf: np.asarray(leaf)[0], found[0][1:])
        outputs = np.concatenate([np.asarray(output) for output, *_ in found])
        return Exact(_host(after, base), stages, outputs[: len(changes)])

    def linear(self, case: ContactCase, base: HostState) -> Linear:
        found = [self._derivatives(size, case, base) for size in self._sizes]
        own, tape = found[0], found[-1]
        if own is tape:
            return own
        parameters = self.layout.columns("contact")  # over which both modes use the tape
        forward = np.concatenate([own.forward, tape.forward[:, parameters]], axis=1)
        reverse = np.concatenate([own.reverse, tape.reverse[:, parameters]], axis=1)
        return Linear(own.qpos, own.residual, forward, reverse, tape.reverse)

    def stock_step(self, case: ContactCase, base: HostState, shake: float = 0.0) -> HostState:
        """Return the state after `mjx.step`, run to convergence from the warm start, with geoms moved by up to `shake`
        [m]."""
        return _host(self.compiler.run(self._stock_step, _point(case, base), self._shake(shake)), base)

    def _shake(self, most: float = 0.0) -> Float[np.ndarray, "geoms 3"]:
        return most * self._random.uniform(-1, 1, (self.layout.scene.host.ngeom, 3))

    def stock(self, case: ContactCase, base: HostState) -> Float[np.ndarray, "outputs inputs"]:
        """Jacobian of `mjx.step` by forward mode."""
        inputs, point = len(self.layout.inputs), _point(case, base)
        pushes = [_unit_rows(first, inputs) for first in range(0, inputs, DIRECTIONS)]
        rows = [np.asarray(self.compiler.run(self._stock, point, push)) for push in pushes]
        return np.concatenate(rows)[:inputs].T

    def _derivatives(self, inputs: int, case: ContactCase, base: HostState) -> Linear:
        """Derivatives with respect to the first inputs."""
        outputs, point = len(self.layout.outputs), _point(case, base)
        found = [
            self.compiler.run(self._linear, point, _unit_rows(first, inputs), _unit_rows(first, outputs))
            for first in range(0, max(inputs, outputs), DIRECTIONS)
        ]
        (qpos, *_), (residual, *_), pushed, pulled = zip(*found, strict=True)
        forward, reverse = np.concatenate(pushed)[:inputs].T, np.concatenate(pulled)[:outputs]
        return Linear(np.asarray(qpos), float(residual), forward, reverse)

    def _after(self, step_function, point, change, parameters, reference=None):
        """Outputs after a change, relative to a given position or that after the step; and the state there."""
        layout, ((contact, scales), state, control) = self.layout, point
        moved, moved_control = layout.state(state, control, change)
        after, *rest = step_function(layout.scene, layout.model(contact, scales, parameters), moved, moved_control)
        reference = jax.lax.stop_gradient(after.qpos) if reference is None else reference
        tangent = difference_position(layout.scene.host, reference, after.qpos)
        return jnp.concatenate([tangent, after.qvel, after.act]), (after, *rest)

    def _steps_after(self, point, reference, changes):
        def one(change):
            parameters = change[self.layout.num_state :]
            output, (after, _, data) = self._after(exact_step, point, change, parameters, reference)
            contact, scales = point[0]
            return output, after, _stages(self.layout.model(contact, scales, parameters), data)

        return jax.lax.map(one, changes)

    def _derivatives_along(self, point, push_rows, pull_rows):
        """Position after the step, residual, and derivatives along rows, forwards and backwards."""
        num_state, still, fixed = self.layout.num_state, jnp.zeros(len(self.layout.inputs)), None
        if push_rows.shape[1] < len(still):
            still, fixed = jnp.split(still, [num_state])

        def output(change):
            return self._after(step, point, change, change[num_state:] if fixed is None else fixed)

        _, push, (after, residual) = jax.linearize(output, still, has_aux=True)
        pull = jax.linear_transpose(push, still)
        return after.qpos, residual, jax.lax.map(push, push_rows), jax.lax.map(lambda row: pull(row)[0], pull_rows)

    def _stock_derivatives(self, point, push_rows):
        def output(change):
            return self._after(_mjx_step, point, change, change[self.layout.num_state :])[0]

        _, push = jax.linearize(output, jnp.zeros(len(self.layout.inputs)))
        return jax.lax.map(push, push_rows)

    def _step_of_mjx(self, point, shake):
        layout, ((contact, scales), state, control) = self.layout, point
        model = constraint.with_generous_budget(layout.model(contact, scales, jnp.zeros(len(layout.scales))))
        model = model.replace(geom_pos=model.geom_pos + shake)
        return _mjx_step(layout.scene, model, state, control)[0]


def _stages(model: mjx.Model, data: Any) -> dict[str, Any]:
    rows = data._impl
    own = {name: getattr(data, name) for name in STAGES if name != "qM"}
    constraints = ("efc_type", "efc_J", "efc_aref", "efc_D", "efc_frictionloss")
    contacts = {name: jnp.asarray(getattr(rows.contact, name)) for name in ("dist", "pos", "frame", "geom")}
    own |= {name: jnp.asarray(getattr(rows, name)) for name in constraints}
    return own | contacts | {"qM": mjx.full_m(model, data), "margin": rows.contact.includemargin}


def _mjx_step(scene, model, state, control):
    data = scene.template.replace(
        qpos=state.qpos, qvel=state.qvel, act=state.act, ctrl=control, qacc_warmstart=state.warmstart
    )
    data = mjx.step(model, data)
    return State(data.qpos, data.qvel, data.act, data.qacc), jnp.zeros(())


def _point(case: ContactCase, base: HostState) -> tuple[ContactCase, State, Array]:
    arrays = (jnp.asarray(part) for part in (base.qpos, base.qvel, base.act, base.warmstart))
    return case, State(*arrays), jnp.asarray(base.control)


def _host(after: State, base: HostState) -> HostState:
    qpos, qvel, act, qacc = map(np.asarray, (after.qpos, after.qvel, after.act, after.warmstart))
    return HostState(qpos, qvel, act, base.control, qacc)


def _unit_rows(first: int, size: int) -> Float[np.ndarray, "directions size"]:
    """Rows of the identity from `first` on, `DIRECTIONS` or `size` if fewer, padded with zeros."""
    rows = np.eye(size)[first : first + DIRECTIONS]
    return np.pad(rows, ((0, min(DIRECTIONS, size) - len(rows)), (0, 0)))
