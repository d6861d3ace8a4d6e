"""Shapes of the five robots, a module each: materials, solids and collision boxes by link. `lab.robots.author` writes them."""
