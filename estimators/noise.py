"""Noise densities exp(-psi), their scores grad psi, and the noise and initial state that belong to a sample's key."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

Draw = Callable[[Key[Array, ""], tuple[int, ...], jnp.dtype], Float[Array, "..."]]
Score = Callable[[Float[Any, "..."]], Float[Any, "..."]]
Density = Callable[[Float[np.ndarray, "..."]], Float[np.ndarray, "..."]]

LOGISTIC_SCALE = math.sqrt(3.0) / math.pi
LAPLACE_SCALE = math.sqrt(0.5)
DEGREES_OF_FREEDOM = 5.0
STUDENT_SCALE = math.sqrt((DEGREES_OF_FREEDOM - 2.0) / DEGREES_OF_FREEDOM)
STUDENT_PEAK = math.gamma((DEGREES_OF_FREEDOM + 1.0) / 2.0) / (
    math.sqrt(DEGREES_OF_FREEDOM * math.pi) * math.gamma(DEGREES_OF_FREEDOM / 2.0)
)


@dataclass(frozen=True)
class NoiseDensity:
    """A symmetric density of mean 0 and variance 1, applied entry by entry.

    sigma z has the score psi'(z) / sigma. E[psi'] = 0 and E[z psi'] = 1 make zeroth-order estimates unbiased;
    E[psi'^2], the Fisher information, scales their variance.

    Attributes:
        name: Key in `NOISES`, and in `estimators.choices.DENSITIES`.
        score: psi'(z).
        density: exp(-psi(z)), in NumPy and float64, for quadrature.
        reach: Upper bound on the |z| exceeded with a given probability.
        information: E[psi'^2] >= 1, least for the Gaussian.
    """

    name: str
    draw: Draw
    score: Score
    density: Density
    reach: Callable[[float], float]
    information: float


def _student_score(z: Float[Any, "..."]) -> Float[Any, "..."]:
    return (DEGREES_OF_FREEDOM + 1.0) * z / (DEGREES_OF_FREEDOM * STUDENT_SCALE**2 + z**2)


def _student_density(z: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    power = (DEGREES_OF_FREEDOM + 1.0) / 2.0
    return STUDENT_PEAK / STUDENT_SCALE * (1.0 + (z / STUDENT_SCALE) ** 2 / DEGREES_OF_FREEDOM) ** -power


def _student_reach(probability: float) -> float:
    """Bound the tail by the density without its 1, C (t^2 / n)^(-(n+1)/2): P(|t| > x) <= 2 C n^((n-1)/2) x^-n."""
    n = DEGREES_OF_FREEDOM
    return STUDENT_SCALE * (2.0 * STUDENT_PEAK * n ** ((n - 1.0) / 2.0) / probability) ** (1.0 / n)


NOISES: dict[str, NoiseDensity] = {
    noise.name: noise
    for noise in (
        NoiseDensity(
            "gaussian",
            jax.random.normal,
            score=lambda z: z,
            density=lambda z: np.exp(-(z**2) / 2.0) / math.sqrt(2.0 * math.pi),
            reach=lambda probability: math.sqrt(-2.0 * math.log(probability)),
            information=1.0,
        ),
        NoiseDensity(
            "logistic",
            lambda key, shape, dtype: LOGISTIC_SCALE * jax.random.logistic(key, shape, dtype),
            score=lambda z: jnp.tanh(z / (2.0 * LOGISTIC_SCALE)) / LOGISTIC_SCALE,
            density=lambda z: (1.0 - np.tanh(z / (2.0 * LOGISTIC_SCALE)) ** 2) / (4.0 * LOGISTIC_SCALE),
            reach=lambda probability: LOGISTIC_SCALE * math.log(2.0 / probability),
            information=1.0 / (3.0 * LOGISTIC_SCALE**2),
        ),
        NoiseDensity(
            "laplace",
            lambda key, shape, dtype: LAPLACE_SCALE * jax.random.laplace(key, shape, dtype),
            score=lambda z: jnp.sign(z) / LAPLACE_SCALE,
            density=lambda z: np.exp(-np.abs(z) / LAPLACE_SCALE) / (2.0 * LAPLACE_SCALE),
            reach=lambda probability: -LAPLACE_SCALE * math.log(probability),
            information=1.0 / LAPLACE_SCALE**2,
        ),
        NoiseDensity(
            "student",
            lambda key, shape, dtype: STUDENT_SCALE * jax.random.t(key, DEGREES_OF_FREEDOM, shape, dtype),
            score=_student_score,
            density=_student_density,
            reach=_student_reach,
            information=(DEGREES_OF_FREEDOM + 1.0) / ((DEGREES_OF_FREEDOM + 3.0) * STUDENT_SCALE**2),
        ),
    )
}


def split_sample_key(key: Key[Array, ""]) -> tuple[Key[Array, ""], Key[Array, ""]]:
    """Split a sample's key into those of its initial state and its noise."""
    start_key, noise_key = jax.random.split(key)
    return start_key, noise_key


def standard_noise(
    noise_key: Key[Array, ""], shape: tuple[int, int], dtype, density: str = "gaussian", normal: Draw | None = None
) -> Float[Array, "steps dimensions"]:
    """Draw unit-variance noise for a rollout, (steps, dimensions), which policies scale by sigma; `normal` draws that
    of the Gaussian."""
    draw = normal if normal and density == "gaussian" else NOISES[density].draw
    return draw(noise_key, (math.prod(shape),), dtype).reshape(shape)  # the same bits, in long vectors


@partial(jax.jit, static_argnames=("shape", "density"))
def batch_noise(
    keys: Key[Array, " samples"], shape: tuple[int, int], density: str
) -> tuple[Key[Array, " samples"], Float[Array, "samples steps dimensions"]]:
    """Return the initial-state keys and unit-variance noise of a batch of samples."""

    def one(key: Key[Array, ""]) -> tuple[Key[Array, ""], Float[Array, "steps dimensions"]]:
        start_key, noise_key = split_sample_key(key)
        return start_key, standard_noise(noise_key, shape, jnp.float64, density)

    return jax.vmap(one)(keys)


def noise_score(
    noise: Float[Array, "..."], sigma: float | Float[Array, ""], density: str = "gaussian"
) -> Float[Array, "..."]:
    """Score grad psi(w) of noise with standard deviation sigma."""
    return NOISES[density].score(noise / sigma) / sigma


def check_density(name: str) -> NoiseDensity:
    """Look up a noise density by name; a ValueError if there is none."""
    if name not in NOISES:
        raise ValueError(f"the noise density must be one of {', '.join(NOISES)}; got {name!r}")
    return NOISES[name]


def check_sigma(sigma: float) -> None:
    """Raise ValueError unless sigma is positive and finite."""
    if not 0 < sigma < math.inf:
        raise ValueError(f"sigma must be positive and finite, in the unit of the quantity it is added to; got {sigma}")
