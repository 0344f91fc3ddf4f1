"""From a sample's key to its initial state and noise; the same for MJX and for the reference systems."""

import jax
from jaxtyping import Array, Float, Key

from estimators import NOISES, NoiseDensity


def split_sample_key(key: Key[Array, ""]) -> tuple[Key[Array, ""], Key[Array, ""]]:
    """The keys of a sample's initial state and of its noise."""
    start_key, noise_key = jax.random.split(key)
    return start_key, noise_key


def standard_noise(
    noise_key: Key[Array, ""], shape: tuple[int, int], dtype, density: str = "gaussian"
) -> Float[Array, "steps dimensions"]:
    """Unit-variance noise of a whole rollout, (steps, dimensions); a policy adds it times sigma."""
    return NOISES[density].draw(noise_key, shape, dtype)


def noise_score(
    noise: Float[Array, "..."], sigma: float | Float[Array, ""], density: str = "gaussian"
) -> Float[Array, "..."]:
    """Score grad psi(w) of noise with standard deviation sigma."""
    return NOISES[density].score(noise / sigma) / sigma


def check_density(name: str) -> NoiseDensity:
    """The noise density of that name.

    Raises:
        ValueError: unknown name.
    """
    if name not in NOISES:
        raise ValueError(f"the noise density must be one of {', '.join(NOISES)}; got {name!r}")
    return NOISES[name]
