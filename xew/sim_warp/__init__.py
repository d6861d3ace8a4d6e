"""Simulation: (task, seed) to episodes, by scenes, experts, physics and rendering on Newton and Warp. It never imports JAX.

The root has the commands (`generate`, `inspect`), the known seeds (`manifest`), and the modules that tasks use (`scene`,
`objects`, `plan`, `stage`). The packages make episodes: `tasks`, `production`, `physics`, `rendering`, and their foundations.
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
