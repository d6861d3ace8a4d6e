"""Shapes of the UR5 with WSG-50: light grey tubes, blue caps, a silver gripper, after the link sizes of the vendors' meshes."""

from xew.sim_warp.robots.shapes.solids import PAD_HALF_WIDTH, PAD_THICKNESS, Box, Part, box_solid

MATERIALS = {"grey": (198, 202, 206), "silver": (150, 152, 156)}
MESH_NAMES: dict[str, str] = {}

FINGER = (
    Box((0.0027 - PAD_THICKNESS, -PAD_HALF_WIDTH, 0.0955), (0.0027, PAD_HALF_WIDTH, 0.1305), name="pad"),
    Box((-0.02, -0.015, 0.0575), (-0.002, 0.015, 0.0955)),
)
COLLISIONS = {
    "shoulder_link": (Box((-0.06, -0.06, -0.065), (0.06, 0.0705, 0.0685)),),
    "upper_arm_link": (Box((-0.06, -0.065, -0.06), (0.06, 0.0686, 0.485)),),
    "forearm_link": (Box((-0.058, -0.057, -0.058), (0.0585, 0.0545, 0.431)),),
    "wrist_1_link": (Box((-0.039, 0.0475, -0.057), (0.039, 0.1325, 0.0475)),),
    "wrist_2_link": (Box((-0.039, -0.057, 0.049), (0.039, 0.0475, 0.1334)),),
    "wrist_3_link": (Box((-0.0375, 0.0473, -0.0375), (0.0375, 0.0818, 0.043)),),
    "wsg_50_base_link": (Box((-0.073, -0.025, 0), (0.073, 0.025, 0.0725)),),
    "finger_left": FINGER,
    "finger_right": FINGER,
}
PARTS: dict[str, list[Part]] = {
    link: [("silver" if "wsg" in link or "finger" in link else "grey", box_solid(box)) for box in boxes]
    for link, boxes in COLLISIONS.items()
}
PARTS["base_link"] = [("grey", box_solid(Box((-0.075, -0.075, 0), (0.075, 0.075, 0.03))))]
