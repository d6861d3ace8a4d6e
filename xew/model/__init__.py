"""Episodes -> latent cache -> checkpoint -> rollouts, on JAX, Flax NNX, Optax, Orbax and Grain.

Its commands are `latents`, `train`, `train_codec`, `train_vae`, `rollout`, `outside`, `export` and `release`; `conditions`
holds what the network may be told, and `experiment` reads a config.
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
    "train_codec",
    "train_vae",
]
