"""A changed first frame and the latents behind it: every codec says what the same later frames are then."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.model.codecs.test_codec import smooth_clip
from xew.model.codecs.autoencoders import ConvAutoencoderCodec
from xew.model.codecs.codec import CODECS
from xew.model.codecs.contract import Codec, decode_to_pictures
from xew.model.codecs.conv_autoencoder import AUTOENCODERS, ConvAutoencoder
from xew.model.codecs.patches import PatchCodec
from xew.model.diffusion.flow_matching import put_first
from xew.model.training.step import estimate_clean, sample_pairs


@pytest.fixture(scope="module")
def patches() -> PatchCodec:
    codec = PatchCodec.fit([smooth_clip(seed) for seed in range(8)], spatial_factor=8, channels=24)
    return jax.tree.map(jnp.asarray, codec)  # as in a compiled step


@pytest.fixture(scope="module")
def groups(random_autoencoder: ConvAutoencoder) -> ConvAutoencoderCodec:
    return ConvAutoencoderCodec.from_autoencoder(random_autoencoder)


def later(codec: Codec, latents: jax.Array) -> np.ndarray:
    """Frames 1 and on of latents [1 k y x c], float32 [4 k h w 3]."""
    return np.asarray(decode_to_pictures(codec, latents)[0, 1:]).astype(np.float32)


def test_all_codecs_are_handled() -> None:
    assert {name for name, kind in CODECS.items() if kind.relative} == {"patch_pca"}


def test_differences_are_taken_from_the_shown_frame(patches: PatchCodec) -> None:
    """With a reference noise of .1, later frames are off by far less than if the targets stayed relative to the true frame."""
    true = jnp.asarray(patches.encode(smooth_clip(9))[None])
    shown = true[:, :1] + 0.1 * jax.random.normal(jax.random.key(0), true[:, :1].shape, jnp.float32)
    assert not np.allclose(patches.replace_reference(true, shown)[:, 1:], true[:, 1:])
    expected = later(patches, true)
    mended = np.abs(later(patches, patches.replace_reference(true, shown)) - expected).mean()
    before = np.abs(later(patches, put_first(true, shown)) - expected).mean()
    assert mended < 0.7 * before, (mended, before)
    back = patches.replace_reference(patches.replace_reference(true, shown), true[:, :1])
    np.testing.assert_allclose(back, true, atol=1e-5)


def test_with_all_components_nothing_is_lost() -> None:
    clips = [np.random.default_rng(seed).integers(0, 256, (9, 8, 8, 3), dtype=np.uint8) for seed in range(40)]
    codec = PatchCodec.fit(clips, spatial_factor=4, channels=48)
    # Changes of the first frame that all four differences of a group share are among the leading directions here.
    moved = [np.concatenate([clip[:1], np.repeat(255 - clip[:1], 8, 0)]) for clip in clips]
    codec = PatchCodec(4, codec.first, PatchCodec.fit(moved, spatial_factor=4, channels=48).later)
    codec = jax.tree.map(jnp.asarray, codec)
    true, other = (jnp.asarray(codec.encode(clip)[None]) for clip in moved[:2])
    replaced = codec.replace_reference(true, other[:, :1])
    np.testing.assert_allclose(later(codec, replaced), later(codec, true), atol=1)


def test_groups_stand_alone(groups: ConvAutoencoderCodec) -> None:
    """Neither a later latent nor a later frame depends on the first frame, so a changed reference changes no target."""
    video, changed = smooth_clip(9), smooth_clip(9)
    changed[0] = 255 - changed[0]
    true, other = (jnp.asarray(groups.encode(clip)[None]) for clip in (video, changed))
    assert not np.allclose(true[:, 0], other[:, 0])
    np.testing.assert_array_equal(true[:, 1:], other[:, 1:])
    np.testing.assert_array_equal(groups.replace_reference(true, other[:, :1]), other)
    np.testing.assert_array_equal(later(groups, put_first(true, other[:, :1])), later(groups, true))


def test_estimate_of_a_clip_is_behind_its_true_first_frame(patches: PatchCodec) -> None:
    """Where the velocity is right, the estimate decodes to the clip, though its targets are behind a perturbed reference."""
    true = jnp.asarray(patches.encode(smooth_clip(9))[None])
    pair = sample_pairs(jax.random.split(jax.random.key(1), 1), true, 5.0, patches.replace_reference)
    found = estimate_clean(true, pair, pair.velocity, patches.replace_reference)
    np.testing.assert_allclose(found, true, atol=1e-4)
    assert not np.allclose(estimate_clean(true, pair, pair.velocity), true, atol=1e-4)
    assert AUTOENCODERS["tiny"].spatial_factor == 16
