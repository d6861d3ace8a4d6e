"""The network against diffusers' WanTransformer3DModel on the CPU, random weights passed through our own saving and loading."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import golden
from tests.networks import draw_network, world_model
from tests.torch_ops import make_torchvision_importable
from xew.model.network import dit
from xew.model.network.dit import ModelSize, WorldModel
from xew.model.network.dit_layouts import load_dit, save_dit
from xew.model.network.spec import Visibility

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


def save_random(size: ModelSize, folder: Path) -> Path:
    """A folder in diffusers' format with all parameters N(0, 0.2); the network's own start leaves modulations near zero."""
    save_dit(draw_network(lambda: world_model(size, CHANNELS)), folder)
    return folder


def load_theirs(folder: Path) -> Any:
    """Diffusers' network, built from the config.json in a folder and strictly loaded."""
    operators = make_torchvision_importable()
    import diffusers
    from safetensors.torch import load_file

    model = diffusers.WanTransformer3DModel.from_config(diffusers.WanTransformer3DModel.load_config(folder))
    (file,) = folder.glob("*.safetensors")
    model.load_state_dict(load_file(file), strict=True)
    model.registered_operators = operators
    return model.eval().requires_grad_(False)


def use_float64_features(model: Any) -> None:
    """Give diffusers' network the time features of Wan's own code."""
    import torch

    class Float64Features(torch.nn.Module):
        def forward(self, timestep: torch.Tensor) -> torch.Tensor:
            angles = torch.outer(timestep.to(torch.float64), 10_000 ** (-torch.arange(128, dtype=torch.float64) / 128))
            return torch.cat([angles.cos(), angles.sin()], dim=1).to(torch.float32)

    model.condition_embedder.timesteps_proj = Float64Features()


def load_ours(folder: Path, size: ModelSize, *streams: str, **options: Any) -> WorldModel:
    model = world_model(size, CHANNELS, streams, seed=1, **options)
    load_dit(model, folder)
    return model


def normal(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape, np.float32)


def channels_first(latents: np.ndarray) -> Any:
    import torch

    return torch.tensor(np.ascontiguousarray(latents.transpose(0, 4, 1, 2, 3)))


def padded_text() -> np.ndarray:
    """Two instructions of different length, zeros behind them, which both networks attend to."""
    text = normal(3, 2, WORDS, TEXT)
    text[0, 2:] = 0
    return text


@pytest.mark.parity
@pytest.mark.parametrize(("head_dim", "grid"), [(12, (3, 4, 6)), (16, (1, 2, 2)), (16, (5, 6, 2)), (24, (2, 10, 6))])
@pytest.mark.parametrize("exact", [False, True])
def test_whole_network(exact: bool, head_dim: int, grid: tuple[int, int, int], tmp_path: Path) -> None:
    """Frame 0 is given t = 0 and the others their sample's (expand_timesteps of diffusers' pipelines)."""
    size, latents, text = size_of(head_dim), normal(2, 2, *grid, CHANNELS), padded_text()
    folder = save_random(size, tmp_path / "folder")
    levels = LEVELS if exact else LOW_LEVELS

    def run_theirs() -> dict[str, np.ndarray]:
        theirs = load_theirs(folder)
        import torch

        if exact:
            use_float64_features(theirs)
        moving = np.repeat(np.arange(grid[0]) > 0, grid[1] * grid[2] // 4)
        timesteps = np.where(moving[None], np.float32(1000) * levels[:, None], np.float32(0))
        inputs = {"timestep": torch.tensor(timesteps), "encoder_hidden_states": torch.tensor(text)}
        velocity = theirs(hidden_states=channels_first(latents), **inputs, return_dict=False)[0]
        return {"velocity": velocity.numpy().transpose(0, 2, 3, 4, 1)}

    expected = golden(f"dit_{head_dim}_{'x'.join(map(str, grid))}{'_exact' * exact}", run_theirs)["velocity"]
    assert np.abs(expected).max() > 2
    model = load_ours(folder, size)
    found = jax.jit(lambda *inputs: model(inputs[0], {}, *inputs[1:]))(latents, levels, text)
    np.testing.assert_allclose(found, expected, atol=EXACT_TOLERANCE if exact else TOLERANCE)


@pytest.mark.parity
@pytest.mark.parametrize("streams", [("action",), ("action", "embodiment")])
@pytest.mark.parametrize("visibility", ["joint", "one_way"])
def test_streams_are_plain_blocks_on_concatenated_tokens(
    streams: tuple[str, ...], visibility: Visibility, tmp_path: Path
) -> None:
    """Two and three streams, by diffusers' own blocks; seen one way, with a mask that forbids looking back at RGB."""
    size, grid, text = size_of(16), (3, 4, 6), padded_text()
    folder = save_random(size, tmp_path / "folder")
    model = load_ours(folder, size, *streams, visibility=visibility)
    latents = jnp.asarray(normal(2, 2, *grid, CHANNELS))
    conditions = {name: jnp.asarray(normal(4 + n, 2, *grid, CHANNELS)) for n, name in enumerate(streams)}
    tokens, levels, (cos, sin) = model.embed_streams(latents, conditions)
    rgb = tokens.shape[1] // (1 + len(streams))

    def run_their_blocks() -> dict[str, np.ndarray]:
        """From the same tokens, with diffusers' own positions for one stream, laid end to end."""
        theirs = load_theirs(folder)
        import torch

        use_float64_features(theirs)
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
        return {"hidden": hidden.numpy()}

    found = model.apply_blocks(
        tokens,
        model.modulation(model.embed_time(jnp.asarray(LEVELS))),
        levels,
        (cos, sin),
        model.context(jnp.asarray(text)),
        rgb,
    )
    expected = golden(f"dit_blocks_{len(streams)}_{visibility}", run_their_blocks)["hidden"]
    assert np.abs(expected).max() > 2
    np.testing.assert_allclose(found, expected, atol=EXACT_TOLERANCE)


def masked(attention: Any, mask: Any) -> Callable[..., Any]:
    """The forward of a diffusers attention with a mask that it is not given by its block."""
    plain = type(attention).forward

    def forward(hidden: Any, context: Any, _: Any, rotary: Any) -> Any:
        return plain(attention, hidden, context, mask[None, None], rotary)

    return forward


@pytest.mark.lab
def test_saved_folder_is_that_of_diffusers(tmp_path: Path) -> None:
    """Written by diffusers, loaded and saved by us: the same tensors."""
    from safetensors.torch import load_file, save_file

    size = size_of(16)
    theirs = load_theirs(save_random(size, tmp_path / "drawn")).state_dict()
    save_file({key: value.contiguous() for key, value in theirs.items()}, tmp_path / "weights.safetensors")
    save_dit(load_ours(tmp_path / "weights.safetensors", size), tmp_path / "folder")
    (file,) = (tmp_path / "folder").glob("*.safetensors")
    again = load_file(file)
    assert again.keys() == theirs.keys() and all(again[key].equal(value) for key, value in theirs.items())


@pytest.mark.lab
def test_rounded_time_is_that_of_float64() -> None:
    """All 50 levels of FlowWAM's sampler and all levels of training: bfloat16 of the float64 sinusoid of bfloat16 of t."""
    import torch

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
