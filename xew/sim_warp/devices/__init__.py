"""Devices and worker processes: choice of the device, number of processes, and waiting for a GPU.

`kernels` compiles many of Warp's kernels in parallel, `workers` starts processes that end with their parent, `waiting` waits
without occupying a core, `newton` imports Newton on first use without adjoint kernels.
"""

__all__ = ["kernels", "newton", "waiting", "workers"]
