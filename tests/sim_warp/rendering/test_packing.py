"""Worlds packed end to end: every frame finds its own triangles and poses again, and what is shown twice is stored once."""

import numpy as np
import pytest
import warp as wp

from xew.sim_warp.geometry import meshes
from xew.sim_warp.rendering.packing import (
    Body,
    PackedGeometry,
    World,
    check_world,
    distinct_worlds,
    pack_frames,
    pack_geometry,
    pack_points,
)
from xew.sim_warp.stage import linear_from_srgb

CUBE, BALL = meshes.box((0.1, 0.1, 0.1), (200, 30, 30)), meshes.sphere(0.05, (30, 30, 200), 1)
ROBOT, THING = Body(CUBE, True), Body(BALL, False)


def poses(frames: int, bodies: int, first: float = 0.0) -> np.ndarray:
    """[t b 7] poses that all differ: x counts on from `first`."""
    pose = np.zeros((frames, bodies, 7))
    pose[..., 0] = first + np.arange(frames * bodies).reshape(frames, bodies)
    pose[..., 6] = 1
    return pose


WORLDS = [
    World([ROBOT, THING], poses(3, 2)),
    World([THING], poses(1, 1, 100)),
    World([ROBOT, THING], poses(2, 2, 200), points=np.ones((2, 4, 3))),
]


@pytest.fixture(scope="module")
def packed() -> PackedGeometry:
    return pack_geometry(distinct_worlds(WORLDS)[0], wp.get_device("cpu"))


def test_worlds_that_show_the_same_meshes_are_one_kind() -> None:
    kinds, index = distinct_worlds(WORLDS)
    assert index == [0, 1, 0] and [len(bodies) for bodies in kinds] == [2, 1]


def test_the_same_mesh_as_robot_and_as_thing_are_two_kinds() -> None:
    worlds = [World([Body(CUBE, is_robot)], poses(1, 1)) for is_robot in (True, False)]
    assert distinct_worlds(worlds)[1] == [0, 1]


def test_equal_meshes_are_one_kind_only_if_they_are_one_object() -> None:
    """Comparing content would cost more than it saves: callers keep one `Mesh` a shape."""
    copy = CUBE.transformed()
    assert distinct_worlds([World([Body(mesh, True)], poses(1, 1)) for mesh in (CUBE, copy, CUBE)])[1] == [0, 1, 0]


def test_every_frame_finds_its_poses() -> None:
    table, pose = pack_frames(WORLDS, [0, 1, 0])
    assert table.world.tolist() == [0, 0, 0, 1, 0, 0]
    expected = [world.pose[frame] for world in WORLDS for frame in range(len(world.pose))]
    for first, bodies in zip(table.pose, expected, strict=True):
        np.testing.assert_array_equal(pose[first : first + len(bodies)], bodies.astype(np.float32))
    assert pose.dtype == np.float32 and len(pose) == 3 * 2 + 1 + 2 * 2


def test_the_next_of_a_frame_stays_in_its_world() -> None:
    table, _ = pack_frames(WORLDS, [0, 1, 0])
    assert table.pose.tolist() == [0, 2, 4, 6, 7, 9]
    assert table.next_pose.tolist() == [2, 4, 4, 6, 9, 9], "the last frame of each world is its own next"


def test_a_part_of_the_frames_is_a_table_of_its_own() -> None:
    table, _ = pack_frames(WORLDS, [0, 1, 0])
    part = table.select(slice(2, 4))
    assert (part.world.tolist(), part.pose.tolist(), part.next_pose.tolist()) == ([0, 1], [4, 6], [4, 6])


def test_triangles_lie_end_to_end_with_indices_of_their_world(packed: PackedGeometry) -> None:
    arrays = packed.arrays
    vertices, triangles = len(CUBE.vertices) + len(BALL.vertices), len(CUBE.triangles) + len(BALL.triangles)
    assert packed.vertex_counts.tolist() == [vertices, len(BALL.vertices)]
    assert packed.triangle_counts.tolist() == [triangles, len(BALL.triangles)]
    assert arrays.triangle_range.numpy().tolist() == [[0, triangles], [triangles, len(BALL.triangles)]]
    assert arrays.vertex_range.numpy().tolist() == [[0, vertices], [vertices, len(BALL.vertices)]]
    corners = arrays.vertex.numpy()[arrays.triangle.numpy()[:triangles]]
    np.testing.assert_array_equal(corners[: len(CUBE.triangles)], CUBE.vertices[CUBE.triangles])
    np.testing.assert_array_equal(corners[len(CUBE.triangles) :], BALL.vertices[BALL.triangles])
    assert arrays.triangle.numpy()[triangles:].min() == 0, "the second world counts from zero again"


def test_bodies_of_a_world_are_counted_from_its_first(packed: PackedGeometry) -> None:
    arrays = packed.arrays
    assert arrays.body_is_robot.numpy().tolist() == [1, 0, 0]
    assert arrays.body_first.numpy().tolist() == [0, 2]
    owners = arrays.triangle_body.numpy()
    assert np.bincount(owners).tolist() == [len(CUBE.triangles) + len(BALL.triangles), len(BALL.triangles)]
    assert owners[-1] == 0


def test_colors_are_packed_as_linear_light(packed: PackedGeometry) -> None:
    albedo = packed.arrays.albedo.numpy()
    np.testing.assert_allclose(albedo[0], linear_from_srgb(np.array([200, 30, 30])), rtol=1e-6)
    assert albedo.shape == packed.arrays.triangle.shape + (3,)


def test_a_world_without_bodies_can_be_packed() -> None:
    empty = pack_geometry([[]], wp.get_device("cpu"))
    assert empty.vertex_counts.tolist() == empty.triangle_counts.tolist() == [0]


def test_worlds_with_fewer_points_are_filled_up() -> None:
    points = pack_points(WORLDS)
    assert points.shape == (6, 4, 3)
    assert np.isnan(points[:4]).all() and (points[4:] == 1).all()
    assert pack_points(WORLDS[:2]).shape == (4, 0, 3)


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (World([ROBOT], poses(2, 2)), r"pose has shape \(2, 2, 7\), expected \(frames, 1, 7\)"),
        (World([ROBOT], poses(2, 1)[0]), r"pose has shape \(1, 7\)"),
        (World([ROBOT], poses(0, 1)), "pose has no frames"),
        (World([ROBOT, THING], np.where(np.arange(14).reshape(1, 2, 7) == 9, np.inf, 0.0)), "body 1 at frame 0 is not finite"),
        (World([ROBOT], poses(2, 1), points=np.zeros((3, 4, 3))), r"points have shape \(3, 4, 3\), expected \(2, points, 3\)"),
        (World([ROBOT], poses(2, 1), points=np.zeros((2, 3))), r"points have shape \(2, 3\)"),
    ],
)
def test_what_does_not_fit_is_told(world: World, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_world(world)
