"""Flow matching: noise levels and training pairs for training, samplers and noise schedules for rollouts.

The functions are pure, take arrays and noise levels in [0, 1], and know neither network nor data.
"""

__all__ = ["flow_matching", "samplers"]
