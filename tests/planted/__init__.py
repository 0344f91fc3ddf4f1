"""Defects to plant one at a time, and a command that says what catches each: `python -m tests.planted`."""

from tests.planted.defect import Defect
from tests.planted.estimation import ESTIMATION
from tests.planted.simulator import SIMULATOR

DEFECTS: tuple[Defect, ...] = (*SIMULATOR, *ESTIMATION)
