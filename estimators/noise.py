"""Noise densities exp(-psi) and their scores grad psi, which is all that a zeroth-order estimate needs of them."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

Draw = Callable[[Key[Array, ""], tuple[int, ...], jnp.dtype], Float[Array, "..."]]
Score = Callable[[Float[Array, "..."]], Float[Array, "..."]]

LOGISTIC_SCALE = math.sqrt(3.0) / math.pi
LAPLACE_SCALE = math.sqrt(0.5)
DEGREES_OF_FREEDOM = 5.0
STUDENT_SCALE = math.sqrt((DEGREES_OF_FREEDOM - 2.0) / DEGREES_OF_FREEDOM)


@dataclass(frozen=True)
class NoiseDensity:
    """A symmetric density of mean 0 and variance 1, entry by entry.

    sigma z has the score psi'(z) / sigma. E[psi'] = 0 and E[z psi'] = 1, so that zeroth-order estimates are unbiased
    under each; E[psi'^2], the Fisher information, scales their variance.

    Attributes:
        name: Key in `NOISES`.
        description: One line.
        draw: Samples z from (key, shape, dtype).
        score: psi'(z).
        information: E[psi'^2] >= 1; the Gaussian's is least.
    """

    name: str
    description: str
    draw: Draw
    score: Score
    information: float


def _student_score(z: Float[Array, "..."]) -> Float[Array, "..."]:
    return (DEGREES_OF_FREEDOM + 1.0) * z / (DEGREES_OF_FREEDOM * STUDENT_SCALE**2 + z**2)


NOISES: dict[str, NoiseDensity] = {
    noise.name: noise
    for noise in (
        NoiseDensity("gaussian", "the paper's", jax.random.normal, lambda z: z, 1.0),
        NoiseDensity(
            "logistic",
            "heavier tails, bounded score",
            lambda key, shape, dtype: LOGISTIC_SCALE * jax.random.logistic(key, shape, dtype),
            lambda z: jnp.tanh(z / (2.0 * LOGISTIC_SCALE)) / LOGISTIC_SCALE,
            1.0 / (3.0 * LOGISTIC_SCALE**2),
        ),
        NoiseDensity(
            "laplace",
            "a score of constant size, which bounds zeroth-order samples",
            lambda key, shape, dtype: LAPLACE_SCALE * jax.random.laplace(key, shape, dtype),
            lambda z: jnp.sign(z) / LAPLACE_SCALE,
            1.0 / LAPLACE_SCALE**2,
        ),
        NoiseDensity(
            "student",
            "Student's t with 5 degrees of freedom: rare large steps",
            lambda key, shape, dtype: STUDENT_SCALE * jax.random.t(key, DEGREES_OF_FREEDOM, shape, dtype),
            _student_score,
            (DEGREES_OF_FREEDOM + 1.0) / ((DEGREES_OF_FREEDOM + 3.0) * STUDENT_SCALE**2),
        ),
    )
}
