"""Named and custom cameras: where they stand on each robot, what they see, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from xew.config import ConfigError
from xew.episode import project
from xew.protocol import HEAD, CameraSpec
from xew.sim_warp.cameras import CAMERAS, demand_sight, fix_camera, get_camera, parse_size, place_camera
from xew.sim_warp.geometry.camera import HEAD_CAMERA
from xew.sim_warp.geometry.poses import matrix_from_pose
from xew.sim_warp.kinematics.forward import tool_poses
from xew.sim_warp.rendering.bodies import body_names, robot_bodies, robot_pose
from xew.sim_warp.rendering.observe import Recording, observe
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.rendering.streams import articulation_action, command_streams, home_action
from xew.sim_warp.robots import ROBOTS, RobotSpec, get_robot
from xew.sim_warp.stage import TABLE_TOP, Stage

WRISTS = ("wrist_left", "wrist_right")


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer()


def winding_number(point: np.ndarray, corners: np.ndarray) -> float:
    """How often a mesh [f 3 3] winds round a point [3]: 1 inside, 0 outside (van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(corners - point, 1, 0)
    lengths = [np.linalg.norm(side, axis=1) for side in (a, b, c)]
    pairs = np.sum(a * b, 1) * lengths[2] + np.sum(b * c, 1) * lengths[0] + np.sum(c * a, 1) * lengths[1]
    angle = 2 * np.arctan2(np.sum(a * np.cross(b, c), 1), np.prod(lengths, axis=0) + pairs)
    return float(angle.sum() / (4 * np.pi))


def links_around(camera: str, robot: RobotSpec, action: np.ndarray) -> set[str]:
    """Names of the links that a camera is inside of, at any row of an action."""
    positions = np.broadcast_to(place_camera(fix_camera(CAMERAS[camera], robot), robot, action).position, (len(action), 3))
    around = set()
    for (_, link), body, poses in zip(
        body_names(robot), robot_bodies(robot), robot_pose(robot, action).swapaxes(0, 1), strict=True
    ):
        corners = body.mesh.vertices[body.mesh.triangles]
        for position, frame in zip(positions, matrix_from_pose(poses), strict=True):
            if winding_number(frame[:3, :3].T @ (position - frame[:3, 3]), corners) > 0.5:
                around.add(link)
    return around


@pytest.mark.parametrize("robot", [*ROBOTS, "body:3"])
@pytest.mark.parametrize("camera", CAMERAS)
def test_no_camera_is_inside_a_link(camera: str, robot: str) -> None:
    spec = get_robot(robot)
    assert links_around(camera, spec, home_action(spec)[None]) == set()


def test_a_point_inside_a_link_is_found() -> None:
    robot = ROBOTS["piper"]
    poses = robot_pose(robot, home_action(robot)[None])
    body, frame = robot_bodies(robot)[1], matrix_from_pose(poses[0, 1])
    corners = body.mesh.vertices[body.mesh.triangles] @ frame[:3, :3].T + frame[:3, 3]
    assert winding_number(corners.mean((0, 1)), corners) > 0.9


def test_the_head_camera_is_what_it_was() -> None:
    camera = place_camera(get_camera("head"), ROBOTS["piper"], np.zeros((3, 16)))
    np.testing.assert_array_equal(camera.extrinsics, HEAD_CAMERA.extrinsics)
    np.testing.assert_array_equal(camera.intrinsics, HEAD_CAMERA.intrinsics)
    np.testing.assert_allclose(camera.position, [-0.032, -0.45, 1.35], atol=1e-12)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_wrist_camera_has_the_tool_at_one_pixel_while_the_arm_moves(robot: str) -> None:
    spec = ROBOTS[robot]
    action = articulation_action(spec)
    for index, name in enumerate(WRISTS):
        camera = place_camera(fix_camera(CAMERAS[name], spec), spec, action)
        pixels, depth = project(tool_poses(spec, action)[:, index, None, :3], camera.intrinsics, camera.extrinsics)
        np.testing.assert_allclose(pixels, np.broadcast_to(pixels[0], pixels.shape), atol=1e-6)
        assert ((pixels > 0) & (pixels < [320, 240])).all() and (depth < 0.2).all()


def test_every_camera_sees_every_robot() -> None:
    demand_sight(list(CAMERAS.values()), [ROBOTS["franka_panda"], get_robot("body:3")])


def test_a_camera_on_a_link_moves_with_it() -> None:
    robot, action = ROBOTS["ur5_wsg"], articulation_action(ROBOTS["ur5_wsg"])
    on_link = place_camera(CameraSpec("own", "left/wrist_3_link", (0.1, 0, 0), (0, 0, 0)), robot, action)
    body = body_names(robot).index((0, "wrist_3_link"))
    frames = matrix_from_pose(robot_pose(robot, action)[:, body])
    np.testing.assert_allclose(on_link.position, frames[:, :3, 3] + 0.1 * frames[:, :3, 0], atol=1e-6)


@pytest.mark.parametrize(("ground", "tolerance"), [(False, 0), (True, 1)])
def test_a_moving_camera_that_rests_sees_the_same_pixels(ground: bool, tolerance: int, renderer: Renderer) -> None:
    """But for the last bit of the ground's large triangles, which are cut at another near plane."""
    robot, action = ROBOTS["piper"], articulation_action(ROBOTS["piper"])[:6]
    still = place_camera(get_camera("side", "160x120"), robot, action)
    moving = replace(still, extrinsics=np.tile(still.extrinsics, (len(action), 1, 1)))
    bodies, pose = robot_bodies(robot), robot_pose(robot, action)
    one, other = (renderer.render(bodies, pose, camera, ground, optical_flow=True) for camera in (still, moving))
    assert np.abs(one.rgb.astype(int) - other.rgb).max() <= tolerance
    np.testing.assert_array_equal(one.optical_flow, other.optical_flow)
    np.testing.assert_array_equal(one.robot_mask, other.robot_mask)


def test_seen_from_the_wrist_its_own_hand_does_not_flow(renderer: Renderer) -> None:
    robot, action = ROBOTS["franka_panda"], articulation_action(ROBOTS["franka_panda"])
    action[:, [7, 15]] = 1.0
    camera = place_camera(fix_camera(CAMERAS["wrist_left"], robot), robot, action)
    frames = renderer.render(robot_bodies(robot), robot_pose(robot, action), camera, False, body=True, optical_flow=True)
    hand = [index for index, (copy, link) in enumerate(body_names(robot)) if copy == 0 and "finger" in link]
    fingers = np.isin(frames.body, hand)
    assert fingers.any((1, 2)).all()
    assert np.abs(frames.optical_flow[fingers]).max() < 0.01
    assert np.abs(frames.optical_flow[frames.robot_mask & ~fingers]).max() > 1


@pytest.mark.parametrize("name", [name for name in CAMERAS if name != HEAD])
@pytest.mark.parametrize("robot", ROBOTS)
def test_the_table_hides_the_commanded_robot_and_is_not_drawn(robot: str, name: str, renderer: Renderer) -> None:
    spec, action, raised = ROBOTS[robot], articulation_action(ROBOTS[robot])[1:4], -0.03
    camera = place_camera(fix_camera(get_camera(name, "160x120"), spec), spec, action)
    alone, hidden = (command_streams(spec, action, camera, table) for table in (None, TABLE_TOP + raised))
    seen = observe(renderer, [Recording(spec, action)], camera, Stage(raised=raised))[0].robot_mask
    np.testing.assert_array_equal(hidden.mask, seen)
    np.testing.assert_array_equal(hidden.optical_flow, np.where(seen[..., None], alone.optical_flow, 0))
    assert seen.any() and (hidden.render[~maximum_filter(seen, (0, 3, 3))] == 255).all()
    within = minimum_filter(seen, (0, 3, 3))
    np.testing.assert_array_equal(hidden.render[within], alone.render[within])
    assert robot != "aloha_agilex" or (alone.mask & ~seen).any(), "its stand"


@pytest.mark.parametrize("robot", ROBOTS)
def test_no_table_hides_the_robot_from_the_head_camera(robot: str, renderer: Renderer) -> None:
    spec, action = ROBOTS[robot], articulation_action(ROBOTS[robot])[1:4]
    alone = renderer.render(robot_bodies(spec), robot_pose(spec, action), ground=False, optical_flow=True)
    streams = command_streams(spec, action)
    np.testing.assert_array_equal(streams.render, alone.rgb)
    np.testing.assert_array_equal(streams.mask, alone.robot_mask)
    np.testing.assert_array_equal(streams.optical_flow, alone.optical_flow)


def test_a_camera_needs_a_pose_for_each_frame(renderer: Renderer) -> None:
    robot, action = ROBOTS["piper"], articulation_action(ROBOTS["piper"])
    camera = place_camera(CAMERAS["wrist_left"], robot, action[:3])
    with pytest.raises(ValueError, match="3 poses, expected one for each of the 17 frames"):
        renderer.render(robot_bodies(robot), robot_pose(robot, action), camera)


def test_a_custom_camera_comes_from_a_short_file(tmp_path: Path) -> None:
    path = tmp_path / "shelf.yaml"
    path.write_text("name: shelf\nposition: [0.6, -0.2, 1.4]\ntarget: [0, -0.1, 0.8]\nvertical_fov: 50\n")
    assert get_camera(str(path)).view == "shelf"
    assert get_camera(str(path), "640x480").view == "shelf_640x480"
    path.write_text("name: head\nvertical_fov: 50\n")
    with pytest.raises(ConfigError, match="the name 'head' of a built-in camera"):
        get_camera(str(path))


@pytest.mark.parametrize("text", ["640", "640x481", "0x0", "8x8", "99999x480", "640 x 480", "-640x480"])
def test_an_impossible_size_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=f"the size is '{text}'; expected WIDTHxHEIGHT such as 640x480"):
        parse_size(text)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("name: a/b", "name of a camera is 'a/b'"),
        ("name: a+b", "its name has a ., as tiled views have"),
        ("name: own\nvertical_fov: 0", "field of view of 0 degrees"),
        ("name: own\nposition: [0, 0, 1]\ntarget: [0, 0, 0]", "choose a target away"),
        ("name: own\nsize: [320, 100]", "the size is '320x100'"),
        ("name: own\nfov: 5", "unknown key 'fov'"),
    ],
)
def test_a_camera_that_makes_no_picture_is_refused(lines: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(lines + "\n")
    with pytest.raises(ConfigError, match=message):
        get_camera(str(path))


def test_a_name_that_no_camera_has_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"no camera 'wrist_lef'; did you mean 'wrist_left'\?.* known: head, wrist_left"):
        get_camera("wrist_lef")


def test_a_link_that_a_robot_does_not_have_is_refused() -> None:
    with pytest.raises(ConfigError, match="fixed to 'left/hand', which piper does not have; its links are left/base_link"):
        fix_camera(CameraSpec("own", "left/hand"), ROBOTS["piper"])


def test_a_camera_that_sees_no_robot_is_refused() -> None:
    away = CameraSpec("own", position=(0, 0, 1.5), target=(0, 1, 1.5))
    with pytest.raises(ConfigError, match=r"own at .* sees nothing of piper; turn it by its target"):
        demand_sight([away], [ROBOTS["piper"]])
