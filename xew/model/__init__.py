"""Episodes -> latent cache -> checkpoint -> rollouts, on JAX, Flax NNX, Optax, Orbax and Grain.

Commands: `latents`, `train`, `rollout`, `outside`, `export`, `release`. `conditions` lists the network's conditions.
"""

__all__ = [
    "conditions",
    "experiment",
    "export",
    "latents",
    "loading",
    "outside",
    "release",
    "rollout",
    "train",
]
