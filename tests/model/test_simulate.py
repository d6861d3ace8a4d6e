"""The closed loop: with the recorded commands it is a rollout, a policy's commands move the robot, and the page's code runs."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from tests import synthetic
from tests.commands import run_command
from tests.model.test_rollout import CONFIG, FRAMES, choose_tests, random_predictor
from tests.test_docs import blocks, forget_modules, run_block
from xew.config import ConfigError
from xew.dataset import Episode, find_accepted
from xew.episode import read_pixels, read_states, write_episode
from xew.model import latents, rollout, simulate, train
from xew.model.episodes.commands import new_command
from xew.model.experiment import load_experiment
from xew.model.sampling.predict import Predictor
from xew.model.simulate import WorldModelEnv
from xew.model.video.frames import to_camera_size
from xew.policies import environment
from xew.policies.environment import run_policy
from xew.policies.policy import expert, noisy_expert
from xew.rollout import find_rollouts, read_rollout_video
from xew.sim_warp.rendering.render import Renderer, World

PAGE = Path(__file__).parents[2] / "docs" / "evaluate_a_policy.md"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes of two robots and lengths, whose robot.mkv is the render of their commands, and a run of one step."""
    root = tmp_path_factory.mktemp("world")
    synthetic.write_synthetic_data(root / "data", seeds=(0,), robots=("ur5_wsg",), frames=FRAMES)
    for robot, frames in (("piper", FRAMES), ("arx_x5", FRAMES - 2)):
        synthetic.write_synthetic_data(root / "data", seeds=(1_000_000,), robots=(robot,), frames=frames)
    for folder, record in find_accepted(root / "data"):
        states, rgb = read_states(folder), read_pixels(folder, "rgb")
        render = new_command(folder, record, states, states.action, rgb[:1]).render
        write_episode(root / "data", record, states, rgb, render)
    config = CONFIG.format(root=root).replace(f"{root}/run", f"{root}/runs/fixed")
    (root / "config.yaml").write_text(config)
    options = [str(root / "config.yaml")]
    latents.main(options)
    train.main([*options, "--train.samples", "0"])
    return root


def predictor_of(world: Path, *options: str) -> Predictor:
    return random_predictor(load_experiment(world / "config.yaml", options))


@pytest.fixture(scope="module")
def predictor(world: Path) -> Predictor:
    return predictor_of(world)


@pytest.fixture(scope="module")
def episodes(world: Path) -> Sequence[Episode]:
    return choose_tests(world / "data")


@pytest.mark.parametrize(
    ("action", "embodiment"), [("joints", "robot_render"), ("mask_and_flow_channels", "carried_render_and_shadows")]
)
def test_the_experts_commands_give_the_rollout(
    action: str, embodiment: str, world: Path, episodes: Sequence[Episode], monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the byte; grippers that never close carry nothing, so the carried scene is causal here."""
    predictor = predictor_of(world, "--model.action", action, "--model.embodiment", embodiment)
    open_loop = predictor.predict(episodes, FRAMES)
    rendered: list[int] = []
    render = Renderer.render_batch

    def count(self: Renderer, worlds: Sequence[World], *args: Any, **options: Any) -> Any:
        rendered.extend(len(world.pose) for world in worlds)
        return render(self, worlds, *args, **options)

    monkeypatch.setattr(Renderer, "render_batch", count)
    videos = run_policy(WorldModelEnv(predictor, episodes), expert)
    assert max(rendered) == predictor.inputs.clip.frames, "new commands and the last one, whose flow they change"
    assert [len(video) for video in videos] == [record.frame_count for _, record in episodes] == [FRAMES - 2, FRAMES]
    for video, expected in zip(videos, open_loop, strict=True):
        np.testing.assert_array_equal(video, to_camera_size(expected[: len(video)]))


def test_it_is_an_environment(predictor: Predictor, episodes: Sequence[Episode]) -> None:
    env = WorldModelEnv(predictor, episodes, batch=3)
    frames, info = env.reset(seed=1)
    assert env.observation_space.contains(frames) and info["frame"] == 0
    np.testing.assert_array_equal(frames[:, -1], [read_pixels(folder, "rgb")[0] for folder, _ in episodes])
    truncations, seen = [], []
    while not info["frame"] >= FRAMES - 1:
        actions = expert(frames, env.state)
        assert env.action_space.contains(actions)
        frames, rewards, terminated, truncated, info = env.step(actions)
        assert env.observation_space.contains(frames) and not rewards.any() and not terminated.any()
        truncations.append(truncated.tolist())
        seen.append(frames[1])
    assert truncations == [[False, False], [False, False], [True, True]]
    np.testing.assert_array_equal(np.concatenate(seen)[: FRAMES - 1], env.videos()[1][1:])
    with pytest.raises(ResetNeeded):
        env.step(actions)
    _, info = env.reset(options={"episodes": episodes[::-1]})
    assert [record.robot for record in info["records"]] == ["piper", "arx_x5"] and info["frame"] == 0


def test_no_more_than_max_frames_are_predicted(predictor: Predictor, episodes: Sequence[Episode]) -> None:
    env = WorldModelEnv(replace(predictor, settings=replace(predictor.settings, max_frames=5)), episodes)
    env.reset()
    assert env.step(env.state.recorded)[3].all()
    assert [len(video) for video in env.videos()] == [5, 5]


def test_noise_depends_on_episode_and_frame_and_spares_grippers(predictor: Predictor, episodes: Sequence[Episode]) -> None:
    env, alone = WorldModelEnv(predictor, episodes), WorldModelEnv(predictor, episodes[1:])
    frames, _ = env.reset()
    noisy, recorded = noisy_expert(frames, env.state), env.state.recorded
    np.testing.assert_array_equal(noisy_expert(frames[1:], alone.state), noisy[1:])
    moved = noisy != recorded
    assert moved[..., :2].all() and not moved[..., [6, 7, 15]].any() and np.abs(noisy - recorded).max() < 0.1
    assert (env.step(noisy)[0] != run_policy(alone, expert)[0][1:5]).any()


def test_commands_of_another_shape_are_refused(predictor: Predictor, episodes: Sequence[Episode]) -> None:
    env = WorldModelEnv(predictor, episodes)
    with pytest.raises(ConfigError, match=r"gave commands \[2, 4, 7\]; expected \[2, 4, 16\]"):
        env.step(np.zeros((2, 4, 7)))
    with pytest.raises(ConfigError, match="finite"):
        env.step(np.full((2, 4, 16), np.nan))
    with pytest.raises(ConfigError, match="found 1 episodes"):
        env.reset(options={"episodes": episodes[:1]})
    with pytest.raises(ConfigError, match="expected at least one"):
        WorldModelEnv(predictor, [])


def test_the_command_writes_rollouts_that_are_graded(world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, data = str(world / "runs" / "fixed"), str(world / "data")
    rollout.main([run, "--data", data, "--out", str(tmp_path / "open")])
    simulate.main([run, "--data", data, "--out", str(tmp_path / "closed")])
    for one, other in zip(find_rollouts(tmp_path / "open"), find_rollouts(tmp_path / "closed"), strict=True):
        np.testing.assert_array_equal(read_rollout_video(one), read_rollout_video(other))
        assert (other.model, other.header["policy"]) == ("fixed-expert", "expert")
    scores = tmp_path / "scores.parquet"
    run_command("xew.metrics.evaluate", tmp_path / "closed", "--data", data, "--metrics", "psnr", "--out", scores)
    assert scores.is_file()
    capsys.readouterr()
    with pytest.raises(SystemExit, match="2"):
        simulate.main([run, "--data", data, "--policy", "expret"])
    assert "did you mean 'expert'" in capsys.readouterr().err


def test_without_gymnasium_a_line_says_what_to_install(
    world: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(environment, "VectorEnv", object)
    with pytest.raises(SystemExit, match="2"):
        simulate.main([str(world / "runs" / "fixed"), "--data", str(world / "data")])
    assert "pip install 'xew[policy]'" in capsys.readouterr().err


def test_the_page_runs(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(world)
    monkeypatch.syspath_prepend(str(world))
    commands = [line for _, text in blocks(PAGE) for line in text.splitlines() if line.startswith("python -m xew.model")]
    commands += [line.replace("expert", "my_policies:hold_still") for line in commands]
    snippets = [block for block in blocks(PAGE) if block[0] == "python" and "SimulatorEnv" not in block[1]]
    for language, text in [*snippets, ("bash", "\n".join(commands))]:
        run_block(language, text, world, monkeypatch)
    assert {path.name: len(find_rollouts(path)) for path in (world / "rollouts").iterdir() if path.is_dir()} == {
        "fixed-expert": 1,
        "fixed-hold_still": 1,
    }
    forget_modules(world)
