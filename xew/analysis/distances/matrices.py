"""Symmetric matrices of distances: how they are filled, and the mean distance of each robot to the others."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations

import numpy as np


def mean_distances(matrix: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
    """Each robot's mean distance to the others [... n], from symmetric matrices [... n n] with a zero diagonal."""
    matrix = np.asarray(matrix, np.float64)
    return matrix.sum(axis=-1) / (matrix.shape[-1] - 1)


def symmetric_matrix(count: int, distance: Callable[[int, int], float], workers: int = 1) -> np.ndarray:
    """A matrix [count count] float64 with a zero diagonal, filled by `distance(row, column)` once for each pair in threads."""
    matrix = np.zeros((count, count))
    pairs = list(combinations(range(count), 2))
    with ThreadPoolExecutor(workers) as pool:
        for (a, b), found in zip(pairs, pool.map(lambda pair: distance(*pair), pairs), strict=True):
            matrix[a, b] = matrix[b, a] = found
    return matrix
