"""The diffusion transformer: tokens, blocks, mechanisms, low-rank corrections, and the names of its published weights.

Shapes in, shapes out; nothing here reads an episode or knows a training loop.
"""

__all__ = ["blocks", "dit", "dit_layouts", "lora", "mechanisms", "tokens"]
