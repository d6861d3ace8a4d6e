"""Shapes of the ARX X5: black, its upper arm and forearm white, after the link sizes of the vendor's meshes."""

from xew.sim_warp.robots.shapes.solids import PAD_HALF_WIDTH, PAD_THICKNESS, Box, Part, box_solid

MATERIALS = {"black": (32, 32, 34), "white": (236, 236, 232)}
MESH_NAMES: dict[str, str] = {}

LINK1 = (Box((-0.022, -0.039, 0), (0.037, 0.039, 0.058)),)
LINK2 = (Box((-0.294, -0.033, -0.03), (0.03, 0.037, 0.03)),)
LINK3 = (Box((-0.02, -0.038, -0.076), (0.06, 0.038, 0.02)), Box((0.06, -0.028, -0.085), (0.273, 0.028, -0.03)))
LINK4 = (Box((-0.0175, -0.031, -0.0845), (0.096, 0.029, 0.0175)),)
LINK5 = (Box((-0.03, -0.03, 0), (0.03, 0.03, 0.1106)),)
PALM = (Box((0, -0.087, -0.028), (0.066, 0.087, 0.03)),)


def finger(side: int, tip: float, face: float) -> tuple[Box, ...]:
    """Carriage and pad of the finger that opens towards `side` (+1, -1) of y: its tip at x, its face at y = -side * face."""
    low, high = sorted((-side * face, side * (PAD_THICKNESS - face)))
    pad = Box((tip - 0.035, low, -PAD_HALF_WIDTH), (tip, high, PAD_HALF_WIDTH), name="pad")
    inner, outer = sorted((side * (0.004 - face), side * 0.0127))
    return (pad, Box((-0.015, inner, -0.025), (tip - 0.035, outer, 0.025)))


COLLISIONS = {
    "link1": LINK1,
    "link2": LINK2,
    "link3": LINK3,
    "link4": LINK4,
    "link5": LINK5,
    "link6": PALM,
    "link7": finger(1, 0.157 - 0.08657, 0.024896),
    "link8": finger(-1, 0.157 - 0.08657, 0.0249),
}
PARTS: dict[str, list[Part]] = {
    link: [("white" if link == "link3" else "black", box_solid(box)) for box in boxes] for link, boxes in COLLISIONS.items()
}
