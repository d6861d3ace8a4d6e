"""Training of autoencoders: pictures decoded once into memory, one step for every kind of autoencoder, and a report.

A step's samples and noise depend on the seed and the number of the step alone, so that a resumed training repeats them.
"""

__all__ = ["kinds", "pictures", "report", "sampling", "settings", "step"]
