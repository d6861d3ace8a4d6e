"""Simulation: (task, seed) to episodes, by scenes, experts, physics and rendering on Newton and Warp. It never imports JAX."""
