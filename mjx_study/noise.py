"""How a sample's key becomes its start and its noise; the same for MJX and for the reference systems."""

import jax
from jaxtyping import Array, Float, Key


def split_sample_key(key: Key[Array, ""]) -> tuple[Key[Array, ""], Key[Array, ""]]:
    """The keys of a sample's start state and of its noise."""
    start_key, noise_key = jax.random.split(key)
    return start_key, noise_key


def standard_noise(noise_key: Key[Array, ""], shape: tuple[int, int], dtype) -> Float[Array, "steps dimensions"]:
    """Standard normal noise of a whole rollout, (steps, dimensions); times sigma it is what a policy adds."""
    return jax.random.normal(noise_key, shape, dtype)
