"""Symmetric matrices of distances: how they are filled, and the mean distance of each robot to the others."""

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np


def mean_distances(matrix: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
    """Each robot's mean distance to the others [... n], from symmetric matrices [... n n] with a zero diagonal."""
    matrix = np.asarray(matrix, np.float64)
    return matrix.sum(axis=-1) / (matrix.shape[-1] - 1)


def symmetric_matrix(count: int, distance: Callable[[int, int], float]) -> np.ndarray:
    """A matrix [count count] float64 with a zero diagonal, filled by `distance(row, column)` once for each pair."""
    matrix = np.zeros((count, count))
    for a, b in combinations(range(count), 2):
        matrix[a, b] = matrix[b, a] = distance(a, b)
    return matrix
