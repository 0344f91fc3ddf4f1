"""Unrolled dense linear algebra for small matrices.

Under `vmap`, an entry of a small matrix is a whole batch. Unrolled, sums and products of entries fuse with surrounding
operations, whereas library routines for batches of small matrices are loops on CPUs and separate kernels on GPUs.
"""

from typing import Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

MOST_UNROLLED: Final = 8
"""Largest number of degrees of freedom for which linear systems are unrolled in XLA's programs."""


def product(matrix: Float[Array, "rows columns"], vector: Float[Array, " columns"]) -> Float[Array, " rows"]:
    """Multiply a matrix and a vector by multiply-adds."""
    return jnp.sum(matrix * vector, axis=1)


def cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the upper factor U of a symmetric positive definite matrix U^T U."""
    size = matrix.shape[0]
    if size > MOST_UNROLLED:
        return jax.scipy.linalg.cholesky(matrix)
    upper = [[jnp.zeros_like(matrix, shape=()) for _ in range(size)] for _ in range(size)]
    for j in range(size):
        upper[j][j] = jnp.sqrt(matrix[j, j] - sum(upper[k][j] ** 2 for k in range(j)))
        for i in range(j + 1, size):
            upper[j][i] = (matrix[i, j] - sum(upper[k][i] * upper[k][j] for k in range(j))) / upper[j][j]
    return jnp.stack([jnp.stack(row) for row in upper])


def solve_factored(upper: Float[Array, "n n"], right_side: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Solve U^T U x = b for one or more right-hand sides."""
    size = upper.shape[0]
    if size > MOST_UNROLLED:
        return jax.scipy.linalg.cho_solve((upper, False), right_side)
    solution = list(right_side)
    for i in range(size):
        solution[i] = (solution[i] - sum(upper[k, i] * solution[k] for k in range(i))) / upper[i, i]
    for i in reversed(range(size)):
        solution[i] = (solution[i] - sum(upper[i, k] * solution[k] for k in range(i + 1, size))) / upper[i, i]
    return jnp.stack(solution)


def solve_positive_definite(matrix: Float[Array, "n n"], right_side: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Solve a symmetric positive definite linear system.

    Large ones are eliminated from the end, where inertia matrices have leaves of the body tree: zeros stay zero.
    """
    if matrix.shape[0] > MOST_UNROLLED:
        flipped = jax.scipy.linalg.cho_factor(matrix[::-1, ::-1])
        return jax.scipy.linalg.cho_solve(flipped, right_side[::-1])[::-1]
    return solve_factored(cholesky(matrix), right_side)
