"""Points on meshes: on the surface, spread over it, the same every time."""

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from xew.sim_warp.geometry.meshes import Mesh, box, sphere
from xew.sim_warp.geometry.surface_points import farthest_points, sample_surface

RED = (200, 45, 40)


def test_points_lie_on_the_surface_and_face_outward() -> None:
    points, normals = sample_surface(box((0.2, 0.1, 0.04), RED), 40)
    away = np.abs(points) / (0.1, 0.05, 0.02)
    np.testing.assert_allclose(away.max(axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(np.abs(normals).max(axis=1), 1)
    side = np.abs(normals).argmax(axis=1)
    rows = np.arange(len(points))
    assert (np.sign(points[rows, side]) == np.sign(normals[rows, side])).all()
    np.testing.assert_allclose(away[rows, side], 1, atol=1e-6)


def test_points_are_spread_and_the_same_every_time() -> None:
    points, _ = sample_surface(sphere(0.1, RED, subdivisions=3), 24)
    again, _ = sample_surface(sphere(0.1, RED, subdivisions=3), 24)
    np.testing.assert_array_equal(points, again)
    assert pdist(points).min() > 0.033, "24 points can be 0.066 apart, and a greedy choice reaches half of the best"
    assert np.linalg.norm(points.mean(axis=0)) < 0.02


def test_what_has_no_area_has_no_points() -> None:
    flat = Mesh(*(np.zeros((3, 3), kind) for kind in (np.float32, np.int32, np.uint8)), np.zeros((3, 3, 3), np.float32))
    assert len(sample_surface(flat, 5)[0]) == len(sample_surface(box((1, 1, 1), RED), 0)[0]) == 0
    with pytest.raises(ValueError, match="count is -1"):
        sample_surface(flat, -1)


def test_farthest_points_begin_at_the_ends() -> None:
    line = np.array([[0.0], [0.1], [0.5], [0.9], [1.2]])
    assert farthest_points(line, 3).tolist() == [4, 0, 2]
    assert len(farthest_points(line, 9)) == 5
