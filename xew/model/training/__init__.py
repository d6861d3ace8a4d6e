"""Training: batches in an exact order, one compiled step, memory estimated beforehand, curves and samples.

The same numbers on one device and on many, interrupted or not.
"""

__all__ = ["data", "flops", "loop", "memory", "order", "samples", "start", "step"]
