"""The latent cache: every stream of an episode encoded once, and the scales of numeric conditions.

File names hold a hash of their sources, so stale files are never read. A missing file is an error with the remedy.
"""

__all__ = ["clips", "encode", "keys", "scales", "store"]
