"""LoRA (Hu et al. 2021, arXiv 2106.09685): low-rank corrections W + A B of the blocks' matrices, to adapt a trained run.

The paper's few-shot protocol fine-tunes all weights on the target's episodes; LoRA and replay are options against forgetting.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Key

from xew.model.devices.sharding import LAYERS, path_names

LORA_LAYERS = ("q", "k", "v", "o", "first", "second")
"""Names of the corrected linear layers in a block: both attentions' and the feed-forward's."""
Lora = dict[str, dict[str, dict[str, Float[Array, "layers i o"]]]]
"""Matrices A [layers in rank] and B [layers rank out] float32, as {"blocks": {"self_attn.q.kernel": {"a": A, "b": B}, …}}."""


def init_lora(params: Any, rank: int, key: Key[Array, ""]) -> Lora:
    """Initial corrections of the matrices [layers in out] in the blocks: A [layers in rank] is random, B is zero."""
    learned = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        names = path_names(path)
        if names[0] == LAYERS and names[-1] == "kernel" and names[-2] in LORA_LAYERS:
            key, own = jax.random.split(key)
            layers, inputs, outputs = leaf.shape
            a = jax.random.normal(own, (layers, inputs, rank), jnp.float32) / np.sqrt(inputs).astype(np.float32)
            learned[".".join(names[1:])] = {"a": a, "b": jnp.zeros((layers, rank, outputs), jnp.float32)}
    return {LAYERS: learned}


def apply_lora(base: Any, learned: Any) -> Any:
    """The network's parameters: `base` plus its corrections (see `Lora`), or `learned` if there is no base."""
    if base is None:
        return learned

    def add(path: tuple[Any, ...], leaf: Array) -> Array:
        matrices = learned[LAYERS].get(".".join(path_names(path)[1:]))
        return leaf if matrices is None else leaf + matrices["a"] @ matrices["b"]

    return jax.tree_util.tree_map_with_path(add, base)
