"""Robots in other colors: only colors differ, each follows from robot and number; episodes are painted from their states."""

from pathlib import Path

import numpy as np
import pytest

from tests.sim_warp.small import TASK, work_inline
from xew.config import ConfigError
from xew.dataset import find_accepted
from xew.episode import EpisodeError, episode_folder, read_record, verify_episode
from xew.protocol import painted_key, unpainted_key
from xew.sim_warp.generate import Args, generate
from xew.sim_warp.rendering.bodies import robot_bodies
from xew.sim_warp.rendering.streams import home_action
from xew.sim_warp.robots import ROBOTS, get_robot, recorded_robot
from xew.sim_warp.robots.user.own import robot_key

robots = pytest.mark.parametrize("robot", ROBOTS)


@robots
def test_only_colors_differ_and_every_color_becomes_one(robot: str) -> None:
    own, painted = robot_bodies(ROBOTS[robot]), robot_bodies(get_robot(painted_key(robot, 1)))
    for before, after in zip(own, painted, strict=True):
        for name in ("vertices", "triangles", "normals"):
            np.testing.assert_array_equal(getattr(before.mesh, name), getattr(after.mesh, name))
    old, new = (np.concatenate([body.mesh.colors for body in bodies]) for bodies in (own, painted))
    pairs = np.unique(np.concatenate([old, new], axis=1), axis=0)
    assert len(pairs) == len(np.unique(old, axis=0)) and (old != new).any()
    np.testing.assert_array_equal(home_action(ROBOTS[robot]), home_action(get_robot(painted_key(robot, 1))))


def test_colors_follow_from_the_robot_and_the_number() -> None:
    looks = {
        (robot, paint): robot_bodies(get_robot(painted_key(robot, paint)))[0].mesh.colors[0].tolist()
        for robot in ROBOTS
        for paint in range(1, 9)
    }
    assert len({tuple(color) for color in looks.values()}) > len(ROBOTS)
    assert all(len({tuple(looks[robot, paint]) for paint in range(1, 9)}) > 1 for robot in ROBOTS)
    again = robot_bodies(recorded_robot("arx_x5_paint_3"))
    assert again[0].mesh is robot_bodies(get_robot("arx_x5_paint_3"))[0].mesh, "meshes are shared, so that they are stored once"


def test_names_of_painted_robots() -> None:
    painted = get_robot("arx_x5_paint_3")
    assert (painted.key, painted.paint, painted.urdf) == ("arx_x5_paint_3", 3, ROBOTS["arx_x5"].urdf)
    assert unpainted_key("arx_x5_paint_3") == "arx_x5" and unpainted_key("arx_x5") == "arx_x5"
    assert get_robot("body_3_paint_2").title == "Body 3, paint 2"
    with pytest.raises(ConfigError, match="no paint 0 of arx_x5; they count from 1"):
        get_robot("arx_x5_paint_0")
    with pytest.raises(ConfigError, match="unknown robot 'arx_x4'"):
        get_robot("arx_x4_paint_1")


def test_a_robot_of_ones_own_takes_no_painted_name() -> None:
    assert robot_key(Path("lab/arx_x5_paint_3.urdf")) == "arx_x5_paint_3_own"


def test_a_negative_number_of_paints_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EpisodeError, match="--paints is -1; expected"):
        generate(Args(tasks=(TASK,), robots=("piper",), out=tmp_path, device="cpu", paints=-1))


def test_training_episodes_are_painted_from_their_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work_inline(monkeypatch)
    args = Args(tasks=(TASK,), robots=("piper",), train_seeds=3, test_seeds=1, out=tmp_path, device="cpu", paints=2)
    generate(args)
    found = [(record.seed, record.robot) for _, record in find_accepted(tmp_path)]
    painted = [(0, "piper_paint_1"), (1, "piper_paint_2"), (2, "piper_paint_1")]
    assert sorted(found) == sorted([*painted, *((seed, "piper") for seed in (0, 1, 2, 1_000_000))])
    for seed, robot in painted:
        own, other = (read_record(episode_folder(tmp_path, TASK, seed, name)) for name in ("piper", robot))
        assert verify_episode(episode_folder(tmp_path, TASK, seed, robot)) == other
        assert own.hashes["states"] == other.hashes["states"] and own.scene_hash == other.scene_hash
        assert own.hashes["rgb"] != other.hashes["rgb"] and own.hashes["robot"] != other.hashes["robot"]
    times = {folder: (folder / "episode.json").stat().st_mtime_ns for folder, _ in find_accepted(tmp_path)}
    monkeypatch.delattr("xew.sim_warp.generate.paint_again")
    generate(args)  # nothing is painted again
    assert times == {folder: (folder / "episode.json").stat().st_mtime_ns for folder, _ in find_accepted(tmp_path)}
