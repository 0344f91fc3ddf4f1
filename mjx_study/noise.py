"""How one sample's key becomes its start and its noise; the same for MJX and for the reference systems."""

import jax
from jaxtyping import Array, Float, Key


def split_sample_key(key: Key[Array, ""]) -> tuple[Key[Array, ""], Key[Array, ""]]:
    """The keys of a sample's start state and of its noise."""
    start_key, noise_key = jax.random.split(key)
    return start_key, noise_key


def standard_noise(noise_key: Key[Array, ""], horizon: int, controls: int, dtype) -> Float[Array, "horizon nu"]:
    """Standard normal noise of a whole rollout; times sigma it is added to the controls."""
    return jax.random.normal(noise_key, (horizon, controls), dtype)
