"""(task, seed) -> episodes: scenes, experts, physics and rendering on Newton and Warp. Never imports JAX."""
