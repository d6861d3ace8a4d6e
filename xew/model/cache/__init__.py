"""The latent cache: every stream of an episode encoded once, and the scales of conditions that are numbers.

What is stale is never found, and what is missing is an error that says how to make it.
"""

__all__ = ["clips", "encode", "keys", "scales", "store"]
