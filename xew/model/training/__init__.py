"""Training: batches in a reproducible order, one compiled step, a memory estimate, curves and samples.

Results are the same on one device and on many, interrupted or not.
"""

__all__ = ["data", "flops", "loop", "memory", "order", "samples", "start", "step"]
