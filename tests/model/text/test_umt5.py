"""The text encoder against transformers' UMT5EncoderModel, its names at full size, and what a wrong file says."""

import ast
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import save_file

from tests.golden import golden
from tests.torch_ops import make_torchvision_importable
from xew.config import ConfigError
from xew.model.network.dit import parameter_count
from xew.model.text.umt5 import HF_DUPLICATE, UMT5S, Umt5Encoder, hf_layout, load_umt5, official_layout, relative_buckets
from xew.model.weights.layout import checkpoint_shapes
from xew.model.weights.writing import save_weights

TINY = UMT5S["tiny"]
REFERENCE = Path(__file__).parents[1] / "reference"


def random_encoder(seed: int = 0) -> Umt5Encoder:
    """All parameters N(0, 0.2) about their starts, so that no part is idle."""
    encoder = Umt5Encoder(TINY, rngs=nnx.Rngs(seed))
    state = nnx.state(encoder)
    keys = iter(jax.random.split(jax.random.key(seed), 100))
    drawn = jax.tree.map(lambda leaf: 0.2 * jax.random.normal(next(keys), leaf.shape) + jnp.float32(leaf == 1), state)
    nnx.update(encoder, drawn)
    return encoder


def shapes(name: str) -> dict[str, tuple[int, ...]]:
    lines = (REFERENCE / name).read_text().splitlines()
    return {key: tuple(ast.literal_eval(shape)) for key, shape in (line.split("\t") for line in lines)}


def test_names_and_shapes_at_full_size() -> None:
    encoder = nnx.eval_shape(lambda: Umt5Encoder(UMT5S["xxl"], rngs=nnx.Rngs(0)))
    assert parameter_count(encoder) == 5_680_910_336
    assert checkpoint_shapes(encoder, official_layout(UMT5S["xxl"])) == shapes("keys_umt5_official.tsv")
    hf = shapes("keys_umt5_hf.tsv")
    assert hf.pop(HF_DUPLICATE) == hf["shared.weight"]
    assert checkpoint_shapes(encoder, hf_layout(UMT5S["xxl"])) == hf


def transformers_output(tensors: Path, ids: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """What transformers' encoder makes of a checkpoint in its names."""
    make_torchvision_importable()
    import torch
    import transformers
    from safetensors.torch import load_file

    config = transformers.UMT5Config(
        vocab_size=TINY.vocabulary, d_model=TINY.dim, d_kv=TINY.head_dim, d_ff=TINY.ffn_dim, num_layers=TINY.depth,
        num_heads=TINY.heads, relative_attention_num_buckets=32, relative_attention_max_distance=128,
        feed_forward_proj="gated-gelu",
    )  # fmt: skip
    model = transformers.UMT5EncoderModel(config).eval()
    missing, unexpected = model.load_state_dict(load_file(tensors), strict=False)
    assert set(missing) <= {HF_DUPLICATE} and not unexpected
    mask = torch.from_numpy((np.arange(ids.shape[1]) < lengths[:, None]).astype(np.int64))
    with torch.no_grad():
        return model(torch.from_numpy(ids.astype(np.int64)), attention_mask=mask).last_hidden_state.numpy()


@pytest.mark.parity
@pytest.mark.parametrize("length", [1, 12, 300], ids=["one", "short", "long"])
def test_parity_with_transformers(length: int, tmp_path: Path) -> None:
    encoder = random_encoder()
    save_weights(encoder, tmp_path / "hf.safetensors", hf_layout(TINY))
    rng = np.random.default_rng(length)
    ids = rng.integers(0, TINY.vocabulary, (3, length)).astype(np.int32)
    lengths = np.array([length, max(1, length // 2), max(1, length - 5)])
    weights = tmp_path / "hf.safetensors"
    expected = golden(f"umt5_{length}", lambda: {"hidden": transformers_output(weights, ids, lengths)})["hidden"]
    with jax.default_matmul_precision("highest"):
        found = np.asarray(load_umt5(tmp_path / "hf.safetensors", TINY, jnp.float32)(jnp.asarray(ids), jnp.asarray(lengths)))
    assert np.abs(expected).max() > 1
    for row, n in enumerate(lengths):
        np.testing.assert_allclose(found[row, :n], expected[row, :n], atol=5e-5)
        assert not found[row, n:].any()


def transformers_buckets() -> dict[str, np.ndarray]:
    """The bucket of each pair of 512 positions [512 512] in transformers."""
    make_torchvision_importable()
    import torch
    from transformers import UMT5Config
    from transformers.models.umt5.modeling_umt5 import UMT5Attention

    attention = UMT5Attention(UMT5Config(d_model=8, d_kv=4, num_heads=2), has_relative_attention_bias=True)
    relative = torch.arange(512)[None] - torch.arange(512)[:, None]
    return {"buckets": attention._relative_position_bucket(relative).numpy().astype(np.int16)}


@pytest.mark.parity
def test_buckets_of_all_distances_are_those_of_transformers() -> None:
    np.testing.assert_array_equal(relative_buckets(512, 32, 128), golden("umt5_buckets", transformers_buckets)["buckets"])


@pytest.mark.parametrize(
    "name",
    ["official.safetensors", "hf.safetensors", "hf_twice", "hf_other", pytest.param("official.pth", marks=pytest.mark.lab)],
)
def test_every_published_format_loads(name: str, tmp_path: Path) -> None:
    encoder = random_encoder(1)
    path = tmp_path / name
    if name.startswith("official"):
        save_weights(encoder, tmp_path / "official.safetensors", official_layout(TINY))
    else:
        path = path.with_suffix(".safetensors")
        save_weights(encoder, path, hf_layout(TINY))
    if path.suffix == ".pth":
        import torch
        from safetensors.torch import load_file

        torch.save(load_file(tmp_path / "official.safetensors"), path)
    if name in ("hf_twice", "hf_other"):
        from safetensors.numpy import load_file as load_arrays

        tensors = load_arrays(path)
        tensors[HF_DUPLICATE] = tensors["shared.weight"].copy()
        if name == "hf_other":
            del tensors["shared.weight"]
        save_file(tensors, path)
    loaded = load_umt5(path, TINY, jnp.float32)
    for read, written in zip(jax.tree.leaves(nnx.state(loaded)), jax.tree.leaves(nnx.state(encoder)), strict=True):
        np.testing.assert_array_equal(read, written)


def test_padding_changes_nothing() -> None:
    encoder = random_encoder()
    ids = jnp.arange(1, 9, dtype=jnp.int32)[None]
    padded = jnp.concatenate([ids, jnp.full((1, 24), 7, jnp.int32)], axis=1)
    found = encoder(padded, jnp.array([8]))
    np.testing.assert_allclose(found[:, :8], encoder(ids, jnp.array([8])), atol=1e-5)
    assert not np.asarray(found[:, 8:]).any()


def test_bfloat16_is_near(tmp_path: Path) -> None:
    encoder = random_encoder()
    save_weights(encoder, tmp_path / "w.safetensors", official_layout(TINY))
    ids, lengths = jnp.arange(16, dtype=jnp.int32)[None], jnp.array([16])
    half = load_umt5(tmp_path / "w.safetensors", TINY)
    assert {leaf.dtype for leaf in jax.tree.leaves(nnx.state(half))} == {jnp.dtype(jnp.bfloat16)}
    exact = np.asarray(encoder(ids, lengths))
    found = np.asarray(half(ids, lengths))
    assert found.dtype == np.float32
    assert np.corrcoef(found.ravel(), exact.ravel())[0, 1] > 0.99


def test_a_wrong_file_says_what_differs(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no weights at"):
        load_umt5(tmp_path / "none.safetensors", TINY)
    save_weights(random_encoder(), tmp_path / "w.safetensors", official_layout(TINY))
    with pytest.raises(ConfigError, match=r"token_embedding.*\[97, 32\].*\[256384, 4096\]"):
        load_umt5(tmp_path / "w.safetensors", UMT5S["xxl"])
    save_file({"foreign": np.zeros(3, np.float32)}, tmp_path / "other.safetensors")
    with pytest.raises(ConfigError, match=r"missing: shared\.weight"):
        load_umt5(tmp_path / "other.safetensors", TINY)
