"""The variables of a study: dimensions within a cell, unit and description."""

import dataclasses
from collections.abc import Iterable
from typing import Final


@dataclasses.dataclass(frozen=True)
class Variable:
    """A variable of a study: dimensions within a cell, unit ("gradient" is cost per unit of theta) and description."""

    dims: tuple[str, ...]
    unit: str
    description: str


BATCH: Final = ("seed", "estimator")
GRADIENTS: Final = {
    "gradient_norm": Variable(BATCH, "gradient", "norm of the mean"),
    "variance": Variable(BATCH, "gradient^2", "variance of one sample, the trace of the covariance"),
    "variance_lower": Variable(BATCH, "gradient^2", "lower end of the variance's confidence interval"),
    "variance_upper": Variable(BATCH, "gradient^2", "upper end of the variance's confidence interval"),
    "norm_median": Variable(BATCH, "gradient", "median of the samples' norms"),
    "norm_90": Variable(BATCH, "gradient", "90 % quantile of the samples' norms"),
    "norm_max": Variable(BATCH, "gradient", "largest norm of a sample"),
    "effective_samples": Variable(BATCH, "1", "effective number of samples behind the variance"),
    "top_share": Variable(BATCH, "1", "share of the variance that the largest sample carries"),
    "relative_error": Variable(BATCH, "1", "distance from the mean to the reference, over the norm of the reference"),
    "relative_error_se": Variable(BATCH, "1", "standard error of relative_error"),
    "debiased_error": Variable(BATCH, "1", "relative error, corrected for sampling noise"),
    "debiased_error_se": Variable(BATCH, "1", "standard error of debiased_error"),
    "cosine": Variable(BATCH, "1", "cosine of the angle between mean and reference"),
    "cosine_se": Variable(BATCH, "1", "standard error of cosine"),
    "debiased_cosine": Variable(BATCH, "1", "cosine, corrected for sampling noise"),
    "debiased_cosine_se": Variable(BATCH, "1", "standard error of debiased_cosine"),
    "alpha": Variable(BATCH, "1", "weight of the first-order batch"),
    "epsilon": Variable(BATCH, "gradient", "confidence radius of the zeroth-order mean"),
    "discrepancy": Variable(BATCH, "gradient", "distance between the two means"),
    "bias_p_value": Variable(BATCH, "1", "p-value of no bias against the reference"),
    "nonfinite": Variable(BATCH, "1", "nonfinite samples, left out"),
    "pooled_error": Variable(
        ("estimator",), "1", "distance from the mean over all seeds to the reference, over the norm of the reference"
    ),
    "squared_bias": Variable(
        ("estimator",), "1", "unbiased estimate of the squared bias, over the reference's squared norm"
    ),
    "squared_bias_se": Variable(("estimator",), "1", "standard error of squared_bias"),
    "residual": Variable(("estimator",), "1", "largest relative residual of the constraint solver"),
    "unconverged": Variable(("estimator",), "1", "rollouts whose solver residual is too large"),
    "seconds_per_sample": Variable(("estimator",), "s", "computing time of one sample, measured; compilation excluded"),
    "onsets": Variable(("estimator",), "1", "onsets of contact in the first-order batches"),
    "onsets_bounded": Variable(("estimator",), "1", "onsets at grazing speed, with a bounded term"),
    "onsets_missed": Variable(("estimator",), "1", "onsets without a term"),
    "onset_strength": Variable(
        ("estimator",), "1", "share of the approach speed that an onset takes in a step, root mean square"
    ),
    "onset_spread": Variable(("estimator",), "1", "standard deviation of the step of a rollout's first onset"),
    "reference_norm": Variable((), "gradient", "norm of the reference gradient"),
    "reference_uncertainty": Variable((), "1", "standard error of the reference, over its norm"),
    "reference_effective_samples": Variable((), "1", "effective number of samples behind the reference's variance"),
    "gradient": Variable((*BATCH, "param"), "gradient", "mean gradient"),
    "reference": Variable(("param",), "gradient", "reference gradient"),
}
ONSETS: Final = tuple(name for name in GRADIENTS if name.startswith("onset"))
"""Variables of studies with an onset term."""
HISTORY: Final = ("cost", "gradient_norm", "variance", "alpha", "nonfinite", "residual")
"""Variables recorded at each iteration of a descent; see `mjx_study.study.iteration.Record`."""
METRIC: Final = "metric_"
START: Final = "start_metric_"
"""Prefixes of a task's metrics: of the final policies, and of the initial one."""
STEP: Final = ("iteration", *BATCH)
DESCENTS: Final = {
    "final_cost": Variable(BATCH, "cost", "mean cost of the final policy"),
    "final_cost_se": Variable(BATCH, "cost", "standard error of final_cost"),
    "start_cost": Variable((), "cost", "mean cost of the initial policy"),
    "start_cost_se": Variable((), "cost", "standard error of start_cost"),
    "stopped_at": Variable(BATCH, "1", "iteration at which a seed stopped before the end; NaN for none"),
    "reason": Variable(BATCH, "1", "why it stopped, an index into `mjx_study.study.iteration.REASONS`; NaN for none"),
    "cost": Variable(STEP, "cost", "mean cost of the batch, before the update"),
    "gradient_norm": Variable(STEP, "gradient", "norm of the estimate"),
    "variance": Variable(STEP, "gradient^2", "variance of one sample, the trace of the covariance"),
    "alpha": Variable(STEP, "1", "weight of the first-order batch"),
    "nonfinite": Variable(STEP, "1", "nonfinite samples, left out"),
    "residual": Variable(STEP, "1", "largest relative residual of the constraint solver"),
    "rollouts": Variable(("estimator",), "1", "rollouts simulated in one iteration of one seed"),
    "seconds": Variable(("iteration", "estimator"), "s", "time since the start, measured; compilation excluded"),
    "theta": Variable((*BATCH, "param"), "unit of theta", "parameters of the final policy"),
}
LANDSCAPES: Final = {
    "position": Variable(("point",), "unit of theta", "t in theta_0 + t direction"),
    "cost": Variable(("point",), "cost", "cost without noise; the mean over initial states if these are random"),
    "smoothed": Variable(("point",), "cost", "mean cost with noise"),
    "smoothed_se": Variable(("point",), "cost", "standard error of smoothed"),
    "slope": Variable(("estimator", "point"), "gradient", "mean of the estimator along the line"),
    "slope_se": Variable(("estimator", "point"), "gradient", "standard error of slope"),
    "nonfinite": Variable(("estimator", "point"), "1", "nonfinite samples, left out"),
    "exact_smoothed": Variable(("point",), "cost", "smoothed without sampling error, where a quadrature is available"),
    "exact_slope": Variable(("point",), "gradient", "slope of exact_smoothed, the mean of an unbiased estimator"),
    "exact_first": Variable(("point",), "gradient", "mean of first-order gradients, without sampling error"),
    "exact_slope_error": Variable(("point",), "gradient", "quadrature error of exact_slope"),
    "exact_first_error": Variable(("point",), "gradient", "quadrature error of exact_first"),
    "residual": Variable((), "1", "largest relative residual of the constraint solver"),
    "unconverged": Variable((), "1", "rollouts whose solver residual is too large"),
}
CELL: Final = {
    "solref": Variable(("solref_entry",), "1", "MuJoCo's solref of the contact; NaN where it is the MJCF's"),
    "solimp": Variable(("solimp_entry",), "1", "MuJoCo's solimp of the contact; NaN where it is the MJCF's"),
}
"""Variables of every kind of study."""
VARIABLES: Final = {"gradients": GRADIENTS, "descents": DESCENTS, "landscapes": LANDSCAPES}
"""Variables by kind of study."""
MEASURED: Final = ("seconds", "seconds_per_sample")
"""Measured times, the only variables that differ from run to run."""


def variables_of(kind: str, names: Iterable[str]) -> dict[str, Variable]:
    """Return the variables of a kind of study, with the metrics among the given names."""
    told = {name: f"{name.partition('metric_')[2]}, mean over the rollouts of a final cost" for name in names}
    metrics = {name: Variable(BATCH, "1", told[name]) for name in told if name.startswith(METRIC)}
    metrics |= {name: Variable((), "1", told[name]) for name in told if name.startswith(START)}
    return VARIABLES[kind] | metrics | CELL


def markdown_table(kind: str) -> str:
    """Format the table of variables in docs/studies.md."""
    rows = [
        f"| `{name}` | {', '.join(variable.dims) or '-'} | {variable.unit} | {variable.description} |"
        for name, variable in VARIABLES[kind].items()
    ]
    return "\n".join([f"| {kind} | within a cell | unit | meaning |", "| --- | --- | --- | --- |", *rows])
