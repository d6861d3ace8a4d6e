"""Names of the network's parameters in published weights: Wan2.2 (official and diffusers), FlowWAM and BWM.

Sources: Wan2.2's `wan/modules/model.py`, diffusers' `WanTransformer3DModel`, FlowWAM's `flow_stream`.
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
"""Key of config.json for the base of rotary positions; diffusers ignores keys with a leading underscore."""
COLUMN = {"official": 0, "diffusers": 1}
"""Index of each project's name in the pairs below."""

LINEARS = {
    "text_embedding.first": ("text_embedding.0", "condition_embedder.text_embedder.linear_1"),
    "text_embedding.second": ("text_embedding.2", "condition_embedder.text_embedder.linear_2"),
    "time_embedding.first": ("time_embedding.0", "condition_embedder.time_embedder.linear_1"),
    "time_embedding.second": ("time_embedding.2", "condition_embedder.time_embedder.linear_2"),
    "time_projection": ("time_projection.1", "condition_embedder.time_proj"),
    "head.head": ("head.head", "proj_out"),
}
"""Names of xew's modules in both projects; all have a weight and a bias."""
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
"""Norms and modulation; Wan's norm3 is norm2 in diffusers."""

FLOW_STREAM = "action"
"""xew's stream for FlowWAM's optical-flow stream."""
BWM_LINEARS = {
    "mechanisms.pose_context.first": "action_encoder.action_mlp1.0",
    "mechanisms.pose_context.second": "action_encoder.action_mlp1.2",
    "mechanisms.pose_time.first": "action_encoder.action_mlp2.0",
    "mechanisms.pose_time.second": "action_encoder.action_mlp2.2",
}
"""Names of the two tool-pose mechanisms (action bwm) in Boundless-World-Model."""
NOT_OURS = ("flow_stream.flow_head.*", "action_encoder.action_embedding.*")
"""Patterns of unused keys: FlowWAM's head for flow, and an embedding that BWM itself does not use."""


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
    """FlowWAM's additional tensors: the patch embedding and the embedding of its flow stream."""
    if FLOW_STREAM not in model.condition_streams:
        return {}
    embedding = Source(("flow_stream.stream_embed",), "leading_ones", (1, 1))
    patches = _patches(f"stream_inputs.{FLOW_STREAM}", "flow_stream.flow_patch_embedding", model.size.patch)
    return {f"stream_embeddings.{FLOW_STREAM}": embedding, **dict(patches)}


def bwm_layout(model: WorldModel) -> Layout:
    """Boundless-World-Model's additional tensors: its two tool-pose mechanisms."""
    layout: dict[str, Source] = {}
    for ours, theirs in BWM_LINEARS.items():
        if ours.split(".")[1] in model.mechanisms:
            layout |= dict(_linear(ours, (theirs,)))
    return layout


def dit_layout(model: WorldModel, naming: Naming) -> Layout:
    """Every leaf of a model: Wan's, FlowWAM's, BWM's, and xew's own under their paths."""
    named = {**wan_layout(model, naming), **flowwam_layout(model), **bwm_layout(model)}
    paths = (".".join(map(str, path)) for path, _ in nnx.to_flat_state(nnx.state(model, nnx.Param)))
    return named | {path: Source((path,)) for path in paths if path not in named}


def load_dit(model: WorldModel, path: Path) -> None:
    """Fill a model in place from published weights of Wan (official or diffusers), FlowWAM or BWM.

    Missing patch embeddings of picture streams become copies of RGB's. A missing embedding of FlowWAM's flow stream
    becomes zeros, as in its training. Other missing leaves (stream embeddings, numeric streams, mechanisms, words) keep their
    initial values.

    Args:
        model: of any size; abstract (of `nnx.eval_shape`) only if the file has all of its leaves.
        path: as for `reading.read_tensors`.

    Raises:
        ConfigError: tensors are missing, left over or of another shape, or config.json next to them has other norms or
            positions than the model.
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
    """Raise the errors of `load_dit` without reading the tensors; `model` may be abstract (of `nnx.eval_shape`)."""
    _check_constants(model, tensors)
    layout, optional = _find_layout(model, tensors)
    check_fit(model, tensors, layout, optional=optional)


def _check_constants(model: WorldModel, tensors: Tensors) -> None:
    """Raise ConfigError if config.json next to the weights has another eps or base of positions than the model."""
    config, size = tensors.config, model.size
    for key, field in (("eps", "epsilon"), (ROPE_BASE, "rotary_base")):
        theirs, ours = config.get(key, getattr(size, field)), getattr(size, field)
        if not isinstance(theirs, int | float) or not math.isclose(theirs, ours, rel_tol=1e-6):
            raise ConfigError(
                f"the weights {tensors.source} were made with {key} = {theirs!r} (config.json), the model's size has {field} = "
                f"{ours:g}; choose a size with that {field} (MODELS in xew/model/network/dit.py)."
            )


def _find_layout(model: WorldModel, tensors: Tensors) -> tuple[Layout, tuple[str, ...]]:
    """The layout of a checkpoint, and patterns of optional leaves (all that Wan does not have) and of unused keys."""
    naming = find_naming(tensors)
    layout = dit_layout(model, naming)
    return layout, (*(layout.keys() - wan_layout(model, naming).keys()), *NOT_OURS)


def load_dit_params(graph: nnx.GraphDef, params: Any, path: Path) -> Any:
    """`load_dit` for a split model; returns the loaded parameters with the placement of `params`."""
    model = nnx.merge(graph, params)
    load_dit(model, path)
    return nnx.state(model, nnx.Param)


def save_dit(model: WorldModel, path: Path, naming: Naming = "diffusers") -> None:
    """Write a model as safetensors (one file, or a folder of shards) under the names of a project.

    A folder with diffusers' names gets a config.json for `WanTransformer3DModel.from_pretrained`, which ignores the tensors of
    streams, mechanisms and words.

    Raises:
        ConfigError: the file cannot be written.
    """
    save_weights(model, path, dit_layout(model, naming))
    if naming == "diffusers" and Path(path).suffix != ".safetensors":
        write_text(Path(path) / "config.json", json.dumps(diffusers_config(model), indent=2), within=Path(path))


def diffusers_config(model: WorldModel) -> dict[str, Any]:
    """Arguments of `WanTransformer3DModel`, and the base of positions, which that class fixes at 10,000."""
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
