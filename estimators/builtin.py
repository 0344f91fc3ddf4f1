"""The built-in estimators. Their formulas are in other modules, imported when an estimate is computed."""

import pkgutil
from abc import abstractmethod
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar

from estimators.choices import BASELINES, MAX_DEVIATION, PLUG_IN, PUBLISHED_TOLERANCE, VARIANCE_PROXIES, WEIGHTS
from estimators.estimator import Estimator, option, register

if TYPE_CHECKING:
    import estimators.batches


@dataclass(frozen=True, kw_only=True)
class Formula(Estimator):
    """Base of estimators that apply a function to their batches, with their options as keywords."""

    separable = True

    computes: ClassVar[str]
    """The function, as module:name."""

    def combine(self, *args: Any, **kwargs: Any) -> "estimators.batches.GradientEstimate":
        options = {field.name: getattr(self, field.name) for field in fields(self)}
        return pkgutil.resolve_name(self.computes)(*args, **kwargs, **options)


@dataclass(frozen=True, kw_only=True)
class Baselined(Formula):
    """Base of estimators with a zeroth-order batch."""

    baseline: str = option("baseline of zeroth-order estimates: {}", choices=BASELINES, default="zero_noise")


@dataclass(frozen=True, kw_only=True)
class Interpolation(Baselined):
    """Base of estimators that weight two batches."""

    separable = False  # weights may differ between steps

    weights: str = option(
        "weights of interpolations: plug_in, or cross_fitted (unbiased)", choices=WEIGHTS, default=PLUG_IN
    )


class Paired(Baselined):
    """Base of estimators over pairs of opposite noise: the mean of both halves, each with the baseline of its half.

    A pair is one sample. Unbiased for symmetric noise. If the noise is added to theta itself, any baseline shared by a
    pair cancels, and the part of f that is odd in the noise remains, ((f^+ - f^-) / 2) s^+: all of the signal without
    the variance of the even part.
    """

    def combine(self, *args: Any, **kwargs: Any) -> "estimators.batches.GradientEstimate":
        from estimators.statistics import summarise

        (pair,) = args
        above, below = (super(Paired, self).combine(half, **kwargs).per_sample for half in pair)
        return summarise((above + below) / 2.0)


@register
class ZerothOrder(Baselined):
    """Zeroth order: values times scores."""

    name, label, needs = "zobg", "ZoBG", ("evaluation",)
    formula, unbiased = r"$`(V_1 - b)\, s`$", "always"
    style = "#0072B2", "o"

    computes = "estimators.zeroth_first:zeroth_order"


@register
class Antithetic(Paired):
    """Zeroth order over pairs of opposite noise."""

    name, label, needs = "zobg_antithetic", "ZoBG (antithetic)", ("pair",)
    formula, unbiased = "the mean of `zobg` over the pair $`w, -w`$", "for symmetric noise"
    style = "#56B4E9", "v"

    computes = "estimators.zeroth_first:zeroth_order"


@register
class CostToGo(Baselined):
    """Zeroth order: costs to go times the scores of single steps."""

    name, label, needs = "zobg_to_go", "ZoBG (costs to go)", ("steps",)
    formula, unbiased = r"$`\sum_h D\pi^\top \nabla\psi(w_h)\, (V_h - b_h)`$", "always"
    style = "#56B4E9", "P"

    computes = "estimators.stepwise:cost_to_go"


@register
class AntitheticCostToGo(Paired):
    """Costs to go over pairs of opposite noise."""

    name, label, needs = "zobg_to_go_antithetic", "ZoBG (to go, antithetic)", ("step_pair",)
    formula, unbiased = "the mean of `zobg_to_go` over the pair $`w, -w`$", "for symmetric noise"
    style = "#0072B2", "X"

    computes = "estimators.stepwise:cost_to_go"


@register
class FirstOrder(Formula):
    """First order: gradients of the samples."""

    name, label, needs = "fobg", "FoBG", ("differentiation",)
    formula, unbiased = r"$`\nabla_\theta V_1`$", "where f is continuous"
    style = "#D55E00", "s"

    computes = "estimators.zeroth_first:first_order"


@register
class OnsetFirstOrder(FirstOrder):
    """First order, corrected where contact begins and ends."""

    name, label, needs = "fobg_onset", "FoBG (onset)", ("corrected",)
    formula = "`fobg` with the [onset term](onset-correction.md): the linear one, or what `--onset` says"
    unbiased = "where f is continuous; nearly, also where a contact force sets in or ends with a jump"
    style = "#7A2E00", "s"


@register
@dataclass(frozen=True, kw_only=True)
class ClippedFirstOrder(Formula):
    """First order, the norm of every sample bounded."""

    name, label, needs = "fobg_clipped", "FoBG (clipped)", ("differentiation",)
    formula, unbiased = "`fobg`, each sample clipped to a norm of `--max-norm`", "no"
    style = "#E69F00", "<"

    max_norm: float = option("fobg_clipped: norm at which samples are clipped", "(0, inf)", metavar="G", example=1000.0)

    computes = "estimators.zeroth_first:clipped_first_order"


@register
@dataclass(frozen=True, kw_only=True)
class TruncatedFirstOrder(Formula):
    """First order, the adjoint cut every few steps."""

    name, label, needs = "fobg_truncated", "FoBG (truncated)", ("linearisation",)
    formula, unbiased = "`fobg`, the adjoint cut every `--window` steps", "no"
    style = "#E69F00", ">"

    window: int = option("fobg_truncated: steps between cuts", "[1, 1000000]", metavar="H", example=20)

    computes = "estimators.recursion:truncated_first_order"


class OneWeight(Interpolation):
    """Base of estimators with a single weight for two batches."""

    separable = True

    @abstractmethod
    def choose(self, zeroth: Any, first: Any) -> "estimators.batches.AlphaChoice":
        """Choose the weight of two estimates."""

    def combine(self, *args: Any, **kwargs: Any) -> "estimators.batches.GradientEstimate":
        from estimators.interpolation import apply_choice, weigh_batches

        def choose(*batches: Any) -> "estimators.batches.AlphaChoice":
            return self.choose(*self.parts(*batches))

        def mix(choice: Any, *batches: Any) -> "estimators.batches.GradientEstimate":
            return apply_choice(choice, *self.parts(*batches))

        return weigh_batches(choose, mix, args, self.weights)

    def parts(self, *batches: Any) -> "tuple[estimators.batches.GradientEstimate, ...]":
        from estimators.zeroth_first import first_order, zeroth_order

        evaluation, differentiation = batches
        return zeroth_order(evaluation, self.baseline), first_order(differentiation)

    def join(self, zeroth: Any, first: Any) -> "estimators.batches.GradientEstimate":
        from estimators.interpolation import apply_choice

        return apply_choice(self.choose(zeroth, first), zeroth, first)


@register
@dataclass(frozen=True, kw_only=True)
class AlphaOrder(OneWeight):
    """Alpha order: the two interpolated with an error of at most gamma.

    Gamma and the radius are in [cost/param]; the last three options are those of `bernstein_epsilon`.
    """

    name, label, needs = "aobg", "AoBG", ("evaluation", "differentiation")
    formula = (
        r"$`\alpha\, g_1 + (1 - \alpha)\, g_0`$ of `fobg` and `zobg`; alpha of least variance such that "
        r"$`\varepsilon + \alpha B \le \gamma`$ (`--gamma`)"
    )
    unbiased = "bias at most gamma, if epsilon is valid"
    style = "#009E73", "D"

    gamma: float = option("AoBG's accuracy bound; inf for none", "(0, inf]", metavar="G", default=float("inf"))
    failure_probability: float = option("failure probability of epsilon", "(0, 1)", metavar="P", default=0.05)
    variance_proxy: str = option("variance in epsilon: {}", choices=VARIANCE_PROXIES, metavar="S2", default="variance")
    radius: str | float = option(
        "R in epsilon: max_deviation, or a bound",
        "[0, inf)",
        choices=(MAX_DEVIATION,),
        metavar="R",
        default=MAX_DEVIATION,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        from estimators.confidence import check_confidence_arguments

        check_confidence_arguments(self.failure_probability, self.variance_proxy, self.radius)

    def choose(self, zeroth: Any, first: Any) -> "estimators.batches.AlphaChoice":
        from estimators.confidence import bernstein_epsilon
        from estimators.interpolation import choose_alpha

        epsilon = bernstein_epsilon(
            zeroth, failure_probability=self.failure_probability, variance_proxy=self.variance_proxy, radius=self.radius
        )
        return choose_alpha(zeroth, first, gamma=self.gamma, epsilon=epsilon)


@register
class OnsetAlphaOrder(AlphaOrder):
    """Alpha order, its first-order batch corrected where contact begins and ends."""

    name, label, needs = "aobg_onset", "AoBG (onset)", ("evaluation", "corrected")
    formula = "`aobg` with `fobg_onset` in place of `fobg`"
    style = "#8FBF5A", "D"


@register
class InverseVariance(OneWeight):
    """Inverse-variance weighting: alpha order with gamma infinite."""

    name, label, needs = "ivw", "IVW", ("evaluation", "differentiation")
    formula, unbiased = "`aobg` with gamma infinite", "where f is continuous, for a given alpha"
    style = "#CC79A7", "^"

    def choose(self, zeroth: Any, first: Any) -> "estimators.batches.AlphaChoice":
        from estimators.interpolation import choose_alpha

        return choose_alpha(zeroth, first)


@register
class StepwiseInverseVariance(Interpolation):
    """Inverse-variance weights for every step and control."""

    name, label, needs = "ivw_h", "IVW-H", ("steps", "step_differentiation")
    formula = r"an inverse-variance weight for every step and control, then pulled back through $`D\pi`$"
    unbiased = "where f is continuous, for given weights"
    style = "#CC79A7", "p"

    computes = "estimators.stepwise:stepwise_inverse_variance"


@register
class TotalPropagation(Interpolation):
    """Inverse-variance weights inside the backward recursion."""

    name, label, needs = "total_propagation", "total propagation", ("linearisation",)
    formula = "an inverse-variance weight at every step of the backward recursion; the mixture propagates further back"
    unbiased = "where f is continuous, for given weights"
    style = "#332288", "*"

    computes = "estimators.recursion:total_propagation"


@register
@dataclass(frozen=True, kw_only=True)
class DiscontinuityGated(Interpolation):
    """Inverse-variance weighting where a test finds no discontinuity, else zeroth order."""

    name, label, needs = "ddcg", "DDCG", ("evaluation", "step_differentiation")
    formula = (
        r"`ivw` if $`\operatorname{tr} \operatorname{Cov}[\nabla_w f] \ge 2 (1 - c) \operatorname{Var}[f] / \sigma^2 "
        r"- 2 \lVert \mathbb{E} \nabla_w f \rVert^2`$, else `zobg`"
    )
    unbiased = "where the test is right"
    style = "#009E73", "h"
    gaussian = True

    sigma: float = option("standard deviation of the noise", "(0, inf)", metavar="S", unit="control", example=0.1)
    tolerance: float = option(
        "ddcg: tolerance of its discontinuity test", "[0, 1)", metavar="C", default=PUBLISHED_TOLERANCE
    )

    computes = "estimators.stepwise:discontinuity_gated"


@register
@dataclass(frozen=True, kw_only=True)
class DeltaMethod(Estimator):
    """First-order mean plus a zeroth-order estimate of the remainder; noise on theta itself."""

    name, label, needs = "delta", "delta", ("evaluation", "differentiation")
    formula = "$`g + (f - f(0) - w^\\top g)\\, s`$, g the mean of `fobg`"
    unbiased = "always; noise on theta itself"
    style = "#999933", "d"
    gaussian = additive = True

    sigma: float = option("standard deviation of the noise", "(0, inf)", metavar="S", unit="param", example=0.1)

    def combine(self, evaluation: Any, differentiation: Any) -> "estimators.batches.GradientEstimate":
        from estimators.zeroth_first import delta_control_variate, first_order

        return delta_control_variate(evaluation, first_order(differentiation).mean, self.sigma)
