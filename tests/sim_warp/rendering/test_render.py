"""The rasteriser against ray casting in NumPy, and what its images promise."""

import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from scipy.ndimage import binary_dilation, binary_erosion, map_coordinates
from scipy.spatial.transform import Rotation

from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.camera import HEAD_CAMERA, Camera, look_at, project
from xew.sim_warp.geometry.meshes import Mesh
from xew.sim_warp.rendering import raster_kernels, shading_kernels
from xew.sim_warp.rendering.render import FLOW_LIMIT, Body, Renderer, World
from xew.sim_warp.stage import LIGHTS, TABLE_TOP

NEAR = 0.1
CUBE = meshes.box((0.08, 0.08, 0.08), (200, 60, 60))
BALL = meshes.sphere(0.05, (60, 160, 60), 4)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer("cpu")


def still(*positions: tuple[float, float, float], frames: int = 1) -> np.ndarray:
    """[t b 7] unturned bodies at positions."""
    poses = np.zeros((frames, len(positions), 7))
    poses[..., :3], poses[..., 6] = np.reshape(positions, (-1, 3)), 1
    return poses


def tumbling(frames: int, bodies: int, seed: int = 0) -> np.ndarray:
    """[t b 7] bodies that move and turn over the table by a few pixels a frame."""
    rng = np.random.default_rng(seed)
    start = rng.uniform((-0.2, -0.15, 0.85), (0.2, 0.15, 1.0), (bodies, 3))
    steps = np.arange(frames)[:, None, None]
    turn = Rotation.from_rotvec((rng.normal(size=(bodies, 3)) + 0.05 * steps * rng.normal(size=(bodies, 3))).reshape(-1, 3))
    position = start + 0.008 * steps * rng.normal(size=(bodies, 3))
    return np.concatenate([position, turn.as_quat().reshape(frames, bodies, 4)], -1)


def ray_cast(mesh: Mesh, pose: np.ndarray, camera: Camera) -> np.ndarray:
    """[h w] depth of the first front face met by the ray of every pixel's center beyond the near plane, inf if none."""
    world = Rotation.from_quat(pose[3:]).apply(mesh.vertices) + pose[:3]
    corners = (world @ camera.extrinsics[:3, :3].T + camera.extrinsics[:3, 3])[mesh.triangles]
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    ray = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.intrinsics).T
    nearest = np.full(x.shape, np.inf)
    for a, b, c in corners:
        normal = np.cross(b - a, c - a)
        along = ray @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (a @ normal) / along
        inside = [((ray * depth[..., None] - p) @ np.cross(normal, q - p)) >= 0 for p, q in ((a, b), (b, c), (c, a))]
        hit = (along < 0) & (depth >= NEAR) & np.all(inside, 0)
        nearest = np.where(hit & (depth < nearest), depth, nearest)
    return nearest


@pytest.mark.parametrize("mesh", [CUBE, meshes.sphere(0.05, (60, 160, 60), 2)], ids=["cube", "ball"])
def test_mask_and_depth_agree_with_ray_casting(renderer: Renderer, mesh: Mesh) -> None:
    pose = tumbling(3, 1, seed=1)
    frames = renderer.render([Body(mesh, True)], pose, ground=False, depth=True)
    for frame in range(len(pose)):
        expected = ray_cast(mesh, pose[frame, 0], HEAD_CAMERA)
        differs = frames.robot_mask[frame] != np.isfinite(expected)
        assert np.isfinite(expected).sum() > 500
        assert differs.sum() <= 2  # a ray along an edge may be decided either way in single precision
        both = frames.robot_mask[frame] & np.isfinite(expected)
        assert np.abs(frames.depth[frame] - expected)[both].max() < 2e-4


def test_a_ball_has_the_area_of_its_projection(renderer: Renderer) -> None:
    distance, radius = 0.6, 0.05
    center = HEAD_CAMERA.position + distance * HEAD_CAMERA.extrinsics[2, :3]
    frames = renderer.render([Body(BALL, True)], still(tuple(center)), ground=False)
    # on the optical axis the silhouette is the circle of the tangent cone
    projected = HEAD_CAMERA.intrinsics[0, 0] * np.tan(np.arcsin(radius / distance))
    assert frames.robot_mask.sum() == pytest.approx(np.pi * projected**2, rel=0.01)
    rows, columns = np.nonzero(frames.robot_mask[0])
    assert np.allclose([columns.mean(), rows.mean()], [159.5, 119.5], atol=0.1)


def test_edges_are_anti_aliased_by_their_coverage(renderer: Renderer) -> None:
    black = meshes.box((0.2, 0.1, 0.02), (0, 0, 0))
    pose = still((0.0, 0.0, 0.8))
    pose[0, 0, 3:] = Rotation.from_euler("z", 20, degrees=True).as_quat()
    frames = renderer.render([Body(black, True)], pose, ground=False)
    rgb = frames.rgb[0].astype(float).mean(-1)
    edge = binary_dilation(frames.robot_mask[0]) & ~binary_erosion(frames.robot_mask[0])
    levels = np.unique(rgb[edge].round())
    assert len(levels) >= 5
    assert (rgb[~binary_dilation(frames.robot_mask[0], iterations=2)] == 255).all()


def test_a_body_that_reaches_behind_the_camera_is_cut_at_the_near_plane(renderer: Renderer) -> None:
    beam = meshes.box((0.05, 0.05, 3.0), (50, 50, 50))
    position = HEAD_CAMERA.position
    for offset in ((0.08, 0, 0), (0.0, -0.05, 0.1), (0.03, 0.02, 0.0)):
        pose = np.array([*(position + offset), *Rotation.from_euler("x", 45, degrees=True).as_quat()])
        frames = renderer.render([Body(beam, True)], pose[None, None], ground=False, depth=True)
        expected = ray_cast(beam, pose, HEAD_CAMERA)
        assert (frames.robot_mask[0] != np.isfinite(expected)).sum() <= 3
        assert frames.depth[0][frames.robot_mask[0]].min(initial=1.0) >= NEAR - 1e-4


def test_a_body_behind_the_camera_leaves_no_trace(renderer: Renderer) -> None:
    behind = HEAD_CAMERA.position - 0.5 * HEAD_CAMERA.extrinsics[2, :3]
    frames = renderer.render([Body(CUBE, True)], still(tuple(behind)), ground=False)
    assert not frames.robot_mask.any()
    assert (frames.rgb == 255).all()


def test_the_nearer_body_hides_the_farther_and_the_table_both(renderer: Renderer) -> None:
    bodies = [Body(CUBE, False), Body(BALL, True), Body(CUBE, True)]
    toward = -HEAD_CAMERA.extrinsics[2, :3]
    center = np.array([0.0, 0.0, 0.85])
    pose = still(tuple(center), tuple(center + 0.2 * toward), (0.0, 0.0, 0.5))
    frames = renderer.render(bodies, pose, body=True)
    x, y = project(HEAD_CAMERA, center)[0].round().astype(int)
    assert frames.body[0, y, x] == 1
    assert 0 in frames.body[0]
    assert 2 not in frames.body[0]
    assert np.array_equal(frames.robot_mask[0], frames.body[0] == 1)


def test_the_same_input_gives_the_same_bytes(renderer: Renderer) -> None:
    bodies, pose = [Body(CUBE, True), Body(BALL, False)], tumbling(5, 2)
    first = renderer.render(bodies, pose, depth=True, optical_flow=True)
    second = Renderer("cpu").render(bodies, pose, depth=True, optical_flow=True)
    for name in ("rgb", "robot_mask", "depth", "optical_flow"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name


@pytest.mark.parametrize("ground", [True, False])
def test_a_world_looks_the_same_alone_and_in_any_batch(ground: bool) -> None:
    worlds = [
        World([Body(CUBE, True), Body(BALL, False)], tumbling(3, 2), points=np.full((3, 2, 3), (0.0, 0.0, 0.8))),
        World([Body(BALL, True)], tumbling(7, 1, seed=2)),
        World([Body(CUBE, False)], tumbling(1, 1, seed=3), points=np.full((1, 5, 3), (0.1, 0.0, 0.8))),
        World([Body(CUBE, True), Body(BALL, False)], tumbling(2, 2, seed=4)),
    ]
    together = Renderer("cpu", frames_per_chunk=4).render_batch(worlds, ground=ground, optical_flow=True)
    alone = Renderer("cpu", frames_per_chunk=1)
    for world, batched in zip(worlds, together, strict=True):
        single = alone.render_batch([world], ground=ground, optical_flow=True)[0]
        assert np.array_equal(single.rgb, batched.rgb)
        assert np.array_equal(single.robot_mask, batched.robot_mask)
        assert np.array_equal(single.optical_flow, batched.optical_flow)
        if world.points is not None:
            assert np.array_equal(single.point_body, batched.point_body)
            assert np.array_equal(single.point_depth, batched.point_depth)


def test_a_frame_without_the_robot_does_not_know_which_robot_was_beside_it(renderer: Renderer) -> None:
    scene = World([Body(BALL, False)], still((0.1, 0.0, 0.79)))
    robots = [[Body(CUBE, True)], [Body(BALL, True)]]
    seen = [renderer.render_batch([World(robot, still((-0.1, 0.0, 0.9))), scene])[1].rgb for robot in robots]
    assert np.array_equal(*seen)


def blocked_lights(center: np.ndarray, half: np.ndarray, camera: Camera) -> np.ndarray:
    """[h w] how many of the lights a box keeps from the point of the table's plane under each pixel."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    ray = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.intrinsics).T @ camera.extrinsics[:3, :3]
    point = camera.position + ray * ((TABLE_TOP - camera.position[2]) / ray[..., 2])[..., None]
    blocked = np.zeros(x.shape, int)
    for light in LIGHTS:
        toward = -np.array(light.direction) if light.position is None else light.position - point
        enter, leave = np.sort([(center - half - point) / (toward + 1e-12), (center + half - point) / (toward + 1e-12)], 0)
        blocked += (enter.max(-1) < leave.min(-1)) & (leave.min(-1) > 0)
    return blocked


def test_shadows_fall_where_a_light_is_blocked_and_nowhere_else(renderer: Renderer) -> None:
    empty = renderer.render([], still()).rgb[0].astype(int)
    size, center = np.array([0.12, 0.1, 0.02]), np.array([0.02, -0.1, TABLE_TOP + 0.12])
    frames = renderer.render([Body(meshes.box(size, (90, 90, 90)), False)], still(tuple(center)), body=True)
    darker = (empty - frames.rgb[0]).min(-1)
    blocked = blocked_lights(center, size / 2, HEAD_CAMERA)
    on_table = (np.arange(240)[:, None] > 30) & ~binary_dilation(frames.body[0] >= 0, iterations=2)
    clear = on_table & ~binary_dilation(blocked > 0, iterations=13)  # penumbrae reach that far at corners
    shaded = on_table & binary_erosion(blocked > 0, iterations=6)
    assert (darker[clear] == 0).all()
    assert clear.sum() > 10000
    assert (darker[shaded] >= 8).all()
    assert shaded.sum() > 1000


def test_a_shadow_begins_where_a_body_touches_the_table(renderer: Renderer) -> None:
    empty = renderer.render([], still()).rgb[0].astype(int)
    frames = renderer.render([Body(CUBE, False)], still((0.0, 0.0, TABLE_TOP + 0.04)), body=True)
    x, y = project(HEAD_CAMERA, np.array([-0.04, 0.0, TABLE_TOP]))[0]
    column, row = int(np.floor(x)) - 2, round(float(y))  # beside the left face, in the right light's shadow
    assert frames.body[0, row, column] == -1
    assert (empty[row, column] - frames.rgb[0, row, column].astype(int)).min() > 10


def test_lit_faces_have_no_shadow_acne(renderer: Renderer) -> None:
    plate = meshes.box((0.2, 0.2, 0.02), (200, 200, 200))
    frames = renderer.render([Body(plate, True)], still((0.0, 0.0, 0.85)))
    inside = binary_erosion(frames.robot_mask[0], iterations=12)
    steps = np.abs(np.diff(frames.rgb[0].astype(int), axis=1)).max(-1)[inside[:, 1:] & inside[:, :-1]]
    assert len(steps) > 1000
    assert steps.max() <= 1


def checkered() -> Mesh:
    """A ball whose triangles have colors of their own."""
    colors = np.random.default_rng(0).integers(0, 255, (len(BALL.triangles) // 4, 1)).repeat(4, 0).repeat(3, 1)
    return Mesh(BALL.vertices, BALL.triangles, colors.astype(np.uint8), BALL.normals)


def test_optical_flow_is_the_motion_of_the_surface_under_the_pixel(renderer: Renderer) -> None:
    meshes, pose = (CUBE, BALL), tumbling(4, 2, seed=5)
    frames = renderer.render([Body(m, True) for m in meshes], pose, ground=False, depth=True, body=True, optical_flow=True)
    assert (frames.optical_flow[-1] == 0).all()
    assert (frames.optical_flow[~frames.robot_mask] == 0).all()
    inverse = np.linalg.inv(HEAD_CAMERA.extrinsics)
    for t in range(3):
        rows, columns = np.nonzero(frames.robot_mask[t])
        pixels = np.stack([columns, rows], -1)
        ray = np.concatenate([pixels, np.ones((len(pixels), 1))], -1) @ np.linalg.inv(HEAD_CAMERA.intrinsics).T
        world = (ray * frames.depth[t, rows, columns, None]) @ inverse[:3, :3].T + inverse[:3, 3]
        body = frames.body[t, rows, columns]
        now, after = pose[t, body], pose[t + 1, body]
        local = Rotation.from_quat(now[:, 3:]).inv().apply(world - now[:, :3])
        landed, _ = project(HEAD_CAMERA, Rotation.from_quat(after[:, 3:]).apply(local) + after[:, :3])
        error = np.linalg.norm(frames.optical_flow[t, rows, columns] - (landed - pixels), axis=-1)
        assert np.linalg.norm(landed - pixels, axis=-1).mean() > 1
        assert error.max() < 0.01


def test_optical_flow_warps_one_frame_onto_the_next(renderer: Renderer) -> None:
    """Photometric: of all small shifts of the flow, none at all must explain the next frame best."""
    pose = tumbling(2, 1, seed=6)
    frames = renderer.render([Body(checkered(), True)], pose, ground=False, optical_flow=True)
    rows, columns = np.nonzero(binary_erosion(frames.robot_mask[0], iterations=4))
    flow = frames.optical_flow[0, rows, columns]
    now, after = frames.rgb[..., 0].astype(float)
    shifts = np.linspace(-0.5, 0.5, 11)
    for axis in range(2):
        errors = []
        for shift in shifts:
            moved = flow + shift * np.eye(2)[axis]
            warped = map_coordinates(after, [rows + moved[:, 1], columns + moved[:, 0]], order=3)
            errors.append(np.mean((warped - now[rows, columns]) ** 2))
        curve = np.polyfit(shifts, errors, 2)
        assert abs(-curve[1] / (2 * curve[0])) < 0.1


def test_optical_flow_is_clipped(renderer: Renderer) -> None:
    pose = still((-0.1, 0.0, 0.9), frames=2)
    pose[1, 0, 0] = 0.1
    flow = renderer.render([Body(CUBE, True)], pose, ground=False, optical_flow=True).optical_flow[0]
    length = np.linalg.norm(flow, axis=-1)
    assert length.max() == pytest.approx(FLOW_LIMIT, abs=1e-3)
    assert flow[length > 1][:, 0].min() > 24


def test_points_tell_what_their_pixel_shows(renderer: Renderer) -> None:
    points = np.array([[[0.0, 0.0, 0.82], [0.3, 0.2, TABLE_TOP], [5.0, 0.0, 0.8], [0.0, -2.0, 3.0]]])
    frames = renderer.render([Body(CUBE, False)], still((0.0, 0.0, 0.78)), points=points)
    assert frames.point_body.tolist() == [[0, -1, -2, -2]]
    _, depth = project(HEAD_CAMERA, points[0, :2])
    assert np.allclose(frames.point_depth[0, :2], depth, atol=2e-3)


def test_other_cameras_see_other_images(renderer: Renderer) -> None:
    camera = look_at((0.5, 0.5, 1.2), (0.0, 0.0, 0.8), width=64, height=48)
    frames = renderer.render([Body(BALL, True)], still((0.0, 0.0, 0.8)), camera)
    rows, columns = np.nonzero(frames.robot_mask[0])
    assert frames.rgb.shape == (1, 48, 64, 3)
    assert np.allclose([columns.mean(), rows.mean()], [31.5, 23.5], atol=0.5)


@pytest.mark.skipif(sys.platform == "darwin", reason="Warp compiles for CUDA on Linux and Windows")
def test_kernels_compile_for_cuda_without_fused_or_approximate_arithmetic(tmp_path: Path) -> None:
    """Fused multiply-adds and approximate roots or divisions would give a GPU other bytes than a CPU."""
    for module in (raster_kernels, shading_kernels):
        wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    programs = [path.read_bytes() for path in tmp_path.glob("*.ptx")]
    assert len(programs) == 2
    for program in programs:
        assert b"div.rn.f32" in program
        assert not any(word in program for word in (b"fma.rn.f32", b"div.approx", b"div.full", b"sqrt.approx", b"rcp.approx"))


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a GPU")
@pytest.mark.parametrize("ground", [True, False])
def test_a_gpu_makes_the_same_bytes(renderer: Renderer, ground: bool) -> None:
    bodies, pose = [Body(CUBE, True), Body(BALL, False)], tumbling(5, 2)
    here, there = (r.render(bodies, pose, ground=ground, depth=True, optical_flow=True) for r in (renderer, Renderer("cuda:0")))
    for name in ("rgb", "robot_mask", "depth", "optical_flow"):
        assert np.array_equal(getattr(here, name), getattr(there, name)), name


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (np.zeros((2, 3, 7)), r"\(frames, 1, 7\)"),
        (np.zeros((0, 1, 7)), "no frames"),
        (np.full((2, 1, 7), np.nan), "body 0 at frame 0 is not finite"),
    ],
)
def test_poses_that_do_not_fit_are_refused(renderer: Renderer, pose: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        renderer.render([Body(CUBE, True)], pose)


def test_a_camera_cannot_look_along_its_up() -> None:
    with pytest.raises(ValueError, match="choose another"):
        look_at((0, 0, 1), (0, 0, 0))
