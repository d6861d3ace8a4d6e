"""Episodes -> latent cache -> checkpoint -> rollouts, on JAX, Flax NNX, Optax, Orbax and Grain.

Its commands are `latents`, `train`, `rollout`, `outside`, `export` and `release`; `conditions` lists
what the network can be conditioned on, and `experiment` reads a config.
"""

__all__ = [
    "conditions",
    "experiment",
    "export",
    "latents",
    "outside",
    "release",
    "rollout",
    "train",
]
