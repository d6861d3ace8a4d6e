"""(task, seed) -> episodes: scenes, experts, physics and rendering on Newton and Warp. Never imports JAX."""

import warp

warp.config.log_level = warp.LOG_ERROR  # no banner, no line per kernel module, no warning that a CPU is not a GPU
