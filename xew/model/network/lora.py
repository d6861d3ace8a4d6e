"""Adaptation of a trained run to a new robot from a few episodes: which episodes, and low-rank corrections (LoRA).

The paper's few-shot protocol (its section on few-shot adaptation) changes all weights on the target's episodes alone.
Two remedies against forgetting, which it leaves open, are options: replay of the run's own training episodes, and LoRA
(Hu et al. 2021, arXiv 2106.09685), which leaves the run's weights as they are and learns W + A B with A of `rank` columns.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from xew.model.devices.sharding import LAYERS, path_names

LORA_LAYERS = ("q", "k", "v", "o", "first", "second")
"""Linear layers of the blocks that are corrected: both attentions' and the feed-forward's."""


def init_lora(params: Any, rank: int, key: Array) -> dict[str, dict[str, dict[str, Array]]]:
    """Corrections of the blocks' matrices, all zero in effect: A is normal over the root of its inputs, B is zero.

    Returns:
        {"blocks": {"self_attn.q.kernel": {"a": [layers in rank], "b": [layers rank out]}, …}} float32.
    """
    corrections = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        names = path_names(path)
        if is_lora_layer(names):
            key, own = jax.random.split(key)
            layers, inputs, outputs = leaf.shape
            a = jax.random.normal(own, (layers, inputs, rank), jnp.float32) / np.sqrt(inputs).astype(np.float32)
            corrections[".".join(names[1:])] = {"a": a, "b": jnp.zeros((layers, rank, outputs), jnp.float32)}
    return {LAYERS: corrections}


def is_lora_layer(names: Sequence[str]) -> bool:
    """Whether the parameter of this path is a matrix that LoRA corrects."""
    return names[0] == LAYERS and names[-1] == "kernel" and names[-2] in LORA_LAYERS


def apply_lora(base: Any, learned: Any) -> Any:
    """The network's parameters: `base` plus its corrections, or without a base what was learned itself."""
    if base is None:
        return learned

    def add(path: tuple[Any, ...], leaf: Array) -> Array:
        correction = learned[LAYERS].get(".".join(path_names(path)[1:]))
        return leaf if correction is None else leaf + correction["a"] @ correction["b"]

    return jax.tree_util.tree_map_with_path(add, base)
