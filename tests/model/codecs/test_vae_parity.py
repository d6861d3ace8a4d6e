"""The autoencoder beside diffusers' AutoencoderKLWan: the same numbers from the same weights, by both kinds of file."""

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from tests.golden import golden
from tests.torch_ops import make_torchvision_importable
from xew.config import ConfigError
from xew.model.codecs.vae import VAES, VaeSize, VideoVae, abstract_vae
from xew.model.codecs.vae_layouts import diffusers_layout, load_vae, official_layout
from xew.model.weights.layout import checkpoint_shapes
from xew.model.weights.writing import save_weights

REFERENCE = Path(__file__).parents[1] / "reference"
SIZE = VaeSize(4, encoder_dim=16, decoder_dim=16, multipliers=(1, 2, 4, 4), halve_time=(False, True, True), blocks=1)
TOLERANCE = 1e-5


@pytest.fixture(scope="module", autouse=True)
def exact() -> Iterator[None]:
    with jax.default_matmul_precision("highest"):
        yield


def draw(size: VaeSize) -> VideoVae:
    """Random weights that leave no layer without effect."""
    vae = abstract_vae(size)
    rng = np.random.default_rng(0)
    for path, leaf in nnx.to_flat_state(nnx.state(vae, nnx.Param)):
        values = rng.standard_normal(leaf.shape, np.float32)
        if path[-1] == "gamma":
            values = rng.uniform(0.5, 1.5, leaf.shape).astype(np.float32)
        elif path[-1] == "bias":
            values *= 0.1
        else:
            values /= np.prod(leaf.shape[:-1]) ** 0.5
        leaf.set_value(jnp.asarray(values))
    return vae


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """diffusion_pytorch_model.safetensors under diffusers' names."""
    folder = tmp_path_factory.mktemp("vae")
    save_weights(draw(SIZE), folder / "diffusion_pytorch_model.safetensors", diffusers_layout(abstract_vae(SIZE)))
    return folder


@pytest.fixture(scope="module")
def ours(folder: Path) -> VideoVae:
    vae = abstract_vae(SIZE)
    load_vae(vae, folder)
    return vae


@functools.cache
def load_theirs(folder: Path) -> Any:
    """AutoencoderKLWan with the weights of the folder, strictly loaded."""
    operators = make_torchvision_importable()
    import diffusers
    from safetensors.torch import load_file

    model = diffusers.AutoencoderKLWan(
        base_dim=SIZE.encoder_dim,
        decoder_base_dim=SIZE.decoder_dim,
        z_dim=SIZE.channels,
        dim_mult=list(SIZE.multipliers),
        num_res_blocks=SIZE.blocks,
        temperal_downsample=list(SIZE.halve_time),
        is_residual=True,
        in_channels=12,
        out_channels=12,
        patch_size=2,
        scale_factor_spatial=16,
        scale_factor_temporal=4,
        latents_mean=[0.0] * SIZE.channels,
        latents_std=[1.0] * SIZE.channels,
    )
    model.load_state_dict(load_file(folder / "diffusion_pytorch_model.safetensors"), strict=True)
    model.registered_operators = operators
    return model.eval().requires_grad_(False)


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(sum(shape)).uniform(-1, 1, shape).astype(np.float32)


jitted_encode = jax.jit(lambda vae, video: vae.moments(video))
jitted_decode = jax.jit(lambda vae, latents: vae.decode(latents))


def to_torch(video: np.ndarray) -> Any:
    """[b t h w c] -> [b c t h w]."""
    import torch

    return torch.from_numpy(np.moveaxis(video, -1, 1).copy())


def from_torch(video: Any) -> np.ndarray:
    return np.moveaxis(video.numpy(), 1, -1)


CLIPS = [(1, 32, 48), (5, 48, 16), (9, 32, 32), (13, 16, 48)]


@pytest.mark.parity
@pytest.mark.parametrize(("frames", "height", "width"), CLIPS)
def test_encoder(ours: VideoVae, folder: Path, frames: int, height: int, width: int) -> None:
    video = noise(2, frames, height, width, 3)

    def encode() -> dict[str, np.ndarray]:
        latents = load_theirs(folder).encode(to_torch(video)).latent_dist
        return {"mean": from_torch(latents.mode()), "log_variance": from_torch(latents.logvar)}

    expected = golden(f"vae_encoder_{frames}", encode)
    mean, log_variance = jitted_encode(ours, video)
    assert np.abs(mean).max() > 0.5
    np.testing.assert_allclose(mean, expected["mean"], atol=TOLERANCE)
    np.testing.assert_allclose(log_variance, expected["log_variance"], atol=TOLERANCE)


@pytest.mark.parity
@pytest.mark.parametrize(("frames", "height", "width"), CLIPS)
def test_decoder(ours: VideoVae, folder: Path, frames: int, height: int, width: int) -> None:
    latents = noise(2, (frames - 1) // 4 + 1, height // 16, width // 16, SIZE.channels)
    decoded = jitted_decode(ours, latents)
    assert decoded.shape == (2, frames, height, width, 3)
    assert np.std(decoded) > 0.1

    def decode() -> dict[str, np.ndarray]:
        return {"video": from_torch(load_theirs(folder).decode(to_torch(latents)).sample)}

    np.testing.assert_allclose(decoded, golden(f"vae_decoder_{frames}", decode)["video"], atol=TOLERANCE)


@pytest.mark.parametrize("suffix", ["vae.safetensors", pytest.param("Wan2.2_VAE.pth", marks=pytest.mark.lab)])
def test_official_file(ours: VideoVae, tmp_path: Path, suffix: str) -> None:
    """Written under Wan2.2's names, as safetensors and as the .pth that is published, and read back without a change."""
    path = tmp_path / suffix
    save_weights(ours, path.with_suffix(".safetensors"), official_layout(ours))
    if path.suffix == ".pth":
        import torch
        from safetensors.torch import load_file

        torch.save(load_file(path.with_suffix(".safetensors")), path)
    vae = abstract_vae(SIZE)
    load_vae(vae, path)
    for mine, read in zip(jax.tree.leaves(nnx.state(ours)), jax.tree.leaves(nnx.state(vae)), strict=True):
        np.testing.assert_array_equal(mine, read)


@pytest.mark.lab
def test_diffusers_reads_what_is_written(ours: VideoVae, folder: Path, tmp_path: Path) -> None:
    theirs = load_theirs(folder)
    import diffusers
    import torch

    theirs.save_config(tmp_path)
    save_weights(ours, tmp_path / "diffusion_pytorch_model.safetensors", diffusers_layout(ours))
    read = diffusers.AutoencoderKLWan.from_pretrained(tmp_path)
    for name, tensor in theirs.state_dict().items():
        assert torch.equal(read.state_dict()[name], tensor), name


@pytest.mark.parametrize(("kind", "layout"), [("official", official_layout), ("diffusers", diffusers_layout)])
def test_every_key_and_shape_at_full_size(kind: str, layout: Any) -> None:
    vae = abstract_vae(VAES["wan22"])
    lines = (REFERENCE / f"keys_vae22_{kind}.tsv").read_text().splitlines()
    expected = {key: tuple(int(n) for n in shape.strip("[]").split(",")) for key, shape in (line.split("\t") for line in lines)}
    assert len(expected) == 196
    assert checkpoint_shapes(vae, layout(vae)) == expected
    assert sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(nnx.state(vae, nnx.Param))) == 704_688_668


def test_a_wrong_file_says_what_differs(ours: VideoVae, tmp_path: Path) -> None:
    save_weights(ours, tmp_path / "vae.safetensors", diffusers_layout(ours))
    larger = VaeSize(4, encoder_dim=16, decoder_dim=32, multipliers=(1, 2, 4, 4), halve_time=(False, True, True), blocks=1)
    with pytest.raises(ConfigError, match=r"decoder\.conv_in\.bias is \[64\], .*decoder\.conv_in\.bias needs \[128\]"):
        load_vae(abstract_vae(larger), tmp_path / "vae.safetensors")
    with pytest.raises(ConfigError, match="no weights at"):
        load_vae(abstract_vae(SIZE), tmp_path / "nowhere.pth")


@pytest.mark.lab
def test_another_torch_file_is_refused(tmp_path: Path) -> None:
    import torch

    torch.save({"weight": torch.zeros(3)}, tmp_path / "other.pth")
    with pytest.raises(ConfigError, match=r"not an autoencoder of Wan2\.2: it holds weight"):
        load_vae(abstract_vae(SIZE), tmp_path / "other.pth")
