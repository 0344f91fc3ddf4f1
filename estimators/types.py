"""What goes into an estimator (an objective and its batches) and what comes out (an estimate)."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Array, Float, Int, Key

from estimators.pytree import register_pytree


@register_pytree
@dataclass(frozen=True)
class Evaluation:
    """A batch of rollouts that were evaluated and not differentiated.

    Let f_i be the value of sample i, noise w_h ~ exp(-psi) and policy pi(x, theta). The score is
    s_i = sum_h D_theta pi(x_h^i)^T grad psi(w_h^i), for Gaussian noise of standard deviation sigma
    s_i = (1/sigma^2) sum_h D_theta pi(x_h^i)^T w_h^i.

    Attributes:
        value: f_i, the total cost, [cost].
        score: s_i, [1/param].
        baseline: The cost of the zero-noise rollout from the same start as sample i, [cost].
        residual: How far sample i's own numerical solve was from converged, relative; None for closed forms.

    Reference: Suh et al. 2022, appendix, prop. on the policy gradient, where the score must read grad psi(w)
    (the text prints psi(w)).
    """

    value: Float[Array, " samples"]
    score: Float[Array, "samples params"]
    baseline: Float[Array, " samples"]
    residual: Float[Array, " samples"] | None = None


@register_pytree
@dataclass(frozen=True)
class Differentiation:
    """A batch of rollouts that were differentiated.

    Attributes:
        value: f_i, the total cost, [cost].
        gradient: grad_theta f_i at fixed noise, [cost/param].
        residual: How far sample i's own numerical solve was from converged, relative; None for closed forms.
    """

    value: Float[Array, " samples"]
    gradient: Float[Array, "samples params"]
    residual: Float[Array, " samples"] | None = None


@runtime_checkable
class Objective(Protocol):
    """A stochastic objective F(theta) = E f(theta, w): two methods, and nothing else is needed.

    One key per sample: sample i depends on `keys[i]` alone, so a result does not depend on how samples are
    chunked or spread over devices.
    """

    @property
    def num_params(self) -> int:
        """The length of theta."""
        ...

    def evaluate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Evaluation:
        """Roll out without differentiating the dynamics."""
        ...

    def differentiate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Differentiation:
        """Roll out and differentiate every sample with respect to theta."""
        ...


@register_pytree
@dataclass(frozen=True)
class AlphaChoice:
    """Why an interpolated estimate weighs its two batches as it does.

    Attributes:
        alpha: Weight of the first-order batch, in [0, 1].
        epsilon: Confidence radius of the zeroth-order mean, [cost/param].
        discrepancy: B = ||gbar_1 - gbar_0||, [cost/param].
        variance_zeroth: sigmahat_0^2 of one zeroth-order sample, [cost^2/param^2].
        variance_first: sigmahat_1^2 of one first-order sample, [cost^2/param^2].
    """

    alpha: Float[Array, ""]
    epsilon: Float[Array, ""]
    discrepancy: Float[Array, ""]
    variance_zeroth: Float[Array, ""]
    variance_first: Float[Array, ""]


@register_pytree
@dataclass(frozen=True)
class GradientEstimate:
    """A gradient estimate with the samples it was made of.

    Attributes:
        per_sample: g_i, [cost/param]. Rows that are not finite stay as they came; the summary leaves them
            out.
        mean: gbar, [cost/param].
        variance: sigmahat^2 = 1/(n-1) sum_i ||g_i - gbar||^2, the trace of the sample covariance,
            [cost^2/param^2].
        standard_error: Of each entry of the mean, [cost/param].
        num_finite: n, the number of rows in which every entry is finite.
        alpha: What chose the interpolation; None for an estimate from one batch.

    Reference: Suh et al. 2022, def. of empirical variance.
    """

    per_sample: Float[Array, "samples params"]
    mean: Float[Array, " params"]
    variance: Float[Array, ""]
    standard_error: Float[Array, " params"]
    num_finite: Int[Array, ""]
    alpha: AlphaChoice | None = None

    @property
    def num_nonfinite(self) -> Int[Array, "..."]:
        """The number of rows that were left out."""
        return self.per_sample.shape[-2] - self.num_finite
