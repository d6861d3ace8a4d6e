"""Symmetric matrices of distances."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations

import numpy as np


def symmetric_matrix(count: int, distance: Callable[[int, int], float], workers: int = 1) -> np.ndarray:
    """A matrix [count count] float64 with a zero diagonal, filled by `distance(row, column)` once for each pair in threads."""
    matrix = np.zeros((count, count))
    pairs = list(combinations(range(count), 2))
    with ThreadPoolExecutor(workers) as pool:
        for (a, b), found in zip(pairs, pool.map(lambda pair: distance(*pair), pairs), strict=True):
            matrix[a, b] = matrix[b, a] = found
    return matrix
