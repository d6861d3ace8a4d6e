"""Points and normals on the surfaces of meshes, deterministic for each mesh.

Points are drawn with a density proportional to area and thinned by farthest-point sampling (Y. Eldar et al., "The farthest
point strategy for progressive image sampling", 1997).
"""

import numpy as np

from xew.sim_warp.geometry.meshes import Mesh

CANDIDATES_PER_POINT = 8
"""Number of drawn candidates per selected point."""
SEED = 20_14
"""Key of the counter-based generator that draws the candidates."""


def sample_surface(mesh: Mesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Evenly spread points of a mesh; a function of the mesh and the count alone.

    Args:
        mesh: in the frame of its body.
        count: number of points.

    Returns:
        Points [count 3] float64 m and outward unit normals of their triangles [count 3] float64, frame of the body; empty
        arrays if the mesh has no area.

    Raises:
        ValueError: the count is negative.
    """
    if count < 0:
        raise ValueError(f"count is {count}, expected the number of points to sample, 0 or more.")
    corners = mesh.vertices.astype(np.float64)[mesh.triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=-1)
    if not count or not area.sum() > 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    rng = np.random.Generator(np.random.Philox(key=SEED))
    triangle = np.searchsorted(np.cumsum(area) / area.sum(), rng.random(count * CANDIDATES_PER_POINT), side="right")
    triangle = np.minimum(triangle, len(area) - 1)
    root, other = np.sqrt(rng.random(len(triangle)))[:, None], rng.random(len(triangle))[:, None]
    a, b, c = np.moveaxis(corners[triangle], 1, 0)
    points = (1 - root) * a + root * (1 - other) * b + root * other * c
    chosen = farthest_points(points, count)
    return points[chosen], (cross / np.where(area > 0, area, 1)[:, None])[triangle[chosen]]


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Indices [count] of points [n 3] far apart: first the point farthest from the mean, then greedily."""
    nearest = np.full(len(points), np.inf)
    chosen: list[int] = []
    following = int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=-1)))
    for _ in range(min(count, len(points))):
        chosen.append(following)
        nearest = np.minimum(nearest, np.linalg.norm(points - points[following], axis=-1))
        following = int(np.argmax(nearest))
    return np.array(chosen, int)
