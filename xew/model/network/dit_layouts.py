"""Published weights of the network: where each leaf lies in the files of Wan2.2 (official and diffusers), FlowWAM and BWM.

Reads and writes checkpoints through xew/model/weights.
Names: Wan2.2's own `wan/modules/model.py`, diffusers' `WanTransformer3DModel`, FlowWAM's `flow_stream`.
"""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx

from xew.config import ConfigError
from xew.files import write_text
from xew.model.network.dit import STREAMS, WorldModel
from xew.model.network.tokens import TIME_FREQUENCIES, Patch
from xew.model.weights.filling import check_fit, fill
from xew.model.weights.layout import Layout, Source
from xew.model.weights.reading import Tensors, read_tensors
from xew.model.weights.writing import save_weights

Naming = Literal["official", "diffusers"]
ROPE_BASE = "_rope_base"
"""Key of config.json for the base of rotary positions; diffusers passes over keys that begin so."""
COLUMN = {"official": 0, "diffusers": 1}
"""Place of a project's name in the pairs below."""

LINEARS = {
    "text_embedding.first": ("text_embedding.0", "condition_embedder.text_embedder.linear_1"),
    "text_embedding.second": ("text_embedding.2", "condition_embedder.text_embedder.linear_2"),
    "time_embedding.first": ("time_embedding.0", "condition_embedder.time_embedder.linear_1"),
    "time_embedding.second": ("time_embedding.2", "condition_embedder.time_embedder.linear_2"),
    "time_projection": ("time_projection.1", "condition_embedder.time_proj"),
    "head.head": ("head.head", "proj_out"),
}
"""Names of each of our modules in both projects; all have a weight and a bias."""
BLOCK_LINEARS = {
    **{
        f"{ours}.{part}": (f"{ours}.{part}", f"{theirs}.{their_part}")
        for ours, theirs in (("self_attn", "attn1"), ("cross_attn", "attn2"))
        for part, their_part in (("q", "to_q"), ("k", "to_k"), ("v", "to_v"), ("o", "to_out.0"))
    },
    "ffn.first": ("ffn.0", "ffn.net.0.proj"),
    "ffn.second": ("ffn.2", "ffn.net.2"),
}
BLOCK_VECTORS = {
    **{
        f"{ours}.norm_{part}.scale": (f"{ours}.norm_{part}.weight", f"{theirs}.norm_{part}.weight")
        for ours, theirs in (("self_attn", "attn1"), ("cross_attn", "attn2"))
        for part in ("q", "k")
    },
    "norm3.scale": ("norm3.weight", "norm2.weight"),
    "norm3.bias": ("norm3.bias", "norm2.bias"),
    "modulation": ("modulation", "scale_shift_table"),
}
"""Norms and modulation. What Wan calls norm3 is diffusers' norm2; the norms without parameters have the other two names."""

FLOW_STREAM = "action"
"""Stream of ours that FlowWAM's optical-flow stream becomes."""
BWM_LINEARS = {
    "mechanisms.pose_context.first": "action_encoder.action_mlp1.0",
    "mechanisms.pose_context.second": "action_encoder.action_mlp1.2",
    "mechanisms.pose_time.first": "action_encoder.action_mlp2.0",
    "mechanisms.pose_time.second": "action_encoder.action_mlp2.2",
}
"""Names in Boundless-World-Model of the two paths of its tool poses (action bwm), which it has besides Wan's keys."""
NOT_OURS = ("flow_stream.flow_head.*", "action_encoder.action_embedding.*")
"""Patterns of keys that we do not use. FlowWAM has a head for its flow too, which its published file may lack; BWM's class has
an embedding that its network does not use."""


def wan_layout(model: WorldModel, naming: Naming) -> Layout:
    """The 825 tensors (at full size) of Wan2.2-TI2V-5B, under the names of either project."""
    column, layers = COLUMN[naming], range(model.size.depth)
    layout = dict(_patches("patch_embedding", "patch_embedding", model.size.patch))
    layout["head.modulation"] = Source((("head.modulation", "scale_shift_table")[column],))
    for ours, theirs in LINEARS.items():
        layout |= dict(_linear(ours, (theirs[column],)))
    for ours, theirs in BLOCK_LINEARS.items():
        layout |= dict(_linear(f"blocks.{ours}", tuple(f"blocks.{layer}.{theirs[column]}" for layer in layers), stacked=True))
    for ours, theirs in BLOCK_VECTORS.items():
        keys = tuple(f"blocks.{layer}.{theirs[column]}" for layer in layers)
        layout[f"blocks.{ours}"] = Source(keys, stacked=True)
    return layout


def flowwam_layout(model: WorldModel) -> Layout:
    """What FlowWAM has besides: the patch embedding and the embedding of its flow stream."""
    if FLOW_STREAM not in model.condition_streams:
        return {}
    embedding = Source(("flow_stream.stream_embed",), "leading_ones", (1, 1))
    patches = _patches(f"stream_inputs.{FLOW_STREAM}", "flow_stream.flow_patch_embedding", model.size.patch)
    return {f"stream_embeddings.{FLOW_STREAM}": embedding, **dict(patches)}


def bwm_layout(model: WorldModel) -> Layout:
    """What Boundless-World-Model has besides: its two paths of tool poses."""
    layout: dict[str, Source] = {}
    for ours, theirs in BWM_LINEARS.items():
        if ours.split(".")[1] in model.mechanisms:
            layout |= dict(_linear(ours, (theirs,)))
    return layout


def dit_layout(model: WorldModel, naming: Naming) -> Layout:
    """Every leaf of a model: Wan's, FlowWAM's, BWM's, and under their own paths those that no other project has."""
    named = {**wan_layout(model, naming), **flowwam_layout(model), **bwm_layout(model)}
    paths = (".".join(map(str, path)) for path, _ in nnx.to_flat_state(nnx.state(model, nnx.Param)))
    return named | {path: Source((path,)) for path in paths if path not in named}


def load_dit(model: WorldModel, path: Path) -> None:
    """Fill a model in place from published weights: official Wan, diffusers' (its keys say which), or FlowWAM.

    What the file lacks of the streams starts from what it has: a picture stream's patch embedding becomes a copy of the
    loaded RGB one. FlowWAM's flow stream without a stream embedding gets none (zeros), as its world model was trained;
    other new leaves (stream embeddings, numeric streams, mechanisms, words) keep their random start.

    Args:
        model: of any size; of `nnx.eval_shape` only if the file has all of its leaves.
        path: as for `reading.read_tensors`.

    Raises:
        ConfigError: tensors are missing, left over or of another shape, or config.json next to them has other norms or
            positions than the model's.
    """
    tensors = read_tensors(path)
    _check_constants(model, tensors)
    layout, optional = _find_layout(model, tensors)
    fill(model, tensors, layout, optional=optional)
    for name in model.condition_streams:
        if STREAMS[name].source == "latents" and layout[f"stream_inputs.{name}.kernel"].keys[0] not in tensors:
            model.stream_inputs[name] = jax.tree.map(jnp.copy, model.patch_embedding)
        elif name == FLOW_STREAM and layout[f"stream_embeddings.{name}"].keys[0] not in tensors:
            embedding = model.stream_embeddings[name]
            embedding.set_value(jnp.zeros_like(embedding.get_value()))


def check_dit(model: WorldModel, tensors: Tensors) -> None:
    """Raise what `load_dit` would of these tensors, without reading one; `model` may be of `nnx.eval_shape`."""
    _check_constants(model, tensors)
    layout, optional = _find_layout(model, tensors)
    check_fit(model, tensors, layout, optional=optional)


def _check_constants(model: WorldModel, tensors: Tensors) -> None:
    """Raise ConfigError if config.json next to the weights says another eps or base of positions than the model's."""
    config, size = tensors.config, model.size
    for key, field in (("eps", "epsilon"), (ROPE_BASE, "rotary_base")):
        theirs, ours = config.get(key, getattr(size, field)), getattr(size, field)
        if not isinstance(theirs, int | float) or not math.isclose(theirs, ours, rel_tol=1e-6):
            raise ConfigError(
                f"the weights {tensors.source} were made with {key} = {theirs!r} (config.json), the model's size has {field} = "
                f"{ours:g}; choose a size with that {field} (MODELS in xew/model/network/dit.py)."
            )


def _find_layout(model: WorldModel, tensors: Tensors) -> tuple[Layout, tuple[str, ...]]:
    """The layout of a checkpoint; leaves that it may lack (all that Wan does not have) and keys that it may have besides."""
    naming = find_naming(tensors)
    layout = dit_layout(model, naming)
    return layout, (*(layout.keys() - wan_layout(model, naming).keys()), *NOT_OURS)


def load_dit_params(graph: nnx.GraphDef, params: Any, path: Path) -> Any:
    """`load_dit` for split models: the parameters with what the file has in them, each placed as it was."""
    model = nnx.merge(graph, params)
    load_dit(model, path)
    return nnx.state(model, nnx.Param)


def save_dit(model: WorldModel, path: Path, naming: Naming = "diffusers") -> None:
    """Write a model as safetensors (one file, or a folder of shards) under the names of a project.

    A folder of diffusers' names gets its config.json too, so that `WanTransformer3DModel.from_pretrained` opens it. What
    streams, mechanisms and words add is written with them, under the names that `load_dit` knows; that class passes over it.

    Raises:
        ConfigError: the file cannot be written.
    """
    save_weights(model, path, dit_layout(model, naming))
    if naming == "diffusers" and Path(path).suffix != ".safetensors":
        write_text(Path(path) / "config.json", json.dumps(diffusers_config(model), indent=2))


def diffusers_config(model: WorldModel) -> dict[str, Any]:
    """Arguments of `WanTransformer3DModel`, and under ROPE_BASE what it has no argument for: it turns with base 10,000."""
    size = model.size
    return {
        "_class_name": "WanTransformer3DModel",
        "attention_head_dim": size.head_dim,
        "cross_attn_norm": True,
        "eps": size.epsilon,
        "ffn_dim": size.ffn_dim,
        "freq_dim": TIME_FREQUENCIES,
        "in_channels": model.network.channels,
        "num_attention_heads": size.heads,
        "num_layers": size.depth,
        "out_channels": model.network.channels,
        "patch_size": list(model.size.patch),
        "qk_norm": "rms_norm_across_heads",
        "rope_max_seq_len": 1024,
        "text_dim": size.text_dim,
        ROPE_BASE: size.rotary_base,
    }


def find_naming(tensors: Tensors) -> Naming:
    """The project whose names a checkpoint uses."""
    return "diffusers" if any(key.startswith("condition_embedder.") for key in tensors) else "official"


def _linear(ours: str, theirs: tuple[str, ...], stacked: bool = False) -> Iterator[tuple[str, Source]]:
    yield f"{ours}.kernel", Source(tuple(f"{name}.weight" for name in theirs), "linear", stacked=stacked)
    yield f"{ours}.bias", Source(tuple(f"{name}.bias" for name in theirs), stacked=stacked)


def _patches(ours: str, theirs: str, patch: Patch) -> Iterator[tuple[str, Source]]:
    yield f"{ours}.kernel", Source((f"{theirs}.weight",), "patches", patch)
    yield f"{ours}.bias", Source((f"{theirs}.bias",))
