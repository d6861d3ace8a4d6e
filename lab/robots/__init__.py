"""Tools for the package's robots: author the five robots' geometry, draw them, map their reach, find procedural bodies.

    python -m lab.robots.author            shapes -> URDFs and meshes of the five robots
    python -m lab.robots.sheet             pictures and reference renders of robots
    python -m lab.robots.reach             which tool poses the robots reach, as Markdown
    python -m lab.robots.bodies            search for procedural bodies that work -> catalog.json
    python -m lab.robots.measure_bodies    yields, distances, rate and loading time of procedural bodies

All but `measure_bodies` write or print what the package and its pages keep; `measure_bodies` measures it.
"""
