"""The ways into the network beside streams, each against a naive form of itself, and the systems made of them."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import save_file
from test_dit import tiny

from tests import synthetic
from tests.networks import normal, world_model
from xew.config import ConfigError
from xew.episode import HEIGHT, WIDTH, read_record, read_states
from xew.model.codecs.codec import CODECS
from xew.model.codecs.vae import VAES
from xew.model.conditions import ACTIONS, CONDITIONS, HISTORY, Condition, list_conditions, make_command
from xew.model.diffusion.samplers import SAMPLERS, SCHEDULES
from xew.model.experiment import load_experiment
from xew.model.network import dit
from xew.model.network.dit import MODELS, STREAMS, WorldModel
from xew.model.network.dit_layouts import dit_layout, load_dit
from xew.model.network.mechanisms import MECHANISMS, frames_of_groups, ray_maps
from xew.model.network.tokens import WAN_PATCH
from xew.model.weights.layout import checkpoint_shapes

ROOT = Path(__file__).parents[3]
CHANNELS = 3
SHAPE = (2, 3, 4, 6, CHANNELS)
EARLIER = (-10, -4)
SIGMA = jnp.array([0.3, 0.9], jnp.float32)


LATENTS, TEXT = normal(2, *SHAPE), normal(3, 2, 8, 16)


def make_conditions(streams: tuple[str, ...]) -> dict[str, jax.Array]:
    """Noise in the shape of what each stream or mechanism is told."""
    history = len(EARLIER) if "history" in streams else 0
    shapes = {name: SHAPE for name in streams} | {"history": (2, history, *SHAPE[2:]), "joints": (2, 3, 16)}
    for name, mechanism in MECHANISMS.items():
        if mechanism.width:
            shapes[name] = (2, 3 + (history if mechanism.enters == "frame" else 0), mechanism.width)
    return {name: normal(number + 10, *shapes[name]) for number, name in enumerate(streams)}


def model_of(streams: tuple[str, ...], **options: object) -> WorldModel:
    return tiny(streams, history=EARLIER if "history" in streams else (), **options)


def streams_of(action: str, embodiment: str, history: bool) -> tuple[str, ...]:
    conditions = [*list_conditions(ACTIONS[action]), *list_conditions(CONDITIONS[embodiment]), *([HISTORY] if history else [])]
    return tuple(condition.stream for condition in conditions)


KINDS = [(action, embodiment, action == "ctrl_world") for action in ACTIONS for embodiment in ("none", "robot_render")]
KINDS += [("none", embodiment, False) for embodiment in CONDITIONS if embodiment not in ("none", "robot_render")]


@pytest.mark.parametrize(("action", "embodiment", "history"), KINDS, ids=lambda value: str(value))
def test_every_condition_fits_is_used_and_can_be_learned(action: str, embodiment: str, history: bool) -> None:
    """All of ACTIONS and CONDITIONS: shapes, finite gradients, and a change of any condition changes the velocity."""
    streams = streams_of(action, embodiment, history)
    model, conditions = model_of(streams), make_conditions(streams)
    graph, params = nnx.split(model, nnx.Param)

    def loss(params: nnx.State, conditions: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        velocity = nnx.merge(graph, params)(LATENTS, conditions, SIGMA, TEXT)
        return jnp.square(velocity[:, 1:]).mean(), velocity

    gradients_and_velocity = jax.jit(jax.grad(loss, has_aux=True))
    gradients, before = gradients_and_velocity(params, conditions)
    assert before.shape == SHAPE and before.dtype == jnp.float32
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    for name in streams:
        moved = gradients_and_velocity(params, conditions | {name: conditions[name] + 1.0})[1]
        assert np.abs(moved - before)[:, 1:].max() > 1e-3, name
    learned = nnx.to_flat_state(gradients)
    own = [leaf for path, leaf in learned if path[0] in ("mechanisms", "stream_inputs", "stream_embeddings")]
    assert all(np.abs(leaf.get_value()).max() > 0 for leaf in own)


def test_mechanisms_are_named_by_the_registry() -> None:
    """Every entry point is a stream or a mechanism, and each mechanism that a condition can feed is used by a system."""
    fed = {c.stream for entry in (*ACTIONS.values(), *CONDITIONS.values()) for c in list_conditions(entry)}
    assert fed <= set(STREAMS) | set(MECHANISMS)
    assert {name for name, mechanism in MECHANISMS.items() if mechanism.source != "reference"} <= fed
    assert not set(STREAMS) & set(MECHANISMS)
    assert HISTORY.stream in STREAMS and HISTORY.make is None


def test_without_mechanisms_nothing_changes_but_the_named_leaves() -> None:
    """New leaves stand beside the published ones, which keep their shapes."""
    plain, system = (nnx.eval_shape(lambda s=s: world_model(MODELS["wan5b"], 48, s)) for s in ((), tuple(MECHANISMS)))
    before, after = (dict(nnx.to_flat_state(nnx.state(model, nnx.Param))) for model in (plain, system))
    assert {path: leaf.shape for path, leaf in before.items()} == {path: after[path].shape for path in before}
    assert {path[0] for path in after if path not in before} == {"mechanisms"}


def test_new_parts_that_can_start_at_zero_do() -> None:
    """Vectors of frames and channels leave a network as it is at first: what is pretrained stays so."""
    names = tuple(name for name, mechanism in MECHANISMS.items() if mechanism.enters in ("time", "channels"))
    model, plain = (world_model(MODELS["tiny"], CHANNELS, streams) for streams in (names, ()))
    for network in (model, plain):  # the head starts at zero too
        network.head.head.kernel.set_value(normal(5, *network.head.head.kernel.shape))
    conditions = make_conditions(names)
    expected = plain(LATENTS, {}, SIGMA, TEXT)
    model.mechanisms["relative_time"].null.set_value(jnp.zeros(MODELS["tiny"].dim, jnp.float32))
    np.testing.assert_allclose(model(LATENTS, conditions, SIGMA, TEXT), expected, atol=1e-5)


# Channels: pictures joined to RGB's.


def test_the_reference_in_channels_is_its_first_frame_in_every_frame() -> None:
    """As if a condition fed it; a change of the first frame then changes what is joined to every other."""
    own = model_of(("reference_channels",))
    fed = model_of(("map_channels",))
    params = nnx.to_flat_state(nnx.state(own, nnx.Param))
    names = {"reference_channels": "map_channels"}
    renamed = [(tuple(names.get(part, part) for part in path), leaf) for path, leaf in params]
    nnx.update(fed, nnx.from_flat_state(renamed))
    first = jnp.broadcast_to(LATENTS[:, :1], SHAPE)
    expected = fed(LATENTS, {"map_channels": first}, SIGMA, TEXT)
    np.testing.assert_allclose(own(LATENTS, {}, SIGMA, TEXT), expected, atol=1e-6)
    assert np.abs(fed(LATENTS, {"map_channels": first + 1.0}, SIGMA, TEXT) - expected)[:, 1:].max() > 1e-3


def test_a_network_at_its_start_predicts_the_guess_that_it_is_given() -> None:
    """Its head starts at zero, so a prediction of residuals is the guess itself where nothing but noise is seen."""
    noise, guess = jnp.ones((2,), jnp.float32), normal(9, *SHAPE)
    model = world_model(MODELS["tiny"], CHANNELS, ("map_channels",), prediction="residual", guess="map_channels")
    clean = LATENTS - model(LATENTS, {"map_channels": guess}, noise, TEXT)
    np.testing.assert_allclose(clean, guess, atol=1e-5)
    for embodiment in ("pasted_render", "carried_render"):
        settings = load_experiment(ROOT / "configs" / "debug.yaml", ["--model.embodiment", embodiment])
        assert settings.network.guess == "map_channels"
    assert load_experiment(ROOT / "configs" / "fixed.yaml", ["--model.embodiment", "none"]).network.guess == ""


def test_no_condition_feeds_what_the_network_has_of_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CONDITIONS, "wrong", Condition("wrong", "reference_channels", None, title="Wrong", label="wrong"))
    with pytest.raises(ConfigError, match=r"feeds 'reference_channels'; expected one of action, embodiment, joints, history, "):
        load_experiment(ROOT / "configs/debug.yaml", ["--model.embodiment", "wrong"])
    experiment = load_experiment(ROOT / "configs/debug.yaml", ["--model.reference", "channels"])
    assert "reference_channels" in experiment.network.streams and "reference_channels" not in experiment.inputs.shapes


# Time: a vector for each latent frame.


def test_each_frame_is_told_its_own_vector() -> None:
    """Embeddings of time are those of the noise levels, then a sum for each frame; a stream's tokens keep the noise levels."""
    model, conditions = model_of(("action", "pose_time")), make_conditions(("action", "pose_time"))
    tokens, levels, _ = model.embed_streams(LATENTS, conditions)
    time = model.embed_time(SIGMA)
    framed, of_tokens = model.add_frame_vectors(time, levels, LATENTS.shape, conditions)
    vectors = model.mechanisms["pose_time"](conditions["pose_time"])
    np.testing.assert_allclose(framed[:, 2], time[:, 0] + vectors[:, 0], atol=1e-5)
    np.testing.assert_allclose(framed[:, 3:], time[:, 1:] + vectors[:, 1:], atol=1e-5)
    assert of_tokens.tolist() == [2] * 6 + [3] * 6 + [4] * 6 + [0] * 6 + [1] * 12
    assert tokens.shape[1] == len(of_tokens)


def test_levels_of_frames_equal_a_timestep_of_every_token() -> None:
    model, conditions = model_of(("pose_time",)), make_conditions(("pose_time",))
    tokens, levels, rotary = model.embed_streams(LATENTS, conditions)
    time, levels = model.add_frame_vectors(model.embed_time(SIGMA), levels, LATENTS.shape, conditions)
    every, of_tokens = np.arange(tokens.shape[1]), time[:, levels]
    seen = model.apply_blocks(tokens, model.modulation(of_tokens), every, rotary, model.context(TEXT), len(every))
    expected = dit.unpatchify(model.head(seen, of_tokens, every), LATENTS.shape, WAN_PATCH)
    np.testing.assert_allclose(model(LATENTS, conditions, SIGMA, TEXT), expected, atol=2e-5)


def test_irasim_tells_no_action_before_the_first_frame() -> None:
    vector = model_of(("relative_time",)).mechanisms["relative_time"]
    numbers = normal(6, 2, 3, 56)
    np.testing.assert_array_equal(vector(numbers)[:, 0], vector(numbers + 1.0)[:, 0])
    assert (np.abs(vector(numbers)[:, 1:] - vector(numbers + 1.0)[:, 1:]) > 0).any()


# Frame: context of one frame.


def test_frames_see_their_own_context_and_no_other() -> None:
    """The same as one attention over all context under a mask, for RGB, for earlier frames and for the other stream."""
    streams = ("pose_frame", "history", "action")
    model, conditions = model_of(streams), make_conditions(streams)
    context = model.framed_context(TEXT, LATENTS.shape, conditions)
    attention = nnx.merge(*_first_layer(model.blocks)).cross_attn
    count = (3 + 2 + 3) * 6
    tokens = normal(7, 2, count, MODELS["tiny"].dim)
    everything = jnp.concatenate([context.shared, context.framed[:, :, 0]], axis=1)
    own = np.repeat(np.arange(8), 6)[:, None] == np.arange(5)[None]
    mask = np.concatenate([np.ones((count, 8), bool), own], axis=1)
    q = attention._heads(attention.norm_q(attention.q(tokens)), None)
    k, v = attention.keys_values(everything, None)
    expected = attention.o(jax.nn.dot_product_attention(q, k, v, mask=mask[None, None]).reshape(tokens.shape))
    np.testing.assert_allclose(attention.attend_by_frame(tokens, context), expected, atol=2e-5)


def test_poses_of_earlier_frames_go_to_earlier_frames() -> None:
    """Numbers come in the order of time, tokens as RGB's, then the earlier ones."""
    model = model_of(("pose_frame", "history"))
    conditions = make_conditions(("pose_frame", "history"))
    framed = model.framed_context(TEXT, LATENTS.shape, conditions).framed
    of_rows = model.mechanisms["pose_frame"](conditions["pose_frame"])
    np.testing.assert_allclose(framed[:, :3], of_rows[:, 2:], atol=1e-6)
    np.testing.assert_allclose(framed[:, 3:], of_rows[:, :2], atol=1e-6)


def _first_layer(blocks: nnx.Module) -> tuple[nnx.GraphDef, nnx.State]:
    graph, layers = nnx.split(blocks)
    return graph, jax.tree.map(lambda leaf: leaf[0], layers)


# Context: tokens for all.


def test_bwm_does_without_text_and_enerverse_ac_beside_it() -> None:
    alone, beside = model_of(("pose_context",)), model_of(("pooled_context",))
    conditions = make_conditions(("pose_context", "pooled_context"))
    assert alone.context(TEXT, conditions).shape == (2, 9, 32)
    np.testing.assert_array_equal(alone.context(TEXT, conditions), alone.context(TEXT + 1.0, conditions))
    assert beside.context(TEXT, conditions).shape == (2, 8 + 16, 32)
    np.testing.assert_allclose(beside.context(TEXT, conditions)[:, :8], beside.text_embedding(TEXT), atol=1e-6)


def test_groups_are_the_frames_of_video() -> None:
    frames = np.arange(9, dtype=np.float32)[:, None] + np.array([[0.0, 0.5]], np.float32)
    grouped = np.concatenate([frames[:1].repeat(3, 0), frames]).reshape(1, 3, 8)
    np.testing.assert_array_equal(frames_of_groups(jnp.asarray(grouped))[0], frames)


def test_pooled_tokens_know_the_order_of_actions() -> None:
    pooled = model_of(("pooled_context",)).mechanisms["pooled_context"]
    numbers = normal(8, 1, 3, 56)
    assert np.abs(pooled(numbers) - pooled(numbers[:, ::-1])).max() > 1e-3


# Channels: pictures joined to RGB's.


def test_channels_are_a_wider_patch_embedding() -> None:
    model, conditions = model_of(("map_channels",)), make_conditions(("map_channels",))
    joined = jnp.concatenate([dit.patchify(pictures, WAN_PATCH) for pictures in (LATENTS, conditions["map_channels"])], axis=-1)
    kernel = jnp.concatenate([model.patch_embedding.kernel[...], model.mechanisms["map_channels"].columns.kernel[...]])
    expected = joined @ kernel + model.patch_embedding.bias[...][None, None]
    np.testing.assert_allclose(model.embed_streams(LATENTS, conditions)[0], expected, atol=2e-5)


def test_rays_go_through_the_pixels_they_belong_to() -> None:
    """A point on the ray of a latent pixel is projected to where that pixel lies in the camera's image."""
    rng = np.random.default_rng(0)
    rotation, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    position, k = rng.standard_normal(3), np.array([300.0, 310.0, 160.0, 118.0])
    camera = np.concatenate([k, rotation.ravel(), position]).astype(np.float32)[None, None]
    height, width = 16, 20  # 320x256: eight rows of padding above and below
    maps = np.asarray(ray_maps(jnp.asarray(camera), (1, 1, height, width, 3)))[0, 0]
    np.testing.assert_allclose(np.linalg.norm(maps[..., :3], axis=-1), 1, atol=1e-5)
    seen = (maps[..., 3:] + 2 * maps[..., :3] - position) @ rotation.T
    x = seen[..., 0] / seen[..., 2] * k[0] + k[2]
    y = seen[..., 1] / seen[..., 2] * k[1] + k[3]
    columns = (np.arange(width) + 0.5) * WIDTH / width - 0.5
    rows = (np.arange(height) + 0.5) * (HEIGHT + 16) / height - 0.5 - 8
    np.testing.assert_allclose(x, np.broadcast_to(columns, x.shape), atol=2e-2)
    np.testing.assert_allclose(y, np.broadcast_to(rows[:, None], y.shape), atol=2e-2)


# History: earlier frames.


def test_earlier_frames_are_rgb_at_their_own_times() -> None:
    model, conditions = model_of(("action", "history")), make_conditions(("action", "history"))
    tokens, levels, (cos, _) = model.embed_streams(LATENTS, conditions)
    patches = dit.patchify(conditions["history"], WAN_PATCH)
    embedded = model.patch_embedding(patches) + model.stream_embeddings["history"][...][None, None]
    np.testing.assert_allclose(tokens[:, 18:30], embedded, atol=1e-5)
    assert levels[18:30].tolist() == [0] * 12
    angles = dit.rotary_angles((2, 2, 3), 16, times=[frame / 4 for frame in EARLIER])
    np.testing.assert_allclose(cos[18:30], np.cos(angles), atol=1e-6)
    assert not np.allclose(cos[18:24], cos[:6])
    assert "history" not in model.stream_inputs


# Systems.


def test_the_public_checkpoint_of_bwm_loads(tmp_path: Path) -> None:
    """A tiny checkpoint in its format: Wan's official names and the four layers of its action encoder."""
    streams = streams_of("bwm", "none", history=False)
    model = model_of(streams)
    shapes = checkpoint_shapes(model, dit_layout(model, "official"))
    rng = np.random.default_rng(0)
    tensors = {key: rng.standard_normal(shape).astype(np.float32) for key, shape in shapes.items()}
    prefixed = {
        f"pipe.{key}" if key.startswith("action_encoder") else f"pipe.dit.{key}": value for key, value in tensors.items()
    }
    named = {
        f"pipe.action_encoder.action_mlp{path}.{layer}.{part}"
        for path in (1, 2)
        for layer in (0, 2)
        for part in ("weight", "bias")
    }
    assert {key for key in prefixed if "action" in key} == named
    save_file(prefixed, tmp_path / "step-12000.safetensors")
    load_dit(model, tmp_path / "step-12000.safetensors")
    first = tensors["action_encoder.action_mlp1.0.weight"]
    np.testing.assert_array_equal(model.mechanisms["pose_context"].first.kernel[...], first.T)
    np.testing.assert_array_equal(model.mechanisms["pose_time"].second.bias[...], tensors["action_encoder.action_mlp2.2.bias"])
    misshapen = prefixed | {"pipe.action_encoder.action_mlp1.0.weight": first[:, :7].copy()}
    save_file(misshapen, tmp_path / "other.safetensors")
    with pytest.raises(ConfigError, match=r"action_encoder.action_mlp1.0.weight is \[32, 7\]"):
        load_dit(model, tmp_path / "other.safetensors")


def test_shapes_of_bwm_at_full_size() -> None:
    streams = streams_of("bwm", "none", history=False)
    model = nnx.eval_shape(lambda: world_model(MODELS["wan5b"], 48, streams))
    shapes = checkpoint_shapes(model, dit_layout(model, "official"))
    own = {key.removeprefix("action_encoder."): shape for key, shape in shapes.items() if key.startswith("action_encoder")}
    assert len(shapes) - len(own) == 825
    assert {key: shape for key, shape in own.items() if key.endswith("weight")} == {
        "action_mlp1.0.weight": (3072, 14),
        "action_mlp1.2.weight": (3072, 3072),
        "action_mlp2.0.weight": (12288, 56),
        "action_mlp2.2.weight": (3072, 12288),
    }


def test_one_way_sampling_with_a_cache_equals_training() -> None:
    """Mechanisms enter beside the cached streams as they do without a cache."""
    streams = ("action", "pose_time", "map_channels", "pooled_context")
    model, conditions = model_of(streams, visibility="one_way"), make_conditions(streams)
    cache = model.condition_cache(conditions, TEXT)
    expected = model(LATENTS, conditions, SIGMA, TEXT)
    np.testing.assert_allclose(model(LATENTS, conditions, SIGMA, TEXT, cache), expected, atol=2e-5)


def test_conditions_of_a_system_are_all_of_one_kind() -> None:
    """Numbers that are scaled are scaled alike wherever they go by one name, since the cache knows them by it."""
    by_name: dict[str, Condition] = {}
    for system in ACTIONS.values():
        for condition in list_conditions(system):
            same = by_name.setdefault(condition.name, condition)
            assert (same.make, same.change, same.group, same.scale) == (
                condition.make,
                condition.change,
                condition.group,
                condition.scale,
            )


TOPICS = ("model", "conditioning", "codec", "training", "rollout", "pretrained_weights")
PAGES = "\n".join((ROOT / "docs" / f"{topic}.md").read_text() for topic in TOPICS)


def test_the_pages_name_all_that_can_be_chosen() -> None:
    registries = (MODELS, STREAMS, ACTIONS, CONDITIONS, MECHANISMS, CODECS, VAES, SAMPLERS, SCHEDULES)
    absent = [name for registry in registries for name in registry if f"`{name}`" not in PAGES]
    assert not absent
    assert all((ROOT / path).is_file() for path in re.findall(r"configs/[\w/]+\.yaml", PAGES))
    modules = set(re.findall(r"python -m (xew[\w.]+)", PAGES))
    assert len(modules) > 5 and all((ROOT / f"{module.replace('.', '/')}.py").is_file() for module in modules)


def test_the_page_s_condition_from_outside_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = re.findall(r"^```python\n(.*?)^```$", PAGES, re.MULTILINE | re.DOTALL)
    (tmp_path / "my_conditions.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    chosen = ["--model.embodiment", "my_conditions:STILL"]
    experiment = load_experiment(ROOT / "configs" / "fixed.yaml", chosen)
    assert experiment.conditions["embodiment"].name == "still_render"
    folder = synthetic.write_cell(tmp_path / "data", "place_empty_cup", 0, "piper", frames=3)
    command = make_command(folder, read_record(folder), read_states(folder))
    made = experiment.conditions["embodiment"].make(command)
    np.testing.assert_array_equal(made, np.repeat(command.render[:1], 3, axis=0))
    system = load_experiment(
        ROOT / "configs" / "fixed.yaml", ["--model.action", "my_conditions:SYSTEM", "--model.embodiment", "none"]
    )
    assert set(system.conditions) == {"embodiment", "joints", "history"}
