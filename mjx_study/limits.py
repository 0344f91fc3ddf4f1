"""Limits on the size of a plan; larger plans are rejected before anything is computed."""

from typing import Final

MOST_MODELS: Final = 5_000
"""Maximum number of contact models per task."""
MOST_CELLS: Final = 50_000
"""Maximum number of cells in a sweep, each of which is a file."""
MOST_PROGRAMS: Final = 500
"""Maximum number of programs compiled by a sweep: each timestep, cone and task needs its own."""
MOST_PARAMS: Final = 10_000_000
"""Maximum number of network parameters."""
MOST_LAYERS: Final = 100
"""Maximum number of hidden layers."""
MOST_STEPS: Final = 1_000_000
"""Maximum number of rollout steps."""
LARGEST_COORDINATE: Final = 1e10
"""Size of coordinates and velocities from which a state counts as nonfinite [m, rad, m/s or rad/s], as in MuJoCo."""
MOST_GIB: Final = 16.0
"""Maximum memory for arrays held at once [GiB], as counted by `mjx_study.experiment.memory.check_memory`."""
MOST_NUMBERS: Final = 500_000_000
"""Maximum size of a variable of a study, over all of its cells."""


def check_count(count: int, what: str, limit: int, change: str) -> None:
    """Raise a ValueError that names the limit and what to change if a count exceeds it."""
    if count > limit:
        raise ValueError(f"{count} {what} are planned, and the limit is {limit}: {change}")
