"""Estimator inputs (objectives and their batches) and outputs (estimates)."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from estimators.merged_samples import Merged
from estimators.pytree import register_pytree
from estimators.samples import Rows


@register_pytree
@dataclass(frozen=True)
class Evaluation:
    """A batch of rollouts that were evaluated but not differentiated.

    For the value f_i of sample i, noise w_h ~ exp(-psi) and policy pi(x, theta), the score is
    s_i = sum_h D_theta pi(x_h^i)^T grad psi(w_h^i); for Gaussian noise of standard deviation sigma,
    s_i = (1/sigma^2) sum_h D_theta pi(x_h^i)^T w_h^i.

    Attributes:
        value: f_i, the total cost, [cost].
        score: s_i, [1/param].
        baseline: Cost of the zero-noise rollout from the start of sample i, [cost].
        residual: Relative residual of sample i's numerical solves; None for closed forms.

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
    """A batch of differentiated rollouts.

    Attributes:
        value: f_i, the total cost, [cost].
        gradient: grad_theta f_i at fixed noise, [cost/param].
        residual: As in `Evaluation`.
        events: Counts of the discontinuities included in the gradient (found, bounded, missed), their strength, and the
            time of the first; None if the gradient includes none by design.
    """

    value: Float[Array, " samples"]
    gradient: Float[Array, "samples params"]
    residual: Float[Array, " samples"] | None = None
    events: Float[Array, "samples 6"] | None = None


@register_pytree
@dataclass(frozen=True)
class StepEvaluation:
    """A batch of rollouts that were evaluated step by step but not differentiated; `residual` as in `Evaluation`.

    Noise acts at S steps in m dimensions: at every step of a policy, or once (S = 1) where theta + w determines
    the initial state.

    Attributes:
        value_to_go: V_h^i, the cost from step h on; V_1 is the total, [cost].
        baseline_to_go: Cost to go of the zero-noise rollout from the same start, [cost].
        noise_score: grad psi(w_h^i); w / sigma^2 for Gaussian noise, [1/control].
        policy_jacobian: D_theta pi(x_h^i), [control/param]; None if theta matches the noise entry by entry and acts in
            the same way.
        residual: As in `Evaluation`.
    """

    value_to_go: Float[Array, "samples steps"]
    baseline_to_go: Float[Array, "samples steps"]
    noise_score: Float[Array, "samples steps controls"]
    policy_jacobian: Float[Array, "samples steps controls params"] | None
    residual: Float[Array, " samples"] | None = None


@register_pytree
@dataclass(frozen=True)
class StepDifferentiation:
    """A batch of rollouts differentiated with respect to the noise of every step.

    `policy_jacobian` is as in `StepEvaluation`, `residual` and `events` as in `Differentiation`.

    Attributes:
        value: V_1^i, the total cost, [cost].
        noise_gradient: dV_1^i / dw_h, which is dV_1^i / du_h, [cost/control].
        policy_jacobian: As in `StepEvaluation`.
        residual, events: As in `Differentiation`.
    """

    value: Float[Array, " samples"]
    noise_gradient: Float[Array, "samples steps controls"]
    policy_jacobian: Float[Array, "samples steps controls params"] | None
    residual: Float[Array, " samples"] | None = None
    events: Float[Array, "samples 6"] | None = None


@register_pytree
@dataclass(frozen=True)
class Linearisation:
    """A batch of rollouts with all derivatives needed by a backward recursion.

    Attributes:
        steps: The same rollouts, step by step.
        cost_state, cost_control: Derivatives of each step's cost, [cost/state] and [cost/control].
        final_state: Derivative of the final cost, [cost/state].
        over_state, over_control: Derivatives of each step's next state, the latter [state/control].
        policy_state: Derivative of the policy over the state, [control/state]; None for an open loop.
        start_jacobian: Derivative of the start over theta, [state/param], if theta and the noise act on the start only;
            otherwise None.
    """

    steps: StepEvaluation
    cost_state: Float[Array, "samples horizon states"]
    cost_control: Float[Array, "samples horizon inputs"]
    final_state: Float[Array, "samples states"]
    over_state: Float[Array, "samples horizon states states"]
    over_control: Float[Array, "samples horizon states inputs"]
    policy_state: Float[Array, "samples horizon inputs states"] | None
    start_jacobian: Float[Array, "samples states params"] | None


def pull_back(
    adjoint: Float[Array, "samples steps controls"],
    policy_jacobian: Float[Array, "samples steps controls params"] | None,
) -> Float[Array, "samples params"]:
    """sum_h D_theta pi(x_h)^T adjoint_h of each sample; the adjoint itself if there is no policy Jacobian.

    The adjoint is a quantity per unit of control, such as dV/du_h, [cost/control].
    """
    if policy_jacobian is None:
        return adjoint.reshape(adjoint.shape[0], -1)
    return jnp.einsum("ishp,ish->ip", policy_jacobian, adjoint, precision="highest")


@runtime_checkable
class Objective(Protocol):
    """A stochastic objective F(theta) = E f(theta, w); most estimators need only these two methods.

    Sample i depends on `keys[i]` alone, so results do not depend on how samples are chunked or spread over devices.
    Other estimators call further methods, named in `estimators.choices.ORACLES`; each takes the same arguments, and its
    batches hold the samples of `evaluate` and `differentiate`, or pairs of these with opposite noise.
    """

    @property
    def num_params(self) -> int:
        """Length of theta."""
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
    """Weight of an interpolated estimate, and what determined it.

    Attributes:
        alpha: Weight of the first-order batch, in [0, 1]; the mean of stepwise weights.
        epsilon: Confidence radius of the zeroth-order mean, [cost/param]; None if unused.
        discrepancy: B = ||gbar_1 - gbar_0||, [cost/param]; None if unused.
        variance_zeroth, variance_first: sigmahat_0^2 and sigmahat_1^2 of one sample, [cost^2/param^2]; None for
            stepwise weights.
    """

    alpha: Float[Array, ""]
    epsilon: Float[Array, ""] | None = None
    discrepancy: Float[Array, ""] | None = None
    variance_zeroth: Float[Array, ""] | None = None
    variance_first: Float[Array, ""] | None = None


@register_pytree
@dataclass(frozen=True)
class GradientEstimate:
    """A gradient estimate with its samples.

    Attributes:
        samples: g_i, [cost/param], as rows, or merged from blocks that are not kept. Nonfinite rows are kept; the
            summary leaves them out.
        mean: gbar, [cost/param].
        variance: sigmahat^2 = 1/(n-1) sum_i ||g_i - gbar||^2, the trace of the sample covariance,
            [cost^2/param^2].
        standard_error: Standard error of each entry of the mean, [cost/param].
        num_finite: n, the number of rows with only finite entries.
        alpha: How the interpolation weight was chosen; None for an estimate from one batch.

    Reference: Suh et al. 2022, def. of empirical variance.
    """

    samples: Rows | Merged
    mean: Float[Array, " params"]
    variance: Float[Array, ""]
    standard_error: Float[Array, " params"]
    num_finite: Int[Array, ""]
    alpha: AlphaChoice | None = None

    @property
    def num_nonfinite(self) -> Int[Array, "..."]:
        """Number of rows left out."""
        return self.samples.shape[-2] - self.num_finite

    @property
    def per_sample(self) -> Float[Array, "*batch samples params"]:
        """g_i as rows; a ValueError if the estimate was merged from blocks."""
        return self.samples.rows
