"""Samples of an estimate as rows, with their statistics; `blocks` offers the same interface without the rows."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from estimators.pytree import register_pytree

Scalar = Float[Array, ""]


def finite_rows(per_sample: Float[Array, "samples params"]) -> Bool[Array, " samples"]:
    return jnp.all(jnp.isfinite(per_sample), axis=1)


def centre(
    rows: Float[Array, "samples params"], finite: Bool[Array, " samples"]
) -> tuple[Float[Array, " params"], Float[Array, "samples params"]]:
    """Return the mean of the finite rows and the centred rows; refined once, so that equal rows centre to zero."""
    count = jnp.sum(finite).astype(rows.dtype)
    mean = jnp.sum(jnp.where(finite[:, None], rows, 0.0), axis=0) / count
    mean = mean + jnp.sum(jnp.where(finite[:, None], rows - mean[None, :], 0.0), axis=0) / count
    return mean, jnp.where(finite[:, None], rows - mean[None, :], 0.0)


def weigh(
    weights: tuple[float | Scalar, float | Scalar], zeroth: Float[Array, "*shape"], first: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Weighted sum in which 0 * NaN is 0."""
    weight_zeroth, weight_first = weights
    return jnp.where(weight_zeroth == 0, 0.0, weight_zeroth * zeroth) + jnp.where(
        weight_first == 0, 0.0, weight_first * first
    )


@register_pytree
@dataclass(frozen=True)
class Deviations:
    """Statistics of q_i = ||g_i - gbar||^2 over the n finite samples, with gbar their mean.

    Attributes:
        total: S = sum_i q_i, [cost^2/param^2].
        concentration: sum_i (q_i / S)^2, from 1/n to 1; 0 if all q_i are within rounding.
        top: max_i q_i / S; likewise.
        varies: Whether any q_i exceeds rounding.
        log_spread: (n-1)/n sum_i (l_i - lbar)^2 with l_i = log(S - n/(n-1) q_i), the jackknife variance of log S;
            infinite if one sample carries all of S.
    """

    total: Scalar
    concentration: Scalar
    top: Scalar
    varies: Bool[Array, ""]
    log_spread: Scalar


@register_pytree
@dataclass(frozen=True)
class Rows:
    """Samples stored as rows g_i, [cost/param]; nonfinite rows are ignored below."""

    rows: Float[Array, "samples params"]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.rows.shape

    @property
    def dtype(self) -> jnp.dtype:
        return self.rows.dtype

    @property
    def num_finite(self) -> Int[Array, ""]:
        return jnp.sum(finite_rows(self.rows))

    def mixed(self, weights: tuple[float | Scalar, float | Scalar], other: Any) -> "Rows":
        """Combine with an independent batch row by row with the given weights."""
        return Rows(weigh(weights, self.rows, other.rows))

    def deviations(self) -> Deviations:
        rows = self.rows
        finite = finite_rows(rows)
        count = jnp.sum(finite).astype(rows.dtype)
        squares = jnp.sum(centre(rows, finite)[1] ** 2, axis=1)
        total = jnp.sum(squares)
        largest = jnp.max(jnp.where(finite, jnp.sum(rows**2, axis=1), 0.0))
        varies = jnp.max(squares) > (8.0 * jnp.finfo(rows.dtype).eps) ** 2 * largest
        share = squares / jnp.where(varies, total, 1.0)

        remaining = total - squares * (count / (count - 1.0))
        rounding = 4.0 * jnp.sqrt(count) * jnp.finfo(rows.dtype).eps * total  # of a sum of `count` terms
        exhausted = finite & (remaining <= rounding)
        log_variance = jnp.log(jnp.where(finite & ~exhausted, remaining, 1.0))
        deviation = jnp.where(finite, log_variance - jnp.sum(log_variance) / count, 0.0)
        log_spread = (count - 1.0) / count * jnp.sum(deviation**2)
        return Deviations(
            total=total,
            concentration=jnp.sum(share**2),
            top=jnp.max(share),
            varies=varies,
            log_spread=jnp.where(jnp.any(exhausted), jnp.inf, log_spread),
        )

    def variance_along(self, direction: Float[Array, " params"]) -> Scalar:
        """Variance of the mean's component along a direction; NaN for fewer than two finite components."""
        # A sum, since accelerators may compute float32 matrix products with fewer digits.
        component = jnp.sum(self.rows * direction[None, :], axis=1)[:, None]
        finite = finite_rows(component)
        count = jnp.sum(finite).astype(component.dtype)
        squares = jnp.sum(centre(component, finite)[1] ** 2)
        return jnp.where(count > 1, squares / jnp.maximum(count - 1.0, 1.0), jnp.nan) / count

    def perturbed_means(
        self, mean: Float[Array, " params"], key: Key[Array, ""], num_draws: int
    ) -> Float[Array, "draws params"]:
        """sum_i e_i (g_i - gbar) / sqrt(n (n - 1)) with independent standard normal e_i, the same for any padding."""
        rows, finite = self.rows, finite_rows(self.rows)
        centred = jnp.where(finite[:, None], rows - mean[None, :], 0.0)
        count = jnp.sum(finite).astype(rows.dtype)
        multipliers = jax.random.normal(key, (rows.shape[0], num_draws), rows.dtype)
        return jnp.matmul(multipliers.T, centred, precision="highest") / jnp.sqrt(count * jnp.maximum(count - 1.0, 1.0))

    def norm_quantiles(self, probabilities: Sequence[float]) -> Float[Array, " probabilities"]:
        """Quantiles of ||g_i||, linearly interpolated."""
        rows = self.rows
        norms = jnp.where(finite_rows(rows), jnp.linalg.norm(rows, axis=1), jnp.nan)
        return jnp.nanquantile(norms, jnp.asarray(probabilities, rows.dtype))

    def largest_deviation(self, mean: Float[Array, " params"]) -> Scalar:
        """max_i ||g_i - gbar||."""
        deviation = jnp.linalg.norm(self.rows - mean[None, :], axis=1)
        return jnp.max(jnp.where(finite_rows(self.rows), deviation, 0.0))

    def second_moment(self) -> Scalar:
        """Mean of ||g_i||^2."""
        finite = finite_rows(self.rows)
        kept = jnp.where(finite[:, None], self.rows, 0.0)
        return jnp.sum(kept**2) / jnp.sum(finite).astype(self.rows.dtype)

    def pair_variance(self) -> tuple[Scalar, Scalar]:
        """Sum of ||g_i - g_j||^2 / 2 over disjoint pairs of finite samples, and the number of pairs."""
        rows = self.rows
        count = rows.shape[0] // 2
        one, other = rows[0 : 2 * count : 2], rows[1 : 2 * count : 2]
        finite = finite_rows(one) & finite_rows(other)
        halves = jnp.where(finite, jnp.sum((one - other) ** 2, axis=1) / 2.0, 0.0)
        return jnp.sum(halves), jnp.sum(finite).astype(rows.dtype)
