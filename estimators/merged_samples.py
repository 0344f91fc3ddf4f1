"""Mergeable statistics of samples that arrive block by block and are not kept.

Arrays are NumPy's, in double precision. No sum is split among threads, so the same blocks merged in the same order
give the same bits on any number of cores.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from estimators.pytree import register_pytree
from estimators.samples import Deviations

EXTREMES: Final = 32  # samples kept for each kind of extreme
TINY: Final = float(np.finfo(float).tiny)  # fourth powers below it have lost digits
MAX_THINNED: Final = 2**14
"""Maximum number of samples of a batch whose norms are kept; larger batches are subsampled at a regular stride."""

Block = Float[np.ndarray, "samples parts params"]


@register_pytree
@dataclass(frozen=True)
class Moments:
    """Moments of the finite rows of one batch, or of two batches paired row by row (parts).

    A feature vector holds a sample's deviations d_i = g_i - gbar_i and their products d_i . d_j. A change of mean maps
    it affinely, so its scatter matrix, which holds all moments up to the fourth that the statistics need, can be
    merged. Fourth moments may overflow where variances do not.

    Attributes:
        products: Means of d_i . d_j, i <= j, [cost^2/param^2].
        scatter: Scatter matrix of the features.
        pairs: Sum of ||z - z'||^2 / 2 over disjoint pairs of neighbours, and the number of pairs.
        extremes, places: Samples with the largest deviations or norms, and their indices.
        thinned: Products g_i . g_j of a subset of the samples, chosen by index.
    """

    count: Int[np.ndarray, ""]
    mean: Float[np.ndarray, "parts params"]
    products: Float[np.ndarray, " products"]
    scatter: Float[np.ndarray, "features features"]
    pairs: Float[np.ndarray, " two"]
    extremes: Block
    places: Int[np.ndarray, " extremes"]
    thinned: Float[np.ndarray, "some products"]

    @classmethod
    @np.errstate(over="ignore", invalid="ignore")
    def of(cls, block: Block, first: int, every: int) -> "Moments":
        """Moments of a block whose first sample has index `first`; indices in `thinned` are multiples of `every`."""
        finite = np.all(np.isfinite(block), axis=(1, 2))
        rows, places = np.asarray(block[finite], float), first + np.flatnonzero(finite)
        half = len(block) // 2
        apart = block[0 : 2 * half : 2] - block[1 : 2 * half : 2]
        both = finite[0 : 2 * half : 2] & finite[1 : 2 * half : 2]
        mean = np.zeros(rows.shape[1:])
        if len(rows):
            mean = np.mean(rows, axis=0)
            mean = mean + np.mean(rows - mean, axis=0)
        deviations = rows - mean
        products = _products(deviations)
        centre = np.sum(products, axis=0) / max(len(rows), 1)
        features = np.concatenate([products - centre, deviations.reshape(len(rows), mean.size)], axis=1)
        return cls(
            count=np.array(len(rows)),
            mean=mean,
            products=centre,
            scatter=np.einsum("na,nb->ab", features, features),
            pairs=np.array([np.sum(apart[both] ** 2) / 2, np.sum(both)]),
            thinned=_products(rows[places % every == 0]),
            **_extremes(rows, places, mean, centre),
        )

    @property
    def parts(self) -> int:
        """Number of batches that are paired."""
        return self.mean.shape[0]

    def check(self, params: int) -> None:
        """Raise ValueError unless the arrays are moments of so many parameters, as those of a file may not be."""
        parts = self.mean.shape[0] if self.mean.ndim == 2 else 1
        products, kept = len(_pairs(parts)), self.places.size
        shapes = {
            "count": (), "mean": (parts, params), "products": (products,), "pairs": (2,), "places": (kept,),
            "scatter": (products + parts * params,) * 2, "extremes": (kept, parts, params),
            "thinned": (self.thinned.size // products, products),
        }  # fmt: skip
        for name, shape in shapes.items():
            array, kinds = getattr(self, name), "iu" if name in ("count", "places") else "f"
            if array.shape != shape or array.dtype.kind not in kinds:
                raise ValueError(f"{name} has shape {array.shape} and type {array.dtype}")

    @np.errstate(over="ignore", invalid="ignore")
    def merged(self, other: "Moments") -> "Moments":
        """Return the moments of both blocks together; the order affects rounding."""
        count = int(self.count + other.count)
        share = int(other.count) / max(count, 1)
        mean = self.mean + share * (other.mean - self.mean)
        (centre, scatter), (theirs, more) = self._about(mean), other._about(mean)
        gap = theirs - centre
        products = (centre + share * gap)[: len(self.products)]
        rows = np.concatenate([self.extremes, other.extremes])
        places = np.concatenate([self.places, other.places])
        return Moments(
            count=np.array(count),
            mean=mean,
            products=products,
            scatter=scatter + more + int(self.count) * share * np.multiply.outer(gap, gap),
            pairs=self.pairs + other.pairs,
            thinned=np.concatenate([self.thinned, other.thinned]),
            **_extremes(rows, places, mean, products),
        )

    def _about(self, mean: Float[np.ndarray, "parts params"]) -> tuple[np.ndarray, np.ndarray]:
        """Mean and scatter matrix of the features for deviations from another mean."""
        shift, size = self.mean - mean, len(self.products)
        slope = np.zeros((size, *shift.shape))
        for index, (i, j) in enumerate(_pairs(len(shift))):
            slope[index, i] += shift[j]
            slope[index, j] += shift[i]
        slope = slope.reshape(size, -1)
        scatter = self.scatter.copy()
        upper = scatter[:size] + np.einsum("pa,ab->pb", slope, scatter[size:])
        corner = upper[:, :size] + np.einsum("pa,qa->pq", upper[:, size:], slope)
        scatter[:size], scatter[:, :size] = upper, upper.T
        scatter[:size, :size] = (corner + corner.T) / 2
        return np.concatenate([self.products + _products(shift[None])[0], shift.reshape(-1)]), scatter


def _pairs(parts: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(parts) for j in range(i, parts)]


def _products(rows: Block) -> Float[np.ndarray, "samples products"]:
    """Scalar products between the parts of each sample."""
    return np.stack([np.einsum("np,np->n", rows[:, i], rows[:, j]) for i, j in _pairs(rows.shape[1])], axis=1)


def _extremes(rows: Block, places: np.ndarray, mean: np.ndarray, products: np.ndarray) -> dict[str, np.ndarray]:
    """Samples with the largest deviations and norms, of each part and of their sum at equal spread."""
    sizes = [np.linalg.norm(each, axis=2) for each in (rows - mean, rows)]
    if rows.shape[1] > 1:
        squares = np.array([square for square, (i, j) in zip(products, _pairs(rows.shape[1]), strict=True) if i == j])
        spread = np.sqrt(np.where(squares > 0, squares, 1.0))
        sizes += [np.sum(each / spread, axis=1, keepdims=True) for each in sizes]
    kept = [np.argsort(-size, kind="stable")[:EXTREMES] for each in sizes for size in each.T]
    chosen = np.unique(np.concatenate(kept))
    return {"extremes": rows[chosen], "places": places[chosen]}


Parts = tuple[Moments, ...]
"""Moments of one batch; or, for two batches, of the first, the second, and the pairs."""


def moments_of(parts: Sequence[Float[Any, "samples params"]], first: int, every: int) -> Parts:
    """Compute the moments of a block of rows of one batch or two; arguments as in `Moments.of`."""
    rows = [np.asarray(part, float)[:, None] for part in parts]
    rows += [np.concatenate(rows, axis=1)] if len(rows) > 1 else []
    return tuple(Moments.of(each, first, every) for each in rows)


@dataclass(frozen=True)
class Merged:
    """Samples reduced to their moments, with the interface of `estimators.samples.Rows`.

    They belong to one batch, or to two batches weighted row by row; the weights need not be known when the samples are
    drawn. Counts, means, (co)variances, concentration and `second_moment` agree with those from rows up to rounding.
    The rest is approximate:

    - `top`, `largest_deviation`: from the extremes. Exact unless more than `EXTREMES` samples of a block lie within
      twice the distance between the block's and the batch's mean. For a mixture, a lower bound, exact if its largest
      sample is among the largest of a part or of the sum of both at equal spread.
    - `log_spread`: exact for the extremes, second order for the rest, each of which has less than 1/`EXTREMES` of the
      spread; the relative error is below that share, and about the largest share of any sample if there are no tails.
    - `norm_quantiles`: from at most `MAX_THINNED` thinned samples, so ranks have a standard error of 0.4 % (at the
      median); exact for fewer samples. The maximum is that of `top`.
    - `concentration`, `log_spread`: NaN where fourth powers of the deviations leave the range of numbers.
    - `perturbed_means`: different draws from the same distribution.

    `size` is the number of samples per batch, nonfinite ones included.
    """

    parts: Parts
    weights: tuple[float, ...]
    size: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.size, self.parts[0].mean.shape[-1]

    @property
    def dtype(self) -> jnp.dtype:
        return jnp.zeros(0).dtype

    @property
    def rows(self) -> Any:
        raise ValueError("an estimate that was merged from blocks has no rows")

    @property
    def num_finite(self) -> Int[Array, ""]:
        return jnp.asarray(self._moments.count)

    def mixed(self, weights: tuple[Any, Any], other: Any) -> "Merged":
        """Combine two batches of the same pairing row by row with the given weights."""
        share, rest = map(float, weights)
        mixture = tuple(share * one + rest * two for one, two in zip(self.weights, other.weights, strict=True))
        return Merged(self.parts, mixture, self.size)

    @property
    def mean(self) -> Float[np.ndarray, " params"]:
        return np.einsum("k,kp->p", self._weights, self._moments.mean)

    @property
    def covariance(self) -> Float[np.ndarray, "params params"]:
        """sum_i (g_i - gbar) (g_i - gbar)^T."""
        moments, weights = self._moments, self._weights
        size, (parts, params) = len(moments.products), moments.mean.shape
        inner = moments.scatter[size:, size:].reshape(parts, params, parts, params)
        return np.einsum("i,j,ipjq->pq", weights, weights, inner)

    def deviations(self) -> Deviations:
        moments, product = self._moments, self._product
        count, square = float(moments.count), product @ moments.products
        size = len(product)
        with np.errstate(over="ignore", invalid="ignore"):
            squares = product @ moments.scatter[:size, :size] @ product + count * square**2
        total = count * square
        far = np.sum(self._weighed(moments.extremes - moments.mean) ** 2, axis=1)
        top = float(np.max(far, initial=0.0))
        eps = float(jnp.finfo(self.dtype).eps)
        varies = top > (8 * eps) ** 2 * (np.linalg.norm(self.mean) + np.sqrt(top)) ** 2
        concentration = spread = 0.0
        if count >= 2 and varies:
            concentration = squares / total / total if TINY < squares < np.inf else np.nan
            spread = _log_spread(count, far / total, float(concentration), eps)
        found = total, concentration, top / total if varies else 0.0, varies, spread
        return Deviations(*map(jnp.asarray, found))

    def variance_along(self, direction: Float[Array, " params"]) -> Float[Array, ""]:
        along, count = np.asarray(direction, float), float(self._moments.count)
        spread = np.einsum("p,pq,q->", along, self.covariance, along)
        return jnp.asarray(spread / (count - 1) / count if count > 1 else np.nan)

    def perturbed_means(
        self, mean: Float[Array, " params"], key: Key[Array, ""], num_draws: int
    ) -> Float[Array, "draws params"]:
        count, gap = float(self._moments.count), self.mean - np.asarray(mean)
        spread, axes = np.linalg.eigh(self.covariance + count * np.multiply.outer(gap, gap))
        scale = np.sqrt(np.maximum(spread, 0.0) / max(count * max(count - 1, 1), 1))
        normal = np.asarray(jax.random.normal(key, (num_draws, len(gap))))
        return jnp.asarray(np.einsum("dk,pk->dp", normal * scale, axes))

    def norm_quantiles(self, probabilities: Sequence[float]) -> Float[Array, " probabilities"]:
        moments = self._moments
        largest = np.max(np.linalg.norm(self._weighed(moments.extremes), axis=1), initial=0.0)
        norms = np.sqrt(np.maximum(moments.thinned @ self._product, 0.0))
        if len(norms) == 0:
            return jnp.full(len(probabilities), jnp.nan)
        found = np.quantile(norms, probabilities)
        return jnp.asarray(np.where(np.asarray(probabilities) == 1.0, np.maximum(found, largest), found))

    def largest_deviation(self, mean: Float[Array, " params"]) -> Float[Array, ""]:
        apart = self._weighed(self._moments.extremes) - np.asarray(mean)
        return jnp.asarray(np.max(np.linalg.norm(apart, axis=1), initial=0.0))

    def second_moment(self) -> Float[Array, ""]:
        return jnp.asarray(self._product @ self._moments.products + np.sum(self.mean**2))

    def pair_variance(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Sum of ||g_i - g_j||^2 / 2 over disjoint pairs of neighbours in a block, and the number of pairs."""
        halves, pairs = np.sum(self._weights) ** 2 * self._moments.pairs[0], self._moments.pairs[1]
        return jnp.asarray(halves), jnp.asarray(pairs)

    @property
    def _moments(self) -> Moments:
        """Moments of the batches with nonzero weight, so that 0 * NaN counts as 0."""
        used = [index for index, weight in enumerate(self.weights) if weight != 0]
        return self.parts[used[0] if len(used) == 1 else -1]

    @property
    def _weights(self) -> Float[np.ndarray, " parts"]:
        used = [weight for weight in self.weights if weight != 0]
        return np.array(used if used else self.weights, float)

    @property
    def _product(self) -> Float[np.ndarray, " products"]:
        """Weights of the parts' products in the squared norm of a sample."""
        weights = self._weights
        return np.array([weights[i] * weights[j] * (1 if i == j else 2) for i, j in _pairs(len(weights))])

    def _weighed(self, rows: Block) -> Float[np.ndarray, "samples params"]:
        return np.einsum("k,nkp->np", self._weights, rows)


def _log_spread(count: float, far: np.ndarray, concentration: float, eps: float) -> float:
    """`Deviations.log_spread` from the shares of the extremes and the sum of squares of all shares."""
    scale = count / (count - 1)
    shares = scale * far
    if np.any(1 - shares <= 4 * np.sqrt(count) * eps):
        return np.inf
    logs = np.log1p(-shares)
    rest = max(scale**2 * concentration - np.sum(shares**2), 0.0)
    total = np.sum(logs) - (scale - np.sum(shares)) - rest / 2
    return float((count - 1) / count * (np.sum(logs**2) + rest - total**2 / count))
