"""Shapes of the AgileX Piper: a dark, slender arm with red marks, after the link sizes of the vendor's meshes."""

from lab.robots.shapes.parts import camera
from xew.sim_warp.robots.procedural.solids import (
    PAD_HALF_WIDTH,
    PAD_THICKNESS,
    Box,
    Part,
    box_solid,
    cylinder,
    hull,
    loft,
    rounded_box,
    transform,
)

MATERIALS = {
    "dark": (70, 73, 80),
    "gray": (128, 131, 137),
    "black": (36, 37, 41),
    "red": (208, 38, 38),
    "rubber": (20, 20, 22),
    "case": (150, 152, 156),
    "lens": (24, 24, 28),
}
MESH_NAMES: dict[str, str] = {}

UPPER_ARM = (0, 0, 0.10095)
FOREARM = (0, 0, 1.3826)
"""Axes of the vendor's later frames of link2 and link3, in which mesh sizes are known: x, respectively y, along the arm."""


def finger(side: int) -> tuple[Box, ...]:
    """Pad and carriage of the finger whose frame has the approach along `side` (+1, -1) of y; it opens toward -z."""
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


def base_parts() -> list[Part]:
    foot = rounded_box((-0.0585, -0.04, 0), (0.04, 0.04, 0.03), 0.006)
    return [
        ("dark", foot),
        ("dark", cylinder((0, 0, 0.03), (0, 0, 0.08), 0.0375)),
        ("gray", cylinder((0, 0, 0.08), (0, 0, 0.084), 0.035)),
    ]


def link1_parts() -> list[Part]:
    """A turning head with the shoulder's motor across it."""
    head = hull(cylinder((0, 0, -0.035), (0, 0, -0.02), 0.035), cylinder((-0.034, 0, 0), (0.034, 0, 0), 0.029))
    return [
        ("dark", head),
        ("gray", cylinder((0, 0, -0.043), (0, 0, -0.035), 0.033)),
        ("black", cylinder((-0.0405, 0, 0), (0.0367, 0, 0), 0.022)),
    ]


def link2_parts() -> list[Part]:
    """The upper arm: forked at both ends, its beam bowed."""
    turn = transform(rpy=UPPER_ARM)
    beam = loft(
        "x",
        [
            (-0.01, -0.026, 0.026, -0.043, 0.043),
            (0.034, -0.0327, 0.0287, -0.043, 0.043),
            (0.077, -0.0387, 0.0114, -0.0325, 0.0325),
            (0.121, -0.046, 0.0012, -0.0205, 0.0205),
            (0.164, -0.0559, -0.0085, -0.0205, 0.0205),
            (0.208, -0.0647, -0.016, -0.0292, 0.0292),
            (0.251, -0.062, 0.0277, -0.043, 0.043),
            (0.296, -0.0462, 0.0262, -0.043, 0.043),
        ],
        UPPER_ARM,
    )
    motors = [cylinder((x, 0, -0.0485), (x, 0, 0.0485), 0.0312, bevel=0.003) for x in (0, 0.285)]
    marks = [cylinder((x, 0, z), (x, 0, 1.04 * z), 0.021) for x in (0, 0.285) for z in (-0.0485, 0.0485)]
    for solid in motors + marks:
        solid.apply_transform(turn)
    return [("dark", beam), *[("black", solid) for solid in motors], *[("red", solid) for solid in marks]]


def link3_parts() -> list[Part]:
    """The forearm: a hub in the upper arm's fork, a waist, and the motor of the wrist's turn."""
    tube = loft(
        "y",
        [
            (0.0, -0.024, 0.03, -0.036, 0.036),
            (0.03, -0.02, 0.037, -0.038, 0.038),
            (0.0465, -0.0072, 0.039, -0.038, 0.038),
            (0.077, 0.0037, 0.0373, -0.0219, 0.0219),
            (0.108, 0.0071, 0.0379, -0.0183, 0.0183),
            (0.138, -0.0027, 0.0467, -0.0234, 0.0234),
            (0.165, -0.0065, 0.0505, -0.0285, 0.0285),
            (0.205, -0.0065, 0.0505, -0.0285, 0.0285),
        ],
        FOREARM,
    )
    hub = cylinder((0, 0, -0.04), (0, 0, 0.0408), 0.03)
    end = cylinder((0.022, 0.205, 0), (0.022, 0.2148, 0), 0.0265)
    stripe = rounded_box((0.0504, 0.15, -0.006), (0.0515, 0.195, 0.006), 0.0004)
    for solid in (hub, end, stripe):
        solid.apply_transform(transform(rpy=FOREARM))
    return [("dark", tube), ("black", hub), ("gray", end), ("red", stripe)]


def link4_parts() -> list[Part]:
    """The wrist's knuckle."""
    knuckle = hull(cylinder((0, 0, -0.034), (0, 0, -0.01), 0.0285), cylinder((0, -0.03, 0), (0, 0.0225, 0), 0.0255))
    return [("dark", knuckle), ("black", cylinder((0, -0.034, 0), (0, 0.028, 0), 0.02))]


def link5_parts() -> list[Part]:
    """A one-sided yoke round the knuckle, and the motor of the last joint."""
    yoke = hull(
        cylinder((0, 0, -0.031), (0, 0, -0.0225), 0.0285), rounded_box((-0.027, 0.02, -0.031), (0.027, 0.04, -0.0225), 0.002)
    )
    motor = loft(
        "y",
        [
            (0.028, -0.026, 0.026, -0.03, 0.0285),
            (0.05, -0.0285, 0.0285, -0.029, 0.0299),
            (0.087, -0.0285, 0.0285, -0.0275, 0.0299),
        ],
        corner=0.5,
    )
    return [("dark", yoke), ("dark", motor), ("gray", cylinder((0, 0.087, 0.001), (0, 0.091, 0.001), 0.026))]


def link6_parts() -> list[Part]:
    """Flange, gripper body, and the rail on which the fingers slide along y."""
    body = loft(
        "z", [(0.004, -0.028, 0.028, -0.028, 0.028), (0.03, -0.0305, 0.034, -0.033, 0.033), (0.05, -0.028, 0.03, -0.05, 0.05)]
    )
    rail = loft(
        "y",
        [
            (-0.0725, -0.0113, 0.0113, 0.046, 0.067),
            (-0.03, -0.0235, 0.0235, 0.042, 0.067),
            (0.03, -0.0235, 0.0235, 0.042, 0.067),
            (0.0725, -0.0113, 0.0113, 0.046, 0.067),
        ],
    )
    return [("gray", cylinder((0, 0, 0), (0, 0, 0.004), 0.0265)), ("dark", body), ("black", rail)]


def finger_parts(side: int) -> list[Part]:
    """A paddle that narrows toward its rubber tip; the approach is along `side` of y."""
    stations = [
        (-0.0715, -0.026, 0.026, -0.0245, -0.002),
        (-0.0572, -0.026, 0.026, -0.0243, -0.002),
        (-0.0476, -0.0225, 0.0225, -0.02, -0.002),
        (-0.0381, -0.0187, 0.0187, -0.016, -0.002),
        (-0.0285, -0.0145, 0.0145, -0.0125, -0.0015),
        (-0.004, -0.0115, 0.0115, -0.0095, -0.001),
    ]
    paddle = loft("y", [(side * station[0], *station[1:]) for station in stations])
    return [("dark", paddle), ("rubber", box_solid(finger(side)[0]))]


PARTS: dict[str, list[Part]] = {
    "base_link": base_parts(),
    "link1": link1_parts(),
    "link2": link2_parts(),
    "link3": link3_parts(),
    "link4": link4_parts(),
    "link5": link5_parts(),
    "link6": link6_parts(),
    "link7": finger_parts(1),
    "link8": finger_parts(-1),
    "camera": camera((-0.0125, -0.077, -0.0125), (0.0125, 0.013, 0.0125), ((-0.008, -0.047, -0.04), (0.006, -0.017, -0.01))),
}
