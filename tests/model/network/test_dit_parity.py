"""The network against diffusers' WanTransformer3DModel on the CPU, random weights passed through our own loading."""

from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from tests.torch_ops import make_torchvision_importable

torch = pytest.importorskip("torch")
operators = make_torchvision_importable()
diffusers = pytest.importorskip("diffusers")

from safetensors.torch import load_file, save_file  # noqa: E402

from tests.networks import world_model  # noqa: E402
from xew.model.network import dit  # noqa: E402
from xew.model.network.dit import ModelSize, WorldModel  # noqa: E402
from xew.model.network.dit_layouts import diffusers_config, load_dit, save_dit  # noqa: E402
from xew.model.network.spec import Visibility  # noqa: E402

CHANNELS, TEXT, WORDS = 8, 24, 5
TOLERANCE = 1e-4
"""Absolute, on values of a scale of 5 to 10, against diffusers as it is."""
EXACT_TOLERANCE = 3e-5
"""Where diffusers is given Wan's own float64 time features instead of its float32 ones, whose error random weights enlarge."""
LEVELS = np.array([0.25, 0.937], np.float32)
LOW_LEVELS = np.array([0.1, 0.3], np.float32)


@pytest.fixture(autouse=True)
def full_precision() -> Iterator[None]:
    with jax.default_matmul_precision("highest"):
        yield


def size_of(head_dim: int) -> ModelSize:
    """Norms with another eps than Wan's, large enough that each of them is seen in the output."""
    return ModelSize(dim=2 * head_dim, depth=2, heads=2, ffn_dim=48, text_dim=TEXT, text_tokens=WORDS, epsilon=1e-2)


def reference(size: ModelSize, seed: int = 0) -> torch.nn.Module:
    """Diffusers' network with every parameter N(0, 0.2): its own start leaves modulations too small to matter."""
    arguments = diffusers_config(nnx.eval_shape(lambda: world_model(size, CHANNELS)))
    model = diffusers.WanTransformer3DModel(**{key: value for key, value in arguments.items() if key[0] != "_"}).eval()
    torch.manual_seed(seed)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return model.requires_grad_(False)


class Float64Features(torch.nn.Module):
    """Time features as in Wan's own code."""

    def forward(self, timestep: torch.Tensor) -> torch.Tensor:
        angles = torch.outer(timestep.to(torch.float64), 10_000 ** (-torch.arange(128, dtype=torch.float64) / 128))
        return torch.cat([angles.cos(), angles.sin()], dim=1).to(torch.float32)


def ours(theirs: torch.nn.Module, size: ModelSize, path: Path, *streams: str, **options: object) -> WorldModel:
    save_file({key: value.contiguous() for key, value in theirs.state_dict().items()}, path)
    model = world_model(size, CHANNELS, streams, seed=1, **options)
    load_dit(model, path)
    return model


def normal(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape, np.float32)


def channels_first(latents: np.ndarray) -> torch.Tensor:
    return torch.tensor(np.ascontiguousarray(latents.transpose(0, 4, 1, 2, 3)))


def padded_text() -> np.ndarray:
    """Two instructions of different length, zeros behind them, which both networks attend to."""
    text = normal(3, 2, WORDS, TEXT)
    text[0, 2:] = 0
    return text


@pytest.mark.parametrize(("head_dim", "grid"), [(12, (3, 4, 6)), (16, (1, 2, 2)), (16, (5, 6, 2)), (24, (2, 10, 6))])
@pytest.mark.parametrize("exact", [False, True])
def test_whole_network(exact: bool, head_dim: int, grid: tuple[int, int, int], tmp_path: Path) -> None:
    """Frame 0 is told t = 0 and the others their sample's (expand_timesteps of diffusers' pipelines)."""
    size, latents, text = size_of(head_dim), normal(2, 2, *grid, CHANNELS), padded_text()
    theirs = reference(size)
    model = ours(theirs, size, tmp_path / "weights.safetensors")
    levels = LEVELS if exact else LOW_LEVELS
    if exact:
        theirs.condition_embedder.timesteps_proj = Float64Features()
    moving = np.repeat(np.arange(grid[0]) > 0, grid[1] * grid[2] // 4)
    timesteps = np.where(moving[None], np.float32(1000) * levels[:, None], np.float32(0))
    with torch.no_grad():
        expected = theirs(
            hidden_states=channels_first(latents),
            timestep=torch.tensor(timesteps),
            encoder_hidden_states=torch.tensor(text),
            return_dict=False,
        )[0]
    expected = expected.numpy().transpose(0, 2, 3, 4, 1)
    assert np.abs(expected).max() > 2
    found = jax.jit(lambda *inputs: model(inputs[0], {}, *inputs[1:]))(latents, levels, text)
    np.testing.assert_allclose(found, expected, atol=EXACT_TOLERANCE if exact else TOLERANCE)


@pytest.mark.parametrize("streams", [("action",), ("action", "embodiment")])
@pytest.mark.parametrize("visibility", ["joint", "one_way"])
def test_streams_are_plain_blocks_on_concatenated_tokens(
    streams: tuple[str, ...], visibility: Visibility, tmp_path: Path
) -> None:
    """Two and three streams, by diffusers' own blocks; seen one way, with a mask that forbids looking back at RGB."""
    size, grid, text = size_of(16), (3, 4, 6), padded_text()
    theirs = reference(size)
    theirs.condition_embedder.timesteps_proj = Float64Features()
    model = ours(theirs, size, tmp_path / "weights.safetensors", *streams, visibility=visibility)
    latents = jnp.asarray(normal(2, 2, *grid, CHANNELS))
    conditions = {name: jnp.asarray(normal(4 + n, 2, *grid, CHANNELS)) for n, name in enumerate(streams)}
    tokens, levels, (cos, sin) = model.embed_streams(latents, conditions)
    rgb = tokens.shape[1] // (1 + len(streams))

    # Diffusers, from the same tokens: its own positions for one stream, laid end to end.
    with torch.no_grad():
        rotary = theirs.rope(channels_first(np.asarray(latents)))
        rotary = tuple(torch.cat([table] * (1 + len(streams)), dim=1) for table in rotary)
        timesteps = torch.tensor(np.where(levels[None] == 0, np.float32(0), np.float32(1000) * LEVELS[:, None]))
        condition = theirs.condition_embedder
        _, projected, context, _ = condition(timesteps.flatten(), torch.tensor(text), timestep_seq_len=levels.size)
        projected = projected.unflatten(2, (6, -1))
        hidden = torch.tensor(np.array(tokens))
        for block in theirs.blocks:
            if visibility == "one_way":
                mask = np.ones((levels.size, levels.size), bool)
                mask[rgb:, :rgb] = False
                block.attn1.forward = masked(block.attn1, torch.tensor(mask))
            hidden = block(hidden, context, projected, rotary)

    found = model.apply_blocks(
        tokens,
        model.modulation(model.embed_time(jnp.asarray(LEVELS))),
        levels,
        (cos, sin),
        model.context(jnp.asarray(text)),
        rgb,
    )
    assert np.abs(hidden.numpy()).max() > 2
    np.testing.assert_allclose(found, hidden.numpy(), atol=EXACT_TOLERANCE)


def masked(attention: torch.nn.Module, mask: torch.Tensor) -> object:
    """The forward of a diffusers attention with a mask that it is not given by its block."""
    plain = type(attention).forward

    def forward(hidden: torch.Tensor, context: object, _: object, rotary: object) -> torch.Tensor:
        return plain(attention, hidden, context, mask[None, None], rotary)

    return forward


def test_saved_folder_is_that_of_diffusers(tmp_path: Path) -> None:
    """Written by us, built from the config.json beside it and strictly loaded: the same network again."""
    size = size_of(16)
    theirs = reference(size)
    save_dit(ours(theirs, size, tmp_path / "weights.safetensors"), tmp_path / "folder")
    again = diffusers.WanTransformer3DModel.from_config(diffusers.WanTransformer3DModel.load_config(tmp_path / "folder"))
    (file,) = (tmp_path / "folder").glob("*.safetensors")
    again.load_state_dict(load_file(file), strict=True)
    assert all(torch.equal(again.state_dict()[key], value) for key, value in theirs.state_dict().items())


def test_rounded_time_is_that_of_float64() -> None:
    """All 50 levels of FlowWAM's sampler and all levels of training: bfloat16 of the float64 sinusoid of bfloat16 of t."""
    shifted = [5 * u / (1 + 4 * u) for steps in (50, 1000) for u in np.linspace(1, 0, steps + 1)[:-1]]
    timesteps = torch.tensor(1000 * np.array(shifted, np.float32)).to(torch.bfloat16)
    frequencies = torch.pow(10000, -torch.arange(128, dtype=torch.float64).div(128))
    angles = torch.outer(timesteps.to(torch.float64), frequencies)
    expected = torch.cat([torch.cos(angles), torch.sin(angles)], dim=1).to(torch.bfloat16).to(torch.float32).numpy()
    found = np.asarray(dit.rounded_sinusoid(1000 * jnp.asarray(np.array(shifted, np.float32))))
    wrong = found != expected
    assert wrong.mean() < 1e-4  # ties that float32 rounds the other way
    np.testing.assert_allclose(found, expected, atol=2**-8)
    exact = np.asarray(dit.sinusoid(1000 * jnp.asarray(np.array(shifted, np.float32))))
    assert np.abs(exact - expected).max() > 0.5  # the rounding of t is felt: by up to 2 from 512 on


def test_time_features_are_as_exact_as_float64() -> None:
    timesteps = np.random.default_rng(0).uniform(0, 1000, 500).astype(np.float32)
    found = np.asarray(jax.jit(dit.sinusoid)(jnp.asarray(timesteps)))
    angles = np.outer(timesteps.astype(np.float64), 10_000.0 ** (-np.arange(128) / 128))
    np.testing.assert_allclose(found, np.concatenate([np.cos(angles), np.sin(angles)], axis=1), atol=3e-7)


def test_rounded_time_is_an_option() -> None:
    models = [world_model(size_of(16), CHANNELS, time=time) for time in ("exact", "flowwam")]
    exact, rounded = (np.asarray(model.embed_time(jnp.asarray(LEVELS))) for model in models)
    assert np.abs(exact[:, 1] - rounded[:, 1]).max() > 1e-3
