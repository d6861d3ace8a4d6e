"""The block stack against what is known of Wan2.2-TI2V-5B and against naive forms of itself."""

import functools
from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from tests.networks import draw_network, normal, world_model
from xew.model.network import blocks, dit
from xew.model.network.dit import MODELS, STREAMS, WorldModel
from xew.model.network.dit_layouts import diffusers_config
from xew.model.network.tokens import WAN_PATCH
from xew.model.training.flops import flops
from xew.model.training.memory import kept_bytes

CHANNELS = 3
SHAPE = (2, 3, 4, 6, CHANNELS)
TOLERANCE = 2e-5


def tiny(streams: tuple[str, ...] = (), **options: object) -> WorldModel:
    """A model whose every parameter is drawn anew, so that nothing hides behind a zero start."""
    return draw_network(lambda: world_model(MODELS["tiny"], CHANNELS, streams, **options))


@pytest.fixture(scope="module")
def inputs() -> tuple[jax.Array, jax.Array, jax.Array]:
    """Latents, noise levels and text."""
    return normal(2, *SHAPE), jnp.array([0.3, 0.9], jnp.float32), normal(3, 2, 8, 16)


def test_parameters_of_the_published_model() -> None:
    model = nnx.eval_shape(lambda: world_model(MODELS["wan5b"], 48))
    paths = jax.tree_util.tree_leaves_with_path(nnx.state(model, nnx.Param))
    tensors = sum(MODELS["wan5b"].depth if "blocks" in jax.tree_util.keystr(path) else 1 for path, _ in paths)
    assert dit.parameter_count(model) == 4_999_787_712
    assert tensors == 825


def test_extra_stream_costs_what_flowwam_says() -> None:
    """592,896 for the patch embedding; the stream embedding is one width more."""
    plain, flow = (nnx.eval_shape(lambda s=s: world_model(MODELS["wan5b"], 48, s)) for s in ((), ("action",)))
    assert dit.parameter_count(flow) - dit.parameter_count(plain) == 592_896 + 3072


def test_stream_embedding_copies_the_patch_embedding() -> None:
    model = world_model(MODELS["tiny"], CHANNELS, ("action",))
    copied = model.stream_inputs["action"]
    np.testing.assert_array_equal(copied.kernel[...], model.patch_embedding.kernel[...])
    assert copied.kernel is not model.patch_embedding.kernel


def test_zero_velocity_at_the_start(inputs: tuple[jax.Array, jax.Array, jax.Array]) -> None:
    latents, sigma, text = inputs
    model = world_model(MODELS["tiny"], CHANNELS)
    assert not np.any(model(latents, {}, sigma, text))


def test_one_stream_is_the_plain_block_stack(inputs: tuple[jax.Array, jax.Array, jax.Array]) -> None:
    """Scan over stacked layers = calling each layer's block in turn."""
    latents, sigma, text = inputs
    model = tiny()
    tokens, levels, rotary = model.embed_streams(latents, {})
    time = model.time_embedding(dit.sinusoid(jnp.stack([jnp.zeros(2), 1000 * sigma], 1)))
    modulation, context = model.modulation(time), model.text_embedding(text)
    graph, layers = nnx.split(model.blocks)
    for layer in range(MODELS["tiny"].depth):
        block = nnx.merge(graph, jax.tree.map(lambda leaf, layer=layer: leaf[layer], layers))
        tokens = block(tokens, modulation, levels, rotary, context)
    expected = dit.unpatchify(model.head(tokens, time, levels), latents.shape, model.size.patch)
    np.testing.assert_allclose(model(latents, {}, sigma, text), expected, atol=TOLERANCE)


def test_remat_changes_nothing(inputs: tuple[jax.Array, jax.Array, jax.Array]) -> None:
    latents, sigma, text = inputs

    def gradient(remat: blocks.RematName) -> list[np.ndarray]:
        graph, params = nnx.split(tiny(remat=remat))
        loss = jax.jit(jax.grad(lambda params: jnp.square(nnx.merge(graph, params)(latents, {}, sigma, text)).sum()))
        return jax.tree.leaves(jax.device_get(loss(params)))

    expected = gradient("none")
    for remat in ("dots", "full"):  # that all names keep what they say is tested below, without compiling
        for found, leaf in zip(gradient(remat), expected, strict=True):
            np.testing.assert_allclose(found, leaf, atol=1e-4 * np.abs(leaf).max(), err_msg=remat)


def test_streams_are_one_sequence(inputs: tuple[jax.Array, jax.Array, jax.Array]) -> None:
    """A stream equals the same tokens appended to RGB's, with their own positions."""
    latents, *_ = inputs
    model, condition = tiny(("embodiment",)), normal(4, 2, 1, 4, 6, CHANNELS)
    tokens, levels, (cos, _) = model.embed_streams(latents, {"embodiment": condition})
    rgb_tokens, _, (rgb_cos, _) = tiny().embed_streams(latents, {})
    np.testing.assert_allclose(tokens[:, :18], model.patch_embedding(dit.patchify(latents, model.size.patch)), atol=TOLERANCE)
    assert rgb_tokens.shape == tokens[:, :18].shape
    np.testing.assert_array_equal(cos[:18], rgb_cos)
    np.testing.assert_array_equal(cos[18:], cos[:6])
    assert tokens.shape[1] == 3 * 2 * 3 + 1 * 2 * 3
    patches = dit.patchify(condition, model.size.patch)
    own = model.stream_inputs["embodiment"](patches) + model.stream_embeddings["embodiment"][None, None]
    np.testing.assert_allclose(tokens[:, 18:], own, atol=TOLERANCE)
    np.testing.assert_array_equal(levels, [0] * 6 + [1] * 12 + [0] * 6)


def test_conditions_matter_and_rgb_alone_is_predicted(inputs: tuple[jax.Array, jax.Array, jax.Array]) -> None:
    latents, sigma, text = inputs
    model = tiny(("embodiment", "joints"))
    conditions = {"embodiment": normal(4, *SHAPE), "joints": normal(5, 2, 3, 16)}
    velocity = model(latents, conditions, sigma, text)
    assert velocity.shape == SHAPE
    for name, values in conditions.items():
        moved = model(latents, conditions | {name: values + 1}, sigma, text)
        assert np.abs(moved - velocity).max() > 1e-3, name


def test_two_levels_equal_a_timestep_for_every_token(inputs: tuple[jax.Array, jax.Array, jax.Array]) -> None:
    latents, sigma, text = inputs
    model, conditions = tiny(("action",)), {"action": normal(4, *SHAPE)}
    tokens, levels, rotary = model.embed_streams(latents, conditions)
    timesteps = jnp.where(levels[None] == 0, 0.0, 1000 * sigma[:, None])
    time = model.time_embedding(dit.sinusoid(timesteps))
    every = np.arange(tokens.shape[1])
    tokens = model.apply_blocks(tokens, model.modulation(time), every, rotary, model.text_embedding(text))
    rgb = every[: tokens.shape[1] // 2]
    expected = dit.unpatchify(model.head(tokens[:, rgb], time, rgb), latents.shape, model.size.patch)
    np.testing.assert_allclose(model(latents, conditions, sigma, text), expected, atol=TOLERANCE)


def test_noise_levels_told_to_streams() -> None:
    grid = (3, 1, 2)
    assert dit.token_levels(STREAMS["rgb"], grid).tolist() == [0, 0, 1, 1, 1, 1]
    assert dit.token_levels(STREAMS["action"], grid).tolist() == [0, 0, 1, 1, 1, 1]
    assert dit.token_levels(STREAMS["embodiment"], grid).tolist() == [0] * 6


@pytest.mark.parametrize(("head_dim", "parts"), [(128, (44, 42, 42)), (64, (24, 20, 20)), (16, (8, 4, 4))])
def test_rotary_split(head_dim: int, parts: tuple[int, int, int]) -> None:
    """Each axis has its own frequencies 10000^(-2i/width), in the order time, height, width."""
    angles = dit.rotary_angles((3, 2, 2), head_dim)
    assert angles.shape == (12, head_dim // 2)
    last = angles[-1]
    series = [
        position * 10_000.0 ** (-np.arange(0, width, 2) / width) for position, width in zip((2, 1, 1), parts, strict=True)
    ]
    np.testing.assert_allclose(last, np.concatenate(series), rtol=1e-12)


def test_rotation_is_a_complex_product_of_neighboring_pairs() -> None:
    values, angles = np.asarray(normal(6, 1, 12, 2, 16)), dit.rotary_angles((3, 2, 2), 16)
    pairs = values[..., 0::2] + 1j * values[..., 1::2]
    expected = pairs * np.exp(1j * angles)[None, :, None]
    rotated = blocks.rotate(
        jnp.asarray(values), (jnp.asarray(np.cos(angles), "float32"), jnp.asarray(np.sin(angles), "float32"))
    )
    rotated = np.asarray(rotated)
    np.testing.assert_allclose(rotated[..., 0::2] + 1j * rotated[..., 1::2], expected, atol=1e-5)


def test_sinusoid_is_cosine_first() -> None:
    features = dit.sinusoid(jnp.array([0.0, 1.0], jnp.float32))
    assert features.shape == (2, 256)
    np.testing.assert_allclose(features[0], [1.0] * 128 + [0.0] * 128)
    np.testing.assert_allclose(features[1, [0, 64, 128]], [np.cos(1), np.cos(0.01), np.sin(1)], atol=1e-6)


def test_patchify_orders_features_as_wan() -> None:
    """In: channel slowest, then row and column of the patch. Out: row, column, channel fastest."""
    latents = np.arange(4 * CHANNELS, dtype=np.float32).reshape(1, 1, 2, 2, CHANNELS)
    np.testing.assert_array_equal(dit.patchify(jnp.asarray(latents), WAN_PATCH)[0, 0], latents[0, 0].transpose(2, 0, 1).ravel())
    np.testing.assert_array_equal(dit.unpatchify(jnp.asarray(latents.reshape(1, 1, -1)), latents.shape, WAN_PATCH), latents)


def test_a_token_may_be_one_latent_pixel(inputs: tuple[jax.Array, jax.Array, jax.Array]) -> None:
    """Four times as many tokens as Wan's, in every stream and in what is joined to RGB's channels."""
    latents, sigma, text = inputs
    size, streams = replace(MODELS["tiny"], patch=(1, 1, 1)), ("action", "map_channels")
    model = draw_network(lambda: world_model(size, CHANNELS, streams))
    conditions = {"action": normal(4, *SHAPE), "map_channels": normal(5, *SHAPE)}
    tokens, levels, _ = model.embed_streams(latents, conditions)
    assert tokens.shape[1] == len(levels) == 2 * 3 * 4 * 6
    velocity = model(latents, conditions, sigma, text)
    assert velocity.shape == SHAPE and np.ptp(velocity) > 0
    assert diffusers_config(model)["patch_size"] == [1, 1, 1]


def test_query_norm_spans_all_heads() -> None:
    """Wan normalizes before the split: scaling one head's queries changes the others' logits."""
    attention = tiny().blocks.self_attn
    assert attention.norm_q.scale.shape == (MODELS["tiny"].depth, MODELS["tiny"].dim)


def test_bfloat16_keeps_parameters_and_result_float32(inputs: tuple[jax.Array, jax.Array, jax.Array]) -> None:
    latents, sigma, text = inputs
    with jax.numpy_dtype_promotion("standard"):  # JAX's own attention mixes bfloat16 and float32
        exact, rounded = (tiny(dtype=dtype)(latents, {}, sigma, text) for dtype in (jnp.float32, jnp.bfloat16))
    assert rounded.dtype == jnp.float32
    assert 0 < np.abs(rounded - exact).max() < 0.1 * np.abs(exact).max()


@pytest.mark.parametrize("name", MODELS)
def test_sizes_are_consistent(name: str) -> None:
    size = MODELS[name]
    assert size.dim == size.heads * size.head_dim
    assert size.head_dim % 2 == 0


@pytest.mark.parametrize("rows", [[0, 1, 1, 0], [0, 0, 0, 0], [2, 0, 3, 1, 1]])
def test_rows_and_their_gradient(rows: list[int]) -> None:
    """A choice of two or a gather of many: values and gradient of plain indexing."""
    values, weights = normal(7, 2, max(2, max(rows) + 1), 5), normal(8, 2, len(rows), 5)
    for function in (lambda x: dit.select_levels(x, np.array(rows)), lambda x: x[:, np.array(rows)]):
        found, gradient = jax.value_and_grad(lambda x, f=function: (f(x) * weights).sum())(values)
        expected = np.zeros(values.shape, np.float32)
        np.add.at(expected, (slice(None), rows), np.asarray(weights))
        np.testing.assert_allclose(found, (np.asarray(values)[:, rows] * np.asarray(weights)).sum(), rtol=1e-5)
        np.testing.assert_allclose(gradient, expected, atol=1e-6)


def test_one_way_conditions_do_not_see_rgb() -> None:
    """Their tokens are the same whatever RGB and its noise level are; RGB's tokens see them."""
    latents, text, conditions = normal(2, *SHAPE), normal(3, 2, 8, 16), {"action": normal(4, *SHAPE)}

    def tokens(model: WorldModel, latents: jax.Array, sigma: float) -> np.ndarray:
        embedded, levels, rotary = model.embed_streams(latents, conditions)
        modulation = model.modulation(model.embed_time(jnp.full(2, sigma, jnp.float32)))
        return np.asarray(model.apply_blocks(embedded, modulation, levels, rotary, model.context(text), rgb=18))

    for visibility in ("joint", "one_way"):
        model = tiny(("action",), visibility=visibility)
        first, second = tokens(model, latents, 0.2), tokens(model, 1 + latents, 0.7)
        assert np.abs(first[:, :18] - second[:, :18]).max() > 0.1
        assert (np.abs(first[:, 18:] - second[:, 18:]).max() > 0.1) == (visibility == "joint")
        if visibility == "one_way":
            np.testing.assert_array_equal(first[:, 18:], second[:, 18:])


@pytest.mark.parametrize("remat", ["none", "full"])
def test_condition_cache_is_the_training_path(remat: blocks.RematName, inputs: tuple[jax.Array, jax.Array, jax.Array]) -> None:
    latents, sigma, text = inputs
    model = tiny(("action", "embodiment", "joints"), visibility="one_way", remat=remat)
    conditions = {"action": normal(4, *SHAPE), "embodiment": normal(5, 2, 1, 4, 6, CHANNELS), "joints": normal(6, 2, 3, 16)}
    expected = model(latents, conditions, sigma, text)
    cache = model.condition_cache(conditions, text)
    assert cache.keys.shape == (MODELS["tiny"].depth, 2, 18 + 6 + 3, 2, 16)
    for scale in (1.0, 0.5):  # one cache serves every noise level
        np.testing.assert_allclose(
            model(latents, {}, scale * sigma, text, cache), model(latents, conditions, scale * sigma, text), atol=1e-5
        )
    assert np.abs(model(latents, {}, sigma, text, jax.tree.map(jnp.zeros_like, cache)) - expected).max() > 1e-3


def test_no_cache_where_conditions_see_rgb() -> None:
    with pytest.raises(ValueError, match="visibility one_way"):
        tiny(("action",)).condition_cache({"action": normal(4, *SHAPE)}, normal(3, 2, 8, 16))


def test_learned_words() -> None:
    """Ids are rows of the model's own table; 0 is no word, as zero padding is, and learns nothing."""
    model, ids = tiny(words=9), jnp.asarray([[3, 8, 0], [1, 0, 0]], jnp.int32)
    table = np.array(model.words.embedding[...])
    table[0] = 0
    np.testing.assert_allclose(model.context(ids), model.text_embedding(jnp.asarray(table)[np.asarray(ids)]), atol=TOLERANCE)
    graph, params = nnx.split(model)
    gradient = jax.grad(lambda params: nnx.merge(graph, params).context(ids).sum())(params)
    rows = np.asarray(gradient["words"]["embedding"][...])
    assert [number for number, row in enumerate(rows) if row.any()] == [1, 3, 8]


def test_compute_params_are_the_same_model_rounded_once(inputs: tuple[jax.Array, jax.Array, jax.Array]) -> None:
    latents, sigma, text = inputs
    graph, params = nnx.split(tiny(("embodiment",), dtype=jnp.bfloat16), nnx.Param)
    rounded = dit.cast_params(graph, params)
    types = {".".join(map(str, path)): leaf.dtype for path, leaf in nnx.to_flat_state(rounded)}
    for name in (
        "blocks.ffn.first.kernel",
        "patch_embedding.bias",
        "stream_inputs.embodiment.kernel",
        "text_embedding.first.kernel",
    ):
        assert types[name] == jnp.bfloat16, name
    for name in (
        "blocks.modulation",
        "blocks.norm3.scale",
        "blocks.self_attn.norm_q.scale",
        "time_projection.kernel",
        "head.head.kernel",
    ):
        assert types[name] == jnp.float32, name
    assert next(leaf.dtype for path, leaf in nnx.to_flat_state(params) if path[-2:] == ("first", "kernel")) == jnp.float32
    conditions = {"embodiment": normal(4, *SHAPE)}

    def loss(params: nnx.State) -> jax.Array:
        return jnp.square(nnx.merge(graph, params)(latents, conditions, sigma, text)).sum()

    with jax.numpy_dtype_promotion("standard"):
        np.testing.assert_allclose(jax.jit(loss)(rounded), jax.jit(loss)(params), rtol=1e-3)
        gradient = jax.eval_shape(jax.grad(lambda params: loss(dit.cast_params(graph, params))), params)
    assert jax.tree.map(lambda leaf: leaf.dtype, gradient) == jax.tree.map(lambda leaf: leaf.dtype, params)


# The rule of attention, on machines that are not here.


class Gpu:
    platform, device_kind = "gpu", "NVIDIA Something"

    def __init__(self, capability: str, version: str = "cuda 13000") -> None:
        self.compute_capability, self.client = capability, type("Client", (), {"platform_version": version})


@pytest.mark.parametrize(
    ("device", "head_dim", "dtype", "expected"),
    [
        (Gpu("9.0"), 128, jnp.bfloat16, "cudnn"),
        (Gpu("9.0"), 256, jnp.float16, "cudnn"),
        (Gpu("8.0"), 128, jnp.bfloat16, "cudnn"),
        (Gpu("8.0"), 192, jnp.bfloat16, "xla"),
        (Gpu("7.5"), 128, jnp.bfloat16, "xla"),
        (Gpu("9.0"), 12, jnp.bfloat16, "xla"),
        (Gpu("9.0"), 128, jnp.float32, "xla"),
        (Gpu("9.0", "rocm 70000"), 128, jnp.bfloat16, "xla"),
        (None, 128, jnp.bfloat16, "xla"),
    ],
)
def test_attention_by_rule(
    device: Gpu | None, head_dim: int, dtype: jnp.dtype, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if device is not None:
        monkeypatch.setattr(jax, "devices", lambda: [device])
    if device is not None or jax.default_backend() == "cpu":
        assert blocks.choose_attention(head_dim, dtype) == expected


# Work.

OF_320X256, OF_640X480 = (8, 10), (15, 20)


@pytest.mark.parametrize(
    ("frames", "side", "streams", "tera"),
    [
        (31, OF_320X256, 1, 24.9),
        (31, OF_320X256, 2, 53.7),
        (31, OF_320X256, 3, 87.0),
        (21, OF_320X256, 2, 34.6),
        (21, OF_320X256, 3, 54.7),
        (15, OF_320X256, 2, 24.0),
        (15, OF_320X256, 3, 37.3),
        (9, OF_320X256, 2, 14.1),
        (9, OF_320X256, 3, 21.5),
        (31, OF_640X480, 2, 293),
        (31, OF_640X480, 3, 535),
    ],
)
def test_flops_of_the_published_size(frames: int, side: tuple[int, int], streams: int, tera: float) -> None:
    """Counted by hand for 5B (reference table): 30 blocks of projections, attention, text keys and values."""
    found = flops(MODELS["wan5b"], [(frames, *side)] * streams)
    assert found == pytest.approx(1e12 * tera, rel=0.02)
    assert flops(MODELS["wan5b"], [(frames, *side)] * streams, batch=3) == pytest.approx(3 * found)


def test_flops_of_a_cached_step() -> None:
    grids = [(31, *OF_320X256)] * 3
    joint, one_way, cached = (
        flops(MODELS["wan5b"], grids, visibility=visibility, cached=cached)
        for visibility, cached in (("joint", False), ("one_way", False), ("one_way", True))
    )
    assert cached == pytest.approx(29.4e12, rel=0.03)
    assert cached < one_way < joint


def test_flops_are_those_that_xla_counts(inputs: tuple[jax.Array, jax.Array, jax.Array]) -> None:
    """Of the whole network at a size where matrix products are nearly all; XLA counts a loop's body once."""
    size = blocks.ModelSize(dim=64, depth=1, heads=2, ffn_dim=256, text_dim=64, text_tokens=16)
    model = nnx.eval_shape(lambda: world_model(size, CHANNELS, ("action",)))
    graph, params = nnx.split(model)
    latents = jax.ShapeDtypeStruct((2, 4, 16, 16, CHANNELS), jnp.float32)
    shapes = (
        params,
        latents,
        {"action": latents},
        jax.ShapeDtypeStruct((2,), jnp.float32),
        jax.ShapeDtypeStruct((2, 16, 64), jnp.float32),
    )
    compiled = jax.jit(lambda params, *inputs: nnx.merge(graph, params)(*inputs)).lower(*shapes).compile()
    counted = compiled.cost_analysis()["flops"]
    assert flops(size, [(4, 8, 8)] * 2, 16, batch=2, channels=CHANNELS) == pytest.approx(counted, rel=0.1)


@pytest.mark.parametrize("remat", ["none", "dots", "attention", "full"])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_what_blocks_keep_is_what_the_memory_estimate_says(remat: blocks.RematName, dtype: jnp.dtype) -> None:
    """Counted in the traced gradient: what the loop over blocks hands from its forward to its backward pass."""
    size, tokens = blocks.ModelSize(dim=512, depth=3, heads=4, ffn_dim=2048, text_dim=16, text_tokens=7), 3 * 8 * 8
    options = {"dtype": dtype, "remat": remat}
    graph, params = nnx.split(nnx.eval_shape(lambda: world_model(size, CHANNELS, **options)), nnx.Param)
    params = jax.eval_shape(lambda params: dit.cast_params(graph, params), params)

    def loss(params: nnx.State, latents: jax.Array, sigma: jax.Array, text: jax.Array) -> jax.Array:
        return nnx.merge(graph, params)(latents, {}, sigma, text).sum()

    shapes = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((1, 3, 16, 16, CHANNELS), (1,), (1, 7, 16))]
    with jax.numpy_dtype_promotion("standard"):
        traced = jax.make_jaxpr(jax.grad(loss))(params, *shapes)
    forward = next(equation for equation in traced.eqns if equation.primitive.name == "scan")
    kept = [variable.aval for variable in forward.outvars[forward.params["num_carry"] :]]
    pairs = [array for array in kept if array.shape[-2] == tokens and array.shape[-1] in (tokens, size.text_tokens)]
    assert bool(pairs) == (remat == "none")
    of_tokens = sum(array.size * array.dtype.itemsize for array in kept if tokens in array.shape and array not in pairs)
    estimate = kept_bytes(size, remat, jnp.dtype(dtype).itemsize)
    assert of_tokens / size.depth / tokens == pytest.approx(estimate, rel=0.05)


@pytest.mark.parametrize(("queries", "keys"), [(6, 7), (7, 6), (5, 5), (6, 8)])
def test_odd_numbers_of_tokens_are_evened_out(queries: int, keys: int) -> None:
    """Values and gradients equal those of plain attention: what is added has no part in either."""
    q, k, v = (jax.random.normal(jax.random.key(number), (2, n, 3, 8)) for number, n in enumerate((queries, keys, keys)))
    plain = functools.partial(jax.nn.dot_product_attention, implementation="xla")
    even = functools.partial(blocks.attend_in_pairs, implementation="xla")

    def total(attend: Callable[..., jax.Array], *arrays: jax.Array) -> jax.Array:
        return jnp.sum(jnp.sin(attend(*arrays)))

    np.testing.assert_allclose(even(q, k, v), plain(q, k, v), atol=1e-6)
    gradients = [jax.grad(functools.partial(total, attend), argnums=(0, 1, 2))(q, k, v) for attend in (plain, even)]
    for wanted, found in zip(*gradients, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-6)
    program = str(jax.make_jaxpr(even)(q, k, v))
    assert f"{queries + queries % 2},{keys + keys % 2}" in program.replace(" ", ""), "the numbers that attention sees are even"
