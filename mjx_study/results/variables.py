"""The quantities of a study, each described once for its Dataset, tables, figures, help and documentation."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final

from mjx_study.table import described, number


@dataclass(frozen=True)
class Variable:
    """A quantity of a study: dimensions within a cell, unit ("gradient" is cost per unit of theta), description (whose
    first clause labels axes), heading or symbol in tables, significant digits in tables (0 for a count), and what they
    multiply it by."""

    dims: tuple[str, ...]
    unit: str
    description: str
    heading: str = ""
    digits: int = 3
    factor: float = 1.0

    @property
    def shown_unit(self) -> str:
        """Unit in figures; empty if it says nothing."""
        return "" if self.unit in ("1", "cost") or "unit of" in self.unit else self.unit.replace("^2", "$^2$")

    @property
    def label(self) -> str:
        return re.split("[,;]", self.description)[0] + (f" [{self.shown_unit}]" if self.shown_unit else "")

    def text(self, value: float | int | None) -> str:
        """Format a value for a table; `-` for None."""
        if value is None:
            return "-"
        return number(self.factor * value, self.digits) if self.digits else f"{value:.0f}"

    def interval(self, value: float, low: float, high: float) -> str:
        """Format a value with the ends of its interval."""
        return f"{self.text(value)} ({number(self.factor * low, 2)} to {number(self.factor * high, 2)})"


BATCH: Final = ("seed", "estimator")
EACH: Final = ("estimator",)
LINE: Final = ("point",)
THETA: Final = "unit of theta"
COORDINATES: Final = {
    "stiffness": Variable(("model",), "N/m", "contact stiffness K", "K"),
    "timestep": Variable(("timestep",), "s", "timestep h", "h"),
    "sigma": Variable(("sigma",), "unit of what the noise is added to", "noise sigma", "sigma"),
    "samples": Variable(("samples",), "1", "samples N in a batch", "N", 0),
}
"""Coordinates that are numbers, which may be a figure's axis."""
GRADIENTS: Final = {
    "gradient_norm": Variable(BATCH, "gradient", "norm of the mean gradient", "|gradient|"),
    "variance": Variable(BATCH, "gradient^2", "variance of one sample, the trace of the covariance", "variance"),
    "variance_lower": Variable(BATCH, "gradient^2", "lower end of the variance's confidence interval"),
    "variance_upper": Variable(BATCH, "gradient^2", "upper end of the variance's confidence interval"),
    "norm_median": Variable(BATCH, "gradient", "median of the samples' norms"),
    "norm_90": Variable(BATCH, "gradient", "90 % quantile of the samples' norms"),
    "norm_max": Variable(BATCH, "gradient", "largest norm of a sample"),
    "effective_samples": Variable(
        BATCH, "1", "number of samples that carry the variance; with few, it means little", "effective", 2
    ),
    "top_share": Variable(BATCH, "1", "share of the variance that the largest sample carries", "top"),
    "relative_error": Variable(BATCH, "1", "distance from mean to reference, over the latter's norm", "relative error"),
    "relative_error_se": Variable(BATCH, "1", "standard error of relative_error"),
    "debiased_error": Variable(BATCH, "1", "relative error, corrected for sampling noise", "debiased"),
    "debiased_error_se": Variable(BATCH, "1", "standard error of debiased_error"),
    "cosine": Variable(BATCH, "1", "cosine of the angle between mean and reference", "cosine"),
    "cosine_se": Variable(BATCH, "1", "standard error of cosine"),
    "debiased_cosine": Variable(BATCH, "1", "cosine, corrected for sampling noise", "debiased"),
    "debiased_cosine_se": Variable(BATCH, "1", "standard error of debiased_cosine"),
    "alpha": Variable(BATCH, "1", "weight of the first-order batch", "alpha"),
    "epsilon": Variable(BATCH, "gradient", "confidence radius of the zeroth-order mean", "epsilon"),
    "discrepancy": Variable(BATCH, "gradient", "distance between the two means", "B"),
    "bias_p_value": Variable(BATCH, "1", "p-value of no bias against the reference"),
    "nonfinite": Variable(BATCH, "1", "samples left out since cost or derivative is not finite", "nan", 0),
    "pooled_error": Variable(EACH, "1", "relative error of the mean over all seeds"),
    "squared_bias": Variable(EACH, "1", "squared bias over the reference's squared norm, unbiased", "squared bias"),
    "squared_bias_se": Variable(EACH, "1", "standard error of squared_bias"),
    "residual": Variable(EACH, "1", "largest relative residual of the constraint solver", "residual", 2),
    "unconverged": Variable(EACH, "1", "rollouts whose solver residual is too large", digits=0),
    "seconds_per_sample": Variable(EACH, "s", "computing time of one sample, without compilation", "ms", 2, 1e3),
    "onsets": Variable(EACH, "1", "onsets of contact in the first-order batches", digits=0),
    "onsets_bounded": Variable(EACH, "1", "onsets and ends at grazing speed, with a bounded term", digits=0),
    "onsets_missed": Variable(
        EACH, "1", "events without a term: of chattering contacts, or beyond the slots", digits=0
    ),
    "onset_strength": Variable(
        EACH, "1", "share of the approach speed that an onset takes in a step, root mean square"
    ),
    "onset_spread": Variable(EACH, "1", "standard deviation of the step of a rollout's first onset"),
    "onsets_replaced": Variable(
        EACH, "1", "points of corners and edges that appear or vanish in contact, without a term", digits=0
    ),
    "reference_norm": Variable((), "gradient", "norm of the reference gradient"),
    "reference_uncertainty": Variable((), "1", "standard error of the reference, over its norm"),
    "reference_effective_samples": Variable((), "1", "effective number of samples behind the reference's variance"),
    "reference_pairs": Variable((), "1", "pairs of rollouts behind the reference"),
    "gradient": Variable((*BATCH, "param"), "gradient", "mean gradient"),
    "reference": Variable(("param",), "gradient", "reference gradient"),
}
ONSETS: Final = tuple(name for name in GRADIENTS if name.startswith("onset"))
"""Variables of studies with an onset term."""
HISTORY: Final = ("cost", "gradient_norm", "variance", "alpha", "nonfinite", "residual")
"""Variables recorded at each iteration of a descent; see `mjx_study.experiment.iteration.Record`."""
METRIC: Final = "metric_"
START: Final = "start_metric_"
"""Prefixes of a task's metrics: of the final policies, and of the initial one."""
STEP: Final = ("iteration", *BATCH)
DESCENTS: Final = {
    "final_cost": Variable(BATCH, "cost", "mean cost of the final policy with noise", "final cost", 4),
    "final_cost_se": Variable(BATCH, "cost", "standard error of final_cost"),
    "start_cost": Variable((), "cost", "mean cost of the initial policy with noise", "cost at the start", 4),
    "start_cost_se": Variable((), "cost", "standard error of start_cost"),
    "stopped_at": Variable(BATCH, "1", "iteration at which a seed stopped before the end; NaN for none"),
    "reason": Variable(BATCH, "1", "why it stopped, an index into `experiment.iteration.REASONS`; NaN for none"),
    "cost": Variable(STEP, "cost", "mean cost of the batch, before the update"),
    **{name: replace(GRADIENTS[name], dims=STEP) for name in HISTORY[1:]},
    "rollouts": Variable(EACH, "1", "rollouts simulated in one iteration of one seed", digits=0),
    "seconds": Variable(
        STEP[::2], "s", "time of all seeds, measured; compilation excluded, other estimators beside", "seconds"
    ),
    "theta": Variable((*BATCH, "param"), THETA, "parameters of the final policy"),
}
LANDSCAPES: Final = {
    "position": Variable(LINE, THETA, "t in theta_0 + t direction"),
    "cost": Variable(LINE, "cost", "cost without noise; the mean over initial states if these are random"),
    "smoothed": Variable(LINE, "cost", "mean cost with noise", digits=4),
    "smoothed_se": Variable(LINE, "cost", "standard error of smoothed"),
    "slope": Variable(("estimator", "point"), "gradient", "mean of the estimator along the line"),
    "slope_se": Variable(("estimator", "point"), "gradient", "standard error of slope"),
    "nonfinite": replace(GRADIENTS["nonfinite"], dims=("estimator", "point")),
    "exact_smoothed": Variable(LINE, "cost", "smoothed without sampling error, where a quadrature is available"),
    "exact_slope": Variable(LINE, "gradient", "slope of exact_smoothed, the mean of an unbiased estimator"),
    "exact_first": Variable(LINE, "gradient", "mean of first-order gradients, without sampling error"),
    "exact_slope_error": Variable(LINE, "gradient", "quadrature error of exact_slope"),
    "exact_first_error": Variable(LINE, "gradient", "quadrature error of exact_first"),
    **{name: replace(GRADIENTS[name], dims=()) for name in ("residual", "unconverged")},
}
CELL: Final = {
    "solref": Variable(("solref_entry",), "1", "MuJoCo's solref of the contact; NaN where it is the MJCF's"),
    "solimp": Variable(("solimp_entry",), "1", "MuJoCo's solimp of the contact; NaN where it is the MJCF's"),
}
"""Variables of every kind of study."""
DERIVED: Final = {
    "variance_seconds": Variable(BATCH, "gradient^2 s", "variance left after a second of computing", "variance x s", 2),
    "seed_rollouts": Variable(EACH, "1", "rollouts of one seed, derivatives and baselines included", "rollouts", 0),
    "best_cost": Variable(EACH, "cost", "final cost of the best seed", "best", 4),
    "stopped_seeds": Variable(EACH, "1", "seeds that stopped before the end", "stopped seeds", 0),
    "least_cost": Variable((), "cost", "lowest mean cost on the line, ± its standard error", "least mean cost", 4),
    "least_at": Variable((), THETA, "position on the line of the lowest mean cost", "least at"),
    "steepest": Variable(EACH, "gradient", "steepest slope on the line", "steepest slope"),
}
"""Quantities of tables that a Dataset does not hold."""
DEBIASED: Final = {"relative_error": "debiased_error", "cosine": "debiased_cosine"}
"""Quantities that noise biases, and the corrected ones, which tables show beside them."""
COLUMNS: Final = (
    ("gradient_norm", "variance", "effective_samples"),
    ("relative_error", "cosine"),
    ("alpha", "epsilon", "discrepancy"),
    ("seconds_per_sample", "variance_seconds", "residual", "nonfinite"),
)
"""Columns of the table of `compare`, in groups that a table keeps together."""
DETAILS: Final = ("gradient_norm", "effective_samples", "cosine", "epsilon", "discrepancy", "residual", "nonfinite")
"""Columns that only --details shows."""
MARKS: Final = """\
After the arrows: the same without the sampling noise of batch and reference, ± one standard error. Errors below two
of them are not detected; a mean is called biased from p = 0.001, 3.3 of them if means are normal. < and >: bounds
of two standard errors where nothing is left; -: noise explains all of it."""


def with_metrics(variables: Mapping[str, Variable], names: Iterable[str]) -> dict[str, Variable]:
    """Add to the variables of a kind of study those of every kind, and the task's metrics among the given names."""
    means = {name: f"{name.partition('metric_')[2]}, mean over the rollouts of a final cost" for name in names}
    metrics = {name: Variable(BATCH, "1", means[name]) for name in means if name.startswith(METRIC)}
    metrics |= {name: Variable((), "1", means[name]) for name in means if name.startswith(START)}
    return {**variables, **metrics, **CELL}


def explained(variables: Mapping[str, Variable], *names: str) -> str:
    """Explain columns of a table for the help: the named ones, derived quantities included, or all variables."""
    known = {**variables, **COORDINATES, **DERIVED}
    return described({known[name].heading: known[name].description for name in names or variables})
