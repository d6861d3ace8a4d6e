"""Closed loop in the simulator: an expert repeats its episodes, and other commands have another outcome."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.sim_warp.small import TASK, produce
from tests.test_docs import blocks, forget_modules, run_block
from xew.config import TRUST, ConfigError
from xew.dataset import Episode, find_accepted
from xew.episode import read_pixels, read_states
from xew.policies.environment import run_policy
from xew.policies.policy import State, expert
from xew.sim_warp.environment import SimulatorEnv
from xew.sim_warp.production.cells import Job
from xew.sim_warp.rendering.streams import default_renderer

CHUNK = 5
PAGE = Path(__file__).parents[2] / "docs" / "evaluate_a_policy.md"


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sequence[Episode]]:
    """One scene of two robots, whose hands close; an episode is no whole number of chunks."""
    out = tmp_path_factory.mktemp("data")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(TRUST, TASK.partition(":")[0])
        produce([Job(TASK, 1_000_001, ("piper", "arx_x5"))], out, default_renderer())
        yield find_accepted(out)


def hold_still(frames: np.ndarray, state: State) -> np.ndarray:
    return np.repeat(state.command[:, None], frames.shape[1], axis=1)


def test_the_experts_commands_repeat_the_episode(episodes: Sequence[Episode]) -> None:
    env = SimulatorEnv(episodes, CHUNK)
    assert not env.info["success"].any() and (env.info["progress"] < 1).all()
    videos = run_policy(env, expert)
    for video, joints, (folder, record) in zip(videos, env.state.joint_pos, episodes, strict=True):
        np.testing.assert_array_equal(video, read_pixels(folder, "rgb"))
        np.testing.assert_array_equal(joints, read_states(folder, record).joint_pos[-1])
    assert env.info["success"].all() and (env.info["progress"] == 1).all() and (env.rewards == 1).all()


def test_another_policy_has_its_own_outcome(episodes: Sequence[Episode]) -> None:
    env = SimulatorEnv(episodes[:1], CHUNK)
    (video,) = run_policy(env, hold_still)
    assert len(video) == episodes[0][1].frame_count and not env.info["success"].any() and not env.rewards.any()
    frames, info = env.reset()
    assert env.observation_space.contains(frames) and info["frame"] == 0
    frames, rewards, terminated, truncated, info = env.step(expert(frames, env.state))
    np.testing.assert_array_equal(frames[0], read_pixels(episodes[0][0], "rgb")[1 : 1 + CHUNK])
    assert info["frame"] == CHUNK and not (rewards.any() or terminated.any() or truncated.any())


def test_a_scene_of_another_version_is_refused(episodes: Sequence[Episode]) -> None:
    folder, record = episodes[0]
    with pytest.raises(ConfigError, match="of another version"):
        SimulatorEnv([(folder, replace(record, scene_hash="0" * 64))])
    camera = replace(record.camera, name="head+side")
    with pytest.raises(ConfigError, match="tiled"):
        SimulatorEnv([(folder, replace(record, camera=camera))])


def test_the_page_runs_in_the_simulator(
    episodes: Sequence[Episode], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "data").symlink_to(episodes[0][0].parents[2])
    for language, text in blocks(PAGE):
        if text.startswith("# file: ") or "SimulatorEnv" in text:
            run_block(language, text, tmp_path, monkeypatch)
    forget_modules(tmp_path)
    rates = [line.split()[:2] for line in capsys.readouterr().out.splitlines()]
    assert rates == [["expert", "1.0"], ["hold_still", "0.0"]]
