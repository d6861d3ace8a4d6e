"""From jobs to episodes: the same bytes every time and in any company, paired over robots, conditions from commands only."""

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from tests.sim_warp.small import SLOW, TASK, WITH_SLOW, produce
from xew.config import ConfigError
from xew.dataset import find_accepted
from xew.episode import (
    EpisodeError,
    Record,
    States,
    array_hash,
    episode_folder,
    read_record,
    read_states,
    read_video,
    verify_episode,
    write_episode,
)
from xew.sim_warp.physics import Motion, World, simulate
from xew.sim_warp.production import cells as cells_module
from xew.sim_warp.production import produce as produce_module
from xew.sim_warp.production import surfaces as surfaces_module
from xew.sim_warp.production.cells import Cell, Job
from xew.sim_warp.production.episodes import fill_instruction
from xew.sim_warp.production.kept_tracks import load_tracks, save_tracks, tracks_key, tracks_path
from xew.sim_warp.production.rerender import add_videos, demand_plausible, render_again
from xew.sim_warp.production.surfaces import read_surfaces
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.rendering.streams import command_streams_batch
from xew.sim_warp.robots import RobotSpec
from xew.sim_warp.scene import scene_rng
from xew.sim_warp.tasks import get_task

ROBOTS = ("franka_panda", SLOW)
JOBS = [Job(TASK, seed, ROBOTS) for seed in (0, 1, 2)]
"""Of these seeds the slow robot cannot do the odd one."""


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer("cpu")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory, renderer: Renderer) -> Path:
    """All jobs made together."""
    out = tmp_path_factory.mktemp("data")
    produce(JOBS, out, renderer, robots=WITH_SLOW)
    return out


def record_of(data: Path, seed: int, robot: str) -> Record:
    return read_record(episode_folder(data, TASK, seed, robot))


def test_headers_are_those_on_disk(data: Path, renderer: Renderer, tmp_path: Path) -> None:
    records = produce(JOBS[:1], tmp_path, renderer, robots=WITH_SLOW)[0]
    assert [record.robot for record in records] == list(ROBOTS)
    assert records == [record_of(tmp_path, 0, robot) for robot in ROBOTS] == [record_of(data, 0, robot) for robot in ROBOTS]
    first = records[0]
    assert first.success and first.object_names == ("block",) and first.instruction == "close both hands"
    assert len(first.keypoint_names) == read_states(episode_folder(data, TASK, 0, first.robot)).keypoints.shape[1]
    assert set(first.versions) == {"xew", "newton", "mujoco", "mujoco-warp", "warp-lang"}


def test_the_same_bytes_alone_and_among_others(
    data: Path, renderer: Renderer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = [Job("grab_roller", 1, ("piper",)), *reversed(JOBS)]
    monkeypatch.setattr(produce_module, "plan_cells", shorten_plans(produce_module.plan_cells))
    produce(others, tmp_path / "among", renderer, robots=WITH_SLOW)
    for job in JOBS:
        produce([job], tmp_path / "alone", renderer, robots=WITH_SLOW)
        for robot in ROBOTS:
            expected = record_of(data, job.seed, robot)
            assert record_of(tmp_path / "among", job.seed, robot) == expected
            assert record_of(tmp_path / "alone", job.seed, robot) == expected


def shorten_plans(plan_cells: object) -> object:
    """Planning of which only the first frames are kept: company for the others, no whole episode."""

    def first_frames(jobs: list[Job], robots: Mapping[str, RobotSpec], device: str | None) -> list[list[Cell]]:
        return [[cut(cell) for cell in cells] for cells in plan_cells(jobs, robots, device)]  # type: ignore[operator]

    def cut(cell: Cell) -> Cell:
        return replace(cell, commands=replace(cell.commands, action=cell.commands.action[:12]))

    return first_frames


def test_an_accepted_seed_has_every_robots_episode(data: Path) -> None:
    accepted = [(record.seed, record.robot) for _, record in find_accepted(data)]
    assert sorted(accepted) == [(seed, robot) for seed in (0, 2) for robot in sorted(ROBOTS)]
    for folder, record in find_accepted(data):
        assert verify_episode(folder).success
        states = read_states(folder)
        assert record.frame_count == states.frame_count == len(read_video(folder / "rgb.mkv")) == 12
        assert states.robot_mask.any(axis=(1, 2)).all()


def test_robots_share_scene_clock_and_objects_but_not_looks(data: Path) -> None:
    records = [record_of(data, 2, robot) for robot in ROBOTS]
    states = [read_states(episode_folder(data, TASK, 2, robot)) for robot in ROBOTS]
    assert records[0].scene_hash == records[1].scene_hash != record_of(data, 0, ROBOTS[0]).scene_hash
    assert states[0].object_pose[0].tobytes() == states[1].object_pose[0].tobytes()
    assert (states[0].action[:, [7, 15]] == states[1].action[:, [7, 15]]).all()
    assert (states[0].extrinsics == states[1].extrinsics).all() and (states[0].intrinsics == states[1].intrinsics).all()
    assert records[0].hashes["rgb"] != records[1].hashes["rgb"]


def test_a_rejected_seed_keeps_its_headers_and_no_pictures(data: Path) -> None:
    for robot, success in zip(ROBOTS, (True, False), strict=True):
        record = record_of(data, 1, robot)
        assert record.success == success and record.hashes == {}
        assert [path.name for path in episode_folder(data, TASK, 1, robot).iterdir()] == ["episode.json"]
    assert record.failure == "plan" and "rad/s, its limit is 0.0" in record.failure_detail


def test_a_robot_that_comes_late_to_a_rejected_seed_gets_no_pictures(renderer: Renderer, tmp_path: Path) -> None:
    record = produce([Job(TASK, 1, ROBOTS[:1], rejected=True)], tmp_path, renderer, robots=WITH_SLOW)[0][0]
    assert record.success and record.hashes == {}


def test_rendering_again_gives_the_recorded_hashes(data: Path, renderer: Renderer) -> None:
    for folder, record in find_accepted(data)[:2]:
        rgb, robot = render_again(folder, renderer)
        assert (array_hash(rgb), array_hash(robot)) == (record.hashes["rgb"], record.hashes["robot"])


def test_accepted_states_are_held_to_what_is_plausible(data: Path, tmp_path: Path) -> None:
    folder, record = find_accepted(data)[0]
    demand_plausible(folder)
    states = read_states(folder)
    sunk = replace(states, penetration=np.full_like(states.penetration, 0.006))
    with pytest.raises(EpisodeError, match=r"sank 6 mm into .* at 0.0 s; delete it"):
        demand_plausible(write_episode(tmp_path, record, sunk))


def test_an_episode_of_a_task_that_has_changed_is_told(data: Path, renderer: Renderer, tmp_path: Path) -> None:
    """It has another number of objects than its seed gives now."""
    folder, record = find_accepted(data)[0]
    states = read_states(folder)
    twice = {name: np.repeat(getattr(states, name), 2, axis=1) for name in ("object_pose", "object_joint", "penetration")}
    older = replace(record, object_names=("block", "mat"))
    changed = write_episode(tmp_path, older, replace(states, contact=np.repeat(states.contact, 2, axis=2), **twice))
    told = "has the objects block, mat, .* now makes block: the task has changed"
    with pytest.raises(EpisodeError, match=told):
        demand_plausible(changed)
    with pytest.raises(EpisodeError, match=told):
        render_again(changed, renderer)


@pytest.mark.parametrize("instruction", ["close both {color} hands", "close {} hands", "close {both hands"])
def test_an_instruction_that_its_scene_cannot_fill_is_told(instruction: str) -> None:
    wordless = replace(get_task(TASK), instruction=instruction)
    with pytest.raises(ConfigError, match=r"cannot be filled .* from the words of its scene \(none\)"):
        fill_instruction(wordless, wordless.sample(scene_rng(TASK, 0), 0))


def test_an_episode_without_videos_gets_them_on_demand(data: Path, renderer: Renderer, tmp_path: Path) -> None:
    record = produce(JOBS[:1], tmp_path, renderer, videos=False, robots=WITH_SLOW)[0][0]
    folder, full = (
        episode_folder(tmp_path, TASK, record.seed, record.robot),
        episode_folder(data, TASK, record.seed, record.robot),
    )
    assert sorted(path.name for path in folder.iterdir()) == ["episode.json", "states.npz"]
    assert record.hashes == read_record(full).hashes and verify_episode(folder) == record
    with pytest.raises(EpisodeError, match=r"inspect DATA --render"):
        read_video(folder / "rgb.mkv")
    add_videos(folder, renderer)
    assert verify_episode(folder) == read_record(full)
    for path in full.iterdir():
        assert (folder / path.name).read_bytes() == path.read_bytes()


@pytest.mark.parametrize("field", ["joint_pos", "object_pose"])
def test_rendering_again_sees_altered_states(data: Path, renderer: Renderer, field: str, tmp_path: Path) -> None:
    folder, record = find_accepted(data)[0]
    states = read_states(folder)
    shifted = replace(states, **{field: getattr(states, field) + np.float32(0.01)})
    altered = write_episode(tmp_path, record, shifted, read_video(folder / "rgb.mkv"), read_video(folder / "robot.mkv"))
    with pytest.raises(EpisodeError, match=r"rendered again on CPU, (states|rgb) has hash .* Use the same device and versions"):
        render_again(altered, renderer)


def test_conditions_see_commands_and_no_future(
    data: Path, renderer: Renderer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With another recorded course of joints and objects the robot-only render is the same to the bit."""

    def elsewhere(worlds: list[World], *device: object) -> list[Motion]:
        return [disturbed(motion) for motion in simulate(worlds, "cpu")]

    def disturbed(motion: Motion) -> Motion:
        pose, joints = motion.object_pose.copy(), motion.joint_pos.copy()
        pose[3:, :, 0] += np.float32(0.05)
        joints[3:, 0] += np.float32(0.1)
        return replace(motion, object_pose=pose, joint_pos=joints)

    monkeypatch.setattr(cells_module, "simulate", elsewhere)
    record = produce(JOBS[:1], tmp_path, renderer, robots=WITH_SLOW)[0][0]
    before = record_of(data, 0, record.robot)
    assert record.hashes["rgb"] != before.hashes["rgb"] and record.hashes["states"] != before.hashes["states"]
    assert record.hashes["robot"] == before.hashes["robot"]


def test_streams_follow_from_the_recorded_commands(data: Path, renderer: Renderer) -> None:
    folder, record = find_accepted(data)[0]
    (streams,) = command_streams_batch([(WITH_SLOW[record.robot], read_states(folder).action)], renderer=renderer)
    assert array_hash(streams.render) == record.hashes["robot"]


def test_points_on_surfaces_are_rendered_once(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, record = find_accepted(data)[0]
    first = read_surfaces(folder, tmp_path)
    assert first is not None and first.visible.any()
    with monkeypatch.context() as patch:
        patch.setattr(surfaces_module, "track_surfaces", None)  # would be called to render
        again = read_surfaces(folder, tmp_path)
    assert again is not None and again.names == first.names
    for field in fields(first):
        assert np.array_equal(getattr(again, field.name), getattr(first, field.name), equal_nan=field.name == "pixels")
    kept = tracks_path(tmp_path, record)
    kept.write_bytes(kept.read_bytes()[:-40])
    mended = read_surfaces(folder, tmp_path)
    assert mended is not None and np.array_equal(mended.shown, first.shown), "a damaged file is made anew"
    kept.unlink()
    kept.mkdir()
    assert read_surfaces(folder, tmp_path) is not None, "what cannot be kept is not missed"


def test_kept_points_are_of_one_robot_scene_motion_and_camera(data: Path, tmp_path: Path) -> None:
    folder, record = find_accepted(data)[0]
    robot, states = WITH_SLOW[record.robot], read_states(folder)
    key = tracks_key(robot, record.scene_hash, states)
    assert key == tracks_key(robot, record.scene_hash, read_states(folder))
    others = [
        tracks_key(WITH_SLOW["arx_x5"], record.scene_hash, states),
        tracks_key(robot, "another", states),
        tracks_key(robot, record.scene_hash, replace(states, joint_pos=states.joint_pos + np.float32(0.1))),
        tracks_key(robot, record.scene_hash, replace(states, extrinsics=2 * states.extrinsics)),
    ]
    assert len({key, *others}) == 5
    tracks = read_surfaces(folder)
    assert tracks is not None
    path, shape = tmp_path / "tracks.npz", states.robot_mask.shape
    save_tracks(path, key, tracks)
    assert load_tracks(path, key, shape) is not None and load_tracks(path, others[0], shape) is None
    for damage in (
        {"pixels": tracks.pixels[:-1]},
        {"pixels": tracks.pixels.astype(int)},
        {"shown": tracks.shown[:-1]},
        {"shown": tracks.shown + np.int16(99)},
        {"body": tracks.body - np.int32(9)},
        {"names": tracks.names[:-1]},
    ):
        save_tracks(path, key, replace(tracks, **damage))
        assert load_tracks(path, key, shape) is None, damage.keys()


def test_measured_states_are_not_the_commands(data: Path) -> None:
    states: States = read_states(find_accepted(data)[0][0])
    assert 0 < np.abs(states.joint_pos[1:, 7] - states.action[1:, 7]).max() < 0.3
    assert np.abs(states.joint_vel[4, 7]) > 1


def test_a_disk_that_fills_up_stops_the_work(renderer: Renderer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("xew.episode.write_video", full)
    with pytest.raises(EpisodeError, match="No space left on device"):
        produce(JOBS[:1], tmp_path, renderer, robots=WITH_SLOW)
    assert not list(tmp_path.glob("*/*/*"))
