"""Names that users choose from, and oracles; free of imports that compute."""

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

PLUG_IN: Final = "plug_in"
CROSS_FITTED: Final = "cross_fitted"
WEIGHTS: Final = (PLUG_IN, CROSS_FITTED)
"""Where an interpolation's weights come from."""
LEAVE_ONE_OUT: Final = "leave_one_out"
BASELINES: Final = ("none", "zero_noise", LEAVE_ONE_OUT)
"""Baselines for zeroth-order samples."""
VARIANCE_PROXIES: Final = ("variance", "second_moment", "upper_bound")
"""Choices for the variance in epsilon."""
MAX_DEVIATION: Final = "max_deviation"  # choice of the radius in epsilon that is computed from the samples
PUBLISHED_TOLERANCE: Final = 0.3  # tolerance of the DDCG test, as published
DENSITIES: Final = {
    "gaussian": "the paper's",
    "logistic": "heavier tails, bounded score",
    "laplace": "a score of constant size, which bounds zeroth-order samples",
    "student": "Student's t with 5 degrees of freedom: rare large steps",
}
"""Noise densities, each with a one-line description."""


@dataclass(frozen=True)
class Oracle:
    """A kind of batch that an objective can produce.

    Attributes:
        name: Name in `ORACLES` and in an estimator's `needs`.
        order: 0 if only values are needed, 1 if derivatives are; batches of the same order share their samples.
        method: Method of the objective, called with theta and keys.
        contents: What the batch holds, for messages and tables.
        rollouts: Number of rollouts of a sample.
        baseline: Whether the batch also has rollouts without noise.
    """

    name: str
    order: int
    method: str
    contents: str
    rollouts: int = 1
    baseline: bool = True

    @property
    def phrase(self) -> str:
        """Name of the batch in messages."""
        return f"a {'first' if self.order else 'zeroth'}-order batch of {self.contents}"


ORACLES: Final[dict[str, Oracle]] = {
    oracle.name: oracle
    for oracle in (
        Oracle("evaluation", 0, "evaluate", "values"),
        Oracle("pair", 0, "evaluate_pair", "pairs", rollouts=2),
        Oracle("steps", 0, "evaluate_steps", "steps"),
        Oracle("step_pair", 0, "evaluate_step_pair", "pairs by step", rollouts=2),
        Oracle("differentiation", 1, "differentiate", "gradients", baseline=False),
        Oracle("corrected", 1, "differentiate_corrected", "corrected gradients", baseline=False),
        Oracle("step_differentiation", 1, "differentiate_steps", "gradients by step", baseline=False),
        Oracle("linearisation", 1, "linearise", "derivatives of steps"),
    )
}


def unknown(label: str, value: object, choices: Iterable[str], more: str = "") -> str:
    """Return the error message for an invalid choice: the closest match, otherwise all choices and `more`."""
    text = str(value)
    shown = repr(value) if len(text) <= 60 else f"{text[:50]!r}..."
    return f"unknown {label} {shown}" + (suggestion(text, choices) or f"; choose from {', '.join(choices)}{more}")


def suggestion(value: str, choices: Iterable[str], cutoff: float = 0.6) -> str:
    """Suggest the choice that a shortened or misspelt value probably means, as the end of a message; empty if none is
    as similar as the cutoff."""
    whole = [choice for choice in choices if value and choice.startswith(value)]
    near = difflib.get_close_matches(value, whole or list(choices), n=1, cutoff=0 if whole else cutoff)
    return "".join(f"; did you mean {each}?" for each in near)
