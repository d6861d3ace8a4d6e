"""The head behind the decoder: what it is given, what it changes, its file, and that it shows no later frame of the scene."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from tests.model.codecs.test_codec import smooth_clip
from xew.config import ConfigError
from xew.model.codecs.autoencoders import ConvAutoencoderCodec
from xew.model.codecs.codec import load_kept_codec
from xew.model.codecs.contract import GivenFrames, given_frames
from xew.model.codecs.conv_autoencoder import HEAD_FILE, ConvAutoencoder
from xew.model.codecs.render_head import SOURCES, HeadSize, RenderHead

SIZE = HeadSize((8, 8), (1, 1))
FRAMES = 9


@pytest.fixture(scope="module")
def plain(random_autoencoder: ConvAutoencoder) -> ConvAutoencoderCodec:
    return ConvAutoencoderCodec.from_autoencoder(random_autoencoder)


def make_head(bias: float | None = None, source: int = 0) -> RenderHead:
    """A head of random weights; or, with a bias, one whose only output is the gate of one source."""
    head = RenderHead(SIZE, rngs=nnx.Rngs(0))
    kernel = head.conv_out.kernel
    if bias is None:
        kernel.set_value(0.1 * jax.random.normal(jax.random.key(3), kernel.shape))
        return head
    outputs = jnp.zeros((SOURCES + 3, 2, 2)).at[source].set(bias)
    head.conv_out.bias.set_value(outputs.ravel())
    return head


def make_given() -> GivenFrames:
    """A render that differs in every frame, and a first frame."""
    render = np.random.default_rng(1).integers(0, 200, (FRAMES, 32, 48, 3), dtype=np.uint8)
    return given_frames(render, smooth_clip(4)[:1], 0, FRAMES)


def test_a_new_head_changes_nothing(plain: ConvAutoencoderCodec) -> None:
    latents = plain.encode(smooth_clip(9, frames=FRAMES))
    codec = plain.with_head(RenderHead(SIZE, rngs=nnx.Rngs(0)))
    np.testing.assert_array_equal(codec.decode(latents, make_given()), plain.decode(latents))


def test_without_a_render_the_head_is_not_used(plain: ConvAutoencoderCodec) -> None:
    latents = plain.encode(smooth_clip(9, frames=FRAMES))
    codec = plain.with_head(make_head())
    np.testing.assert_array_equal(codec.decode(latents), plain.decode(latents))
    assert np.abs(codec.decode(latents, make_given()).astype(int) - plain.decode(latents)).mean() > 1
    np.testing.assert_array_equal(plain.decode(latents, make_given()), plain.decode(latents))


@pytest.mark.parametrize(("source", "shift"), [(0, 0), (1, 1), (2, 2)])
def test_an_open_gate_shows_the_render_of_its_frame(plain: ConvAutoencoderCodec, source: int, shift: int) -> None:
    """Sources 0, 1 and 2 are the render one frame before, at and one frame after the decoded frame."""
    given = make_given()
    decoded = plain.with_head(make_head(1.0, source)).decode(plain.encode(smooth_clip(9, frames=FRAMES)), given)
    np.testing.assert_array_equal(decoded, given.render[shift : shift + FRAMES])


def test_an_open_gate_shows_the_first_frame(plain: ConvAutoencoderCodec) -> None:
    given = make_given()
    decoded = plain.with_head(make_head(1.0, 3)).decode(plain.encode(smooth_clip(9, frames=FRAMES)), given)
    np.testing.assert_array_equal(decoded, np.repeat(given.scene, FRAMES, axis=0))


def test_a_scene_may_have_a_frame_for_each_frame(plain: ConvAutoencoderCodec) -> None:
    """A still scene of many frames is that of one, and an open gate shows the scene of its frame."""
    given, latents = make_given(), plain.encode(smooth_clip(9, frames=FRAMES))
    still = given._replace(scene=given.scene.repeat(FRAMES, axis=0))
    codec = plain.with_head(make_head())
    np.testing.assert_array_equal(codec.decode(latents, still), codec.decode(latents, given))
    moving = given._replace(scene=given.render[1:-1])
    np.testing.assert_array_equal(plain.with_head(make_head(1.0, 3)).decode(latents, moving), moving.scene)


def test_a_frame_depends_on_the_render_around_it_alone(plain: ConvAutoencoderCodec) -> None:
    given, changed = make_given(), make_given()
    changed.render[6] = 255 - changed.render[6]  # the render of frame 5
    latents, codec = plain.encode(smooth_clip(9, frames=FRAMES)), plain.with_head(make_head())
    before, after = (codec.decode(latents, pictures).astype(int) for pictures in (given, changed))
    differs = (before != after).any(axis=(1, 2, 3))
    np.testing.assert_array_equal(np.flatnonzero(differs), [4, 5, 6])


@pytest.mark.parametrize(("start", "expected"), [(0, [0, 0, 1, 2]), (3, [2, 3, 4, 4]), (9, [4, 4, 4, 4])])
def test_ends_of_the_render_are_repeated(start: int, expected: list[int]) -> None:
    render = np.arange(5, dtype=np.uint8)[:, None, None, None].repeat(3, axis=-1)
    given = given_frames(render, render[:1], start, 2)
    assert given.render[..., 0].ravel().tolist() == expected and given.scene.ravel().tolist() == [0, 0, 0]
    assert given_frames(render, render, start, 2).scene[..., 0].ravel().tolist() == [min(start, 4), min(start + 1, 4)]


def test_latents_keep_their_hash_and_decoded_frames_do_not(plain: ConvAutoencoderCodec) -> None:
    codec, other = plain.with_head(make_head()), plain.with_head(make_head(1.0))
    assert plain.hash == codec.hash == other.hash == plain.decoder_hash
    assert len({plain.decoder_hash, codec.decoder_hash, other.decoder_hash}) == 3


def test_a_saved_codec_keeps_its_head(plain: ConvAutoencoderCodec, tmp_path: Path) -> None:
    """Kernels are stored in bfloat16, so those of this head are rounded before."""
    graph, params = nnx.split(make_head())
    rounded = jax.tree.map(lambda leaf: leaf.astype(jnp.bfloat16).astype(jnp.float32), params)
    codec = plain.with_head(nnx.merge(graph, rounded))
    codec.save(tmp_path)
    loaded = ConvAutoencoderCodec.load(tmp_path)
    assert loaded.sees_render and loaded.head.size == SIZE
    latents, given = plain.encode(smooth_clip(9, frames=FRAMES)), make_given()
    loaded = replace(loaded, params=codec.params)  # the autoencoder's kernels are rounded, too
    np.testing.assert_array_equal(loaded.decode(latents, given), codec.decode(latents, given))
    loaded.save(tmp_path / "again")
    assert ConvAutoencoderCodec.load(tmp_path / "again").decoder_hash == loaded.decoder_hash


def test_a_lost_head_is_named(plain: ConvAutoencoderCodec, tmp_path: Path) -> None:
    plain.with_head(make_head()).save(tmp_path / "codec")
    (tmp_path / "codec" / HEAD_FILE).unlink()
    with pytest.raises(ConfigError, match=f"lacks its codec \\({HEAD_FILE}\\); copy it"):
        load_kept_codec(ConvAutoencoderCodec, tmp_path / "codec", "copy it")
