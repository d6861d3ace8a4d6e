"""(task, seed) -> episodes: scenes, experts, physics and rendering on Newton and Warp. Never imports JAX."""

import warp

warp.config.quiet = True  # no banner and no line per kernel module on every command's output
