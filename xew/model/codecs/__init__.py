"""Video codecs: frames to latents and back, the names of published weights, and the ceiling that a codec sets.

Every codec is causal in time: it encodes the first frame alone, then groups of four. `contract.py` says what each promises,
`codec.py` lists them.
"""

__all__ = [
    "autoencoders",
    "ceiling",
    "codec",
    "contract",
    "conv_autoencoder",
    "vae",
    "vae_chunks",
    "vae_layers",
    "vae_layouts",
]
