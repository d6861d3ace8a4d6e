"""Shapes of the AgileX PiPER: a dark, slender arm, after the link sizes of the vendor's meshes."""

from xew.sim_warp.robots.shapes.solids import PAD_HALF_WIDTH, PAD_THICKNESS, Box, Part, box_solid

MATERIALS = {"dark": (44, 46, 50)}
MESH_NAMES: dict[str, str] = {}

UPPER_ARM = (0, 0, 0.10095)
FOREARM = (0, 0, 1.3826)
"""The vendor's later frames of link2 and link3, in which mesh sizes are known: x, respectively y, along the arm."""


def finger(side: int) -> tuple[Box, ...]:
    """Pad and carriage of the finger whose frame has the approach along `side` (+1, -1) of y; it opens towards -z."""
    tip = 0.14 - 0.13503
    low, high = sorted((side * tip, side * (tip - 0.035)))
    back, front = sorted((side * (tip - 0.035), side * -0.0715))
    return (
        Box((-PAD_HALF_WIDTH, low, -PAD_THICKNESS), (PAD_HALF_WIDTH, high, 0), name="pad"),
        Box((-0.02, back, -0.0245), (0.02, front, -0.003)),
    )


COLLISIONS = {
    "link1": (Box((-0.041, -0.036, -0.043), (0.037, 0.036, 0.03)),),
    "link2": (
        Box((-0.0315, -0.04, -0.0485), (0.06, 0.0316, 0.0485), UPPER_ARM),
        Box((0.06, -0.065, -0.0485), (0.3165, 0.0316, 0.0485), UPPER_ARM),
    ),
    "link3": (
        Box((-0.03, -0.03, -0.04), (0.039, 0.06, 0.0408), FOREARM),
        Box((-0.0065, 0.06, -0.0285), (0.0505, 0.2148, 0.0285), FOREARM),
    ),
    "link4": (Box((-0.0305, -0.034, -0.036), (0.033, 0.0285, 0.0285)),),
    "link5": (Box((-0.03, -0.0235, -0.031), (0.03, 0.091, 0.03)),),
    "link6": (Box((-0.0305, -0.0725, 0.03), (0.0305, 0.0725, 0.067)), Box((-0.03, -0.035, 0), (0.035, 0.035, 0.03))),
    "link7": finger(1),
    "link8": finger(-1),
}
PARTS: dict[str, list[Part]] = {link: [("dark", box_solid(box)) for box in boxes] for link, boxes in COLLISIONS.items()}
PARTS["base_link"] = [("dark", box_solid(Box((-0.0585, -0.04, 0), (0.04, 0.04, 0.086))))]
