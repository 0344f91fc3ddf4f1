"""How large a plan may be; what is beyond is refused before anything is computed, with what to change."""

from collections.abc import Sequence
from typing import Final

from estimators import ESTIMATORS
from mjx_study.task import Task

MOST_MODELS: Final = 5_000
"""Contact models of one task."""
MOST_CELLS: Final = 50_000
"""Cells of a sweep, each of which is a file."""
MOST_PROGRAMS: Final = 500
"""Programs that a sweep compiles: a timestep, cone or task needs its own."""
MOST_PARAMS: Final = 10_000_000
"""Parameters of a network."""
MOST_LAYERS: Final = 100
"""Hidden layers of a network."""
MOST_STEPS: Final = 1_000_000
"""Of a rollout."""
MOST_GIB: Final = 16.0
"""Memory of the arrays that are held at once [GiB], as `check_memory` counts them."""


def check_count(count: int, what: str, limit: int, change: str) -> None:
    """Refuse more than a limit.

    Raises:
        ValueError: with the limit and what to change.
    """
    if count > limit:
        raise ValueError(f"{count} {what} are planned, and the limit is {limit}: {change}")


def check_memory(task: Task, estimators: Sequence[str], samples: int, *, other: int = 0) -> None:
    """Refuse a plan whose arrays do not fit into `MOST_GIB`.

    Args:
        task: gives the parameters P, steps H, controls m and the size n of the state.
        estimators: names; each keeps about three numbers for each of the N samples and P parameters, those that work
            step by step N H m (P with feedback) more, and those that linearise N H n (n + m).
        samples: N, those of all batches that are kept at once.
        other: numbers that are kept beside them.

    Raises:
        ValueError: with the limit and what to change.
    """
    host, params = task.scene.host, task.policy.num_params
    controls, state = host.nu, host.nq + host.nv + host.na
    needs = {oracle for name in estimators for oracle in ESTIMATORS[name].needs}
    each = params * (1 + 3 * len(estimators)) + task.horizon * controls
    if any("step" in oracle or oracle == "linearisation" for oracle in needs):
        each += task.horizon * controls * (1 if task.policy.additive else params)
    if "linearisation" in needs:
        each += task.horizon * state * (state + controls)
    gib = 8 * (samples * each + other) / 2**30
    if gib > MOST_GIB:
        raise ValueError(
            f"{samples} samples of {params} parameters and {task.horizon} steps need {gib:.3g} GiB of memory, and the "
            f"limit is {MOST_GIB:g} GiB: take fewer samples, seeds or steps, or share them between several runs"
        )
