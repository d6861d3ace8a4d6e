"""Conditions are made of commands alone, by structure and by trial."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import synthetic

from xew.episode import read_record, read_states, read_video, write_episode
from xew.model.conditions import ACTIONS, CONDITIONS, Command, command_of
from xew.protocol import ACTION_DIM

STORED = [condition for condition in (ACTIONS["joints"], CONDITIONS["robot_render"]) if condition is not None]


@pytest.fixture
def episode(tmp_path: Path) -> Path:
    return synthetic.write_cell(tmp_path, "place_empty_cup", 0, "piper", frames=5)


def test_a_command_holds_nothing_measured() -> None:
    assert {field.name for field in fields(Command)} == {"robot", "action", "intrinsics", "extrinsics", "render_path"}


@pytest.mark.parametrize("condition", STORED, ids=lambda condition: condition.name)
def test_no_condition_sees_the_recorded_future(episode: Path, condition: object) -> None:
    """Turn everything that was recorded from frame 1 on upside down: the condition stays as it was."""
    record, states = read_record(episode), read_states(episode)
    before = condition.make(command_of(episode, record, states))
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
    write_episode(episode.parents[2], record, changed, 255 - read_video(episode / "rgb.mkv"), read_video(episode / "robot.mkv"))
    after = condition.make(command_of(episode, read_record(episode), read_states(episode)))
    np.testing.assert_array_equal(before, after)


def test_joints_are_the_commands(episode: Path) -> None:
    states = read_states(episode)
    joints = ACTIONS["joints"].make(command_of(episode, read_record(episode), states))
    assert joints.shape == (5, ACTION_DIM)
    np.testing.assert_array_equal(joints, states.action)


def test_registries_name_what_feeds_each_stream() -> None:
    for registry in (ACTIONS, CONDITIONS):
        assert registry["none"] is None
        assert all(condition is None or condition.name == name for name, condition in registry.items())
    assert {condition.stream for condition in CONDITIONS.values() if condition} == {"embodiment"}
    assert {condition.stream for condition in ACTIONS.values() if condition} == {"action", "joints"}
