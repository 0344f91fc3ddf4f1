"""The computation of a cell, by kind of study: from a plan to a function of its cells."""

from typing import Final

from mjx_study.study.descents import compute_descents
from mjx_study.study.gradients import compute_gradients
from mjx_study.study.landscapes import compute_landscapes

COMPUTE: Final = {"gradients": compute_gradients, "descents": compute_descents, "landscapes": compute_landscapes}
