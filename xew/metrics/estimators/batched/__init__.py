"""The default estimators for a GPU: all frames of a video at once, in Warp kernels that follow OpenCV's arithmetic.

Kernels are the same on a CPU, where tests hold them against OpenCV; there the frame by frame code is faster.
"""

__all__: list[str] = []
