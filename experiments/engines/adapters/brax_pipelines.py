"""Brax's own pipelines: variants `spring`, `positional` and `generalized`, the last also with others of `SOLVERS`."""

from collections.abc import Callable
from importlib import import_module
from types import SimpleNamespace
from typing import Any, Final

from experiments.engines.adapters.jax_common import batched, started
from experiments.engines.scenes import Scene, Simulate, mjcf, mjcf_state

SPIN = 1e-6  # angular velocity of every body at the start of `generalized` [rad/s], whose derivative at rest is NaN


def short_steps(objective: Callable[[Any], Any], projection: Any, **options: Any) -> Any:
    """In place of `jaxopt.ProjectedGradient`, for a quadratic: steps of one over its largest curvature, no line search.

    A line search knows only the curvature along the step. Beyond twice this length, what the derivative has along the
    largest curvature grows from one iteration to the next.
    """
    jax: Any = import_module("jax")
    jaxopt: Any = import_module("jaxopt")

    def run(start: Any) -> Any:
        curvature = jax.lax.stop_gradient(jax.numpy.linalg.eigvalsh(jax.hessian(objective)(start))[-1])
        step = 1 / jax.numpy.maximum(curvature, 1e-9)  # 0 without contact
        return jaxopt.ProjectedGradient(objective, projection, stepsize=lambda _: step, **options).run(start)

    return SimpleNamespace(run=run)


def exact(objective: Callable[[Any], Any], projection: Any, **options: Any) -> Any:
    """In place of `jaxopt.ProjectedGradient`, for a quadratic: its least value over nonnegative numbers, from 0.

    The derivative holds the set of positive numbers. Reference: Lawson and Hanson, Solving Least Squares Problems
    (1974), chapter 23.
    """
    jax: Any = import_module("jax")
    jnp = jax.numpy

    def solve(free: Any, matrix: Any, vector: Any) -> Any:
        kept = jnp.where(free[:, None] & free, matrix, 0) + jnp.diag(jnp.where(free, 0.0, 1.0))
        return jnp.linalg.solve(kept, jnp.where(free, -vector, 0.0))

    def run(start: Any) -> Any:
        given = jax.hessian(objective)(start), jax.grad(objective)(start)
        matrix, vector = jax.lax.stop_gradient(given)
        rows, floor = jnp.diag(matrix) > 0, 1e-11 * (1 + jnp.max(jnp.abs(vector)))

        def descent(free: Any, numbers: Any) -> Any:
            return jnp.where(~free & rows, -(matrix @ numbers + vector), -jnp.inf)

        def shrink(state: Any) -> Any:
            free, numbers, target = state
            share = jnp.where(
                free & (target <= 0), numbers / jnp.where(numbers > target, numbers - target, 1.0), jnp.inf
            )
            numbers = numbers + jnp.min(share) * (target - numbers)
            free = free & (numbers > 1e-13)
            return free, jnp.where(free, numbers, 0.0), solve(free, matrix, vector)

        def grow(state: Any) -> Any:
            free, numbers, count = state
            free = free.at[jnp.argmax(descent(free, numbers))].set(True)
            state = free, numbers, solve(free, matrix, vector)
            free, _, target = jax.lax.while_loop(lambda at: jnp.any(at[0] & (at[2] <= 0)), shrink, state)
            return free, target, count + 1

        def more(state: Any) -> Any:
            free, numbers, count = state
            return (jnp.max(descent(free, numbers)) > floor) & (count < 4 * len(rows))

        free, _, _ = jax.lax.while_loop(more, grow, (jnp.zeros_like(rows), jnp.zeros_like(vector), 0))
        return SimpleNamespace(params=solve(free, *given))

    return SimpleNamespace(run=run)


SOLVERS: Final = {"short": short_steps, "exact": exact}
"""Of contact forces, in place of the projected gradient of `generalized`."""


def build(scene: Scene, timestep: float, variant: str) -> Simulate:
    """Return rollouts by one of the pipelines, with their own elasticity in place of a restitution."""
    family, _, solver = variant.partition("_")
    pipeline: Any = import_module(f"brax.{family}.pipeline")
    if solver:
        constraint: Any = import_module("brax.generalized.constraint")
        constraint.jaxopt = SimpleNamespace(
            ProjectedGradient=SOLVERS[solver], projection=import_module("jaxopt.projection")
        )
    loader: Any = import_module("brax.io.mjcf")
    qpos, qvel = mjcf_state(scene, scene.center)
    if family == "generalized" and len(qpos) > 1:
        qvel.reshape(-1, 6)[:, 3:] = SPIN

    def final_positions(jax, theta):
        jnp = jax.numpy
        system = loader.loads(mjcf(scene, timestep))
        system = system.replace(elasticity=jnp.full_like(system.elasticity, scene.restitution))
        start = pipeline.init(system, *started(jax, scene, (qpos, qvel), theta))

        def advance(state, _):
            return pipeline.step(system, state, jnp.zeros(system.act_size())), None

        last, _ = jax.lax.scan(advance, start, length=scene.steps(timestep))
        inertia = system.link.inertia.transform
        return jax.vmap(lambda x, inner: x.do(inner).pos)(last.x, inertia)

    # Of `generalized`, 100 iterations in every step: reverse mode takes minutes of compiling and gigabytes
    return batched(scene, final_positions, forward=family == "generalized")
