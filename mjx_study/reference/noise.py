"""Initial states and noise from sample keys, shared by MJX and the reference systems."""

import math
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from estimators import NOISES, NoiseDensity


def split_sample_key(key: Key[Array, ""]) -> tuple[Key[Array, ""], Key[Array, ""]]:
    """Split a sample's key into those of its initial state and its noise."""
    start_key, noise_key = jax.random.split(key)
    return start_key, noise_key


def standard_noise(
    noise_key: Key[Array, ""], shape: tuple[int, int], dtype, density: str = "gaussian"
) -> Float[Array, "steps dimensions"]:
    """Draw unit-variance noise for a rollout, (steps, dimensions); policies scale it by sigma."""
    return NOISES[density].draw(noise_key, shape, dtype)


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
    """Look up a noise density by name.

    Raises:
        ValueError: unknown name.
    """
    if name not in NOISES:
        raise ValueError(f"the noise density must be one of {', '.join(NOISES)}; got {name!r}")
    return NOISES[name]


def check_sigma(sigma: float) -> None:
    """Raise ValueError unless sigma is positive and finite."""
    if not 0 < sigma < math.inf:
        raise ValueError(f"sigma must be positive and finite, in the unit of the quantity it is added to; got {sigma}")
