"""How a sample's key becomes its start and its noise; the same for MJX and for the reference systems."""

import jax
from jaxtyping import Array, Float, Key

from estimators import NOISES, NoiseDensity


def split_sample_key(key: Key[Array, ""]) -> tuple[Key[Array, ""], Key[Array, ""]]:
    """The keys of a sample's start state and of its noise."""
    start_key, noise_key = jax.random.split(key)
    return start_key, noise_key


def standard_noise(
    noise_key: Key[Array, ""], shape: tuple[int, int], dtype, density: str = "gaussian"
) -> Float[Array, "steps dimensions"]:
    """Noise of a whole rollout with variance 1, (steps, dimensions); times sigma it is what a policy adds."""
    return NOISES[density].draw(noise_key, shape, dtype)


def noise_score(
    noise: Float[Array, "..."], sigma: float | Float[Array, ""], density: str = "gaussian"
) -> Float[Array, "..."]:
    """grad psi(w) of noise with standard deviation sigma."""
    return NOISES[density].score(noise / sigma) / sigma


def check_density(name: str) -> NoiseDensity:
    """The density of that name.

    Raises:
        ValueError: there is none.
    """
    if name not in NOISES:
        raise ValueError(f"the noise density must be one of {', '.join(NOISES)}; got {name!r}")
    return NOISES[name]
