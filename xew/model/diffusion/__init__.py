"""Flow matching: noise levels and training pairs for training, samplers and noise schedules for rollouts.

The functions are pure and independent of network and data.
"""

__all__ = ["flow_matching", "samplers"]
