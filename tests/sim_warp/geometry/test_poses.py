"""Poses and homogeneous transforms are two ways to write the same thing."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xew.sim_warp.geometry.poses import matrix_from_pose, pose_from_matrix


def random_poses(*shape: int) -> np.ndarray:
    """[... 7] positions and unit quaternions."""
    rng = np.random.default_rng(0)
    quaternion = rng.normal(size=(*shape, 4))
    return np.concatenate([rng.normal(size=(*shape, 3)), quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)], -1)


def test_a_transform_applies_the_turn_and_then_the_shift() -> None:
    pose = random_poses(1)[0]
    point = np.array([0.3, -0.2, 0.1])
    expected = Rotation.from_quat(pose[3:]).apply(point) + pose[:3]
    np.testing.assert_allclose(matrix_from_pose(pose) @ [*point, 1], [*expected, 1], atol=1e-12)


def test_identity_is_identity_both_ways() -> None:
    identity = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    np.testing.assert_array_equal(matrix_from_pose(identity), np.eye(4))
    np.testing.assert_array_equal(pose_from_matrix(np.eye(4)), identity)


@pytest.mark.parametrize("shape", [(5,), (2, 3), (2, 3, 4)])
def test_poses_of_any_shape_come_back(shape: tuple[int, ...]) -> None:
    pose = random_poses(*shape)
    matrix = matrix_from_pose(pose)
    assert matrix.shape == (*shape, 4, 4)
    back = pose_from_matrix(matrix.reshape(-1, 4, 4)).reshape(*shape, 7)
    sign = np.sign(pose[..., 6:])
    np.testing.assert_allclose(back, np.concatenate([pose[..., :3], sign * pose[..., 3:]], -1), atol=1e-12)
    assert (back[..., 6] >= 0).all()


def test_of_two_quaternions_the_one_with_positive_w_is_given() -> None:
    turned = matrix_from_pose(np.array([0, 0, 0, 0, 0, -np.sin(2.0), -np.cos(2.0)]))
    pose = pose_from_matrix(turned)
    assert pose[6] == pytest.approx(abs(np.cos(2.0)))


def test_transforms_compose_as_matrices_do() -> None:
    first, second = matrix_from_pose(random_poses(2))
    both = pose_from_matrix(first @ second)
    parts = Rotation.from_matrix(first[:3, :3]), Rotation.from_matrix(second[:3, :3])
    np.testing.assert_allclose(both[:3], parts[0].apply(second[:3, 3]) + first[:3, 3], atol=1e-12)
    assert (Rotation.from_quat(both[3:]).inv() * parts[0] * parts[1]).magnitude() < 1e-9
