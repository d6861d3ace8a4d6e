"""Beginning a run: what cannot go on is told before anything of it is written."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.networks import TINY_CODEC
from xew import config
from xew.config import ConfigError
from xew.model.codecs.autoencoders import ConvAutoencoderCodec
from xew.model.experiment import Experiment, load_experiment
from xew.model.runs.folder import START, check_start, prepare_run, trace_run
from xew.model.runs.layout import RUN_MARK, is_run
from xew.model.settings.settings import AdaptSettings


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return load_experiment("xew:debug", ["--codec.weights", str(TINY_CODEC)])


def make_codec(experiment: Experiment, seed: int) -> ConvAutoencoderCodec:
    """The experiment's codec with a change that depends on the seed, and so with a hash of its own."""
    autoencoder = ConvAutoencoderCodec.open(experiment.codec).autoencoder
    autoencoder.latents_mean.set_value(autoencoder.latents_mean[...] + np.float32(seed))
    return ConvAutoencoderCodec.from_autoencoder(autoencoder)


def test_a_run_is_continued_with_its_own_codec_only(experiment: Experiment, tmp_path: Path) -> None:
    begun = replace(experiment, out=tmp_path / "run")
    prepare_run(begun, make_codec(experiment, 0), {}, resume=False, overwrite=False)
    config = (tmp_path / "run/config.yaml").read_bytes()
    longer = replace(begun, train=replace(begun.train, steps=begun.train.steps + 7))
    with pytest.raises(ConfigError, match="was begun with another codec"):
        prepare_run(longer, make_codec(experiment, 1), {}, resume=True, overwrite=False)
    assert (tmp_path / "run/config.yaml").read_bytes() == config
    prepare_run(longer, make_codec(experiment, 0), {}, resume=True, overwrite=False)
    assert load_experiment(tmp_path / "run/config.yaml") == longer


def test_a_run_without_a_checkpoint_is_not_adapted(experiment: Experiment, tmp_path: Path) -> None:
    source = replace(experiment, out=tmp_path / "source")
    prepare_run(source, make_codec(experiment, 0), {}, resume=False, overwrite=False)
    adapt = AdaptSettings(start_from=source.out, robots=("piper",))
    with pytest.raises(ConfigError, match="source has no checkpoint to start from"):
        prepare_run(
            replace(experiment, out=tmp_path / "run", adapt=adapt), make_codec(experiment, 0), {}, resume=False, overwrite=False
        )
    assert is_run(source.out) and not (tmp_path / "run").exists()


def test_a_run_that_was_killed_while_it_was_begun_is_begun_again(experiment: Experiment, tmp_path: Path) -> None:
    """Before its config was there, and before its codec was; what is damaged once a checkpoint depends on it, is told."""
    begun, codec = replace(experiment, out=tmp_path / "run"), make_codec(experiment, 0)
    begun.out.mkdir()
    (begun.out / RUN_MARK).touch()
    (begun.out / ".config.yaml.4194302").write_text("half")
    for left in ("config", "codec"):
        prepare_run(begun, codec, {}, resume=True, overwrite=False)
        assert load_experiment(begun.out / "config.yaml") == begun and (begun.out / "codec/autoencoder.json").stat().st_size, (
            left
        )
        (begun.out / "codec/autoencoder.json").unlink()
    (begun.out / "checkpoints/4").mkdir(parents=True)
    with pytest.raises(ConfigError, match="lacks its codec"):
        prepare_run(begun, codec, {}, resume=True, overwrite=False)
    (begun.out / "config.yaml").unlink()
    with pytest.raises(ConfigError, match="is not empty and holds no run"):
        prepare_run(begun, codec, {}, resume=True, overwrite=False)


def write_chain(root: Path, experiment: Experiment, starts: dict[str, str]) -> None:
    """Runs that were adapted by LoRA from one another, by name, without checkpoints."""
    for name, start in starts.items():
        adapt = AdaptSettings(start_from=root / start if start else None, robots=("piper",), lora_rank=4 if start else 0)
        config.save(
            replace(experiment, out=root / name, adapt=adapt if start else AdaptSettings()), root / name / "config.yaml"
        )
        (root / name / START).write_text(json.dumps({"run": start, "step": 4, "saved": None}))


@pytest.mark.parametrize(
    ("starts", "lineage"),
    [
        ({"a": ""}, ["a"]),
        ({"a": "b", "b": "c", "c": ""}, ["c", "b", "a"]),
        ({"a": "a"}, "a was adapted from itself"),
        ({"a": "b", "b": "a"}, "a was adapted from itself"),
        ({"a": "b", "b": "c", "c": "b"}, "b was adapted from itself"),
        ({"a": "b/../a", "b": ""}, "a was adapted from itself"),
    ],
)
def test_runs_are_traced_to_their_start_or_to_a_circle(
    starts: dict[str, str], lineage: list[str] | str, experiment: Experiment, tmp_path: Path
) -> None:
    write_chain(tmp_path, experiment, starts)
    if isinstance(lineage, list):
        assert [kept.run.name for kept in trace_run(tmp_path / "a")] == lineage
        return
    with pytest.raises(ConfigError, match=lineage):
        trace_run(tmp_path / "a")
    asked = AdaptSettings(start_from=tmp_path / "a", robots=("piper",))
    with pytest.raises(ConfigError, match=lineage):
        check_start(replace(experiment, out=tmp_path / "new", adapt=asked))
