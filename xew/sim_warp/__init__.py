"""Simulation: (task, seed) to episodes, by scenes, experts, physics and rendering on Newton and Warp. It never imports JAX.

At its root lie the commands (`generate`, `inspect`), the seeds that are known (`manifest`), and what a task is written with
(`scene`, `objects`, `plan`, `stage`). One level down lies the way of a seed: `tasks`, `production`, `physics`, `rendering`, and
what these build on.
"""

__all__ = [
    "assets",
    "devices",
    "embodiment",
    "generate",
    "geometry",
    "inspect",
    "kinematics",
    "manifest",
    "objects",
    "physics",
    "plan",
    "production",
    "rendering",
    "robots",
    "scene",
    "stage",
    "tasks",
]
