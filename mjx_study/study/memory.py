"""Memory of a study's batches: seeds are computed a few at a time, and a plan that needs too much is refused."""

import math
from collections.abc import Sequence
from typing import Final

from mjx_study.limits import MOST_GIB
from mjx_study.tasks.task import Task

BIAS_DRAWS: Final = 999
"""Draws of the test for bias; its smallest p-value is 0.001."""
LARGEST_BATCH: Final = 20_000
"""Most samples drawn at once; further seeds are drawn in turn."""
AT_ONCE: Final = 512e6
"""Most memory for the batches of several seeds [bytes]; those of a single seed may take more."""


def numbers_per_sample(task: Task, oracle: str) -> int:
    """Numbers held by one sample of a batch."""
    params, (steps, dimensions) = task.policy.num_params, task.policy.noise_shape
    noise = steps * dimensions * (1 if task.policy.additive else 1 + params)  # scores, and the policy's Jacobian
    states = task.scene.host.nq + task.scene.host.nv + task.scene.host.na
    inputs = states + task.scene.host.nu
    each = {
        "evaluation": params + 3,
        "pair": 2 * (params + 3),
        "steps": 2 * steps + noise,
        "step_pair": 2 * (2 * steps + noise),
        "differentiation": params + 2,
        "corrected": params + 5,
        "step_differentiation": noise + 2,
        "linearisation": 2 * steps + noise + task.horizon * (inputs * (states + 1) + dimensions * states),
    }
    return each[oracle]


def bytes_per_sample(task: Task, oracles: Sequence[str], estimators: int) -> int:
    """Memory per sample [bytes]: every batch, gradients by every estimator, and the draws of the test for bias."""
    numbers = sum(numbers_per_sample(task, oracle) for oracle in oracles)
    return 8 * (numbers + 3 * estimators * task.policy.num_params + 2 * BIAS_DRAWS)


def seeds_at_once(memory_of_seed: int, seeds: int) -> int:
    """Number of seeds that fit into `AT_ONCE`, in as few and as equal groups as possible; at least one."""
    fitting = max(1, int(AT_ONCE / memory_of_seed))
    return math.ceil(seeds / math.ceil(seeds / fitting))


def check_memory(needed: int) -> None:
    """Refuse batches that need more than `MOST_GIB`.

    Args:
        needed: memory of the arrays held at once [bytes].

    Raises:
        ValueError: names the limit and what to change.
    """
    gib = needed / 2**30
    if gib > MOST_GIB:
        raise ValueError(
            f"the batches of a cell would take about {gib:.3g} GiB of memory, and the limit is {MOST_GIB:g} GiB: give "
            "fewer samples, seeds or steps"
        )
