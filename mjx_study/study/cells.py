"""What is computed of each cell of a study, by its kind: a function that makes one of a plan."""

from typing import Final

from mjx_study.study.descents import compute_descents
from mjx_study.study.gradients import compute_gradients
from mjx_study.study.landscapes import compute_landscapes

COMPUTE: Final = {"gradients": compute_gradients, "descents": compute_descents, "landscapes": compute_landscapes}
