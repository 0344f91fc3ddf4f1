"""Limit the memory of a study's batches: compute few seeds at a time, and reject plans that need too much."""

from collections.abc import Sequence
from typing import Final

from estimators import ESTIMATORS, Estimator, oracles_of
from estimators.merged_samples import EXTREMES
from mjx_study.limits import MOST_GIB
from mjx_study.tasks.task import Task

BIAS_DRAWS: Final = 999
"""Number of draws of the bias test; its smallest p-value is 0.001."""
LARGEST_BATCH: Final = {"cpu": 20_000, "gpu": 2**17, "tpu": 2**17}
"""Maximum number of samples drawn at once, by backend; further seeds are drawn in turn."""
AT_ONCE: Final = {"cpu": 512e6, "gpu": 8e9, "tpu": 8e9}
"""Memory limit for the batches of several seeds [bytes]; those of a single seed may take more. Accelerators idle unless
many samples are drawn at once."""
PADDED: Final = (100, 400, 1600)
"""Sizes to which programs pad smaller batches, so that few numbers of samples compile anything."""
LARGEST_BLOCK: Final = 20_000
BLOCK_BYTES: Final = 512e6
"""Limits on a block's samples, which are even, and memory [bytes]; the same on all machines, so that any can compute a
block."""


def padded_size(samples: int) -> int:
    """Smallest size in `PADDED` that holds a batch, or its own."""
    return next((size for size in PADDED if size >= samples), samples)


def padded_seeds(seeds: int) -> int:
    """Smallest power of 16 that holds as many seeds: so many have keys."""
    return next(size for size in (16**power for power in range(1, 9)) if size >= seeds)


def bytes_per_sample(task: Task, oracles: Sequence[str], estimators: int, draws: int = BIAS_DRAWS) -> int:
    """Memory per sample [bytes]: every batch, gradients of every estimator, and the draws of the bias test."""
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
    numbers = sum(each[oracle] for oracle in oracles)
    return 8 * (numbers + 3 * estimators * params + 2 * draws)


def bytes_of_moments(estimators: Sequence[Estimator], params: int) -> int:
    """Memory of a block's moments [bytes], see `estimators.merged_samples.Moments`."""
    sizes = [(1 + params,) if len(each.needs) == 1 else (1 + params, 1 + params, 3 + 2 * params) for each in estimators]
    return 8 * sum(size * (size + 6 * EXTREMES) for each in sizes for size in each)


def check_batches(needed: int, change: str) -> None:
    """Raise ValueError for batches that need more memory than `MOST_GIB`, with what to change."""
    gib = needed / 2**30
    if gib > MOST_GIB:
        raise ValueError(
            f"the batches of a cell would take about {gib:.3g} GiB of memory, and the limit is {MOST_GIB:g} GiB: "
            f"{change}"
        )


def blocks_take(whole: Sequence[str]) -> str:
    """Describe which estimators support batches of any size."""
    able = [name for name, each in ESTIMATORS.items() if each.separable and name not in whole]
    return f"batches of any size are for {', '.join(able)}, without leave_one_out and cross_fitted"


def _gib(task: Task, estimators: Sequence[Estimator], samples: int) -> float:
    return samples * bytes_per_sample(task, oracles_of(estimators, "evaluation"), len(estimators), draws=0) / 2**30


def fits_in_memory(task: Task, estimators: Sequence[Estimator], samples: int) -> bool:
    """Whether the arrays fit into `MOST_GIB`."""
    return _gib(task, estimators, samples) <= MOST_GIB


def check_memory(task: Task, estimators: Sequence[Estimator], samples: int) -> None:
    """Raise ValueError for arrays that do not fit into `MOST_GIB`, with what to change."""
    if (gib := _gib(task, estimators, samples)) > MOST_GIB:
        raise ValueError(
            f"{samples} samples of {task.policy.num_params} parameters and {task.horizon} steps need {gib:.3g} GiB of "
            f"memory, and the limit is {MOST_GIB:g} GiB: use fewer samples, seeds or steps, or split them over several "
            "runs"
        )
