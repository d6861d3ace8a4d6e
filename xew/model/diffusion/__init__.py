"""Flow matching: noise levels and training pairs on the way in, samplers along a noise schedule on the way back.

Pure functions of arrays and noise levels in [0, 1]; they know neither network nor data.
"""

__all__ = ["flow_matching", "samplers"]
