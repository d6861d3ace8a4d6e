"""An autoencoder that every test of codecs may take."""

import jax
import jax.numpy as jnp
import pytest
from flax import nnx

from xew.model.codecs.conv_autoencoder import AUTOENCODERS, ConvAutoencoder


@pytest.fixture(scope="session")
def random_autoencoder() -> ConvAutoencoder:
    """The tiny autoencoder at random, all of its blocks at work."""
    autoencoder = ConvAutoencoder(AUTOENCODERS["tiny"], rngs=nnx.Rngs(0))
    key = jax.random.key(1)
    for path, leaf in nnx.to_flat_state(nnx.state(autoencoder, nnx.Param)):
        if path[-1] == "kernel":
            fan_in = leaf.shape[0] * leaf.shape[1] * leaf.shape[2]
            values = jax.random.normal(jax.random.fold_in(key, hash(path) % 1000), leaf.shape) / fan_in**0.5
            leaf.set_value(values)
    autoencoder.latents_mean.set_value(jnp.linspace(-1.0, 1.0, 48))
    return autoencoder
