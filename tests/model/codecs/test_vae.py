"""The autoencoder by itself: causal, the same in chunks, and as large as its config says."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from xew.config import ConfigError
from xew.model.codecs.vae import VAES, VaeSize, VideoVae, abstract_vae
from xew.model.codecs.vae_chunks import even_chunk
from xew.model.codecs.vae_layers import double_sides, patchify, unpatchify
from xew.model.codecs.vae_layouts import diffusers_layout, load_vae, save_vae
from xew.model.weights.writing import save_weights

CHANNELS = VAES["tiny"].channels
FOUR_STAGES = VaeSize(4, encoder_dim=8, decoder_dim=8, multipliers=(1, 2, 4, 4), halve_time=(False, True, True), blocks=1)


def make(size: VaeSize = VAES["tiny"], dtype: jnp.dtype = jnp.float32) -> VideoVae:
    """With random numbers everywhere, also where layers start from zero or one."""
    vae = abstract_vae(size, dtype)
    rng = np.random.default_rng(0)
    for path, leaf in nnx.to_flat_state(nnx.state(vae, nnx.Param)):
        values = rng.standard_normal(leaf.shape, np.float32) / np.prod(leaf.shape[:-1]) ** 0.5
        leaf.set_value(jnp.asarray(np.abs(values) + 0.5 if path[-1] == "gamma" else values))
    return vae


@pytest.fixture(scope="module")
def vae() -> VideoVae:
    return make()


encode = jax.jit(lambda vae, video, chunk=0: vae.encode(video, chunk), static_argnames="chunk")
decode = jax.jit(
    lambda vae, latents, chunk=0, last_only=False: vae.decode(latents, chunk, last_only=last_only),
    static_argnames=("chunk", "last_only"),
)


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(sum(shape)).uniform(-1, 1, shape).astype(np.float32)


@pytest.mark.parametrize("chunk", [1, 2, 3])
def test_decoding_in_chunks_is_decoding_at_once(vae: VideoVae, chunk: int) -> None:
    latents = noise(2, 6, 3, 2, CHANNELS)
    whole, parts = decode(vae, latents), decode(vae, latents, chunk)
    assert whole.shape == (2, 21, 24, 16, 3) and np.std(whole) > 0.1
    np.testing.assert_allclose(parts, whole, atol=1e-5)


@pytest.mark.parametrize("chunk", [1, 2])
def test_encoding_in_chunks_is_encoding_at_once(vae: VideoVae, chunk: int) -> None:
    video = noise(2, 13, 24, 16, 3)
    whole, parts = encode(vae, video), encode(vae, video, chunk)
    assert whole.shape == (2, 4, 3, 2, CHANNELS) and np.std(whole) > 0.1
    np.testing.assert_allclose(parts, whole, atol=1e-5)


def test_chunks_are_even_where_that_is_cheap() -> None:
    assert [even_chunk(30, most) for most in (0, 1, 4, 8, 40)] == [0, 1, 3, 6, 30]
    assert even_chunk(7, 5) == 5 and even_chunk(0, 8) == 8


def test_the_last_frame_alone(vae: VideoVae) -> None:
    latents = noise(1, 4, 2, 2, CHANNELS)
    np.testing.assert_allclose(decode(vae, latents, 1, True), decode(vae, latents)[:, -1:], atol=1e-5)


@pytest.mark.parametrize("size", [VAES["tiny"], FOUR_STAGES], ids=["8", "16"])
def test_causal(size: VaeSize) -> None:
    """A picture is coded as the first frame of a video is, and what comes later changes nothing before it."""
    vae = make(size)
    factor = size.spatial_factor
    video = noise(1, 9, factor, 2 * factor, 3)
    changed = video.copy()
    changed[:, 5:] *= -1
    before, after = encode(vae, video), encode(vae, changed)
    np.testing.assert_allclose(before[:, :2], after[:, :2], atol=1e-5)
    assert not np.allclose(before[:, 2], after[:, 2], atol=1e-3)
    np.testing.assert_allclose(encode(vae, video[:, :1]), before[:, :1], atol=1e-5)
    latents = np.array(before)
    latents[:, 2] *= -1
    np.testing.assert_allclose(decode(vae, latents)[:, :5], decode(vae, before)[:, :5], atol=1e-5)


def test_the_first_frame_is_not_halved_but_shared(vae: VideoVae) -> None:
    """Every frame of a group of four is seen by its latent."""
    video = noise(1, 5, 16, 16, 3)
    latents = encode(vae, video)
    for frame in range(1, 5):
        changed = video.copy()
        changed[:, frame] *= -1
        assert not np.allclose(encode(vae, changed)[:, 1], latents[:, 1], atol=1e-4), frame


def test_batches_are_their_clips(vae: VideoVae) -> None:
    video = noise(2, 5, 16, 16, 3)
    np.testing.assert_allclose(encode(vae, video)[1:], encode(vae, video[1:]), atol=1e-5)


def test_half_precision_is_near(vae: VideoVae) -> None:
    half = make(dtype=jnp.bfloat16)
    video = noise(1, 9, 16, 16, 3)
    latents = encode(vae, video)
    assert encode(half, video).dtype == decode(half, latents).dtype == jnp.float32
    np.testing.assert_allclose(encode(half, video), latents, atol=0.03 * float(jnp.abs(latents).max()))
    np.testing.assert_allclose(decode(half, latents), decode(vae, latents), atol=0.1)


def test_statistics(vae: VideoVae) -> None:
    """Latents are shifted and scaled channel by channel, and frames do not depend on it."""
    video = noise(1, 5, 16, 16, 3)
    latents = encode(vae, video)
    mean, std = np.arange(CHANNELS, dtype=np.float32), np.linspace(0.5, 2, CHANNELS, dtype=np.float32)
    other = make()
    other.latents_mean.set_value(jnp.asarray(mean))
    other.latents_std.set_value(jnp.asarray(std))
    row = (1, 1, 1, 1, -1)
    normalized = encode(other, video)
    np.testing.assert_allclose(normalized, (latents - mean.reshape(row)) / std.reshape(row), atol=1e-5)
    np.testing.assert_allclose(decode(other, normalized), decode(vae, latents), atol=1e-5)


def test_statistics_of_a_checkpoint_lie_in_its_config(vae: VideoVae, tmp_path: Path) -> None:
    """diffusers keeps them beside the weights; a file of ours holds them, and then its own count."""
    said = {"latents_mean": [0.5 + i for i in range(CHANNELS)], "latents_std": [2.0 + i for i in range(CHANNELS)]}
    save_weights(vae, tmp_path / "theirs" / "vae.safetensors", diffusers_layout(vae))
    save_vae(vae, tmp_path / "ours" / "vae.safetensors")
    for name in ("theirs", "ours"):
        (tmp_path / name / "config.json").write_text(json.dumps(said))
    for path in (tmp_path / "theirs", tmp_path / "theirs" / "vae.safetensors"):
        loaded = abstract_vae(VAES["tiny"])
        load_vae(loaded, path)
        np.testing.assert_array_equal(loaded.latents_mean[...], said["latents_mean"])
        np.testing.assert_array_equal(loaded.latents_std[...], said["latents_std"])
    load_vae(loaded, tmp_path / "ours")
    np.testing.assert_array_equal(loaded.latents_std[...], vae.latents_std[...])
    for wrong in ([1.0], "much", [0.0] * CHANNELS, [float("nan")] * CHANNELS):
        (tmp_path / "theirs" / "config.json").write_text(json.dumps({"latents_std": wrong}))
        with pytest.raises(ConfigError, match=f"latents_std of config.json .* not a list of {CHANNELS} finite numbers"):
            load_vae(loaded, tmp_path / "theirs")


def test_published_statistics() -> None:
    """48 pairs at Wan2.2's size; others begin at 0 and 1."""
    published, small = abstract_vae(VAES["wan22"]), abstract_vae(VAES["tiny"])
    assert published.latents_mean.shape == published.latents_std.shape == (48,)
    found = float(published.latents_mean[0]), float(published.latents_std[-1])
    assert found == (pytest.approx(-0.2289), pytest.approx(0.7744))
    assert np.all(small.latents_mean[...] == 0) and np.all(small.latents_std[...] == 1)


def test_repeating_and_convolving_in_one(vae: VideoVae) -> None:
    """The four small convolutions are the large one that they stand for."""
    conv = vae.decoder.stages[0].resample.conv
    width = conv.kernel.shape[-2]
    frames = noise(2, 5, 3, width)
    large = np.repeat(np.repeat(frames, 2, 1), 2, 2)
    expected = conv.apply(jnp.asarray(large), 1, ((1, 1), (1, 1)))
    np.testing.assert_allclose(double_sides(jnp.asarray(frames), conv), expected, atol=1e-5)


def test_patches() -> None:
    """Channels, then columns, then rows: the order of the published first layer."""
    frames = jnp.arange(2 * 2 * 3, dtype=jnp.float32).reshape(1, 1, 2, 2, 3)
    patches = patchify(frames, 2)
    red = [frames[0, 0, 0, 0, 0], frames[0, 0, 1, 0, 0], frames[0, 0, 0, 1, 0], frames[0, 0, 1, 1, 0]]
    np.testing.assert_array_equal(patches[0, 0, 0, 0, :4], red)
    np.testing.assert_array_equal(unpatchify(patches, 2), frames)


def test_refuses_what_does_not_fit(vae: VideoVae) -> None:
    with pytest.raises(ValueError, match="t = 4 k"):
        vae.encode(jnp.zeros((1, 8, 16, 16, 3)))
    with pytest.raises(ValueError, match="sides in 8s"):
        vae.encode(jnp.zeros((1, 5, 16, 12, 3)))
    with pytest.raises(ValueError, match="exactly two"):
        VaeSize(4, 16, 16, (1, 2), (True,))


def test_sizes_say_their_factors() -> None:
    assert {name: (size.spatial_factor, size.channels) for name, size in VAES.items()} == {
        "tiny": (8, 48),
        "wan22": (16, 48),
    }
