"""What a comparison is asked for, and what it answers: plain data, with every field explained."""

import dataclasses
from typing import Any, ClassVar, Final

import numpy as np
from jaxtyping import Float

from estimators import ENOUGH_EFFECTIVE
from mjx_study.simulation.contact import FAMILIES
from mjx_study.study.configuration import EstimatorConfig, check_names, refuse_repeats

BIAS_DRAWS: Final = 999
"""Draws of the test for bias."""
SURE: Final = 0.001
"""p-value at which a mean is called biased: the least that the test's 999 draws can give."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompareConfig(EstimatorConfig):
    """Everything that decides the result of a comparison; see also `EstimatorConfig`.

    Attributes:
        stiffness: contact stiffnesses [N/m], for the families that take one; None for the task's.
        contact: names of contact families; None for the task's.
        samples: in each batch; an alpha-order estimate uses two batches.
        reference_samples: pairs of rollouts behind each reference gradient.
        confidence: of the intervals that are reported.
    """

    ranges: ClassVar = {"samples": "[3, 1e7]"}

    stiffness: tuple[float, ...] | None = None
    contact: tuple[str, ...] | None = None
    samples: int = 400
    reference_samples: int = 600
    confidence: float = 0.95

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.contact is not None:
            check_names("contact family", self.contact, FAMILIES)
        if self.stiffness is not None:
            if not self.stiffness:
                raise ValueError("no stiffness given: give at least one, in N/m")
            refuse_repeats("stiffness", self.stiffness)
            if self.contact is not None and not any(FAMILIES[name].swept for name in self.contact):
                raise ValueError(f"contact {', '.join(self.contact)} takes no stiffness; leave --stiffness out")


@dataclasses.dataclass(frozen=True)
class Row:
    """One estimator at one contact model. Gradients are in cost per unit of theta.

    Attributes:
        contact: contact family.
        stiffness: K of the contact's spring, at full penetration [N/m]; 0 where there is no contact.
        solref, solimp: MuJoCo's parameters of this contact; empty where each contact has the MJCF's own.
        estimator: name.
        samples: in each batch.
        gradient_norm: of the mean gradient.
        variance: empirical variance of one sample, the trace of the covariance.
        variance_lower, variance_upper: its confidence interval.
        norm_median, norm_90, norm_max: quantiles of the norms of single samples; heavy tails show here.
        effective_samples, top_share: samples that the variance rests on, and what the largest carries of it; see
            `estimators.effective_samples`.
        relative_error, relative_error_se: distance to the reference gradient over its norm, with standard error.
        debiased_error, debiased_error_se: the same without what the noise of both means adds to it.
        cosine, cosine_se: of the angle to the reference gradient, with standard error.
        debiased_cosine, debiased_cosine_se: the same without what the noise of both means takes from it.
        reference_norm: of the reference gradient.
        reference_effective_samples: as above, of the reference.
        reference_uncertainty: its relative standard error; errors below it cannot be told from zero.
        alpha: weight of the first-order batch; None for an estimator of one batch.
        epsilon: confidence radius of the zeroth-order mean; None likewise.
        discrepancy: B, the distance between the two means; None likewise.
        bias_p_value: that the mean's distance to the reference is chance; NaN where the samples of either are all
            equal. See `estimators.bias_test`, and `bias_verdict`.
        seconds_per_sample: of computing, compilation excluded.
        variance_seconds: variance times seconds per sample, the variance that a second of computing leaves.
        residual: largest relative solver residual in the batches.
        unconverged: samples whose residual is above the threshold.
        nonfinite: samples left out because they were not finite.
        onsets, onsets_bounded, onsets_missed: of contact that the first-order batch met, those at grazing speed whose
            term was bounded, and those without a term; None without the onset term.
    """

    contact: str
    stiffness: float
    solref: tuple[float, ...]
    solimp: tuple[float, ...]
    estimator: str
    samples: int
    gradient_norm: float
    variance: float
    variance_lower: float
    variance_upper: float
    norm_median: float
    norm_90: float
    norm_max: float
    effective_samples: float
    top_share: float
    relative_error: float
    relative_error_se: float
    debiased_error: float
    debiased_error_se: float
    cosine: float
    cosine_se: float
    debiased_cosine: float
    debiased_cosine_se: float
    reference_norm: float
    reference_effective_samples: float
    reference_uncertainty: float
    alpha: float | None
    epsilon: float | None
    discrepancy: float | None
    bias_p_value: float
    seconds_per_sample: float
    variance_seconds: float
    residual: float
    unconverged: int
    nonfinite: int
    onsets: int | None = None
    onsets_bounded: int | None = None
    onsets_missed: int | None = None

    @property
    def believable(self) -> bool:
        """Whether the batch has effective samples enough for its errors to mean something."""
        return self.effective_samples >= ENOUGH_EFFECTIVE

    @property
    def bias_verdict(self) -> str:
        """What the test for bias says: "biased", "none seen", or "too few effective samples" for either."""
        if not min(self.effective_samples, self.reference_effective_samples) >= ENOUGH_EFFECTIVE:
            return "too few effective samples"
        return "biased" if self.bias_p_value <= SURE else "none seen"


@dataclasses.dataclass(frozen=True)
class CompareResult:
    """What a comparison found, with what it depended on.

    Attributes:
        config: as resolved: no value is left to a default.
        environment: versions, machine, devices, precision.
        rows: one per cell and estimator, in the order of the configuration.
        warnings: what MuJoCo would alter or the integrator cannot resolve, each with its cell.
        gradients: mean gradients, (rows, params).
        references: reference gradients, (rows, params).
    """

    config: CompareConfig
    environment: dict[str, Any]
    rows: tuple[Row, ...]
    warnings: tuple[str, ...]
    gradients: Float[np.ndarray, "rows params"]
    references: Float[np.ndarray, "rows params"]

    @property
    def families(self) -> tuple[str, ...]:
        """Contact families, in the order of the rows."""
        return tuple(dict.fromkeys(row.contact for row in self.rows))
