"""Meshes are closed, face outwards, have the size that was asked for, and keep all that when they are moved or merged."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.meshes import Mesh

RED, BLUE = (200, 30, 30), (30, 30, 200)
SHAPES = {
    "box": (meshes.box((0.2, 0.1, 0.3), RED), 0.2 * 0.1 * 0.3, 0.0),
    "cylinder": (meshes.cylinder(0.05, 0.2, RED), np.pi * 0.05**2 * 0.2, 0.02),
    "capsule": (meshes.capsule(0.05, 0.2, RED), np.pi * 0.05**2 * (0.2 + 4 / 3 * 0.05), 0.06),
    "sphere": (meshes.sphere(0.1, RED, 3), 4 / 3 * np.pi * 0.1**3, 0.02),
    "cone": (meshes.revolve([(0, 0), (0.1, 0), (0, 0.3)], RED), np.pi * 0.1**2 * 0.1, 0.01),
    "hull": (meshes.hull(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.1, 0.1, 0.1]]), RED), 1 / 6, 0.0),
}
"""A mesh, its volume [m3] and by how much polygons may fall short of a round one."""


def volume(mesh: Mesh) -> float:
    """Signed volume [m3] inside triangles that run counter-clockwise seen from outside."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]].astype(float) for corner in range(3))
    return float(np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6)


def face_normals(mesh: Mesh) -> np.ndarray:
    """[f 3] unit normals by the order of the corners."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]].astype(float) for corner in range(3))
    normal = np.cross(b - a, c - a)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


@pytest.mark.parametrize("name", SHAPES)
def test_a_shape_encloses_its_volume_and_faces_outwards(name: str) -> None:
    mesh, expected, shortfall = SHAPES[name]
    assert expected * (1 - shortfall) - 1e-7 <= volume(mesh) <= expected * 1.0001
    assert trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False).is_watertight


@pytest.mark.parametrize("name", SHAPES)
def test_corner_normals_are_unit_vectors_on_the_outer_side(name: str) -> None:
    mesh, _, _ = SHAPES[name]
    assert mesh.normals.shape == (len(mesh.triangles), 3, 3)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-5)
    bend = np.einsum("fci,fi->fc", mesh.normals, face_normals(mesh))
    assert bend.min() > np.cos(np.radians(40)), "a corner's normal bends less than the crease from its face"


@pytest.mark.parametrize("name", SHAPES)
def test_arrays_have_the_types_that_the_renderer_packs(name: str) -> None:
    mesh, _, _ = SHAPES[name]
    assert (mesh.vertices.dtype, mesh.triangles.dtype) == (np.float32, np.int32)
    assert (mesh.colors.dtype, mesh.normals.dtype) == (np.uint8, np.float32)
    assert mesh.colors.shape == mesh.triangles.shape and (mesh.colors == RED).all()
    assert mesh.triangles.min() >= 0 and mesh.triangles.max() < len(mesh.vertices)


def test_edges_of_a_box_are_sharp_and_a_ball_is_smooth() -> None:
    cube, ball = meshes.box((1, 1, 1), RED), meshes.sphere(1.0, RED, 3)
    np.testing.assert_allclose(cube.normals, np.repeat(face_normals(cube)[:, None], 3, 1), atol=1e-6)
    outwards = ball.vertices[ball.triangles]
    assert np.einsum("fci,fci->fc", ball.normals, outwards).min() > 0.999


def test_the_crease_angle_decides_what_is_sharp() -> None:
    shape = trimesh.creation.box((1, 1, 1))
    smooth = meshes.from_trimesh(shape, RED, crease_angle=np.radians(100))
    corners = smooth.vertices[smooth.triangles]
    assert np.einsum("fci,fci->fc", smooth.normals, corners).min() > 0.7, "normals lean towards the corners of the cube"
    assert np.abs(smooth.normals - face_normals(smooth)[:, None]).max() > 0.3


def test_sizes_are_full_lengths_and_shapes_are_centered() -> None:
    for name, size in (("box", (0.2, 0.1, 0.3)), ("cylinder", (0.1, 0.1, 0.2)), ("capsule", (0.1, 0.1, 0.3))):
        mesh, _, _ = SHAPES[name]
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), size, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(mesh.vertices.max(0) + mesh.vertices.min(0), 0, atol=1e-6, err_msg=name)


def test_a_move_turns_first_by_fixed_axes_and_then_shifts() -> None:
    mesh = meshes.box((0.2, 0.1, 0.3), RED)
    moved = mesh.transformed((1, 2, 3), (0.1, 0.2, 0.3))
    turn = Rotation.from_euler("z", 0.3) * Rotation.from_euler("y", 0.2) * Rotation.from_euler("x", 0.1)
    np.testing.assert_allclose(moved.vertices, turn.apply(mesh.vertices) + [1, 2, 3], atol=1e-6)
    np.testing.assert_allclose(moved.normals.reshape(-1, 3), turn.apply(mesh.normals.reshape(-1, 3)), atol=1e-6)
    assert moved.vertices.dtype == moved.normals.dtype == np.float32
    assert volume(moved) == pytest.approx(volume(mesh), rel=1e-4)


def test_merged_meshes_keep_their_triangles_colors_and_volumes() -> None:
    cube, ball = meshes.box((0.1, 0.1, 0.1), RED), meshes.sphere(0.05, BLUE).transformed((1, 0, 0))
    both = meshes.merge([cube, ball])
    assert volume(both) == pytest.approx(volume(cube) + volume(ball), rel=1e-5)
    count = len(cube.triangles)
    np.testing.assert_array_equal(both.vertices[both.triangles[:count]], cube.vertices[cube.triangles])
    np.testing.assert_array_equal(both.vertices[both.triangles[count:]], ball.vertices[ball.triangles])
    assert (both.colors[:count] == RED).all() and (both.colors[count:] == BLUE).all()
    np.testing.assert_array_equal(both.normals, np.concatenate([cube.normals, ball.normals]))


def test_a_hull_drops_the_points_inside() -> None:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    inside = np.random.default_rng(0).uniform(0.1, 0.9, (20, 3))
    assert len(meshes.hull(np.concatenate([inside, corners]), RED).vertices) == 8


def test_a_box_is_to_the_bit_the_one_that_trimesh_makes() -> None:
    rng = np.random.default_rng(0)
    for size in (10 ** rng.uniform(-4, 0.5, (50, 3))).tolist():
        ours, theirs = meshes.box(size, RED), meshes.from_trimesh(trimesh.creation.box(size), RED)
        for name in ("vertices", "triangles", "colors", "normals"):
            assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes(), name
