"""Where a camera stands, where it looks, and what its image holds."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xew.episode import HEIGHT, WIDTH
from xew.sim_warp.geometry.camera import HEAD_CAMERA, look_at, project
from xew.sim_warp.stage import TABLE_TOP

POSITION, TARGET = np.array((0.4, -0.3, 1.2)), np.array((0.1, 0.2, 0.7))


def test_a_camera_stands_at_its_position_and_sees_its_target_in_the_middle() -> None:
    camera = look_at(POSITION, TARGET, width=64, height=48)
    np.testing.assert_allclose(camera.position, POSITION, atol=1e-12)
    pixel, depth = project(camera, TARGET)
    np.testing.assert_allclose(pixel, (31.5, 23.5), atol=1e-9)
    assert depth == pytest.approx(np.linalg.norm(TARGET - POSITION))


def test_the_axes_are_right_down_and_forward() -> None:
    camera = look_at(POSITION, TARGET)
    right, down, forward = camera.extrinsics[:3, :3]
    np.testing.assert_allclose(camera.extrinsics[:3, :3] @ camera.extrinsics[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.extrinsics[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(forward, (TARGET - POSITION) / np.linalg.norm(TARGET - POSITION))
    assert right[2] == pytest.approx(0) and down[2] < 0
    higher, _ = project(camera, TARGET + [0, 0, 0.05])
    beside, _ = project(camera, TARGET + 0.05 * right)
    assert higher[1] < (HEIGHT - 1) / 2 and beside[0] > (WIDTH - 1) / 2


def test_the_angle_of_view_is_that_of_the_image_s_full_height() -> None:
    camera = look_at((0, 0, 0), (0, 1, 0), vertical_fov=60, width=80, height=60)
    upper_edge = Rotation.from_euler("x", 30, degrees=True).apply([0, 1, 0])
    pixel, _ = project(camera, upper_edge)
    np.testing.assert_allclose(pixel, (39.5, -0.5), atol=1e-9)


def test_pixels_are_square_and_scale_with_the_focal_length() -> None:
    camera = look_at((0, 0, 0), (0, 1, 0), width=80, height=60)
    assert camera.intrinsics[0, 0] == camera.intrinsics[1, 1]
    near, far = (project(camera, np.array([0.1, depth, 0.0]))[0] for depth in (1.0, 2.0))
    assert near[0] - 39.5 == pytest.approx(2 * (far[0] - 39.5)) == pytest.approx(0.1 * camera.intrinsics[0, 0])


def test_another_up_turns_the_image() -> None:
    upright, lying = (look_at((0, 0, 2), (0, 0, 0), up) for up in ((0, 1, 0), (1, 0, 0)))
    point = np.array([0.1, 0.0, 0.0])
    assert project(upright, point)[0][0] > WIDTH / 2
    assert project(lying, point)[0][1] < HEIGHT / 2


@pytest.mark.parametrize("target", [(0, 0, 0), (0, 0, 1)])
def test_a_camera_without_a_line_of_sight_or_an_up_is_refused(target: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match=r"a camera at \(0, 0, 1\) cannot look at .* with up"):
        look_at((0, 0, 1), target)


def test_points_of_many_frames_are_projected_at_once() -> None:
    points = np.random.default_rng(0).uniform((-0.3, -0.2, 0.7), (0.3, 0.3, 0.9), (3, 5, 3))
    pixels, depth = project(HEAD_CAMERA, points)
    assert pixels.shape == (3, 5, 2) and depth.shape == (3, 5)
    one, one_depth = project(HEAD_CAMERA, points[1, 2])
    np.testing.assert_array_equal(pixels[1, 2], one)
    assert depth[1, 2] == one_depth


def test_a_pixel_s_ray_leads_back_to_the_point() -> None:
    points = np.random.default_rng(1).uniform((-0.3, -0.2, 0.7), (0.3, 0.3, 0.9), (20, 3))
    pixels, depth = project(HEAD_CAMERA, points)
    rays = np.column_stack([pixels, np.ones(20)]) @ np.linalg.inv(HEAD_CAMERA.intrinsics).T
    back = (rays * depth[:, None] - HEAD_CAMERA.extrinsics[:3, 3]) @ HEAD_CAMERA.extrinsics[:3, :3]
    np.testing.assert_allclose(back, points, atol=1e-9)


def test_the_head_camera_sees_where_hands_work() -> None:
    corners = np.array([(x, y, TABLE_TOP) for x in (-0.25, 0.2) for y in (-0.2, 0.2)])
    pixels, depth = project(HEAD_CAMERA, corners)
    assert (pixels > 0).all() and (pixels < (WIDTH - 1, HEIGHT - 1)).all() and (depth > 0.3).all()
    pitch = np.degrees(np.arcsin(-HEAD_CAMERA.extrinsics[2, 2]))
    assert pitch == pytest.approx(53, abs=0.5)
