"""The project's own autoencoder as a codec: shapes, causality, its file, and what is said where weights are missing."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import load_file, save_file

from tests.model.codecs.test_codec import smooth_clip
from xew.config import ConfigError
from xew.model.codecs import autoencoders
from xew.model.codecs.autoencoders import ConvAutoencoderCodec
from xew.model.codecs.contract import CodecSettings, encode_pictures
from xew.model.codecs.conv_autoencoder import (
    AUTOENCODERS,
    SIZE,
    AutoencoderSize,
    ConvAutoencoder,
    abstract_autoencoder,
    load_autoencoder,
    read_stored_size,
    save_weights,
)
from xew.model.network.dit import parameter_count


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory, random_autoencoder: ConvAutoencoder) -> Path:
    path = tmp_path_factory.mktemp("weights") / "autoencoder.safetensors"
    save_weights(random_autoencoder, path)
    return path


@pytest.fixture(scope="module")
def codec(weights: Path) -> ConvAutoencoderCodec:
    return ConvAutoencoderCodec.open(CodecSettings(weights=weights))


def test_the_shipped_size_fits_into_20_megabytes() -> None:
    """Two bytes a number, and a little for names and norms."""
    assert 9.0e6 < parameter_count(abstract_autoencoder(AUTOENCODERS["base"])) <= 9.7e6
    assert ConvAutoencoderCodec.latent_size(CodecSettings()) == (16, 48)
    assert load_autoencoder(autoencoders.PACKAGED_WEIGHTS).size == AUTOENCODERS["base"]


def test_shapes_and_types(codec: ConvAutoencoderCodec) -> None:
    video = smooth_clip(9, frames=13)
    latents = codec.encode(video)
    assert latents.shape == (4, 2, 3, 48) and latents.dtype == np.float32
    decoded = codec.decode(latents)
    assert decoded.shape == (13, 32, 48, 3) and decoded.dtype == np.uint8
    with pytest.raises(ValueError, match="t = 4 k"):
        codec.encode(video[:12])


def test_causal_by_groups(codec: ConvAutoencoderCodec) -> None:
    """A latent and the frames decoded from it depend on their own group alone; the first frame stands alone."""
    video, changed = smooth_clip(9), smooth_clip(9)
    changed[5:] = 255 - changed[5:]
    before, after = codec.encode(video), codec.encode(changed)
    np.testing.assert_array_equal(before[:2], after[:2])
    assert not np.allclose(before[2], after[2])
    np.testing.assert_allclose(codec.encode(video[:1])[0], before[0], atol=1e-5)
    np.testing.assert_array_equal(codec.decode(before)[:5], codec.decode(after)[:5])


def test_order_within_a_group_is_kept(random_autoencoder: ConvAutoencoder) -> None:
    """What the encoder sees of a group is its frames in their order, and the decoder gives them back in the same."""
    groups = jax.random.normal(jax.random.key(0), (2, 4, 32, 48, 3))
    latents = random_autoencoder.encode_groups(groups)
    assert latents.shape == (2, 2, 3, 48)
    assert not np.allclose(random_autoencoder.encode_groups(groups[:, ::-1]), latents)
    frames = groups.reshape(1, 8, 32, 48, 3)
    standard = random_autoencoder.encode(jnp.concatenate([frames[:, :1], frames], axis=1))
    mean, std = random_autoencoder.latents_mean[...], random_autoencoder.latents_std[...]
    np.testing.assert_allclose(standard[0, 1:] * std[None, None, None] + mean[None, None, None], latents, atol=1e-4)
    decoded = random_autoencoder.decode(standard)
    expected = jnp.clip(random_autoencoder.decode_groups(latents), -1, 1).reshape(8, 32, 48, 3)
    np.testing.assert_allclose(decoded[0, 1:], expected, atol=1e-4)


def test_the_next_reference_is_what_a_rollout_would_encode(codec: ConvAutoencoderCodec) -> None:
    find = jax.jit(lambda codec, latents: codec.next_reference(latents))
    for frames in (9, 1):
        latents = codec.encode(smooth_clip(9, frames=frames))
        found = find(codec, latents[None])
        assert found.shape == (1, 1, 2, 3, 48)
        # One gray level may be rounded the other way.
        np.testing.assert_allclose(found[0], codec.encode(codec.decode(latents)[-1:]), atol=0.1)


def test_a_batch_is_its_clips_and_weights_are_no_constants(codec: ConvAutoencoderCodec) -> None:
    videos = np.stack([smooth_clip(8), smooth_clip(9)])
    expected = np.stack([codec.encode(video) for video in videos])
    np.testing.assert_allclose(encode_pictures(codec, videos), expected, atol=1e-4)
    learned = parameter_count(abstract_autoencoder(AUTOENCODERS["tiny"]))
    assert sum(np.size(leaf) for leaf in jax.tree.leaves(codec)) == learned + 2 * 48


def test_saved_codec_is_the_same(codec: ConvAutoencoderCodec, weights: Path, tmp_path: Path) -> None:
    codec.save(tmp_path)
    written = (tmp_path / "autoencoder.safetensors").stat().st_mtime_ns
    codec.save(tmp_path)
    assert (tmp_path / "autoencoder.safetensors").stat().st_mtime_ns == written
    loaded = ConvAutoencoderCodec.load(tmp_path)
    assert loaded.hash == codec.hash and loaded.size == codec.size
    np.testing.assert_array_equal(loaded.encode(smooth_clip(9)), codec.encode(smooth_clip(9)))
    assert ConvAutoencoderCodec.from_weights(tmp_path, "bfloat16").hash != codec.hash
    other = load_autoencoder(weights)
    other.latents_mean.set_value(jnp.zeros(48))
    assert ConvAutoencoderCodec.from_autoencoder(other).hash != codec.hash


def test_bfloat16_is_close(codec: ConvAutoencoderCodec, weights: Path) -> None:
    half = ConvAutoencoderCodec.from_weights(weights, "bfloat16")
    exact, rounded = (one.encode(smooth_clip(9)) for one in (codec, half))
    assert rounded.dtype == np.float32
    assert 0 < np.abs(exact - rounded).mean() < 0.05 * exact.std()


def test_a_block_begins_as_its_shortcut() -> None:
    autoencoder = ConvAutoencoder(AUTOENCODERS["tiny"], rngs=nnx.Rngs(0))
    x = jax.random.normal(jax.random.key(0), (1, 4, 4, 16))
    np.testing.assert_array_equal(autoencoder.encoder.stages[0](x), x)


def test_missing_weights_are_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(autoencoders, "PACKAGED_WEIGHTS", tmp_path / "nothing.safetensors")
    for path in (None, tmp_path / "nowhere.safetensors"):
        with pytest.raises(ConfigError, match="there are no weights at"):
            ConvAutoencoderCodec.open(CodecSettings(weights=path))
    with pytest.raises(ConfigError, match=r"holds no \.safetensors; expected the path of one file"):
        ConvAutoencoderCodec.open(CodecSettings(weights=tmp_path))


def test_packaged_weights_are_found(monkeypatch: pytest.MonkeyPatch, weights: Path, codec: ConvAutoencoderCodec) -> None:
    monkeypatch.setattr(autoencoders, "PACKAGED_WEIGHTS", weights)
    assert ConvAutoencoderCodec.open(CodecSettings()).hash == codec.hash


def test_settings_and_files_that_do_not_fit_are_told(weights: Path, tmp_path: Path) -> None:
    tensors = load_file(weights)
    save_file(tensors, tmp_path / "nameless.safetensors")
    with pytest.raises(ConfigError, match="does not hold the size"):
        load_autoencoder(tmp_path / "nameless.safetensors")
    (tmp_path / "broken.safetensors").write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(ConfigError, match="not a whole safetensors file"):
        load_autoencoder(tmp_path / "broken.safetensors")
    for size, said in (
        ("{", "is no JSON"),
        ("[" * 100_000, "is no JSON"),
        ("[]", "expected keys and values"),
        ("{}", "missing key"),
    ):
        save_file(tensors, tmp_path / "size.safetensors", metadata={SIZE: size})
        read_stored_size.cache_clear()
        with pytest.raises(ConfigError, match=said):
            load_autoencoder(tmp_path / "size.safetensors")
    with pytest.raises(ValueError, match="as many stages"):
        AutoencoderSize((8, 8), (1, 1), (8,), (1,))
