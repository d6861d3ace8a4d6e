"""Devices and worker processes: which device does the work, how many processes share it, and how they wait for a GPU.

`kernels` compiles many of Warp's kernels at once, `workers` starts processes that end with their parent, `waiting` waits
without keeping a core busy, `newton` imports Newton when it is needed, and so that its kernels compile in half the time.
"""

__all__ = ["kernels", "newton", "waiting", "workers"]
