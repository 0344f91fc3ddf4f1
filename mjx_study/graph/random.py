"""Normal random numbers as native code: those of `jax.random.normal`, to rounding, from the same keys."""

from collections.abc import Sequence
from functools import cache
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key

from mjx_study.graph.c import source_of
from mjx_study.graph.function import Passes, capture
from mjx_study.graph.native import NativeFunction, computes_steps

_ROTATIONS: Final = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY: Final = 0x1BD11BDA
"""Constants of Threefry-2x32 (Salmon et al., Parallel random numbers: as easy as 1, 2, 3, 2011)."""
_CENTRE: Final = (
    *(-3.64441206401782e-21, -1.6850591381820166e-19, 1.28584807152564e-18, 1.1157877678025181e-17),
    *(-1.3331716628546209e-16, 2.0972767875968562e-17, 6.637638134358324e-15, -4.054566292975207e-14),
    *(-8.151934197605472e-14, 2.6335093153082323e-12, -1.2975133253453532e-11, -5.415412054294628e-11),
    *(1.0512122732115323e-09, -4.112633980346984e-09, -2.9070369957882005e-08, 4.2347877827932404e-07),
    *(-1.3654692000834679e-06, -1.3882523362786469e-05, 0.00018673420803405714, -0.000740702534166267),
    *(-0.006033670871430149, 0.24015818242558962, 1.6536545626831027),
)
_MIDDLE: Final = (
    *(2.2137376921775787e-09, 9.075656193888539e-08, -2.7517406297064545e-07, 1.8239629214389228e-08),
    *(1.5027403968909828e-06, -4.013867526981546e-06, 2.9234449089955446e-06, 1.2475304481671779e-05),
    *(-4.7318229009055734e-05, 6.828485145957318e-05, 2.4031110387097894e-05, -0.0003550375203628475),
    *(0.0009532893797373805, -0.0016882755560235047, 0.002491442096107851, -0.003751208507569241),
    *(0.005370914553590064, 1.0052589676941592, 3.083885610492221),
)
_TAIL: Final = (
    *(-2.7109920616438573e-11, -2.5556418169965252e-10, 1.5076572693500548e-09, -3.789465440126737e-09),
    *(7.61570120807834e-09, -1.496002662714924e-08, 2.914795345090108e-08, -6.771199775845234e-08),
    *(2.2900482228026655e-07, -9.9298272942317e-07, 4.526062597223154e-06, -1.9681778105531671e-05),
    *(7.599527703001776e-05, -0.00021503011930044477, -0.00013871931833623122, 1.0103004648645344),
    *(4.849906401408584,),
)
"""Coefficients of the inverse error function (Giles, Approximating the erfinv function, 2012), as XLA has them."""


def normal(key: Key[Array, ""], shape: tuple[int, ...], dtype: Any) -> Float[Array, "..."]:
    """Return `jax.random.normal(key, shape, dtype)`, vectors of float64 by native code where there is any."""
    known = jax.random.key_impl(key) == "threefry2x32" and jax.config.values["jax_threefry_partitionable"]
    if computes_steps() != "native" or dtype != np.float64 or len(shape) != 1 or not shape[0] or not known:
        return jax.random.normal(key, shape, dtype)
    return _drawing(shape[0], jax.default_backend())(jax.random.key_data(key), jnp.uint32(0))[1].reshape(shape)


@cache
def _drawing(size: int, platform: str) -> NativeFunction:
    """Native code that draws from the data of a key, after the number of the first draw."""
    together = next(count for count in (4, 3, 2, 1) if size % count == 0)  # so that processors overlap them
    number, data = jax.ShapeDtypeStruct((), np.uint32), jax.ShapeDtypeStruct((2,), np.uint32)

    def some(key: Any, at: Any) -> tuple[Any, Any]:
        return at + np.uint32(together), _normal(key[0], key[1], at + np.arange(together, dtype=np.uint32))

    each = capture(some, data, number, most=2000)
    passes = Passes(num_consts=1, num_carry=1, length=size // together, reverse=False)
    inputs, outputs = passes.avals(each)

    def program(data: Any, at: Any) -> list[jax.Array]:
        return [at, jax.random.normal(jax.random.wrap_key_data(data, impl="threefry2x32"), outputs[1].shape)]

    return NativeFunction(lambda: source_of(each, platform, passes), inputs, outputs, lambda: program)


def _normal(key0: Any, key1: Any, at: Any) -> Any:
    """Draws of given numbers, fewer than 2^32."""
    words = _threefry(key0, key1, jnp.zeros_like(at), at)
    high, low = (lax.convert_element_type(each, np.uint64) for each in words)
    unit = (high << np.uint64(32) | low) >> np.uint64(12) | np.uint64(0x3FF << 52)
    least = float(np.nextafter(-1.0, 0.0))
    x = jnp.maximum((lax.bitcast_convert_type(unit, np.float64) - 1.0) * (1.0 - least) + least, least)
    return np.sqrt(2.0) * _erf_inv(x)


def _threefry(key0: Any, key1: Any, left: Any, right: Any) -> tuple[Any, Any]:
    """Threefry-2x32 of 20 rounds: two words of 32 bits from a key and a counter of two."""
    keys = key0, key1, key0 ^ key1 ^ np.uint32(_PARITY)
    left, right = left + key0, right + key1
    for turn in range(5):
        for bits in _ROTATIONS[turn % 2]:
            left = left + right
            right = right << np.uint32(bits) | right >> np.uint32(32 - bits)
            right = right ^ left
        left, right = left + keys[(turn + 1) % 3], right + keys[(turn + 2) % 3] + np.uint32(turn + 1)
    return left, right


def _erf_inv(x: Any) -> Any:
    """Inverse error function between the numbers next to -1 and 1."""
    square = jnp.maximum(x * -x, -1.0)  # rounded: a maximum keeps compilers from fusing it with what follows
    w = -_log(1.0 + square)
    root = jnp.sqrt(w)
    tail = jnp.where(w < 16.0, _polynomial(_MIDDLE, root - 3.25), _polynomial(_TAIL, root - 5.0))
    return jnp.where(w < 6.25, _polynomial(_CENTRE, w - 3.125), tail) * x


def _log(x: Any) -> Any:
    """Logarithm of a number from 2^-53 to 1, to rounding of 1: e log 2 + 2 artanh((m - 1) / (m + 1)) for x = 2^e m."""
    bits, half = lax.bitcast_convert_type(x, np.uint64), np.float64(np.sqrt(0.5)).view(np.uint64)
    exponent = (bits + np.uint64(64 << 52) - half) >> np.uint64(52)
    m = lax.bitcast_convert_type(bits - (exponent - np.uint64(64) << np.uint64(52)), np.float64)
    s = (m - 1.0) / (m + 1.0)
    series = _polynomial([1.0 / k for k in range(21, 0, -2)], s * s)
    return (lax.convert_element_type(exponent, np.float64) - 64.0) * np.log(2.0) + 2.0 * s * series


def _polynomial(coefficients: Sequence[float], x: Any) -> Any:
    """Polynomial with the given coefficients, highest first."""
    total = coefficients[0]
    for each in coefficients[1:]:
        total = total * x + each
    return total
