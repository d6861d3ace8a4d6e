"""Shapes of the Franka Emika Panda with its hand: white shells, grey joints, after the link sizes of the vendor's meshes."""

from xew.sim_warp.robots.shapes.solids import PAD_HALF_WIDTH, PAD_THICKNESS, Box, Part, box_solid

MATERIALS = {"white": (240, 241, 243), "grey": (74, 78, 84)}
MESH_NAMES: dict[str, str] = {}


def finger(side: int) -> tuple[Box, ...]:
    """Pad and carriage of the finger that opens towards `side` (+1, -1) of y."""
    low, high = sorted((0, side * PAD_THICKNESS))
    inner, outer = sorted((side * 0.004, side * 0.026))
    return (
        Box((-PAD_HALF_WIDTH, low, 0.0195), (PAD_HALF_WIDTH, high, 0.0545), name="pad"),
        Box((-0.0105, inner, 0), (0.0105, outer, 0.0195)),
    )


COLLISIONS = {
    "panda_link1": (
        Box((-0.055, -0.055, -0.192), (0.055, 0.055, -0.055)),
        Box((-0.055, -0.1294, -0.055), (0.055, 0.055, 0.055)),
    ),
    "panda_link2": (
        Box((-0.055, -0.194, -0.055), (0.055, -0.055, 0.055)),
        Box((-0.055, -0.055, -0.055), (0.055, 0.055, 0.1295)),
    ),
    "panda_link3": (
        Box((-0.055, -0.055, -0.121), (0.055, 0.055, 0)),
        Box((0.0275, 0, -0.055), (0.1376, 0.111, 0.055)),
    ),
    "panda_link4": (
        Box((-0.1376, 0.0, -0.055), (-0.0275, 0.124, 0.055)),
        Box((-0.055, -0.055, 0), (0.055, 0.055, 0.111)),
    ),
    "panda_link5": (
        Box((-0.055, -0.055, -0.2646), (0.055, 0.09, -0.17)),
        Box((-0.05, 0.0, -0.17), (0.05, 0.13, 0.052)),
    ),
    "panda_link6": (Box((-0.048, -0.0514, -0.044), (0.1322, 0.0817, 0.0563)),),
    "panda_link7": (Box((-0.044, -0.044, 0.052), (0.065, 0.065, 0.107)),),
    "panda_hand": (Box((-0.0316, -0.1, -0.026), (0.0316, 0.1, 0.066)),),
    "panda_leftfinger": finger(1),
    "panda_rightfinger": finger(-1),
}
PARTS: dict[str, list[Part]] = {
    link: [("grey" if "finger" in link else "white", box_solid(box)) for box in boxes] for link, boxes in COLLISIONS.items()
}
PARTS["panda_link0"] = [("white", box_solid(Box((-0.154, -0.0946, 0), (0.0716, 0.0947, 0.14))))]
