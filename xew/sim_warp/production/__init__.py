"""Seeds to episodes in batches: scene, plan, joint commands, physics, pictures, files.

A cell that fails carries its reason; what is written is complete or absent.
"""

__all__ = ["expert", "produce"]
