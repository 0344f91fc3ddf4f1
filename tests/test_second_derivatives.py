"""Second derivatives through contact: all four compositions of forward and reverse mode, against the C engine."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.ad_checkpoint import checkpoint_name

from mjx_study.graph.derivative_rule import refusing, with_rule
from mjx_study.simulation.drop_in import step
from mjx_study.simulation.dynamics import State, rollout
from tests.scenes import FALLING, MECHANISM, compiled, corrected_rollout, floor_scene, option, scene_of, slider

STEPS = 5
Function = Callable[[Any], Any]
COMPOSITIONS: dict[str, Callable[[Function], Function]] = {
    "forward over reverse": lambda f: jax.jacfwd(jax.jacrev(f)),
    "reverse over reverse": lambda f: jax.jacrev(jax.jacrev(f)),
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f)),
    "forward over forward": lambda f: jax.jacfwd(jax.jacfwd(f)),
}


def newton(square: Any) -> Any:
    """The root a of a + a^3/10 = x^2, by a loop that has no reverse mode."""
    advance = lambda carry: (carry[0] - (carry[0] + carry[0] ** 3 / 10 - square) / (1 + 0.3 * carry[0] ** 2), carry[1] + 1)  # noqa: E501, E731  # fmt: skip
    return jax.lax.while_loop(lambda carry: carry[1] < 30, advance, (square, 0))[0]


def root_rule(primals: Any, changes: Any) -> Any:
    value = checkpoint_name(root(*primals), "root")
    return value, 2 * primals[0] * changes[0] / (1 + 0.3 * value**2)


root = with_rule(lambda x: newton(jax.lax.stop_gradient(x**2)), root_rule)


def in_closed_form(x: Any) -> Any:
    return 2 * np.sqrt(10 / 3) * jnp.sinh(jnp.arcsinh(1.5 * np.sqrt(0.3) * x**2) / 3)


def scanned(advance: Function, x: Any) -> Any:
    return jax.lax.scan(lambda carry, _: (advance(carry), None), x, length=STEPS)[0]


def looped(advance: Function, x: Any) -> Any:
    for _ in range(STEPS):
        x = advance(x)
    return x


def checkpointed(advance: Function, x: Any) -> Any:
    return scanned(jax.checkpoint(advance, policy=jax.checkpoint_policies.save_only_these_names("root")), x)


def batched(advance: Function, x: Any) -> Any:
    return jax.vmap(partial(scanned, advance))(jnp.stack([2 * x, x]))[1]


@pytest.mark.parametrize("repeat", [scanned, looped, checkpointed, batched])
def test_a_rule_holds_at_every_order(repeat: Callable[[Function, Any], Any]) -> None:
    of_root, exact = (lambda x, f=f: repeat(lambda x: jnp.sin(x) + f(x) / 2, x) ** 2 for f in (root, in_closed_form))
    truth = jax.jit(jax.grad(jax.grad(exact)))(0.7)
    for name, compose in COMPOSITIONS.items():
        found = jax.jit(jax.vmap(compose(of_root)))(jnp.array([0.2, 0.7]))[1]
        np.testing.assert_allclose(found, truth, rtol=1e-12, err_msg=name)
    third = jax.jit(jax.grad(jax.jacfwd(jax.grad(of_root))))(0.7)
    np.testing.assert_allclose(third, jax.jit(jax.grad(jax.grad(jax.grad(exact))))(0.7), rtol=1e-11)


def test_what_refuses_derivatives_is_the_identity() -> None:
    tied = refusing("there is none")
    value = {"a": jnp.arange(3.0), "b": jnp.ones(2, int)}
    jax.tree.map(np.testing.assert_array_equal, jax.jit(tied)(value), value)
    with pytest.raises(TypeError, match="there is none"):
        jax.jit(jax.grad(lambda x: jax.lax.scan(lambda c, _: (tied(c), None), x, length=2)[0]))(1.0)
    assert jax.grad(lambda x: x * tied(jax.lax.stop_gradient(x)))(2.0) == 2.0


@dataclasses.dataclass(frozen=True)
class Contact:
    """A scene in contact, which two parameters push and throw.

    Attributes:
        source: the MJCF.
        qpos: positions at the start [m or rad; unit quaternions].
        qvel: velocities [m/s or rad/s], and how they change with the parameters.
        over_qvel: (nv, 2).
    """

    source: str
    qpos: tuple[float, ...]
    qvel: tuple[float, ...]
    over_qvel: tuple[tuple[float, float], ...]


ROLLER = '<body><freejoint/><geom size=".1" mass="1" friction=".3 .01 .01" condim="4"/></body>'
MODELS = {
    "falling": Contact(FALLING, (-5e-4,), (-0.1,), ((1, 0.5),)),
    "slider": Contact(
        floor_scene(slider(), option(extra='cone="elliptic"')),
        (0, 0, -5e-4), (0.4, 0.2, -0.1), ((1, 0), (0, 1), (0.1, 0.2)),
    ),
    "free sphere": Contact(
        floor_scene(ROLLER), (0, 0, 0.0995, 0.9, 0.1, -0.3, 0.3), (0.5, -0.3, -0.05, 0.3, 0.1, 0.7),
        ((1, 0), (0, 0.3), (0.1, 0), (0, 1), (0.5, 0), (0, 0.4)),
    ),
    "mechanism": Contact(
        MECHANISM, (-0.012, 0.02, 0.23, 0.3), (-0.3, 0.2, 0.4, -0.7), ((1, 0), (0.3, 0.2), (0, 1), (0.5, 0))
    ),
}  # fmt: skip


def cost(qpos: Any, qvel: Any) -> Any:
    """Of the last state: curved in positions and velocities."""
    weights = 1 + 0.3 * np.arange(qpos.shape[0])
    return (weights * qpos**2).sum() + (0.1 * qvel**3).sum() + (qpos[:2] * qvel[:2]).sum()


def start_of(contact: Contact) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    quaternion = len(contact.qpos) == 7
    qpos = np.array(contact.qpos)
    qpos[3:7] /= np.linalg.norm(qpos[3:7]) if quaternion else 1
    return qpos, np.array(contact.qvel), np.array(contact.over_qvel)


def by_steps(contact: Contact, repeat: Callable[[Function, Any], Any] = scanned, onset: str = "none") -> Function:
    """The cost after steps of the drop-in step, over the parameters."""
    scene = scene_of(contact.source)
    qpos, qvel, over_qvel = start_of(contact)

    def of(parameters: Any) -> Any:
        start = scene.template.replace(qpos=jnp.asarray(qpos), qvel=qvel + over_qvel @ parameters)
        last = repeat(partial(step, scene.model, onset=onset), start)
        return cost(last.qpos, last.qvel)

    return of


def by_rollout(contact: Contact, adjoint: str, *, corrected: bool = False) -> Function:
    """The same by the scenes' step."""
    scene = scene_of(contact.source, adjoint=adjoint)
    qpos, qvel, over_qvel = start_of(contact)
    simulate = corrected_rollout if corrected else rollout

    def of(parameters: Any) -> Any:
        empty = scene.template
        start = State(jnp.asarray(qpos), qvel + over_qvel @ parameters, empty.act, empty.qacc)
        states = simulate(scene, scene.model, start, lambda index, state: empty.ctrl, STEPS)[0]
        return cost(states.qpos[-1], states.qvel[-1])

    return of


def by_the_engine(contact: Contact) -> np.ndarray:
    """Hessian of the same by second differences of the C engine, with one Richardson step."""
    host = mujoco.MjModel.from_xml_string(contact.source)
    host.opt.tolerance = 0.0
    qpos, qvel, over_qvel = start_of(contact)

    def of(parameters: np.ndarray) -> float:
        data = mujoco.MjData(host)
        data.qpos[:], data.qvel[:] = qpos, qvel + over_qvel @ parameters
        for _ in range(STEPS):
            mujoco.mj_step(host, data)
        return float(cost(data.qpos, data.qvel))

    def differences(h: float) -> np.ndarray:
        corners = {(a, b): of(np.array([a, b]) * h) for a in (-1, 0, 1) for b in (-1, 0, 1)}
        first, second = (corners[at] + corners[-at[0], -at[1]] - 2 * corners[0, 0] for at in ((1, 0), (0, 1)))
        mixed = (corners[1, 1] + corners[-1, -1] - corners[1, -1] - corners[-1, 1]) / 4
        return np.array([[first, mixed], [mixed, second]]) / h**2

    return (4 * differences(5e-4) - differences(1e-3)) / 3


def assert_hessian(function: Function, contact: Contact, names: tuple[str, ...]) -> None:
    point, truth = jnp.zeros(2), by_the_engine(contact)
    assert np.abs(truth).min() > 1e-4
    every = compiled(lambda x: [COMPOSITIONS[name](function)(x) for name in names], point)(point)
    for name, found in zip(names, every, strict=True):
        np.testing.assert_allclose(found, truth, rtol=0, atol=1e-5 * np.abs(truth).max(), err_msg=name)


def test_a_hessian_through_scanned_contact() -> None:
    assert_hessian(by_steps(MODELS["falling"]), MODELS["falling"], ("forward over reverse",))


ROUTES: dict[str, Callable[[Contact], Function]] = {
    "scanned": by_steps,
    "looped": partial(by_steps, repeat=looped),
    "checkpointed": partial(by_steps, repeat=checkpointed),
    "batched": lambda contact: lambda x: jax.vmap(by_steps(contact))(jnp.stack([x, x + 0.01]))[0],
    "graph": partial(by_rollout, adjoint="graph"),
    "tape": partial(by_rollout, adjoint="tape"),
}


@pytest.mark.slow
@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("name", [name for name in MODELS if name != "falling"])
def test_hessians_are_the_engines(name: str, route: str) -> None:
    assert_hessian(ROUTES[route](MODELS[name]), MODELS[name], tuple(COMPOSITIONS))


@pytest.mark.parametrize("compose", [COMPOSITIONS["forward over reverse"], COMPOSITIONS["forward over forward"]])
def test_the_onset_term_has_no_second_derivative(compose: Callable[[Function], Function]) -> None:
    contact = MODELS["falling"]
    for function in (by_steps(contact, onset="linear"), by_rollout(contact, "graph", corrected=True)):
        with pytest.raises(TypeError, match="derivatives with the onset term are of first order"):
            jax.eval_shape(compose(function), jnp.zeros(2))
