"""Distance of an estimate from a reference, with its uncertainty."""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.pytree import register_pytree
from estimators.types import GradientEstimate

Scalar = Float[Array, ""]


@register_pytree
@dataclass(frozen=True)
class Comparison:
    """Distance of an estimate from a reference, with standard errors. See `compare`.

    Attributes:
        error: ||gbar - gref||, [cost/param].
        relative_error: r = ||gbar - gref|| / ||gref||, noise of both means included.
        relative_error_se: Standard error of r about its own mean.
        debiased_error: r_d, an estimate of ||E gbar - grad F|| / ||grad F|| with the contribution of noise removed.
        debiased_error_se: Standard error of r_d.
        cosine: c = gbar . gref / (||gbar|| ||gref||).
        cosine_se: Standard error of c about its own mean.
        debiased_cosine: c_d, the cosine of the angle between E gbar and grad F, estimated.
        debiased_cosine_se: Standard error of c_d.
        reference_uncertainty: sqrt(tr Cov[gref]) / ||gref||, the smallest relative error that can be resolved.
    """

    error: Float[Array, ""]
    relative_error: Float[Array, ""]
    relative_error_se: Float[Array, ""]
    debiased_error: Float[Array, ""]
    debiased_error_se: Float[Array, ""]
    cosine: Float[Array, ""]
    cosine_se: Float[Array, ""]
    debiased_cosine: Float[Array, ""]
    debiased_cosine_se: Float[Array, ""]
    reference_uncertainty: Float[Array, ""]


def compare(estimate: GradientEstimate, reference: GradientEstimate) -> Comparison:
    """Compute relative error and cosine against an independent reference, with delta-method standard errors.

    With unit vectors u, v, a along d = gbar - gref, gref, gbar,

        se(r)^2 = ( Var[u . g_i]/N + Var[(u + r v) . gref_j]/M ) / ||gref||^2
        se(c)^2 = Var[(v - c a) . g_i]/(N ||gbar||^2) + Var[(a - c v) . gref_j]/(M ||gref||^2)

    where the variances are those of the projected samples. Both r and c are biased, since noise has length: r upwards
    and |c| downwards, by many standard errors if there are many parameters. With the noise of both means removed,

        r_d^2 = max(0, q),   q = (||d||^2 - s^2 - t^2) / m,   m = ||gref||^2 - t^2,
        c_d = gbar . gref / sqrt((||gbar||^2 - s^2) m), clipped to [-1, 1],
        s^2 = sum_k se_k(gbar)^2,   t^2 = sum_k se_k(gref)^2,
        se(q)^2 = 4 ( Var[d . g_i]/N + Var[(d + q gref) . gref_j]/M ) / m^2,
        se(r_d) = min( se(q) / (2 r_d), sqrt(se(q)) )

    and se(c_d) is se(c) with the norms of c_d. First order in the noise; se(q) counts the second order twice, which is
    conservative near q = 0, where the root has no derivative and the second form of se(r_d) bounds its error.
    For an interpolated estimate the weight is treated as fixed.

    Args:
        estimate: Estimate to compare, gbar of N samples.
        reference: Estimate from other samples, gref of M samples.

    Returns:
        The comparison. An undefined direction (a mean or difference of exactly zero) makes every dependent number NaN;
        so does, for the debiased numbers, a reference mean indistinguishable from zero (m <= 0).
    """
    difference = estimate.mean - reference.mean
    error = jnp.linalg.norm(difference)
    size, reference_size = jnp.linalg.norm(estimate.mean), jnp.linalg.norm(reference.mean)
    along_error, along_estimate = difference / error, estimate.mean / size
    along_reference = reference.mean / reference_size
    relative = error / reference_size
    cosine = jnp.sum(along_estimate * along_reference)

    def propagate(slope: Float[Array, " params"], slope_reference: Float[Array, " params"]) -> Float[Array, ""]:
        return jnp.sqrt(estimate.samples.variance_along(slope) + reference.samples.variance_along(slope_reference))

    def cosine_error(cosine: Scalar, size: Scalar, reference_size: Scalar) -> Scalar:
        across = size * reference_size
        return propagate(
            reference.mean / across - cosine / size**2 * estimate.mean,
            estimate.mean / across - cosine / reference_size**2 * reference.mean,
        )

    noise, reference_noise = (jnp.sum(each.standard_error**2) for each in (estimate, reference))
    true_size, true_reference_size = _root(size**2 - noise), _root(reference_size**2 - reference_noise)
    square = true_reference_size**2
    quotient = (error**2 - noise - reference_noise) / square
    quotient_se = 2.0 * propagate(difference / square, (difference + quotient * reference.mean) / square)
    debiased, bound = jnp.sqrt(jnp.maximum(quotient, 0.0)), jnp.sqrt(quotient_se)
    debiased_cosine = jnp.clip(cosine * (size / true_size) * (reference_size / true_reference_size), -1.0, 1.0)
    return Comparison(
        error=error,
        relative_error=relative,
        relative_error_se=propagate(
            along_error / reference_size, (along_error + relative * along_reference) / reference_size
        ),
        debiased_error=debiased,
        debiased_error_se=quotient_se / jnp.maximum(2.0 * debiased, bound),
        cosine=cosine,
        cosine_se=cosine_error(cosine, size, reference_size),
        debiased_cosine=debiased_cosine,
        debiased_cosine_se=cosine_error(debiased_cosine, true_size, true_reference_size),
        reference_uncertainty=jnp.linalg.norm(reference.standard_error) / reference_size,
    )


def _root(square: Scalar) -> Scalar:
    """Square root; NaN for nonpositive numbers."""
    return jnp.sqrt(jnp.where(square > 0, square, jnp.nan))
