"""What a comparison is asked for, and what it answers: plain data, with every field explained."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from estimators import ESTIMATORS
from estimators.ddcg import PUBLISHED_TOLERANCE
from mjx_study.contact import FAMILIES


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompareConfig:
    """Everything that decides the result of a comparison.

    Attributes:
        task: name of a task.
        stiffness: contact stiffnesses [N/m], for the families that take one; None for the task's.
        contact: names of contact families; None for the task's.
        estimators: names of estimators.
        samples: in each batch; an alpha-order estimate uses two batches.
        reference_samples: pairs of rollouts behind each reference gradient.
        sigma: standard deviation of the noise, in the unit of what it is added to; None for the task's.
        seed: of all randomness.
        baseline: of zeroth-order estimates: zero_noise, leave_one_out or none.
        gamma: accuracy that the alpha-order estimate must keep, in the unit of the gradient; None for the task's.
        failure_probability: of the confidence radius epsilon.
        variance_proxy: in epsilon: variance, second_moment or upper_bound.
        radius: R in epsilon: max_deviation, or a bound in the unit of the gradient.
        confidence: of the intervals that are reported.
        damping: of the contact [N s/m]; None for each family's damping ratio.
        cone: pyramidal or elliptic; None for the MJCF's.
        horizon: steps; None for the task's.
        model: an MJCF in place of the task's own; None for that.
        chunk_size: samples per device and call; None to choose by the number of samples.
        noise: name of the noise's density; None for the task's.
        max_norm: of a sample of the clipped first-order estimate, in the unit of the gradient.
        window: steps between cuts of the truncated first-order estimate.
        tolerance: of the discontinuity test of "ddcg".
    """

    task: str
    stiffness: tuple[float, ...] | None = None
    contact: tuple[str, ...] | None = None
    estimators: tuple[str, ...] = ("zobg", "fobg", "aobg")
    samples: int = 400
    reference_samples: int = 600
    sigma: float | None = None
    seed: int = 0
    baseline: str = "zero_noise"
    gamma: float | None = None
    failure_probability: float = 0.05
    variance_proxy: str = "variance"
    radius: str | float = "max_deviation"
    confidence: float = 0.95
    damping: float | None = None
    cone: str | None = None
    horizon: int | None = None
    model: str | None = None
    chunk_size: int | None = None
    noise: str | None = None
    max_norm: float | None = None
    window: int | None = None
    tolerance: float = PUBLISHED_TOLERANCE

    def __post_init__(self) -> None:
        for label, names, choices in (
            ("contact family", self.contact, FAMILIES),
            ("estimator", self.estimators, ESTIMATORS),
        ):
            if names is None:
                continue
            if not names:
                raise ValueError(f"no {label} given; choose from {', '.join(choices)}")
            _refuse_repeats(label, names)
            for name in names:
                if name not in choices:
                    raise ValueError(f"unknown {label} {name!r}; choose from {', '.join(choices)}")
        if self.stiffness is not None:
            if not self.stiffness:
                raise ValueError("no stiffness given: give at least one, in N/m")
            _refuse_repeats("stiffness", self.stiffness)
            if self.contact is not None and not any(FAMILIES[name].swept for name in self.contact):
                raise ValueError(f"contact {', '.join(self.contact)} takes no stiffness; leave --stiffness out")
        for label, count, least in (("samples", self.samples, 3), ("reference_samples", self.reference_samples, 3)):
            if count < least:
                raise ValueError(f"{label} must be at least {least}, so that a variance has an interval; got {count}")
        if self.chunk_size is not None and self.chunk_size < 1:
            raise ValueError(f"chunk_size must be at least 1 sample, got {self.chunk_size}")
        if not 0 < self.confidence < 1:
            raise ValueError(f"confidence must lie strictly between 0 and 1, got {self.confidence}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")


def _refuse_repeats(label: str, values: Sequence[object]) -> None:
    repeated = {str(value) for value in values if values.count(value) > 1}
    if repeated:
        raise ValueError(f"{label} given twice: {', '.join(sorted(repeated))}")


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
        relative_error, relative_error_se: distance to the reference gradient over its norm, with standard error.
        cosine, cosine_se: of the angle to the reference gradient, with standard error.
        reference_norm: of the reference gradient.
        reference_uncertainty: its relative standard error; errors below it cannot be told from zero.
        alpha: weight of the first-order batch; None for an estimator of one batch.
        epsilon: confidence radius of the zeroth-order mean; None likewise.
        discrepancy: B, the distance between the two means; None likewise.
        bias_p_value: that the mean's distance to the reference is chance; see `estimators.bias_test`.
        seconds_per_sample: of computing, compilation excluded.
        variance_seconds: variance times seconds per sample, the variance that a second of computing leaves.
        residual: largest relative solver residual in the batches.
        unconverged: samples whose residual is above the threshold.
        nonfinite: samples left out because they were not finite.
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
    relative_error: float
    relative_error_se: float
    cosine: float
    cosine_se: float
    reference_norm: float
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
