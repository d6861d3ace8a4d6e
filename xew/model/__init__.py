"""Episodes -> latent cache -> checkpoint -> rollouts, on JAX, Flax NNX, Optax, Orbax and Grain."""
