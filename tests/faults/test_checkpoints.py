"""Damaged checkpoints and codecs: one line that names file and step and offers the last good one; flipped bits are noticed."""

import shutil
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from tests.networks import TINY_CODEC
from xew.config import ConfigError
from xew.model.codecs.autoencoders import ConvAutoencoderCodec
from xew.model.codecs.codec import load_kept_codec
from xew.model.codecs.contract import CodecSettings
from xew.model.runs.checkpoint import TrainState, note_sums, open_checkpoints, restore_state, save_state
from xew.model.runs.log import RunLog

# TensorStore calls back into the event loop that Orbax has closed when a restore fails early: a message, and nothing else.
pytestmark = pytest.mark.filterwarnings("ignore:Exception ignored in:pytest.PytestUnraisableExceptionWarning")


def state(step: int, value: float = 1.0, width: int = 64) -> TrainState:
    kernel = value * np.random.default_rng(step).normal(size=(8, width))  # numbers that do not compress
    params = {"kernel": jnp.asarray(kernel, jnp.float32), "bias": jnp.arange(width, dtype=jnp.float32)}
    return TrainState(jnp.int32(step), params, {"count": jnp.zeros((3,), jnp.float32)})


def save(out: Path, *states: TrainState) -> None:
    with open_checkpoints(out, keep=5) as checkpoints:
        for one in states:
            save_state(checkpoints, one, {"position": 3})
    note_sums(out)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    save(out, state(1), state(2))
    return out


def arrays(item: Path) -> list[Path]:
    """Files that hold the arrays of an item, of which Orbax may have the same bytes twice."""
    largest = max(file.stat().st_size for file in item.rglob("d/*"))
    return [file for file in item.rglob("d/*") if file.stat().st_size == largest]


def change(item: Path, how: Callable[[bytes], bytes]) -> None:
    for file in arrays(item):
        file.write_bytes(how(file.read_bytes()))


def flip(content: bytes) -> bytes:
    """The same with another bit in the middle, which is one of an array's."""
    half = len(content) // 2
    return content[:half] + bytes([content[half] ^ 4]) + content[half + 1 :]


DAMAGES: dict[str, Callable[[Path], object]] = {
    "a flipped bit": lambda step: change(step / "params", flip),
    "a file cut off": lambda step: change(step / "params", lambda content: content[: len(content) // 2]),
    "an empty file": lambda step: change(step / "params", lambda content: b""),
    "a file missing": lambda step: [file.unlink() for file in arrays(step / "params")],
    "an item missing": lambda step: shutil.rmtree(step / "optimizer"),
    "the data's position missing": lambda step: shutil.rmtree(step / "data"),
    "all missing": lambda step: [shutil.rmtree(item) for item in step.iterdir() if item.is_dir()],
}


@pytest.mark.parametrize("sums", ["with sums", "without sums"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_told_and_the_last_good_step_is_offered(damage: str, sums: str, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    DAMAGES[damage](out / "checkpoints/2")
    if sums == "without sums":
        if damage == "a flipped bit":
            pytest.skip("only sums tell it")
        (out / "sums/2.json").unlink()
    with open_checkpoints(out, keep=5) as checkpoints, pytest.raises(ConfigError) as error:
        restore_state(checkpoints, state(0))
    said = str(error.value)
    assert "\n" not in said and f"{out}/checkpoints/2: the checkpoint of step 2 is damaged" in said
    assert "step 1 is whole" in said
    shutil.rmtree(out / "checkpoints/2")
    with open_checkpoints(out, keep=5) as checkpoints:
        restored, position = restore_state(checkpoints, state(0))
    assert int(restored.step) == 1 and position == {"position": 3}


def test_other_sizes_and_weights_that_are_no_numbers_are_told(whole: Path, tmp_path: Path) -> None:
    with open_checkpoints(whole, keep=5) as checkpoints, pytest.raises(ConfigError, match="step 2 is damaged"):
        restore_state(checkpoints, state(0, width=32))
    save(tmp_path, state(1, float("nan")))
    with open_checkpoints(tmp_path, keep=5) as checkpoints, pytest.raises(ConfigError, match=r"holds NaN.*no other is known"):
        restore_state(checkpoints, state(0))


def test_whole_checkpoints_are_read_and_sums_go_with_them(whole: Path, tmp_path: Path) -> None:
    with open_checkpoints(whole, keep=5) as checkpoints:
        restored, _ = restore_state(checkpoints, state(0))
    np.testing.assert_array_equal(restored.params["bias"], state(2).params["bias"])
    assert jax.tree.all(jax.tree.map(lambda leaf: leaf.dtype == jnp.float32, restored.params))
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    shutil.rmtree(out / "checkpoints/1")
    note_sums(out)
    assert [path.name for path in (out / "sums").iterdir()] == ["2.json"]


def test_a_damaged_codec_is_refused(tmp_path: Path) -> None:
    codec = ConvAutoencoderCodec.open(CodecSettings(weights=TINY_CODEC))
    codec.save(tmp_path)
    assert load_kept_codec(ConvAutoencoderCodec, tmp_path, "copy it again").hash == codec.hash
    weights = tmp_path / "autoencoder.safetensors"
    content, tensors = weights.read_bytes(), load_file(weights)
    with safe_open(weights, framework="numpy") as stored:
        metadata = stored.metadata()
    for damaged in (b"", content[:100], content[:-30], content[:8] + b"x" + content[9:], b"text"):
        weights.write_bytes(damaged)
        with pytest.raises(ConfigError, match=r"(copy|download) it again"):
            load_kept_codec(ConvAutoencoderCodec, tmp_path, "copy it again")
    for name, tensor in list(tensors.items())[:4]:
        save_file(tensors | {name: tensor[..., None]}, weights, metadata=metadata)
        with pytest.raises(ConfigError):
            load_kept_codec(ConvAutoencoderCodec, tmp_path, "copy it again")
    weights.unlink()
    with pytest.raises(ConfigError, match=r"no weights at .*autoencoder.safetensors"):
        load_kept_codec(ConvAutoencoderCodec, tmp_path, "copy it again")
    (tmp_path / "autoencoder.json").unlink()
    with pytest.raises(ConfigError, match=r"lacks its codec \(.*autoencoder.json\); copy it again"):
        load_kept_codec(ConvAutoencoderCodec, tmp_path, "copy it again")


def test_a_damaged_log_of_numbers_is_gone_on_from(tmp_path: Path) -> None:
    good = '{"step": 1, "a": 2.0}\n'
    (tmp_path / "metrics.jsonl").write_text(good + 'null\n[1]\n{"a": 1}\n{"step": "x"}\n\x00\x00\n{"step": 9}\n{"step": 2, "b"')
    RunLog(tmp_path, 3).close()
    assert (tmp_path / "metrics.jsonl").read_text() == good
