"""Estimates by a recursion backwards through the derivatives of every step."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from estimators.batches import AlphaChoice, GradientEstimate, Linearisation, pull_back
from estimators.choices import PLUG_IN
from estimators.interpolation import inverse_variance_alpha, weigh_batches
from estimators.samples import finite_rows, weigh
from estimators.statistics import summarise
from estimators.stepwise import control_scores, flat, node_variance

Adjoint = Float[Array, "samples states"]
Inputs = Float[Array, "samples inputs"]
Weights = Float[Array, "*horizon"]


def truncated_first_order(linearisation: Linearisation, window: int) -> GradientEstimate:
    """First-order batched gradient with the adjoint cut every `window` >= 1 steps; a ValueError if below.

        lambda_h = c_x + phi_x^T lambda_{h+1} + pi_x^T g_h,   g_h = c_u + phi_u^T lambda_{h+1},
        with lambda_{h+1} = 0 on the right-hand sides where h is a multiple of the window

    A control is then credited with at most `window` steps of cost, and no product of more than `window` Jacobians is
    formed: less variance where products grow, and a bias, since later effects are left out. A window of at least the
    horizon gives the first-order batched gradient.
    """
    if window < 1:
        raise ValueError(f"window must be at least 1 step; got {window}")
    horizon = linearisation.cost_state.shape[1]
    keeps = jnp.arange(1, horizon + 1) % window != 0
    keeps = keeps.at[-1].set(True) if horizon else keeps  # the end of the horizon is not a cut
    adjoint, controls, _ = _sweep(linearisation, keeps)
    return summarise(_gradient(linearisation, adjoint, controls))


def total_propagation(linearisation: Linearisation, baseline: str, weights: str = PLUG_IN) -> GradientEstimate:
    """Mix first- and zeroth-order estimates at every step of the backward recursion; `alpha` holds the mean weight.

        g_h = alpha_h (c_u + phi_u^T lambda_{h+1}) + (1 - alpha_h) grad psi(w_h) (V_h - b_h)
        lambda_h = c_x + phi_x^T lambda_{h+1} + pi_x^T g_h,     g = sum_h D_theta pi^T g_h

    alpha_h is the inverse-variance weight of the two contributions D_theta pi^T (...) to the gradient. The mixed
    adjoint propagates to earlier steps, so derivatives stop growing over a long horizon where values do better; in an
    open loop nothing propagates through the policy, and steps are mixed independently. Both estimates come from the
    same rollouts, as published, and so are not independent.

    The baseline is applied step by step; a name that is not in `BASELINES` is a ValueError.

    Reference: Parmas, Rasmussen, Peters, Doya, "PIPPS: Flexible model-based policy search robust to the curse of
    chaos", ICML 2018, where noise acts on states; here it acts on controls.
    """

    def choose(linearisation: Linearisation) -> Weights:
        return _propagate(linearisation, baseline, None)[1]

    def mix(alphas: Weights, linearisation: Linearisation) -> GradientEstimate:
        rows, _ = _propagate(linearisation, baseline, alphas)
        return replace(summarise(rows), alpha=AlphaChoice(jnp.mean(alphas)))

    return weigh_batches(choose, mix, (linearisation,), weights)


def _propagate(
    linearisation: Linearisation, baseline: str, given: Weights | None
) -> tuple[Float[Array, "samples params"], Weights]:
    """Gradient of each sample, and the weights of the steps: as given, or the batch's inverse-variance weights."""
    steps = linearisation.steps
    scores = control_scores(steps, baseline)
    finite = jnp.isfinite(steps.value_to_go[:, 0]) & finite_rows(flat(scores))

    def mix(derivative: Inputs, node: tuple[Inputs, Array | None, Array | None]) -> tuple[Inputs, Array]:
        score, jacobian, alpha = node
        if alpha is None:
            usable = finite & finite_rows(derivative)
            shares = [
                pull_back(part[:, None], None if jacobian is None else jacobian[:, None])
                for part in (score, derivative)
            ]
            alpha = inverse_variance_alpha(*(jnp.sum(node_variance(share, usable)) for share in shares))
        return weigh((1.0 - alpha, alpha), score, derivative), alpha

    keeps = jnp.ones(linearisation.cost_state.shape[1], bool)
    if linearisation.start_jacobian is None:
        jacobian = None if steps.policy_jacobian is None else jnp.moveaxis(steps.policy_jacobian, 1, 0)
        adjoint, controls, alphas = _sweep(linearisation, keeps, mix, (jnp.moveaxis(scores, 1, 0), jacobian, given))
        rows = _gradient(linearisation, adjoint, controls)
    else:  # theta acts once, before the first step
        adjoint, controls, _ = _sweep(linearisation, keeps)
        rows, alphas = mix(_gradient(linearisation, adjoint, controls), (scores[:, 0], None, given))
    return jnp.where(finite[:, None], rows, jnp.nan), alphas


def _sweep(
    linearisation: Linearisation,
    keeps: Bool[Array, " horizon"],
    node: Callable[..., tuple[Inputs, Float[Array, ""]]] | None = None,
    inputs: object = None,
) -> tuple[Adjoint, Float[Array, "samples horizon inputs"], Float[Array, " horizon"]]:
    """Run the recursion; return the adjoint of the start, g_h of every step, and the weights chosen by `node`.

    `node` maps a step's derivative and its part of `inputs` to g_h and a weight; without one, g_h is the derivative.
    """

    def back(adjoint: Adjoint, step):
        keep, cost_state, cost_control, over_state, over_control, policy_state, given = step
        adjoint = jnp.where(keep, adjoint, 0.0)
        derivative = cost_control + jnp.einsum("isc,is->ic", over_control, adjoint, precision="highest")
        mixed, weight = node(derivative, given) if node else (derivative, jnp.ones((), derivative.dtype))
        adjoint = cost_state + jnp.einsum("ist,is->it", over_state, adjoint, precision="highest")
        if policy_state is not None:
            adjoint = adjoint + jnp.einsum("ics,ic->is", policy_state, mixed, precision="highest")
        return adjoint, (mixed, weight)

    names = ("cost_state", "cost_control", "over_state", "over_control", "policy_state")
    by_step = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), [getattr(linearisation, name) for name in names])
    adjoint, (controls, weights) = jax.lax.scan(
        back, linearisation.final_state, (keeps, *by_step, inputs), reverse=True
    )
    return adjoint, jnp.moveaxis(controls, 0, 1), weights


def _gradient(
    linearisation: Linearisation, adjoint: Adjoint, controls: Float[Array, "samples horizon inputs"]
) -> Float[Array, "samples params"]:
    """Gradient over theta from the adjoints of start and controls; NaN where the value is nonfinite."""
    if linearisation.start_jacobian is None:
        rows = pull_back(controls, linearisation.steps.policy_jacobian)
    else:
        rows = jnp.einsum("isp,is->ip", linearisation.start_jacobian, adjoint, precision="highest")
    return jnp.where(jnp.isfinite(linearisation.steps.value_to_go[:, :1]), rows, jnp.nan)
