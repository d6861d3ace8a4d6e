"""The codecs, and the way between the camera's frames and the model's."""

from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from flax import nnx

from tests.networks import TINY_CODEC
from xew.config import ConfigError
from xew.metrics import psnr
from xew.model.codecs.autoencoders import ConvAutoencoderCodec, WanVaeCodec
from xew.model.codecs.contract import CodecSettings, decode_to_pictures, encode_pictures, latent_frames
from xew.model.codecs.vae import VAES, abstract_vae
from xew.model.codecs.vae_layouts import save_vae
from xew.model.video.frames import to_camera_size, to_model_size


def smooth_clip(seed: int, frames: int = 9) -> np.ndarray:
    """A few moving plane waves, uint8 [t 32 48 3]."""
    rng = np.random.default_rng(seed)
    t, y, x = np.meshgrid(np.arange(frames), np.arange(32), np.arange(48), indexing="ij")
    waves = [np.sin(rng.uniform(-0.2, 0.2) * x + rng.uniform(-0.2, 0.2) * y + rng.uniform(-0.3, 0.3) * t) for _ in range(3)]
    return (127 + 100 * np.stack(waves, -1)).astype(np.uint8)


@pytest.fixture(scope="module")
def codec() -> ConvAutoencoderCodec:
    return ConvAutoencoderCodec.open(CodecSettings(weights=TINY_CODEC))


def test_shapes(codec: ConvAutoencoderCodec) -> None:
    latents = codec.encode(smooth_clip(9, frames=13))
    assert latents.shape == (latent_frames(13), 4, 6, 8) and latents.dtype == np.float32
    assert codec.decode(latents).shape == (13, 32, 48, 3)


def test_round_trip_of_unseen_video(codec: ConvAutoencoderCodec) -> None:
    for seed in (9, 10):
        clip = smooth_clip(seed)
        frozen = np.repeat(clip[:1], len(clip), axis=0)
        assert np.mean(psnr(codec.decode(codec.encode(clip)), clip)) > np.mean(psnr(frozen, clip)[1:]) + 5


def test_causal(codec: ConvAutoencoderCodec) -> None:
    """The first frame stands alone; each latent depends on frames up to its own group only."""
    video, changed = smooth_clip(9), smooth_clip(9)
    changed[5:] = 255 - changed[5:]
    before, after = codec.encode(video), codec.encode(changed)
    np.testing.assert_array_equal(before[:2], after[:2])
    assert not np.allclose(before[2], after[2])
    np.testing.assert_allclose(codec.encode(video[:1])[0], before[0], atol=1e-5)


def test_a_batch_is_its_clips(codec: ConvAutoencoderCodec) -> None:
    """On the device and in a batch, and one clip at a time as pictures, the codec is the same."""
    videos = np.stack([smooth_clip(8), smooth_clip(9)])
    latents = encode_pictures(codec, videos)
    np.testing.assert_allclose(latents, np.stack([codec.encode(video) for video in videos]), atol=1e-5)
    decoded = np.stack([codec.decode(clip) for clip in np.asarray(latents)])
    assert np.abs(decoded.astype(int) - np.asarray(decode_to_pictures(codec, latents))).max() <= 1


def test_the_next_reference_is_what_a_rollout_would_encode(codec: ConvAutoencoderCodec) -> None:
    latents = codec.encode(smooth_clip(9))
    expected = codec.encode(codec.decode(latents)[-1:])
    found = jax.jit(lambda codec, latents: codec.next_reference(latents))(codec, latents[None])
    assert found.shape == (1, 1, 4, 6, 8)
    np.testing.assert_allclose(found[0], expected, atol=1e-4)


def test_refuses_clips_that_do_not_fit(codec: ConvAutoencoderCodec) -> None:
    with pytest.raises(ValueError, match="t = 4 k"):
        codec.encode(smooth_clip(0)[:8])
    with pytest.raises(ValueError, match="sides in 8s"):
        codec.encode(smooth_clip(0)[:, :30])


def test_saved_codec_is_the_same(codec: ConvAutoencoderCodec, tmp_path: Path) -> None:
    codec.save(tmp_path)
    loaded = ConvAutoencoderCodec.load(tmp_path)
    assert loaded.hash == codec.hash
    np.testing.assert_array_equal(loaded.encode(smooth_clip(9)), codec.encode(smooth_clip(9)))


def test_padding_to_the_paper_s_size_is_lossless() -> None:
    video = np.random.default_rng(0).integers(0, 256, (2, 240, 320, 3), dtype=np.uint8)
    padded = to_model_size(video, 256, 320)
    assert padded.shape == (2, 256, 320, 3)
    np.testing.assert_array_equal(padded[:, 8:248], video)
    np.testing.assert_array_equal(to_camera_size(padded), video)


@pytest.mark.parametrize(
    ("height", "width", "padding"), [(16, 20, (0, 1, 0, 0)), (15, 22, (0, 0, 1, 1)), (15, 20, (0,) * 4), (18, 20, (1, 2, 0, 0))]
)
def test_edges_are_repeated(height: int, width: int, padding: tuple[int, ...]) -> None:
    video = np.random.default_rng(0).integers(0, 256, (2, 15, 20, 3), dtype=np.uint8)
    padded = [cv2.copyMakeBorder(frame, *padding, cv2.BORDER_REPLICATE) for frame in video]
    np.testing.assert_array_equal(to_model_size(video, height, width), padded)


@pytest.mark.parametrize(("height", "width"), [(128, 160), (64, 80), (120, 160), (96, 160)])
def test_resizing_keeps_the_geometry(height: int, width: int) -> None:
    """A bright square comes back where it was."""
    video = np.zeros((1, 240, 320, 3), np.uint8)
    video[:, 80:120, 200:280] = 255
    back = to_camera_size(to_model_size(video, height, width))
    rows, columns = np.nonzero(back[0, ..., 0] > 127)
    assert (rows.mean(), columns.mean()) == pytest.approx((99.5, 239.5), abs=0.5)
    assert np.abs(back.astype(int) - video).mean() < 8


# The autoencoder as a codec.


@pytest.fixture(scope="module")
def vae_codec(tmp_path_factory: pytest.TempPathFactory) -> WanVaeCodec:
    """The tiny autoencoder at random, read from a file of its own."""
    path = tmp_path_factory.mktemp("vae") / "vae.safetensors"
    vae = abstract_vae(VAES["tiny"])
    rng = np.random.default_rng(0)
    for leaf in jax.tree.leaves(nnx.state(vae, nnx.Param), is_leaf=lambda leaf: isinstance(leaf, nnx.Variable)):
        values = rng.standard_normal(leaf.shape, np.float32) / np.prod(leaf.shape[:-1]) ** 0.5
        leaf.set_value(jax.numpy.asarray(values if len(leaf.shape) > 1 else np.abs(values)))
    vae.latents_mean.set_value(jax.numpy.linspace(-1.0, 1.0, 48))
    save_vae(vae, path)
    return WanVaeCodec.open(settings(path))


def settings(weights: Path | None) -> CodecSettings:
    return CodecSettings("wan_vae", vae="tiny", weights=weights, chunk=2)


def test_autoencoder_codec(vae_codec: WanVaeCodec) -> None:
    video = smooth_clip(9, frames=13)
    latents = vae_codec.encode(video)
    assert latents.shape == (4, 4, 6, 48) and latents.dtype == np.float32
    decoded = vae_codec.decode(latents)
    assert decoded.shape == (13, 32, 48, 3) and decoded.dtype == np.uint8
    with pytest.raises(ValueError, match="t = 4 k"):
        vae_codec.encode(video[:12])


def test_the_autoencoder_s_next_reference(vae_codec: WanVaeCodec) -> None:
    """What a rollout would encode after decoding a clip to pictures."""
    latents = vae_codec.encode(smooth_clip(9, frames=13))
    found = jax.jit(lambda codec, latents: codec.next_reference(latents))(vae_codec, latents[None])
    expected = vae_codec.encode(vae_codec.decode(latents)[-1:])
    np.testing.assert_allclose(found[0], expected, atol=0.05)  # one gray level, where rounding falls the other way
    assert np.abs(found[0] - expected).mean() < 1e-3


def test_the_autoencoder_s_weights_are_no_constants_of_a_program(vae_codec: WanVaeCodec) -> None:
    assert sum(np.size(leaf) for leaf in jax.tree.leaves(vae_codec)) > 600_000


def test_saved_autoencoder_is_the_same(vae_codec: WanVaeCodec, tmp_path: Path) -> None:
    vae_codec.save(tmp_path)
    loaded = WanVaeCodec.load(tmp_path)
    assert loaded.hash == vae_codec.hash and loaded.size == vae_codec.size and loaded.chunk == 2
    np.testing.assert_array_equal(loaded.encode(smooth_clip(9)), vae_codec.encode(smooth_clip(9)))
    other = loaded.autoencoder
    other.latents_mean.set_value(jax.numpy.zeros(48))
    assert WanVaeCodec.from_vae(other).hash != vae_codec.hash
    assert WanVaeCodec.from_weights(tmp_path, VAES["tiny"], "bfloat16").hash != vae_codec.hash


def test_an_autoencoder_s_settings_are_checked(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"needs codec\.weights: Wan2\.2_VAE\.pth"):
        WanVaeCodec.open(settings(None))
    with pytest.raises(ConfigError, match="there are no weights at"):
        WanVaeCodec.open(settings(tmp_path / "nowhere.safetensors"))
    with pytest.raises(ConfigError, match="did you mean 'tiny'"):
        WanVaeCodec.latent_size(CodecSettings("wan_vae", vae="tny"))
