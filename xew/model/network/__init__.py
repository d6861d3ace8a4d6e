"""The diffusion transformer: tokens, blocks, mechanisms, LoRA, and the names of its published weights.

Its functions take and return arrays, independent of episodes and training.
"""

__all__ = ["blocks", "dit", "dit_layouts", "lora", "mechanisms", "spec", "tokens"]
