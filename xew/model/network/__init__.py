"""The diffusion transformer: tokens, blocks, mechanisms, LoRA, and the names of its published weights.

Its functions take and give arrays; nothing here reads an episode or knows a training loop.
"""

__all__ = ["blocks", "dit", "dit_layouts", "lora", "mechanisms", "spec", "tokens"]
