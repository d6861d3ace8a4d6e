"""Episodes -> latent cache -> checkpoint -> rollouts, on JAX, Flax NNX, Optax, Orbax and Grain.

Its commands are `latents`, `train`, `train_codec`, `train_vae`, `rollout`, `outside` and `export`; `conditions` holds what the
network may be told, and `experiment` reads a config.
"""

__all__ = ["conditions", "experiment", "export", "latents", "outside", "rollout", "train", "train_codec", "train_vae"]
