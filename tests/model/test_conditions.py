"""Conditions are made of commands alone, by structure and by trial."""

import os
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests import synthetic
from xew.config import ConfigError
from xew.episode import read_record, read_states, read_video, write_episode
from xew.metrics.grading.baselines import paste_render
from xew.model.cache.scales import apply_scales, dump_scales, fit_scales, read_scales
from xew.model.conditions import (
    ACTIONS,
    CONDITIONS,
    POINTING_DOWN,
    Command,
    Condition,
    System,
    camera,
    clip_numbers,
    list_conditions,
    make_command,
    relative_tool_poses,
    tool_deltas,
    tool_poses,
)
from xew.model.episodes.commands import episode_command
from xew.protocol import ACTION_DIM, ROBOT_NAMES, Change
from xew.sim_warp.changes.scenes import raised_by
from xew.sim_warp.geometry.camera import look_at
from xew.sim_warp.rendering.streams import three_shadows
from xew.sim_warp.robots import ROBOTS, keep_robot

STORED = [condition for condition in (ACTIONS["joints"], CONDITIONS["robot_render"]) if isinstance(condition, Condition)]
PASTED = list_conditions(CONDITIONS["pasted_render"])
CARRIED = list_conditions(CONDITIONS["carried_render"])
SYSTEMS = {name: entry for name, entry in ACTIONS.items() if isinstance(entry, System) and entry.conditions}
NUMBERS = [condition for system in SYSTEMS.values() for condition in system if condition.make in (tool_poses, camera)]


@pytest.fixture
def episode(tmp_path: Path) -> Path:
    return synthetic.write_cell(tmp_path, "place_empty_cup", 0, "piper", frames=5)


def test_a_command_holds_nothing_measured() -> None:
    """`rendered` is the video at `render_path`, at hand or rendered anew from the commands (pixels.py); of the scene there is
    the first frame, whether its video is at hand or not."""
    named = {"robot", "action", "intrinsics", "extrinsics", "render_path", "rendered", "data", "read_first", "size", "table"}
    named |= {"parts", "change"}
    assert {field.name for field in fields(Command)} == named


@pytest.mark.parametrize("size", [(320, 240), (640, 480), (160, 120)])
def test_the_camera_s_numbers_are_those_of_its_rays(size: tuple[int, int], episode: Path) -> None:
    """A picture of 4:3 of any size has the head camera's numbers; a camera that moves has its own place at each frame."""
    still, action = look_at((0, -0.4, 1.3), (0, 0, 0.7), width=size[0], height=size[1]), np.zeros((3, 16), np.float32)
    expected = look_at((0, -0.4, 1.3), (0, 0, 0.7))
    command = Command("piper", action, still.intrinsics, still.extrinsics, episode / "robot.mkv", size=size)
    numbers = camera(command)
    k = expected.intrinsics
    np.testing.assert_allclose(numbers[:, :4], [[k[0, 0], k[1, 1], k[0, 2], k[1, 2]]] * 3, rtol=1e-6)
    np.testing.assert_allclose(numbers[:, 13:], [expected.position] * 3, atol=1e-6)
    places = np.stack([look_at((x, -0.4, 1.3), (0, 0, 0.7)).extrinsics for x in (0.0, 0.1, 0.2)])
    np.testing.assert_allclose(camera(replace(command, extrinsics=places))[:, 13], [0.0, 0.1, 0.2], atol=1e-6)


def test_the_first_frame_is_all_of_the_scene_that_a_command_shows(episode: Path) -> None:
    scene = read_video(episode / "rgb.mkv")
    for given in (None, scene):
        command = episode_command(episode, read_record(episode), scene=given)
        np.testing.assert_array_equal(command.read_first(), scene[:1])
        assert not any(np.shares_memory(command.read_first(), part) for part in (scene,))


def test_robots_of_ones_own_are_those_of_the_data_set_of_the_episode(episode: Path, tmp_path: Path) -> None:
    """A rollout's data need not be those of its run."""
    before = dict(os.environ)
    keep_robot(replace(ROBOTS["piper"], key="my_arm", title="My arm"), tmp_path)
    command = episode_command(episode, replace(read_record(episode), robot="my_arm"))
    assert command.data == tmp_path.absolute() and command.robot_spec.title == "My arm"
    assert command.robot_spec.urdf.is_relative_to((tmp_path / "robots").resolve()) and dict(os.environ) == before


@pytest.mark.parametrize("condition", [*STORED, *PASTED, *CARRIED, *NUMBERS], ids=lambda condition: condition.name)
def test_no_condition_sees_the_recorded_future(episode: Path, condition: object) -> None:
    """Turn everything that was recorded from frame 1 on upside down: the condition stays as it was."""
    record, states = read_record(episode), read_states(episode)
    before = condition.make(make_command(episode, record, states))
    changed = replace(
        states,
        joint_pos=states.joint_pos[::-1] + 1,
        joint_vel=-states.joint_vel,
        tool_pose=states.tool_pose[::-1],
        object_pose=states.object_pose[::-1] + 1,
        contact=~states.contact,
        keypoints=states.keypoints[::-1],
        robot_mask=~states.robot_mask,
    )
    scene = read_video(episode / "rgb.mkv")
    scene[1:] = 255 - scene[1:]
    write_episode(episode.parents[2], record, changed, scene, read_video(episode / "robot.mkv"))
    after = condition.make(make_command(episode, read_record(episode), read_states(episode)))
    np.testing.assert_array_equal(before, after)


def test_a_pasted_render_is_the_baseline_of_that_name(episode: Path) -> None:
    (condition,) = PASTED
    made = condition.make(episode_command(episode, read_record(episode)))
    expected = paste_render(read_video(episode / "rgb.mkv")[0], read_video(episode / "robot.mkv"))
    np.testing.assert_array_equal(made, expected)
    assert condition.is_guess and not any(other.is_guess for other in (*STORED, *NUMBERS))


def test_shadows_fall_on_the_table_of_the_scene(episode: Path) -> None:
    record, states = read_record(episode), read_states(episode)
    up, down = (raised_by(Change("height", level)) for level in (4, 3))
    assert down < 0 < up
    commands = [make_command(episode, replace(record, change=change), states) for change in ("light:3", "height:4", "height:3")]
    pictures = [three_shadows(ROBOTS["piper"], states.action, commands[0].camera, raised) for raised in (0, up, down)]
    for command, picture in zip(commands, pictures, strict=True):
        assert np.array_equal(command.shadows, picture)
    assert not np.array_equal(pictures[0], pictures[1]) and not np.array_equal(pictures[0], pictures[2])


def test_joints_are_the_commands(episode: Path) -> None:
    states = read_states(episode)
    joints = ACTIONS["joints"].make(make_command(episode, read_record(episode), states))
    assert joints.shape == (5, ACTION_DIM)
    np.testing.assert_array_equal(joints, states.action)


def test_registries_name_what_feeds_each_stream() -> None:
    for registry in (ACTIONS, CONDITIONS):
        assert list_conditions(registry["none"]) == ()
        assert all(entry.name == name for name, entry in registry.items() if isinstance(entry, Condition))
        assert all(entry.title and entry.label for entry in registry.values())
        assert (
            len({entry.title for entry in registry.values()})
            == len({entry.label for entry in registry.values()})
            == len(registry)
        )
    assert {entry.stream for entry in CONDITIONS.values() if isinstance(entry, Condition)} == {"embodiment"}
    assert {entry.stream for entry in ACTIONS.values() if isinstance(entry, Condition)} == {"action", "joints"}
    for system in SYSTEMS.values():
        assert len({condition.stream for condition in system}) == len(system.conditions)


def test_what_a_user_gives_in_the_place_of_an_entry_is_taken() -> None:
    """A condition, a tuple of them as in docs/conditioning.md, or a system."""
    joints = ACTIONS["joints"]
    assert list_conditions(joints) == list_conditions((joints,)) == list_conditions(System((joints,), "", "")) == (joints,)


def test_the_registries_load_without_jax_and_warp() -> None:
    """Tables take their titles from here, and a report is written where neither is wanted."""
    script = "import sys, xew.model.conditions; print(*({'jax', 'flax', 'warp', 'newton'} & set(sys.modules)), 'loaded')"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout == "loaded\n", done.stderr


def wandering(frames: int = 12) -> np.ndarray:
    """Tool poses [t 14] that turn about all axes and wrap round."""
    rng = np.random.default_rng(1)
    steps = rng.uniform(-0.2, 0.3, (frames, 14)).cumsum(axis=0)
    steps[:, [4, 11]] = 0.5 * np.sin(steps[:, [4, 11]])
    steps[:, [3, 5, 10, 12]] = (steps[:, [3, 5, 10, 12]] + np.pi) % (2 * np.pi) - np.pi
    steps[:, [6, 13]] = rng.uniform(0, 1, (frames, 2))
    return steps


@pytest.mark.parametrize("robot", ["aloha_agilex", "franka_panda"])
def test_tool_poses_are_forward_kinematics_of_commands(tmp_path: Path, robot: str) -> None:
    from xew.sim_warp.geometry.poses import matrix_from_pose
    from xew.sim_warp.kinematics.forward import joint_positions, link_matrices
    from xew.sim_warp.robots import load_urdf

    folder = synthetic.write_cell(tmp_path, "place_empty_cup", 0, robot, frames=5)
    states = read_states(folder)
    poses = tool_poses(make_command(folder, read_record(folder), states))
    assert poses.shape == (5, 14) and poses.dtype == np.float32
    spec = ROBOTS[robot]
    copies = joint_positions(spec, states.action.astype(float))
    for number, arm in enumerate(spec.arms):
        links = link_matrices(load_urdf(spec.urdf), copies[number % len(copies)])
        frame = matrix_from_pose(arm.root_pose) @ links[arm.tool_link] @ matrix_from_pose(arm.tool_pose)
        own = poses[:, 7 * number : 7 * number + 7]
        np.testing.assert_allclose(own[:, :3], frame[:, :3, 3], atol=1e-5)
        turned = Rotation.from_euler("xyz", own[:, 3:6]) * POINTING_DOWN
        np.testing.assert_allclose(turned.as_matrix(), frame[:, :3, :3], atol=1e-5)
        np.testing.assert_array_equal(own[:, 6], states.action[:, 7 + 8 * number])


def test_a_tool_that_points_down_has_no_angles() -> None:
    """x, the approach, goes down; y, along which the fingers open, to the left."""
    np.testing.assert_allclose(POINTING_DOWN.apply([[1, 0, 0], [0, 1, 0]]), [[0, 0, -1], [-1, 0, 0]], atol=1e-12)


@pytest.mark.parametrize("robot", ROBOT_NAMES)
def test_no_angle_is_near_a_jump_where_tools_rest(tmp_path: Path, robot: str) -> None:
    """Angles wrap at pi and are ambiguous at a pitch of pi / 2."""
    from xew.sim_warp.rendering.streams import home_action

    home = home_action(ROBOTS[robot])[None].astype(np.float32)
    poses = tool_poses(Command(robot, home, np.eye(3), np.eye(4), tmp_path))[0]
    assert np.abs(poses[[3, 4, 5, 10, 11, 12]]).max() < 1


def test_relative_poses_lead_from_frame_to_frame() -> None:
    """IRASim's actions, undone one after another from the first pose, give all poses again."""
    poses = wandering()
    relative = relative_tool_poses(poses)
    np.testing.assert_array_equal(relative[0, [0, 1, 2, 3, 4, 5]], np.zeros(6))
    np.testing.assert_array_equal(relative[:, [6, 13]], poses[:, [6, 13]])
    for side in (slice(0, 7), slice(7, 14)):
        position = poses[0, side][:3]
        turn = Rotation.from_euler("xyz", poses[0, side][3:6]) * POINTING_DOWN
        for now, action in zip(poses[1:, side], relative[1:, side], strict=True):
            position = position + turn.apply(action[:3] / 20)
            turn = turn * Rotation.from_euler("xyz", action[3:6] / 20)
            np.testing.assert_allclose(position, now[:3], atol=1e-9)
            expected = Rotation.from_euler("xyz", now[3:6]) * POINTING_DOWN
            assert (turn.inv() * expected).magnitude() < 1e-7


def test_deltas_do_not_jump_where_angles_wrap() -> None:
    poses = np.zeros((2, 14))
    poses[:, 3] = 3.1, -3.1
    poses[:, 0] = 0.2, 0.5
    delta = tool_deltas(poses)
    np.testing.assert_allclose(delta[1, [0, 3]], [0.3, 2 * np.pi - 6.2], atol=1e-12)
    np.testing.assert_array_equal(delta[0], np.zeros(14))


@pytest.mark.parametrize("condition", NUMBERS, ids=lambda condition: condition.stream)
def test_numbers_of_a_latent_frame_do_not_see_later_frames(condition: Condition) -> None:
    """Change the commands from frame 5 on: latent frames 0 and 1 (frames 0 to 4) and earlier ones are told the same."""
    poses = np.concatenate([wandering(), wandering()[:, :2]], axis=1) if condition.make is camera else wandering()
    changed = poses.copy()
    changed[5:] += 0.4
    before, after = (clip_numbers(condition, numbers, 0, 9, (-4, -2)) for numbers in (poses, changed))
    seen = 4 if condition.with_history else 2
    assert before.shape == (seen + 1, {True: 4, False: 1}[condition.group] * poses.shape[1])
    np.testing.assert_array_equal(before[:seen], after[:seen])
    assert not np.allclose(before[seen], after[seen])


def test_numbers_of_a_clip() -> None:
    """A latent frame's last frame or all four; the first stands for four; past the end nothing moves."""
    numbers = np.arange(7, dtype=np.float32)[:, None]
    plain = Condition("n", "pose_frame", tool_poses, with_history=True)
    grouped = Condition("n", "pose_time", tool_poses, group=True)
    moving = Condition("n", "pose_time", tool_poses, group=True, change=lambda rows: np.diff(rows, axis=0, prepend=rows[:1]))
    assert clip_numbers(plain, numbers, 2, 9, (-5, -1))[:, 0].tolist() == [0, 1, 2, 6, 6]
    assert clip_numbers(plain, numbers, 2, 5)[:, 0].tolist() == [2, 6]
    assert clip_numbers(grouped, numbers, 1, 5).tolist() == [[1, 1, 1, 1], [2, 3, 4, 5]]
    assert clip_numbers(moving, numbers, 4, 5).tolist() == [[0, 0, 0, 0], [1, 1, 0, 0]]


def test_scales_of_training_numbers_come_back_from_disk(tmp_path: Path) -> None:
    folders = [synthetic.write_cell(tmp_path, "place_empty_cup", seed, "piper", frames=9) for seed in range(3)]
    commands = [make_command(folder, read_record(folder), read_states(folder)) for folder in folders]
    conditions = {condition.stream: condition for condition in (*SYSTEMS["ctrl_world"], *SYSTEMS["enerverse_ac"])}
    scales = fit_scales(conditions.values(), commands)
    assert set(scales) == {"tool_poses", "tool_deltas"}
    told = np.concatenate([tool_poses(command) for command in commands])
    low, high = np.percentile(told, (1, 99), axis=0)
    scaled = scales["tool_poses"](told)
    assert scaled.min() >= -1 and scaled.max() <= 1
    for number in np.flatnonzero(high - low > 2e-3):
        np.testing.assert_allclose(scales["tool_poses"](np.stack([low, high]))[:, number], [-1, 1], atol=1e-3)
    assert np.abs(scaled[:, high - low == 0]).max(initial=0) < 1e-2
    (tmp_path / "scales.json").write_text(dump_scales(scales))
    again = read_scales(tmp_path / "scales.json", tuple(conditions.values()), "do that")
    grouped = clip_numbers(conditions["pooled_context"], told[:9], 0, 5)[None]
    arrays = {"pooled_context": grouped, "ray_channels": np.ones((1, 2, 16), np.float32)}
    for loaded in (scales, again):
        out = apply_scales(loaded, conditions, arrays)
        np.testing.assert_array_equal(out["ray_channels"], arrays["ray_channels"])
        by_frame = scales["tool_deltas"](grouped.reshape(-1, 14)).reshape(grouped.shape)
        np.testing.assert_allclose(out["pooled_context"], by_frame, rtol=1e-6)
    with pytest.raises(ConfigError, match=r"does not hold the scales of tool_deltas, tool_poses .*; do that"):
        read_scales(tmp_path / "none.json", tuple(conditions.values()), "do that")
