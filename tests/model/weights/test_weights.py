"""Checkpoints in the formats of others: read, refused, written back; and the network's names and shapes at full size."""

import ast
import json
import pickle
from pathlib import Path

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import load_file, save_file

from tests.golden import golden
from tests.networks import world_model
from xew.config import ConfigError
from xew.metrics.estimators.adapters import read_state_dict
from xew.model.network.dit import MODELS, WorldModel
from xew.model.network.dit_layouts import (
    check_dit,
    dit_layout,
    find_naming,
    flowwam_layout,
    load_dit,
    load_dit_params,
    save_dit,
    wan_layout,
)
from xew.model.network.mechanisms import MECHANISMS
from xew.model.weights import reading, writing
from xew.model.weights.filling import fill
from xew.model.weights.layout import Source, checkpoint_shapes
from xew.model.weights.reading import read_tensors
from xew.model.weights.writing import save_weights

REFERENCE = Path(__file__).parents[1] / "reference"
CHANNELS = 3
STREAMS = ("action", "embodiment")
Arrays = dict[str, np.ndarray]


class Leaves(nnx.Module):
    """One leaf of every layout."""

    def __init__(self, rngs: nnx.Rngs) -> None:
        self.linear, self.convolution = nnx.Linear(2, 3, rngs=rngs), nnx.Conv(2, 5, (3, 1, 2), use_bias=False, rngs=rngs)
        self.patches, self.gamma = nnx.Linear(2 * 4, 3, use_bias=False, rngs=rngs), nnx.Param(jnp.ones(4))
        self.embedding = nnx.Param(jnp.ones(4, jnp.bfloat16))
        self.layers = nnx.List([nnx.Param(jnp.ones((2, 3, 4))), nnx.Variable(jnp.ones(2))])


LAYOUT = {
    "linear.kernel": Source(("a.weight",), "linear"),
    "linear.bias": Source(("a.bias",)),
    "convolution.kernel": Source(("conv",), "conv"),
    "patches.kernel": Source(("patch",), "patches", (1, 2, 2)),
    "gamma": Source(("gamma",), "ones", (1, 1, 1)),
    "embedding": Source(("embed",), "leading_ones", (1, 1)),
    "layers.0": Source(("blocks.0.w", "blocks.1.w"), "linear"),
}


@pytest.fixture
def arrays() -> Arrays:
    shapes = checkpoint_shapes(Leaves(nnx.Rngs(0)), LAYOUT)
    return {key: np.random.default_rng(n).standard_normal(shape, np.float32) for n, (key, shape) in enumerate(shapes.items())}


def wan(*streams: str, **options: int) -> WorldModel:
    return world_model(MODELS["tiny"], CHANNELS, streams, **options)


def wan_arrays(naming: str = "official", *streams: str) -> Arrays:
    """A random checkpoint of the tiny network under a project's names."""
    model = nnx.eval_shape(lambda: wan(*streams))
    shapes = checkpoint_shapes(model, {**wan_layout(model, naming), **flowwam_layout(model)})
    random = np.random.default_rng(0)
    return {key: random.standard_normal(shape, np.float32) for key, shape in shapes.items()}


def refusal(path: Path, module: nnx.Module | None = None) -> str:
    with pytest.raises(ConfigError) as error:
        fill(module or Leaves(nnx.Rngs(0)), read_tensors(path), LAYOUT)
    return str(error.value)


# Axes.


def test_shapes_of_the_other_project() -> None:
    assert checkpoint_shapes(nnx.eval_shape(lambda: Leaves(nnx.Rngs(0))), LAYOUT) == {
        "a.weight": (3, 2),
        "a.bias": (3,),
        "conv": (5, 2, 3, 1, 2),
        "patch": (3, 2, 1, 2, 2),
        "gamma": (4, 1, 1, 1),
        "embed": (1, 1, 4),
        "blocks.0.w": (4, 3),
        "blocks.1.w": (4, 3),
    }


def test_every_layout_goes_in_and_out(arrays: Arrays, tmp_path: Path) -> None:
    save_file(arrays, tmp_path / "in.safetensors")
    module = Leaves(nnx.Rngs(0))
    fill(module, read_tensors(tmp_path / "in.safetensors"), LAYOUT)
    np.testing.assert_array_equal(module.linear.kernel[...], arrays["a.weight"].T)
    np.testing.assert_array_equal(module.convolution.kernel[1, 0, 1], arrays["conv"][:, :, 1, 0, 1].T)
    np.testing.assert_array_equal(module.patches.kernel[...], arrays["patch"].reshape(3, 8).T)
    np.testing.assert_array_equal(module.layers[0][1], arrays["blocks.1.w"].T)
    np.testing.assert_array_equal(module.embedding[...], arrays["embed"].ravel().astype(ml_dtypes.bfloat16))
    assert module.embedding.dtype == jnp.bfloat16
    np.testing.assert_array_equal(module.layers[1][...], 1)
    save_weights(module, tmp_path / "out.safetensors", LAYOUT)
    written = load_file(tmp_path / "out.safetensors")
    for key, array in arrays.items():
        np.testing.assert_array_equal(written[key], array if key != "embed" else array.astype(ml_dtypes.bfloat16))


@pytest.mark.parity
def test_patches_are_the_convolution(arrays: Arrays) -> None:
    """A matrix over flattened patches does what the strided convolution does."""
    video = np.random.default_rng(1).standard_normal((1, 2, 3, 4, 6), np.float32)

    def convolve() -> dict[str, np.ndarray]:
        import torch

        found = torch.nn.functional.conv3d(torch.tensor(video), torch.tensor(arrays["patch"]), stride=(1, 2, 2))
        return {"video": found.numpy()}

    expected = golden("patch_convolution", convolve)["video"]
    patches = video.reshape(1, 2, 3, 2, 2, 3, 2).transpose(0, 2, 3, 5, 1, 4, 6).reshape(1, 3, 2, 3, 8)
    np.testing.assert_allclose(patches @ arrays["patch"].reshape(3, 8).T, expected.transpose(0, 2, 3, 4, 1), atol=1e-5)


def test_an_abstract_module_becomes_real(arrays: Arrays, tmp_path: Path) -> None:
    save_file(arrays, tmp_path / "in.safetensors")
    module, real = nnx.eval_shape(lambda: Leaves(nnx.Rngs(0))), Leaves(nnx.Rngs(1))
    for target in (module, real):
        fill(target, read_tensors(tmp_path / "in.safetensors"), LAYOUT)
    (filled, of_real) = (nnx.state(each, nnx.Param) for each in (module, real))
    assert jax.tree.leaves(filled)
    jax.tree.map(np.testing.assert_array_equal, filled, of_real)


# Files.


@pytest.mark.parametrize("dtype", [ml_dtypes.bfloat16, np.float16, np.float32])
def test_types_of_files(dtype: type, arrays: Arrays, tmp_path: Path) -> None:
    rounded = {key: array.astype(dtype) for key, array in arrays.items()}
    save_file(rounded, tmp_path / "in.safetensors")
    module = Leaves(nnx.Rngs(0))
    fill(module, read_tensors(tmp_path / "in.safetensors"), LAYOUT)
    assert module.linear.kernel.dtype == jnp.float32
    np.testing.assert_array_equal(module.linear.kernel[...], rounded["a.weight"].T.astype(np.float32))


def test_reading_is_lazy(arrays: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_file(arrays, tmp_path / "in.safetensors")
    read: list[str] = []
    monkeypatch.setattr(reading, "partial", lambda get, key: lambda: (read.append(key), get(key))[1])
    tensors = read_tensors(tmp_path / "in.safetensors")
    assert tensors.shape("conv") == (5, 2, 3, 1, 2) and "nothing" not in tensors and len(tensors) == len(arrays)
    assert not read
    np.testing.assert_array_equal(tensors["conv"], arrays["conv"])
    assert read == ["conv"]


def sharded(arrays: Arrays, folder: Path) -> Path:
    """Two shards and their index, as published."""
    folder.mkdir()
    names = ("model-00001-of-00002.safetensors", "model-00002-of-00002.safetensors")
    parts = {name: {key: arrays[key] for key in list(arrays)[shard::2]} for shard, name in enumerate(names)}
    for name, part in parts.items():
        save_file(part, folder / name)
    weight_map = {key: name for name, part in parts.items() for key in part}
    index = folder / "model.safetensors.index.json"
    index.write_text(json.dumps({"metadata": {"total_size": 0}, "weight_map": weight_map}))
    return index


def test_shards_by_index_by_folder_and_without_index(arrays: Arrays, tmp_path: Path) -> None:
    index = sharded(arrays, tmp_path / "shards")
    for path in (index, index.parent):
        tensors = read_tensors(path)
        assert all(np.array_equal(tensors[key], array) for key, array in arrays.items()) and len(tensors) == len(arrays)
    index.unlink()
    assert read_tensors(index.parent).keys() == arrays.keys()


def test_broken_indexes_are_told(arrays: Arrays, tmp_path: Path) -> None:
    index = sharded(arrays, tmp_path / "shards")
    (index.parent / "model-00002-of-00002.safetensors").rename(tmp_path / "elsewhere.safetensors")
    assert "names missing shards: model-00002-of-00002.safetensors" in refusal(index)
    whole = json.loads(index.read_text())
    for name in ("../elsewhere.safetensors", str(tmp_path / "elsewhere.safetensors"), "..\\elsewhere.safetensors", "x.pth"):
        index.write_text(json.dumps({"weight_map": whole["weight_map"] | {"conv": name}}))
        assert "names files that are no .safetensors next to it" in refusal(index)
    first = "model-00001-of-00002.safetensors"
    index.write_text(json.dumps({"weight_map": {"a.weight": first, "other": first}}))
    assert "names tensors that its shards lack: other" in refusal(index)
    for text in ("{", "[]", '{"weight_map": 3}', '{"weight_map": {"a": 3}}'):
        index.write_text(text)
        assert "is no index of safetensors" in refusal(index)


def test_folders_that_say_too_little(arrays: Arrays, tmp_path: Path) -> None:
    assert "there are no weights at" in refusal(tmp_path / "none")
    folder = tmp_path / "folder"
    folder.mkdir()
    assert "holds no .safetensors, .pth or .pt" in refusal(folder)
    (folder / "a.pth").touch()
    (folder / "b.pth").touch()
    assert "holds several checkpoints (a.pth, b.pth); name one of them" in refusal(folder)
    save_file(arrays, folder / "a.safetensors")
    save_file(arrays, folder / "b.safetensors")
    assert "repeats tensors of another file" in refusal(folder)
    (tmp_path / "weights.ckpt").touch()
    assert "is not a known kind of checkpoint" in refusal(tmp_path / "weights.ckpt")


def test_a_cut_file_is_told(arrays: Arrays, tmp_path: Path) -> None:
    path = tmp_path / "in.safetensors"
    save_file(arrays, path)
    path.write_bytes(path.read_bytes()[:-10])
    assert "is not a whole safetensors file" in refusal(path)


@pytest.mark.lab
@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("zipped", [True, False])
def test_torch_files(wrapped: bool, zipped: bool, arrays: Arrays, tmp_path: Path) -> None:
    import torch

    state = {f"model.{key}": torch.tensor(array).to(torch.bfloat16) for key, array in arrays.items()}
    content = {"state_dict": state, "epoch": 3} if wrapped else state
    torch.save(content, tmp_path / "in.pth", _use_new_zipfile_serialization=zipped)
    tensors = read_tensors(tmp_path / "in.pth")
    for key, array in arrays.items():
        np.testing.assert_array_equal(tensors[key], array.astype(ml_dtypes.bfloat16))


@pytest.mark.lab
def test_nothing_is_unpickled(tmp_path: Path) -> None:
    """A pickle that would write a file when opened does not get to."""
    import torch

    touched = tmp_path / "touched"

    class Bad:
        def __reduce__(self) -> tuple[object, ...]:
            return Path.touch, (touched,)

    torch.save({"a.weight": Bad()}, tmp_path / "bad.pth")
    assert "holds more than tensors" in refusal(tmp_path / "bad.pth")
    (tmp_path / "raw.pth").write_bytes(pickle.dumps({"a.weight": Bad()}, protocol=2))
    assert "holds more than tensors" in refusal(tmp_path / "raw.pth")
    assert not touched.exists()
    torch.save({"epoch": 3}, tmp_path / "none.pth")
    assert "holds no tensors by name" in refusal(tmp_path / "none.pth")


@pytest.mark.lab
@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "it is empty"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:abc\n", "it is a text that begins with 'version https://git"),
        (b"unauthorized: please log in\n", "it is a text that begins with 'unauthorized"),
        (b"<html><body>404</body></html>", "it is a text that begins with '<html>"),
        (bytes(1000), ""),
        (b"PK\x03\x04" + bytes(50), ""),
        (b"\x80\x04\x95\xff\xff\xff\xff", ""),
        *((letter.encode() + b"rl=1 text\nmore\n", "it is a text that begins with") for letter in "().GNQRUX]abeqrstuhj}"),
    ],
)
def test_files_that_are_no_checkpoint_are_refused(content: bytes, said: str, tmp_path: Path) -> None:
    """PyTorch's reader raises IndexError, KeyError and others for them."""
    path = tmp_path / "a.pth"
    path.write_bytes(content)
    for reader in (read_tensors, lambda path: read_state_dict(path, "CoTracker3")):
        with pytest.raises(ConfigError, match=r"a\.pth is no whole checkpoint of \w+: .*; download it again"):
            reader(path)
    assert said in refusal(path)


@pytest.mark.parametrize("kind", ["F8_E4M3", "F8_E5M2", "F6_E2M3"])
def test_types_that_numpy_lacks_are_refused(kind: str, tmp_path: Path) -> None:
    """Weights of 8 bits, as other tools make them."""
    size = {"F8_E4M3": 8, "F8_E5M2": 8, "F6_E2M3": 6}[kind]
    header = json.dumps({"a": {"dtype": kind, "shape": [8], "data_offsets": [0, size]}}).encode()
    (tmp_path / "a.safetensors").write_bytes(len(header).to_bytes(8, "little") + header + bytes(size))
    tensors = read_tensors(tmp_path / "a.safetensors")
    with pytest.raises(ConfigError, match=r"a\.safetensors: a cannot be read \(.*\); get these weights in bfloat16"):
        tensors["a"]


@pytest.mark.parametrize(
    ("header", "data"),
    [
        ({"a": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 8]}}, 8),
        ({"a": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}, 8),
        ({"a": {"dtype": "F32", "shape": [2**33, 2**33], "data_offsets": [0, 8]}}, 8),
        ({"a": {"dtype": "F32", "shape": [-2], "data_offsets": [0, 8]}}, 8),
        ({"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}}, 800),
        ({"__metadata__": {"a": 1}}, 0),
    ],
)
def test_headers_that_promise_other_sizes_are_refused(header: dict, data: int, tmp_path: Path) -> None:
    text = json.dumps(header).encode()
    for length in (len(text), 2**62, 99_000_000):
        (tmp_path / "a.safetensors").write_bytes(length.to_bytes(8, "little") + text + bytes(data))
        assert "is not a whole safetensors file" in refusal(tmp_path / "a.safetensors")


def test_hidden_files_in_a_folder_are_no_weights(arrays: Arrays, tmp_path: Path) -> None:
    save_file(arrays, tmp_path / "model.safetensors")
    (tmp_path / "._model.safetensors").write_bytes(b"\0\5\x16\7" + bytes(4092))
    assert read_tensors(tmp_path).keys() == arrays.keys()


def test_prefixes_are_taken_off(arrays: Arrays, tmp_path: Path) -> None:
    for prefix in reading.PREFIXES:
        save_file({prefix + key: array for key, array in arrays.items()}, tmp_path / "in.safetensors")
        assert read_tensors(tmp_path / "in.safetensors").keys() == arrays.keys()
    save_file({"model.gamma": arrays["gamma"], "gamma": arrays["gamma"]}, tmp_path / "in.safetensors")
    assert "holds gamma twice" in refusal(tmp_path / "in.safetensors")


def test_what_does_not_fit_is_named(arrays: Arrays, tmp_path: Path) -> None:
    path = tmp_path / "in.safetensors"
    del arrays["gamma"]
    save_file(arrays | {"conv": np.zeros((5, 2, 3, 3, 3), np.float32), "extra": np.zeros(1, np.float32)}, path)
    module = Leaves(nnx.Rngs(0))
    before = np.array(module.linear.kernel[...])
    message = refusal(path, module)
    assert str(path) in message
    assert "1 missing: gamma (for gamma)" in message
    assert "conv is [5, 2, 3, 3, 3], the model's convolution.kernel needs [5, 2, 3, 1, 2]" in message
    assert "1 not of this model: extra" in message
    np.testing.assert_array_equal(module.linear.kernel[...], before)


def test_optional_leaves_and_keys(arrays: Arrays, tmp_path: Path) -> None:
    path = tmp_path / "in.safetensors"
    save_file({key: array for key, array in arrays.items() if "blocks" not in key} | {"head.x": arrays["conv"]}, path)
    module = Leaves(nnx.Rngs(0))
    fill(module, read_tensors(path), LAYOUT, optional=("layers.*", "head.*"))
    np.testing.assert_array_equal(module.layers[0][...], 1)
    save_file({key: array for key, array in arrays.items() if key != "blocks.1.w"}, path)
    with pytest.raises(ConfigError, match=r"1 missing: blocks\.1\.w"):
        fill(module, read_tensors(path), LAYOUT, optional=("layers.*",))


def test_layouts_that_do_not_fit_the_module() -> None:
    with pytest.raises(ValueError, match="the layout names leaves that Leaves lacks: other"):
        checkpoint_shapes(Leaves(nnx.Rngs(0)), {"other": Source(("x",))})
    with pytest.raises(ValueError, match=r"leaf layers\.0 has 2 layers and the layout 3 keys"):
        checkpoint_shapes(Leaves(nnx.Rngs(0)), {"layers.0": Source(("x", "y", "z"))})


def test_shards_are_written_under_their_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = Leaves(nnx.Rngs(0))
    save_weights(module, tmp_path / "one.safetensors", LAYOUT)
    monkeypatch.setattr(writing, "SHARD_BYTES", 150)
    save_weights(module, tmp_path / "many", LAYOUT)
    index = json.loads((tmp_path / "many" / "diffusion_pytorch_model.safetensors.index.json").read_text())
    shards = sorted(set(index["weight_map"].values()))
    assert len(shards) > 2
    assert shards[0] == f"diffusion_pytorch_model-00001-of-{len(shards):05d}.safetensors"
    one, many = read_tensors(tmp_path / "one.safetensors"), read_tensors(tmp_path / "many")
    assert all(np.array_equal(one[key], many[key]) for key in one) and one.keys() == many.keys()
    sizes = [sum(array.nbytes for array in load_file(tmp_path / "many" / name).values()) for name in shards]
    assert index["metadata"]["total_size"] == sum(sizes)
    assert all(size <= 150 or len(load_file(tmp_path / "many" / name)) == 1 for size, name in zip(sizes, shards, strict=True))
    assert not list((tmp_path / "many").glob(".*"))
    (tmp_path / "plain").touch()
    assert (tmp_path / "one.safetensors").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_where_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot write the weights"):
        save_weights(Leaves(nnx.Rngs(0)), tmp_path / "file" / "x.safetensors", LAYOUT)


# The network's own names.


@pytest.mark.parametrize("naming", ["official", "diffusers"])
def test_names_and_shapes_at_full_size(naming: str) -> None:
    model = nnx.eval_shape(lambda: world_model(MODELS["wan5b"], 48))
    rows = (line.split("\t") for line in (REFERENCE / f"keys_dit_{naming}.tsv").read_text().splitlines())
    expected = {key: tuple(ast.literal_eval(shape)) for key, shape in rows}
    assert len(expected) == 825
    assert checkpoint_shapes(model, wan_layout(model, naming)) == expected
    assert {path for path, _ in flat(model)} == set(dit_layout(model, naming))


def flat(model: nnx.Module) -> list[tuple[str, object]]:
    return [(".".join(map(str, path)), leaf) for path, leaf in nnx.to_flat_state(nnx.state(model, nnx.Param))]


def test_models_that_no_other_project_has_go_out_and_in(tmp_path: Path) -> None:
    """Streams, mechanisms and words beside Wan's leaves: every leaf is written and read again."""
    names = ("action", "embodiment", "joints", "history", *MECHANISMS)
    model, other = (world_model(MODELS["tiny"], CHANNELS, names, words=7, seed=seed) for seed in (0, 1))
    save_dit(model, tmp_path / "weights.safetensors")
    load_dit(other, tmp_path / "weights.safetensors")
    written = dict(flat(model))
    assert written.keys() == set(dit_layout(model, "diffusers")) and len(written) > 825 // 30
    for path, leaf in flat(other):
        np.testing.assert_array_equal(leaf[...], written[path][...], err_msg=path)


@pytest.mark.parametrize("form", ["file", "shards", pytest.param("pth", marks=pytest.mark.lab)])
def test_official_checkpoint_to_diffusers_and_back(form: str, tmp_path: Path) -> None:
    """Byte for byte the same tensors, through every format, at every step."""
    official, renamed = wan_arrays(), wan_arrays("diffusers")
    path = tmp_path / "official"
    if form == "file":
        path = path.with_suffix(".safetensors")
        save_file(official, path)
    elif form == "shards":
        path = sharded(official, path)
    else:
        import torch

        path = path.with_suffix(".pth")
        torch.save({key: torch.tensor(array) for key, array in official.items()}, path)
    model = nnx.eval_shape(wan)
    load_dit(model, path)
    save_dit(model, tmp_path / "diffusers")
    converted = read_tensors(tmp_path / "diffusers")
    assert find_naming(converted) == "diffusers" and converted.keys() == renamed.keys()
    layouts = [wan_layout(model, naming) for naming in ("official", "diffusers")]
    pairs = [(a, b) for leaf in layouts[0] for a, b in zip(layouts[0][leaf].keys, layouts[1][leaf].keys, strict=True)]
    assert len(pairs) == len(official)
    for ours, theirs in pairs:
        assert converted[theirs].tobytes() == official[ours].tobytes(), ours
    again = wan()
    load_dit(again, tmp_path / "diffusers")
    save_dit(again, tmp_path / "again.safetensors", "official")
    back = load_file(tmp_path / "again.safetensors")
    assert all(back[key].tobytes() == array.tobytes() for key, array in official.items()) and back.keys() == official.keys()


def test_streams_start_from_the_loaded_patch_embedding(tmp_path: Path) -> None:
    save_file(wan_arrays(), tmp_path / "in.safetensors")
    model = wan(*STREAMS)
    graph, params = nnx.split(model, nnx.Param)
    embeddings = {name: np.array(model.stream_embeddings[name]) for name in STREAMS}
    for loaded in (model, nnx.merge(graph, load_dit_params(graph, params, tmp_path / "in.safetensors"))):
        if loaded is model:
            load_dit(model, tmp_path / "in.safetensors")
        for name in STREAMS:
            np.testing.assert_array_equal(loaded.stream_inputs[name].kernel[...], loaded.patch_embedding.kernel[...])
            np.testing.assert_array_equal(loaded.stream_inputs[name].bias[...], loaded.patch_embedding.bias[...])
            assert loaded.stream_inputs[name].kernel is not loaded.patch_embedding.kernel
            np.testing.assert_array_equal(loaded.stream_embeddings[name][...], embeddings[name])


@pytest.mark.parametrize("lacks", [(), ("flow_head",), ("stream_embed",), ("flow_head", "stream_embed")])
def test_flowwam_checkpoint(lacks: tuple[str, ...], tmp_path: Path) -> None:
    """Its keys, with its prefix, with and without what its two repositories differ in."""
    arrays = wan_arrays("official", "action")
    arrays["flow_stream.flow_head.head.weight"] = np.zeros((12, 32), np.float32)
    arrays["flow_stream.flow_head.modulation"] = np.zeros((1, 2, 32), np.float32)
    given = {key: array for key, array in arrays.items() if not any(name in key for name in lacks)}
    save_file({f"pipe.dit.{key}": array for key, array in given.items()}, tmp_path / "flowwam.safetensors")
    model = wan(*STREAMS)
    load_dit(model, tmp_path / "flowwam.safetensors")
    flow = arrays["flow_stream.flow_patch_embedding.weight"]
    np.testing.assert_array_equal(model.stream_inputs["action"].kernel[...], flow.reshape(len(flow), -1).T)
    embed = arrays["flow_stream.stream_embed"].ravel() * ("stream_embed" not in lacks)
    np.testing.assert_array_equal(model.stream_embeddings["action"][...], embed)
    np.testing.assert_array_equal(model.stream_inputs["embodiment"].kernel[...], model.patch_embedding.kernel[...])
    assert np.any(model.stream_embeddings["embodiment"][...])


def test_another_size_is_told(tmp_path: Path) -> None:
    arrays = wan_arrays()
    save_file(arrays, tmp_path / "in.safetensors")
    check_dit(nnx.eval_shape(lambda: wan(*STREAMS)), read_tensors(tmp_path / "in.safetensors"))
    larger = nnx.eval_shape(lambda: world_model(MODELS["debug"], CHANNELS))
    for refuses, given in ((check_dit, read_tensors(tmp_path / "in.safetensors")), (load_dit, tmp_path / "in.safetensors")):
        with pytest.raises(ConfigError, match=r"blocks\.2\.self_attn\.q\.weight \(for blocks.*and 48 more.*another shape"):
            refuses(larger, given)
    arrays["blocks.1.ffn.2.weight"] = arrays["blocks.1.ffn.2.weight"][:, :-1].copy()
    save_file(arrays, tmp_path / "in.safetensors")
    expected = r"1 of another shape: blocks\.1\.ffn\.2\.weight is \[32, 63\], the model's blocks\.ffn\.second\.kernel"
    with pytest.raises(ConfigError, match=expected):
        load_dit(wan(), tmp_path / "in.safetensors")
