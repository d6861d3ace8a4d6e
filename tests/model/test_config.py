"""Configs: strict, with errors that say what to do."""

import errno
import math
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from xew import config
from xew.config import ConfigError
from xew.model import train
from xew.model.experiment import Experiment, load_experiment
from xew.model.rollout import default_name, is_config

REPOSITORY = Path(__file__).parents[2]
CONFIGS = sorted((REPOSITORY / "configs").glob("*.yaml"))
MODEL_CONFIGS = [REPOSITORY / "configs" / name for name in ("debug.yaml", "fixed.yaml")]


@dataclass(frozen=True)
class Inner:
    depth: int = 3
    rate: float = 1e-3
    names: tuple[str, ...] = ("a",)


@dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner = Inner()


def write(folder: Path, text: str) -> Path:
    path = folder / "config.yaml"
    path.write_text(text)
    return path


def test_reads_and_converts(tmp_path: Path) -> None:
    path = write(tmp_path, "name: x\ninner: {depth: 4, rate: 5e-5, names: [b, c]}")
    assert config.load(Outer, path) == Outer("x", Inner(4, 5e-5, ("b", "c")))


def test_overrides_win(tmp_path: Path) -> None:
    path = write(tmp_path, "name: x\ninner: {depth: 4, rate: 2}")
    assert config.load(Outer, path, ["--inner.depth", "5"]) == Outer("x", Inner(5, 2.0))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name: x\ninner: {dpeth: 4}", "inner: unknown key 'dpeth'; did you mean 'depth'?"),
        ("inner: {depth: 4}", "missing key 'name'"),
        ("name: x\ninner: {depth: 4.5}", "inner.depth: expected int, found float 4.5"),
        ("name: x\ninner: {depth: true}", "inner.depth: expected int, found bool True"),
        ("name: x\ninner: {rate: fast}", "inner.rate: expected float, found str 'fast'"),
        ("name: x\ninner: {names: b}", "inner.names: expected a list, found str 'b'"),
        ("name: x\ninner: 3", "inner: expected keys and values"),
        ("- 3", "expected keys and values, found list"),
        ("name: [", "is not YAML"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        config.load(Outer, write(tmp_path, text))
    assert said in str(error.value)


def test_a_config_changes_its_base(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("name: x\ninner: {depth: 4, names: [a, b]}")
    path = write(tmp_path, "base: base.yaml\ninner: {names: [c]}")
    assert config.load(Outer, path) == Outer("x", Inner(4, names=("c",)))
    config.save(config.load(Outer, path), tmp_path / "saved.yaml")
    assert "base" not in (tmp_path / "saved.yaml").read_text(), "a saved config is resolved"
    (tmp_path / "variants").mkdir()
    assert config.load(Outer, write(tmp_path / "variants", "base: ../base.yaml\nname: y")) == Outer(
        "y", Inner(4, names=("a", "b"))
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("base: config.yaml", "has the base config.yaml; bases cannot be nested"),
        ("base: nowhere.yaml", "cannot read the config .*nowhere.yaml"),
        ("base: 3", "base is 3; expected the path of a config"),
        ("base: xew:fixd", "did you mean 'fixed'"),
    ],
)
def test_mistakes_of_a_base_are_named(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=said):
        config.read_yaml(write(tmp_path, text))


def test_all_mistakes_at_once(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        config.load(Outer, write(tmp_path, "inner: {depth: x, rate: y}"))
    assert len(str(error.value).splitlines()) == 3


def test_missing_file_lists_what_there_is(tmp_path: Path) -> None:
    write(tmp_path, "name: x")
    with pytest.raises(ConfigError, match=r"cannot read the config .*The folder has .*config\.yaml"):
        config.load(Outer, tmp_path / "other.yaml")


def test_unknown_override_exits_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        config.load(Outer, write(tmp_path, "name: x"), ["--inner.dpeth", "5"])
    assert stop.value.code == 2
    assert "--inner.depth" in capsys.readouterr().err


def test_configs_come_with_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    packaged = load_experiment("xew:fixed")
    assert packaged == load_experiment("configs/fixed.yaml") == load_experiment(REPOSITORY / "configs" / "fixed.yaml")
    assert default_name(Path("xew:wan5b/fixed")) == "fixed" and is_config(Path("xew:wan5b/fixed"))
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "fixed.yaml").write_text("mine: 1")
    assert config.read_yaml("configs/fixed.yaml") == {"mine": 1}, "a file that is there goes before"
    for name, said in (("xew:fixd", "did you mean 'fixed'.* known: baselines/bwm"), ("xew:../protocol", "has no config")):
        with pytest.raises(ConfigError, match=said):
            config.read_yaml(name)


@pytest.mark.parametrize("lines", [1, 100_000])
def test_a_command_ends_quietly_when_its_reader_goes_away(lines: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """As `| head` does: few lines are held back until the end, many fail in the middle."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stream, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", stream)
        with pytest.raises(SystemExit) as stop:
            config.user_errors(lambda: print("line\n" * lines))()
    assert stop.value.code == 141


def test_other_broken_pipes_are_no_quiet_end() -> None:
    def lose_a_worker() -> None:
        raise BrokenPipeError(errno.EPIPE, "a worker is gone")

    with pytest.raises(BrokenPipeError, match="a worker is gone"):
        config.user_errors(lose_a_worker)()


def test_user_errors_exit_2_without_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    @config.user_errors
    def command() -> None:
        raise ConfigError("found this, do that")

    with pytest.raises(SystemExit) as stop:
        command()
    assert stop.value.code == 2
    assert capsys.readouterr().err == "error: found this, do that\n"


def test_pick_suggests_and_imports() -> None:
    with pytest.raises(ConfigError, match="did you mean 'mask'"):
        config.pick({"mask": 1, "none": 2}, "maks", "action")
    registry = {"none": None, "one": 1.0}
    assert config.pick(registry, "math:tau", "action") == math.tau
    with pytest.raises(ConfigError, match="cannot import the action 'math:taau'"):
        config.pick(registry, "math:taau", "action")
    with pytest.raises(ConfigError, match="'math:sin' is a builtin_function_or_method; expected a float"):
        config.pick(registry, "math:sin", "action")


CONDITIONS_OF_TEST = """
from xew.model.conditions import Condition, joints, robot_render

SYSTEM = (Condition("still", "embodiment", robot_render), Condition("joints", "joints", joints))
LOST = Condition("lost", "embodimnt", robot_render)
"""


@pytest.mark.parametrize(
    ("action", "said"),
    [
        ("SYSTEM", "still and robot_render both feed embodiment"),
        ("LOST", "the condition lost feeds 'embodimnt'; expected one of action, embodiment"),
    ],
)
def test_conditions_that_would_not_reach_the_network_are_told(
    action: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "conditions_of_test.py").write_text(CONDITIONS_OF_TEST)
    monkeypatch.syspath_prepend(str(tmp_path))
    chosen = ["--model.embodiment", "robot_render", "--model.action", f"conditions_of_test:{action}"]
    with pytest.raises(ConfigError, match=said):
        load_experiment(MODEL_CONFIGS[0], chosen)
    if action == "SYSTEM":
        alone = load_experiment(MODEL_CONFIGS[0], [*chosen, "--model.embodiment", "none"])
        assert {stream: condition.name for stream, condition in alone.conditions.items()} == {
            "embodiment": "still",
            "joints": "joints",
        }


@pytest.mark.parametrize("path", MODEL_CONFIGS, ids=lambda path: path.stem)
def test_shipped_configs_load_and_survive_saving(path: Path, tmp_path: Path) -> None:
    experiment = load_experiment(path)
    config.save(experiment, tmp_path / "saved.yaml")
    assert load_experiment(tmp_path / "saved.yaml") == experiment


def test_bodies_to_adapt_to_are_named_one_by_one_and_not_replayed(tmp_path: Path) -> None:
    config.save(load_experiment(MODEL_CONFIGS[0], ["--split", "scaling_bodies_4"]), tmp_path / "config.yaml")
    adaptation = ["--adapt.start_from", str(tmp_path), "--adapt.robots", "body:1-2", "--adapt.replay", "0.5"]
    choice = load_experiment(MODEL_CONFIGS[0], adaptation).choice
    assert choice.robots == ("body_1", "body_2") and choice.replay == ("body_0", "body_3")


def test_the_cache_lies_next_to_the_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "data" / "task").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "data" / "task")
    assert Experiment(Path(".."), Path("run")).cache_folder == (tmp_path / "data-latents").resolve()
    monkeypatch.chdir(tmp_path / "data")
    assert Experiment(Path("."), Path("run")).cache_folder == (tmp_path / "data-latents").resolve()
    assert Experiment(Path("data"), Path("run")).cache_folder == Path("data-latents")


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["--clip.frames", "16"], r"clip.frames is 16; it must be 4 k \+ 1 .* for example 17"),
        (["--train.steps", "-1"], "train.steps is -1; it must be at least 0"),
        (["--train.ema", "0.5"], "train.ema is 0.5 of the run; it must be at most 0.25"),
        (["--clip.width", "100"], "both sides must be multiples of"),
        (["--model.size", "debgu"], "unknown model size 'debgu'; did you mean 'debug'"),
        (["--model.embodiment", "render"], "unknown embodiment 'render'; did you mean 'robot_render'"),
        (["--split", "fixd"], "unknown split 'fixd'; did you mean 'fixed'"),
    ],
)
def test_experiment_mistakes(overrides: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load_experiment(MODEL_CONFIGS[0], overrides)


@pytest.mark.parametrize("arguments", [["--help"], [str(Path(__file__).parents[2] / "configs/debug.yaml"), "--help"]])
def test_help_lists_what_may_be_overridden(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        train.main(arguments)
    said = capsys.readouterr().out
    assert stop.value.code == 0
    for option in ("--train.steps", "--clip.frames", "--model.action", "--resume", "--overwrite", "--memory-gb"):
        assert option in said, option


def test_a_command_without_a_config_or_with_two_wishes_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, said in (
        ([], "name the CONFIG first"),
        ([str(Path(__file__).parents[2] / "configs/debug.yaml"), "--resume", "--overwrite"], "give one of them"),
        ([str(Path(__file__).parents[2] / "configs/debug.yaml"), "--train.stepz", "4"], "--train.steps"),
    ):
        with pytest.raises(SystemExit) as stop:
            train.main(arguments)
        assert stop.value.code == 2
        assert said in capsys.readouterr().err
