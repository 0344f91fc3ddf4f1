"""Check that an estimator's mean is the gradient of F using values of F alone, without a reference gradient."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from estimators.batches import Objective
from estimators.choices import ORACLES
from estimators.confidence import ENOUGH_EFFECTIVE, effective_samples
from estimators.estimator import Estimator
from estimators.pytree import register_pytree
from estimators.registry import oracles_of
from estimators.sampling import draw, sample_keys
from estimators.statistics import summarise

NODES: Final = 9  # quadrature nodes along a path
HALF_WIDTH_SE: Final = 3.29  # half-width of a 99.9 % interval in standard errors
TOLERANCE: Final = 0.05  # relative error, as a share of F's difference, within which a mean counts as right
Nodes = Float[np.ndarray, " nodes"]


@register_pytree
@dataclass(frozen=True)
class Circulation:
    """Path integral of an estimator's mean, compared with the difference of F. See `circulations`.

    Attributes:
        difference: F(end) - F(start), [cost].
        gap: The integral minus the difference, 0 for an unbiased estimator, [cost].
        standard_error: Standard error of the gap, [cost].
        quadrature: Quadrature error in excess of the noise, [cost].
        effective: n_eff behind the gap; below `ENOUGH_EFFECTIVE` the standard error means little.
        largest: Largest size of one sample's gap, [cost].
        num_nonfinite: Samples left out because they are nonfinite somewhere on the path.
    """

    difference: Float[Array, ""]
    gap: Float[Array, ""]
    standard_error: Float[Array, ""]
    quadrature: Float[Array, ""]
    effective: Float[Array, ""]
    largest: Float[Array, ""]
    num_nonfinite: Int[Array, ""]

    @property
    def half_width(self) -> Float[Array, ""]:
        """Half-width of the 99.9 % interval for the gap, quadrature error included, [cost]."""
        return HALF_WIDTH_SE * self.standard_error + self.quadrature

    def verdict(self, tolerance: float = TOLERANCE) -> str:
        """Return "right" (within a share of F's difference), "biased" or "undecided".

        Few effective samples leave it undecided, unless every sample's gap is within that share.
        """
        gap, half, within = abs(float(self.gap)), float(self.half_width), tolerance * abs(float(self.difference))
        if float(self.quadrature) > within or (self._few and float(self.largest) > within):
            return "undecided"
        return "right" if gap + half <= within else "biased" if gap > half and not self._few else "undecided"

    @property
    def _few(self) -> bool:
        return float(self.gap) != 0 and not float(self.effective) >= ENOUGH_EFFECTIVE

    def more_samples(self, tolerance: float = TOLERANCE) -> float:
        """Factor by which the number of samples would have to grow for a verdict, if gap and quadrature error stay.

        1 with a verdict; infinite if the quadrature error alone prevents one.
        """
        if self.verdict(tolerance) != "undecided":
            return 1.0
        gap, quadrature, within = abs(float(self.gap)), float(self.quadrature), tolerance * abs(float(self.difference))
        room = max(within - gap, gap) - quadrature
        if quadrature > within or not room > 0:
            return math.inf
        rare = ENOUGH_EFFECTIVE / float(self.effective) if self._few and float(self.effective) > 0 else 1.0
        return max(rare, (HALF_WIDTH_SE * float(self.standard_error) / room) ** 2)


def circulations(
    estimators: Sequence[Estimator],
    objective: Objective,
    start: Float[Array, " params"],
    end: Float[Array, " params"],
    key: Key[Array, ""],
    num_samples: int,
    *,
    nodes: int = NODES,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Circulation]:
    """Integrate the means of estimators, which share their batches, along a straight path of theta.

        sum_j w_j g_i(theta_j)^T (end - start) - (f_i(end) - f_i(start))

    for every sample i, with the same keys at all nodes: the mean is 0 if E g = grad F. The nodes are Gauss-Legendre;
    the quadrature error is the difference from the rule on every second node, minus three standard errors. With one
    node, this compares a central difference of the mean cost with the estimator's mean at the midpoint.

    Args:
        estimators: Estimators, each with a result of its own.
        objective: Objective with the oracles that they need.
        start: Start of the path, [param].
        end: End of the path, [param]; a few standard deviations of the noise from its start, or less.
        key: Random key; consumed.
        num_samples: Samples at every node, >= 2; fewer are a ValueError.
        nodes: Number of nodes, odd; an even one is a ValueError.
        progress: Called with the number of nodes done, before each.
    """
    if nodes < 1 or nodes % 2 == 0:
        raise ValueError(f"nodes must be an odd number; got {nodes}")
    if num_samples < 2:
        raise ValueError(f"num_samples must be at least 2; got {num_samples}")
    points, weights, coarse = path_rule(nodes)
    step, needs = end - start, oracles_of(estimators)

    def along(index, theta):
        progress(index)
        batches = draw(needs, objective, theta, jax.random.clone(key), num_samples)
        return jnp.stack([estimator(batches).per_sample @ step for estimator in estimators])

    def difference(order):
        keys = sample_keys(jax.random.clone(key), num_samples)[order]
        first, last = (objective.evaluate(theta, jax.random.clone(keys)).value for theta in (start, end))
        return last - first

    slopes = jnp.stack([along(index, start + t * step) for index, t in enumerate(points)], axis=1)
    orders = [max(ORACLES[oracle].order for oracle in estimator.needs) for estimator in estimators]
    differences = {order: difference(order) for order in set(orders)}
    weights, rough = jnp.asarray(weights, slopes.dtype), jnp.asarray(weights - coarse, slopes.dtype)

    def compared(order: int, slope: Float[Array, "nodes samples"]) -> Circulation:
        expected, apart = differences[order], rough @ slope
        gap = weights @ slope - expected
        found = summarise(jnp.stack([gap, expected, apart], axis=1))
        quadrature = jnp.maximum(jnp.abs(found.mean[2]) - 3 * found.standard_error[2], 0.0)
        kept = jnp.where(jnp.isfinite(apart), gap, jnp.nan)
        count, largest = effective_samples(summarise(kept[:, None])).count, jnp.nanmax(jnp.abs(kept))
        lost = found.num_nonfinite
        return Circulation(found.mean[1], found.mean[0], found.standard_error[0], quadrature, count, largest, lost)

    return [compared(*each) for each in zip(orders, slopes, strict=True)]


def path_rule(nodes: int) -> tuple[Nodes, Nodes, Nodes]:
    """Nodes on [0, 1], their weights, and the weights of an interpolatory rule on every second node."""
    points, weights = np.polynomial.legendre.leggauss(nodes)
    coarse, some = np.zeros(nodes), points[::2]
    moments = np.zeros(len(some))
    moments[0] = 2.0
    coarse[::2] = np.linalg.solve(np.polynomial.legendre.legvander(some, len(some) - 1).T, moments)
    return (points + 1) / 2, weights / 2, coarse / 2
