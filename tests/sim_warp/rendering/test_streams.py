"""Streams from commands, keypoints from states: for every robot of the registry."""

import time
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import warp as wp
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.camera import HEAD_CAMERA, project
from xew.sim_warp.geometry.poses import matrix_from_pose
from xew.sim_warp.kinematics.forward import forward_kinematics, joint_positions, tool_pose
from xew.sim_warp.rendering import streams
from xew.sim_warp.rendering.bodies import body_names, keypoint_links, robot_bodies, robot_pose
from xew.sim_warp.rendering.observe import Recording, keypoint_names, keypoint_positions, observe, scene_things
from xew.sim_warp.rendering.render import Body, Renderer
from xew.sim_warp.rendering.streams import (
    AXIS_COLORS,
    CLIP_FRAMES,
    GRIPPER_COLORS,
    RAY_MAP_GROUND,
    articulation_action,
    articulation_clip,
    command_renders,
    command_streams,
    command_streams_batch,
    default_renderer,
    flow_to_rgb,
    home_action,
    nine_views,
    ray_map,
    reference_image,
    three_shadows,
)
from xew.sim_warp.robots import ROBOTS, load_urdf
from xew.sim_warp.scene import scene_rng
from xew.sim_warp.tasks import TASKS

FRAMES = 4


@cache
def in_view(robot_key: str) -> np.ndarray:
    """[4 16] commands that bring both tools over the table, where the head camera sees them, and move them a little."""
    robot = ROBOTS[robot_key]
    rng = np.random.default_rng(0)
    action = np.zeros((FRAMES, 16))
    for arm, start in enumerate((0, 8)):
        candidates = rng.uniform(robot.joint_lower, robot.joint_upper, (40000, robot.arm_joint_count))
        tool = tool_pose(robot, arm, candidates)[:, :3]
        goal = (-0.15, 0.15)[arm], 0.05, 0.85
        best = np.linalg.norm(tool - goal, axis=1).argmin()
        assert np.linalg.norm(tool[best] - goal) < 0.12
        action[:, start : start + robot.arm_joint_count] = candidates[best]
        action[:, start] += 0.02 * np.arange(FRAMES)
        action[:, start + 7] = np.linspace(1, 0, FRAMES)
    return action


@pytest.fixture(params=ROBOTS)
def robot_key(request: pytest.FixtureRequest) -> str:
    return request.param


def test_bodies_follow_forward_kinematics(robot_key: str) -> None:
    robot, action = ROBOTS[robot_key], in_view(robot_key)
    pose = robot_pose(robot, action)
    assert pose.shape == (FRAMES, len(robot_bodies(robot)), 7)
    copies = [forward_kinematics(robot, joint_pos) for joint_pos in joint_positions(robot, action)]
    for index, (copy, link) in enumerate(body_names(robot)):
        root = np.array(robot.arms[copy].root_pose)
        expected = Rotation.from_quat(root[3:]).apply(copies[copy][link][:, :3]) + root[:3]
        assert np.allclose(pose[:, index, :3], expected, atol=1e-6)


def test_fingers_open_linearly(robot_key: str) -> None:
    robot = ROBOTS[robot_key]
    action = np.tile(in_view(robot_key)[:1], (3, 1))
    action[:, 7] = (0, 0.5, 1)
    first, second = (
        keypoint_names(robot).index(f"left/{load_urdf(robot.urdf).joints[name].child}") for name in robot.arms[0].fingers
    )
    points = keypoint_positions(robot, action)
    gap = np.linalg.norm(points[:, first] - points[:, second], axis=1)
    travel = np.subtract(robot.arms[0].finger_open, robot.arms[0].finger_closed)
    assert gap[1] - gap[0] == pytest.approx(gap[2] - gap[1], abs=1e-6)
    assert abs(gap[2] - gap[0]) == pytest.approx(np.abs(travel).sum(), abs=1e-3)


def test_streams_show_the_commanded_robot(robot_key: str) -> None:
    streams = command_streams(ROBOTS[robot_key], in_view(robot_key))
    assert streams.render.shape == (FRAMES, 240, 320, 3)
    assert streams.optical_flow.shape == (FRAMES, 240, 320, 2)
    for frame in range(FRAMES):
        drawn, mask = (streams.render[frame] < 255).any(-1), streams.mask[frame]
        assert mask.mean() > 0.01
        assert not (drawn & ~binary_dilation(mask, np.ones((3, 3)))).any()
        assert not (mask & ~binary_dilation(drawn, np.ones((3, 3)))).any()
    moving = np.linalg.norm(streams.optical_flow, axis=-1)
    assert moving[0].max() > 1
    assert (moving[-1] == 0).all()
    assert (moving[~streams.mask] == 0).all()


def test_streams_do_not_see_later_commands(robot_key: str) -> None:
    action = in_view(robot_key)
    changed = action.copy()
    changed[2:] += 0.3
    now, other = command_streams_batch([(ROBOTS[robot_key], action), (ROBOTS[robot_key], changed)])
    assert np.array_equal(now.render[:2], other.render[:2])
    assert np.array_equal(now.mask[:2], other.mask[:2])
    assert np.array_equal(now.optical_flow[:1], other.optical_flow[:1])
    assert np.array_equal(flow_to_rgb(now.optical_flow)[:2], flow_to_rgb(other.optical_flow)[:2])
    assert np.array_equal(ray_map(ROBOTS[robot_key], action)[:2], ray_map(ROBOTS[robot_key], changed)[:2])
    assert not np.array_equal(now.render[2], other.render[2])


def test_a_measured_state_that_differs_changes_the_view_but_no_stream() -> None:
    robot, action = ROBOTS["ur5_wsg"], in_view("ur5_wsg")
    before = command_streams(robot, action)
    seen = observe(default_renderer(), [Recording(robot, action), Recording(robot, action - 0.1)])
    after = command_streams(robot, action)
    assert not np.array_equal(seen[0].rgb, seen[1].rgb)
    assert np.array_equal(before.render, after.render)
    assert np.array_equal(before.mask, seen[0].robot_mask)  # a measurement equal to the command has the same silhouette


def test_a_batch_of_robots_equals_each_alone() -> None:
    commands = [(robot, in_view(key)) for key, robot in ROBOTS.items()]
    for (robot, action), batched in zip(commands, command_streams_batch(commands), strict=True):
        alone = command_streams(robot, action)
        assert np.array_equal(alone.render, batched.render)
        assert np.array_equal(alone.optical_flow, batched.optical_flow)
    for batched, render in zip(command_streams_batch(commands), command_renders(commands), strict=True):
        assert np.array_equal(batched.render, render)


def test_a_scene_without_its_robot_is_the_same_beside_any_robot() -> None:
    thing = Body(meshes.box((0.05, 0.05, 0.05), (200, 60, 60)), False)
    pose = np.array([[[0.0, 0.0, 0.765, 0, 0, 0, 1]]])
    renderer = Renderer("cpu")
    alone = renderer.render([thing], pose).rgb
    for key in ROBOTS:
        scene = Recording(ROBOTS[key], in_view(key)[:1], [thing], pose)
        seen = observe(renderer, [scene])[0]
        assert (seen.rgb != alone).any()
        assert np.array_equal(renderer.render([thing], pose).rgb, alone)


def test_keypoints_are_the_projected_links(robot_key: str) -> None:
    robot, action = ROBOTS[robot_key], in_view(robot_key)
    seen = observe(default_renderer(), [Recording(robot, action)])[0]
    names = keypoint_names(robot)
    assert len(set(names)) == len(names) == 2 * (robot.arm_joint_count + 2)
    assert seen.keypoints.shape == (FRAMES, len(names), 2)
    pixels, _ = project(HEAD_CAMERA, keypoint_positions(robot, action))
    assert np.allclose(seen.keypoints, pixels, atol=1e-3, equal_nan=True)
    inside = ((seen.keypoints >= -0.5) & (seen.keypoints < (319.5, 239.5))).all(-1)
    assert seen.keypoint_visible.any()
    assert not (seen.keypoint_visible & ~inside).any()


def test_a_board_in_front_of_the_robot_hides_its_keypoints(robot_key: str) -> None:
    robot, action = ROBOTS[robot_key], in_view(robot_key)
    board = Body(meshes.box((2.0, 2.0, 0.01), (90, 90, 90)), False)
    toward = HEAD_CAMERA.position + 0.15 * HEAD_CAMERA.extrinsics[2, :3]
    turned = Rotation.from_matrix(HEAD_CAMERA.extrinsics[:3, :3].T).as_quat()
    pose = np.tile([*toward, *turned], (FRAMES, 1, 1))
    hidden = observe(default_renderer(), [Recording(robot, action, [board], pose)])[0]
    points = keypoint_positions(robot, action)
    _, depth = project(HEAD_CAMERA, points)
    assert not hidden.keypoint_visible[depth > 0.2].any()
    assert (depth > 0.2).sum() > FRAMES * len(keypoint_links(robot)) / 2


def test_a_lid_turns_about_its_hinge() -> None:
    scene = TASKS["open_laptop"].sample(scene_rng("open_laptop", 0), 0)
    index = next(i for i, thing in enumerate(scene.objects) if thing.hinge is not None)
    hinge = scene.objects[index].hinge
    assert hinge is not None
    pose = np.tile(np.array([thing.pose for thing in scene.objects]), (2, 1, 1))
    joint = np.zeros((2, len(scene.objects)))
    joint[1, index] = 0.7
    bodies, placed = scene_things(scene, pose, joint)
    assert len(bodies) == placed.shape[1] == len(scene.objects) + 1
    assert np.allclose(placed[0, -1], pose[0, index])
    shut, opened = (matrix_from_pose(frame) for frame in placed[:, -1])
    anchor, far = np.array([*hinge.anchor, 1.0]), np.array([*hinge.anchor, 1.0]) + [*hinge.axis, 0.0]
    assert np.allclose(shut @ anchor, opened @ anchor)
    assert np.allclose(shut @ far, opened @ far)
    turned = Rotation.from_matrix(shut[:3, :3].T @ opened[:3, :3]).as_rotvec()
    assert np.allclose(turned, 0.7 * np.array(hinge.axis) / np.linalg.norm(hinge.axis))


def test_zero_flow_is_white_and_frames_hold_the_motion_before_them() -> None:
    flow = np.zeros((3, 4, 5, 2), np.float32)
    flow[1, 1, 2] = (25.0, 0.0)
    flow[1, 2, 2] = (0.3, 0.3)
    flow[2] = 9.0
    video = flow_to_rgb(flow)
    assert video.shape == (3, 4, 5, 3)
    assert (video[:2] == 255).all()
    colored = (video[2] != 255).any(-1)
    assert np.argwhere(colored).tolist() == [[1, 2]]


def test_hue_is_direction_and_saturation_is_length() -> None:
    directions = np.array([(-1, 0), (0, -1), (1, 0), (0, 1)]) * 25.0
    flow = np.zeros((2, 1, 6, 2), np.float32)
    flow[0, 0, :4] = directions
    flow[0, 0, 4:] = ((12.5, 0), (100.0, 0))
    colors = flow_to_rgb(flow)[1, 0].astype(int)
    assert abs(colors[2] - [0, 255, 255]).max() < 10  # half round the wheel from red
    assert abs(colors[5] - colors[2]).max() == 0
    assert abs(colors[4] - [128, 255, 255]).max() < 10
    assert len({tuple(color) for color in colors[:4]}) == 4


def test_each_of_three_lamps_throws_a_shadow_on_the_table(robot_key: str) -> None:
    robot, action = ROBOTS[robot_key], in_view(robot_key)
    drawn, mask = three_shadows(robot, action), command_streams(robot, action).mask
    assert drawn.shape == (FRAMES, 240, 320, 3) and drawn.dtype == np.uint8
    table = drawn[0][~binary_dilation(mask[0], np.ones((3, 3)))].astype(int)
    lit = np.median(table[table.min(-1) > 150], axis=0)
    for lamp in range(3):
        others = np.delete(np.arange(3), lamp)
        alone = (table[:, lamp] < 0.7 * lit[lamp]) & (table[:, others] > 0.9 * lit[others]).all(-1)
        assert alone.sum() > 50, lamp
    changed = action.copy()
    changed[2:] += 0.3
    assert np.array_equal(three_shadows(robot, changed)[:2], drawn[:2])


def test_ray_map_marks_the_tools(robot_key: str) -> None:
    robot, action = ROBOTS[robot_key], in_view(robot_key)
    drawn = ray_map(ROBOTS[robot_key], action)
    assert drawn.shape == (FRAMES, 240, 320, 3)
    for arm, start in enumerate((0, 8)):
        pixels, _ = project(HEAD_CAMERA, tool_pose(robot, arm, action[:, start : start + robot.arm_joint_count])[:, :3])
        for frame, (x, y) in enumerate(pixels.round().astype(int)):
            if 0 <= x < 320 and 0 <= y < 240:
                assert tuple(drawn[frame, y, x]) != RAY_MAP_GROUND
    assert (drawn == RAY_MAP_GROUND).all(-1).mean() > 0.3
    closing = action[:1].copy()
    closing[:, 7] = 0.0
    assert not np.array_equal(ray_map(ROBOTS[robot_key], action[:1]), ray_map(ROBOTS[robot_key], closing))


def test_ray_map_has_three_axes_and_a_base_marker_in_the_gripper_s_color(robot_key: str) -> None:
    action = np.tile(in_view(robot_key)[:1], (2, 1))
    action[:, [7, 15]] = [[0.0, 1.0], [1.0, 0.0]]
    drawn = ray_map(ROBOTS[robot_key], action)
    for frame, (left, right) in enumerate(action[:, [7, 15]].astype(int)):
        shown = {tuple(color) for color in drawn[frame].reshape(-1, 3)}
        assert {GRIPPER_COLORS[0][left], GRIPPER_COLORS[1][right]} <= shown
        assert not {GRIPPER_COLORS[0][1 - left], GRIPPER_COLORS[1][1 - right]} & shown
        assert set(AXIS_COLORS) <= shown
    assert not np.array_equal(drawn[0], drawn[1])


def test_views_show_all_of_the_robot(robot_key: str) -> None:
    views = nine_views(ROBOTS[robot_key])
    assert views.shape == (9, 240, 320, 3)
    assert np.array_equal(reference_image(ROBOTS[robot_key]), views[0])
    border = np.concatenate([views[:, 0], views[:, -1], views[:, :, 0], views[:, :, -1]], 1)
    assert (border == 255).all()
    assert ((views < 255).any(-1).mean((1, 2)) > 0.02).all()
    assert len({view.tobytes() for view in views}) == 9


def test_articulation_clip_moves_and_returns(robot_key: str) -> None:
    clip = articulation_clip(ROBOTS[robot_key])
    assert clip.shape == (CLIP_FRAMES, 240, 320, 3)
    assert np.array_equal(clip[0], clip[-1])
    changed = [(np.abs(a.astype(int) - b) > 8).any(-1).mean() for a, b in pairwise(clip)]
    assert min(changed) > 0.002


def test_the_clip_s_commands_sweep_every_joint_within_the_limits(robot_key: str) -> None:
    robot = ROBOTS[robot_key]
    action = articulation_action(robot)
    assert action.shape == (CLIP_FRAMES, 16)
    assert np.allclose(action[[0, -1]], home_action(robot))
    for start in (0, 8):
        joints = action[:, start : start + robot.arm_joint_count]
        assert (np.ptp(joints, axis=0) > 0.8).all()
        assert (joints >= robot.joint_lower).all() and (joints <= robot.joint_upper).all()
        assert np.ptp(action[:, start + 7]) == 1


def test_odd_commands_are_refused() -> None:
    with pytest.raises(ValueError, match=r"expected \(frames, 16\)"):
        ray_map(ROBOTS["piper"], np.zeros((3, 14)))


def test_threads_that_share_the_renderer_get_what_one_alone_gets():
    """Latents draw their conditions in as many threads as there are cores."""
    keys = list(ROBOTS) * 2
    alone = [command_streams(ROBOTS[key], in_view(key)) for key in keys]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda key: command_streams(ROBOTS[key], in_view(key)), keys))
    for one, other in zip(alone, together, strict=True):
        assert one.render.tobytes() == other.render.tobytes()
        assert one.optical_flow.tobytes() == other.optical_flow.tobytes()


def test_threads_share_one_renderer_and_wait_until_it_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Warp hands out a GPU before its streams are there, so that a second renderer at that moment ends in an error.

    Warp would print a banner and a line for each module among what a command prints.
    """
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_INFO)
    made: list[object] = []

    def make(frames_per_chunk: int | None) -> object:
        time.sleep(0.02)
        made.append(frames_per_chunk)
        return object()

    monkeypatch.setattr(streams, "Renderer", make)
    monkeypatch.setattr(streams, "_shared", [])
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: default_renderer(96), range(4)))
    assert made == [96] and len(set(found)) == 1
    assert wp.config.log_level == wp.LOG_ERROR
