"""Rounding error of a step, which limits the accuracy of finite differences."""

from typing import Any, Final

import numpy as np
from jaxtyping import Float

from mjx_study.gradcheck.coordinates import Coordinates

EPSILON: Final = 1e-15
"""A few rounding errors of a float64."""


def solution_noise(
    layout: Coordinates, stages: dict[str, Any], qacc: Float[np.ndarray, " nv"]
) -> Float[np.ndarray, " outputs"]:
    """Rounding error of the outputs of a step whose equation M a - q - J^T f(J a) = 0 is solved exactly.

    Each term is rounded by EPSILON of its size, which the inverse of the equation propagates to the acceleration. MJX's
    integrators then compute the velocity from the forces, M^-1 (q + J^T f), where large forces that cancel leave their
    rounding.
    """
    jacobian, timestep = stages["efc_J"], layout.scene.timestep
    weighted = stages["efc_D"][:, None] * np.abs(jacobian)
    size = np.abs(stages["qM"]) @ np.abs(qacc) + np.abs(stages["qM"] @ stages["qacc_smooth"])
    size += weighted.T @ (np.abs(jacobian) @ np.abs(qacc) + np.abs(stages["efc_aref"]))
    matrices = stages["qM"] + jacobian.T @ (stages["efc_D"][:, None] * jacobian), stages["qM"]
    if not all(np.all(np.isfinite(matrix)) and np.linalg.cond(matrix) < 1 / EPSILON for matrix in matrices):
        return np.zeros(len(layout.outputs))
    velocity = timestep * EPSILON * sum(np.abs(np.linalg.inv(matrix)) for matrix in matrices) @ size
    activation = np.zeros(len(layout.outputs) - 2 * len(velocity))
    return np.concatenate([timestep * velocity, velocity, activation])
