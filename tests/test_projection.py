"""The pinhole projection against points whose images are known by hand."""

import numpy as np

from xew.episode import project

INTRINSICS = np.array([[100.0, 0, 20], [0, 50, 10], [0, 0, 1]])


def test_a_point_lands_where_its_ray_meets_the_image() -> None:
    moved = np.eye(4)
    moved[:3, 3] = (0, 0, 1)
    pixels, depth = project(np.array([[0.0, 0, 1], [1, 2, 1], [-1, 0, 3]]), INTRINSICS, moved)
    np.testing.assert_allclose(pixels, [[20, 10], [70, 60], [-5, 10]])
    np.testing.assert_allclose(depth, [2, 2, 4])


def test_a_point_at_or_behind_the_camera_has_no_image() -> None:
    pixels, depth = project(np.array([[1.0, 1, 0], [0, 0, -1]]), INTRINSICS, np.eye(4))
    assert np.isnan(pixels).all() and depth.tolist() == [0, -1]
