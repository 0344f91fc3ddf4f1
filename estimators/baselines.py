"""Baselines, subtracted from the values of zeroth-order samples.

A baseline b_i leaves E[(f_i - b_i) s_i] unchanged if it does not depend on the noise of sample i, because
E[s_i] = 0. The batch mean does depend on it: E[(f_i - fbar) s_i] = (1 - 1/N) grad F, a gradient shrunk towards
zero. The mean of the *other* samples does not, hence `leave_one_out`.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.types import Evaluation


def none(evaluation: Evaluation) -> Float[Array, " samples"]:
    """b_i = 0."""
    return jnp.zeros_like(evaluation.value)


def zero_noise(evaluation: Evaluation) -> Float[Array, " samples"]:
    """b_i = V_1(x_1^i, 0, theta), the zero-noise rollout from the same start.

    Reference: Suh et al. 2022, sec. "Gradient estimators", paragraph "Baseline".
    """
    return evaluation.baseline


def leave_one_out(evaluation: Evaluation) -> Float[Array, " samples"]:
    """b_i = 1/(N-1) sum_{j != i} f_j over finite values; 0 if there are no others.

    Sharing values makes the samples dependent. Each stays unbiased, but the variance of their mean exceeds
    E[sigmahat^2]/N by ||grad F||^2/(N-1)^2.
    """
    finite = jnp.isfinite(evaluation.value)
    value = jnp.where(finite, evaluation.value, 0.0)
    num_others = jnp.sum(finite).astype(value.dtype) - finite.astype(value.dtype)
    return jnp.where(num_others > 0, (jnp.sum(value) - value) / jnp.maximum(num_others, 1.0), 0.0)


BASELINES: dict[str, Callable[[Evaluation], Float[Array, " samples"]]] = {
    "none": none,
    "zero_noise": zero_noise,
    "leave_one_out": leave_one_out,
}


def find_baseline(name: str) -> Callable[[Evaluation], Float[Array, " samples"]]:
    """Look up a baseline by name.

    Raises:
        ValueError: No baseline has that name.
    """
    if name not in BASELINES:
        raise ValueError(f"baseline must be one of {', '.join(BASELINES)}; got {name!r}")
    return BASELINES[name]
