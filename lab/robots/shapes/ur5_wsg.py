"""Shapes of the UR5 with WSG-50: light gray tubes, blue caps, a silver gripper, after the link sizes of the vendors' meshes."""

from lab.robots.shapes.parts import camera, point_between
from xew.sim_warp.robots.procedural.solids import (
    PAD_HALF_WIDTH,
    PAD_THICKNESS,
    Box,
    Part,
    Vector,
    box_solid,
    cylinder,
    dome,
    hull,
    rounded_box,
)

MATERIALS = {
    "gray": (206, 209, 212),
    "blue": (112, 168, 208),
    "dark": (78, 80, 84),
    "silver": (158, 161, 166),
    "rubber": (30, 30, 32),
    "case": (150, 152, 156),
    "lens": (24, 24, 28),
}
MESH_NAMES = {"finger_right": "finger_left", "gripper_right": "gripper_left"}

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


def housing(start: Vector, end: Vector, radius: float) -> list[Part]:
    """A joint's housing along its axis: gray, with a blue cap over its end."""
    seam = point_between(start, end, 0.78)
    return [("gray", cylinder(start, seam, radius)), ("blue", dome(seam, end, 0.985 * radius))]


def ring(start: Vector, end: Vector, radius: float) -> Part:
    """The dark gap between two links."""
    return ("dark", cylinder(start, end, radius))


def tee(axis: int) -> list[Part]:
    """A wrist: a stub along `axis` (1 for y, 2 for z) and a capped housing across it."""
    swap = (lambda x, y, z: (x, y, z)) if axis == 1 else (lambda x, y, z: (x, z, y))
    return [
        ring(swap(0, 0.0475, 0), swap(0, 0.052, 0), 0.036),
        ("gray", cylinder(swap(0, 0.052, 0), swap(0, 0.093, 0), 0.0375)),
        *housing(swap(0, 0.093, 0.0435), swap(0, 0.093, -0.057), 0.0385),
        ring(swap(0, 0.093, 0.0435), swap(0, 0.093, 0.0475), 0.036),
    ]


def upper_arm_parts() -> list[Part]:
    ends = [part for z in (0, 0.425) for part in housing((0, -0.061, z), (0, 0.0686, z), 0.0585)]
    return [
        *ends,
        ring((0, -0.0652, 0), (0, -0.061, 0), 0.056),
        ring((0, -0.0652, 0.425), (0, -0.061, 0.425), 0.056),
        ("gray", cylinder((0, 0, 0.04), (0, 0, 0.385), 0.05)),
        ("gray", hull(cylinder((0, 0, 0.03), (0, 0, 0.085), 0.0545, 0.05), cylinder((0, -0.05, 0), (0, 0.045, 0), 0.0565))),
        (
            "gray",
            hull(cylinder((0, 0, 0.34), (0, 0, 0.395), 0.05, 0.0545), cylinder((0, -0.05, 0.425), (0, 0.045, 0.425), 0.0565)),
        ),
    ]


def forearm_parts() -> list[Part]:
    return [
        *housing((0, 0.0545, 0), (0, -0.034, 0), 0.0575),
        ("gray", hull(cylinder((0, 0, 0.03), (0, 0, 0.1), 0.05, 0.039), cylinder((0, -0.02, 0), (0, 0.045, 0), 0.055))),
        ("gray", cylinder((0, 0, 0.1), (0, 0, 0.365), 0.039)),
        *housing((0, 0.0475, 0.39225), (0, -0.0572, 0.39225), 0.0388),
    ]


def gripper_body_parts() -> list[Part]:
    return [
        ("silver", rounded_box((-0.073, -0.025, 0.004), (0.073, 0.025, 0.06), 0.004)),
        ("dark", rounded_box((-0.071, -0.022, 0.06), (0.071, 0.022, 0.0725), 0.003)),
        ("dark", cylinder((0, 0, -0.002), (0, 0, 0.004), 0.032)),
    ]


def finger_parts() -> list[Part]:
    """Bar and pad; the fingertip of the FMF kind is slim."""
    bar = hull(
        rounded_box((-0.02, -0.015, 0.0575), (-0.002, 0.015, 0.073), 0.002),
        box_solid(Box((-0.0155, -0.011, 0.09), (-0.0023, 0.011, 0.12))),
    )
    return [("silver", bar), ("rubber", box_solid(FINGER[0]))]


PARTS: dict[str, list[Part]] = {
    "base_link": [
        ("gray", cylinder((0, 0, 0), (0, 0, 0.02), 0.0745, bevel=0.004, sections=20)),
        ("dark", cylinder((0, 0, 0.02), (0, 0, 0.0265), 0.058)),
    ],
    "shoulder_link": [
        ("gray", cylinder((0, 0, -0.062), (0, 0, 0.03), 0.0585)),
        ("blue", dome((0, 0, 0.03), (0, 0, 0.0685), 0.0578)),
        ("gray", cylinder((0, 0, 0), (0, 0.066, 0), 0.057)),
        ring((0, 0.066, 0), (0, 0.0705, 0), 0.055),
    ],
    "upper_arm_link": upper_arm_parts(),
    "forearm_link": forearm_parts(),
    "wrist_1_link": tee(1),
    "wrist_2_link": tee(2),
    "wrist_3_link": [("dark", cylinder((0, 0.0473, 0), (0, 0.0818, 0), 0.0375, bevel=0.003))],
    "wsg_50_base_link": gripper_body_parts(),
    "gripper_left": [("dark", rounded_box((-0.018, -0.013, 0.06), (-0.001, 0.013, 0.084), 0.002))],
    "gripper_right": [("dark", rounded_box((-0.018, -0.013, 0.06), (-0.001, 0.013, 0.084), 0.002))],
    "finger_left": finger_parts(),
    "finger_right": finger_parts(),
    "camera": camera((-0.0125, -0.045, -0.0125), (0.0125, 0.045, 0.0125), ((-0.008, -0.02, -0.032), (0.006, 0.02, -0.01))),
}
