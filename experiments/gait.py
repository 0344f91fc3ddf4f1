"""Is it the gradient? The lesson of notebooks/7_teach_a_quadruped.ipynb by either order, as docs/robots.md reports it.

    python -m experiments.gait    # two minutes on two cores

Zeroth order adds noise to the servos' targets, in antithetic pairs of rollouts, and weights each step's score with the
costs that follow it: two rollouts where first order takes one and differentiates it.
"""

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import jax
import jax.numpy as jnp
import nbformat
import optax

NOTEBOOK: Final = Path(__file__).parents[1] / "notebooks" / "7_teach_a_quadruped.ipynb"
SIGMA: Final = 0.1  # standard deviation of the noise [rad]


def lesson() -> dict[str, Any]:
    """Names that the notebook's cells define, up to the one that gives lessons."""
    names: dict[str, Any] = {}
    for cell in nbformat.read(NOTEBOOK, as_version=4).cells:
        if cell.source.startswith("LESSONS"):
            break
        if cell.cell_type == "code" and "install" not in cell.metadata.get("tags", ()):
            exec(cell.source.replace("%matplotlib inline", ""), names)
    return names


def zeroth_order(names: dict[str, Any]):
    """The notebook's `update`, by zeroth order."""
    the = SimpleNamespace(**names)

    def rollout(weights, clock, robot, noise):
        def advance(robot, noise):
            qpos, qvel, now = robot
            mean = the.act(weights, clock, robot)
            controls = jax.lax.stop_gradient(mean + SIGMA * noise)
            data = the.data.replace(qpos=qpos, qvel=qvel, time=now, ctrl=controls)
            after = the.mjx_study.step(the.model, data)
            found = the.cost_of(after.qpos, after.qvel), -0.5 * jnp.sum((controls - mean) ** 2) / SIGMA**2
            return (after.qpos, after.qvel, after.time), found

        end, (costs, likelihoods) = jax.lax.scan(advance, jax.lax.stop_gradient(robot), noise)
        return jnp.cumsum(costs[::-1])[::-1] / the.STEPS, likelihoods, end

    @jax.jit
    def update(weights, state, robots, key, clock, renewed):
        def surrogate(weights):
            noise = jax.random.normal(jax.random.fold_in(key, 1), (the.SAMPLES, the.STEPS, the.host.nu))
            play = jax.vmap(rollout, (None, None, 0, 0))
            (costs, likelihoods, ends), (other, opposite, _) = (
                play(weights, clock, robots, sign * noise) for sign in (1.0, -1.0)
            )
            change = jax.lax.stop_gradient(costs - other) / 4
            return jnp.mean(jnp.sum(change * (likelihoods - opposite), axis=1)), ends

        slope, ends = jax.grad(surrogate, has_aux=True)(weights)
        changes, state = the.optimizer.update(slope, state)
        return optax.apply_updates(weights, changes), state, the.renew(ends, key, renewed)

    return update


def main() -> None:
    """Print what each lesson leads to, by seed: tests passed, how long and far, and the median cost of a test."""
    names = lesson()
    for order, update in (("first", names["update"]), ("zeroth", zeroth_order(names))):
        names["update"] = update  # which `learn` calls
        for seed in range(names["SEEDS"]):
            began = time.perf_counter()
            weights = names["learn"](seed, 1.0, 0.2)
            print(f"{time.perf_counter() - began:.0f} s", end=" ")
            names["report"](f"{order} order, seed {seed}", weights, 1.0)


if __name__ == "__main__":
    main()
