"""Shapes of the Franka Emika Panda with its hand: rounded white shells, dark joints, after the vendor's mesh sizes."""

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
    loft,
    rounded_box,
)

MATERIALS = {
    "white": (244, 244, 245),
    "shell": (226, 230, 232),
    "gray": (66, 68, 72),
    "blue": (10, 138, 199),
    "rubber": (30, 30, 32),
    "case": (150, 152, 156),
    "lens": (24, 24, 28),
}
MESH_NAMES: dict[str, str] = {}


def finger(side: int) -> tuple[Box, ...]:
    """Pad and carriage of the finger that opens toward `side` (+1, -1) of y."""
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


def drum(start: Vector, end: Vector, radius: float = 0.0545) -> list[Part]:
    """Half of a joint: dark at the seam where it starts, a white dome where it ends."""
    seam = point_between(start, end, 0.06)
    return [("gray", cylinder(start, seam, 0.96 * radius)), ("white", dome(seam, end, radius))]


def base_parts() -> list[Part]:
    """The foot, with its connector block behind, under the first joint."""
    foot = hull(rounded_box((-0.085, -0.075, 0), (0.06, 0.075, 0.012)), cylinder((0, 0, 0.08), (0, 0, 0.135), 0.0545))
    tail = hull(
        rounded_box((-0.154, -0.06, 0), (-0.06, 0.06, 0.05), 0.008), cylinder((-0.04, 0, 0.1), (-0.04, 0, 0.125), 0.045)
    )
    plate = rounded_box((-0.14, -0.094, 0), (0.0716, 0.094, 0.01), 0.002)
    return [("white", foot), ("shell", tail), ("gray", plate), ("gray", cylinder((0, 0, 0.135), (0, 0, 0.141), 0.052))]


def link1_parts() -> list[Part]:
    """A column, leaning into the outer half of the shoulder."""
    column = cylinder((0, 0, -0.192), (0, 0, -0.14), 0.0548)
    neck = hull(cylinder((0, 0, -0.145), (0, 0, -0.14), 0.0548), cylinder((0, -0.02, 0), (0, -0.1, 0), 0.052))
    return [("white", column), ("white", neck), *drum((0, 0, 0), (0, -0.1294, 0))]


def link2_parts() -> list[Part]:
    """The inner half of the shoulder, and the column of the upper arm."""
    column = cylinder((0, -0.142, 0), (0, -0.19, 0), 0.0548)
    neck = hull(cylinder((0, -0.145, 0), (0, -0.142, 0), 0.0548), cylinder((0, 0, 0.02), (0, 0, 0.1), 0.052))
    collar = cylinder((0, -0.19, 0), (0, -0.195, 0), 0.0525)
    return [("white", column), ("white", neck), ("gray", collar), *drum((0, 0, 0), (0, 0, 0.1295))]


def link3_parts() -> list[Part]:
    """From the upper arm over to the elbow."""
    column = cylinder((0, 0, -0.121), (0, 0, -0.075), 0.0548)
    neck = hull(cylinder((0, 0, -0.08), (0, 0, -0.075), 0.0548), cylinder((0.0825, 0.015, 0), (0.0825, 0.085, 0), 0.052))
    return [("white", column), ("white", neck), *drum((0.0825, 0, 0), (0.0825, 0.1112, 0))]


def link4_parts() -> list[Part]:
    """The other half of the elbow, and over to the forearm."""
    column = cylinder((-0.0825, 0.078, 0), (-0.0825, 0.119, 0), 0.0548)
    neck = hull(cylinder((-0.0825, 0.078, 0), (-0.0825, 0.083, 0), 0.0548), cylinder((0, 0, 0.015), (0, 0, 0.085), 0.052))
    collar = cylinder((-0.0825, 0.119, 0), (-0.0825, 0.1245, 0), 0.0525)
    return [("white", column), ("white", neck), ("gray", collar), *drum((0, 0, 0), (0, 0, 0.1111))]


def link5_parts() -> list[Part]:
    """The forearm: a column that narrows and swings out to the side of the wrist."""
    column = cylinder((0, 0, -0.259), (0, 0, -0.21), 0.0548)
    taper = hull(
        cylinder((0, 0, -0.213), (0, 0, -0.21), 0.0548),
        cylinder((0, 0.055, -0.12), (0, 0.06, -0.12), 0.036),
    )
    shin = hull(
        cylinder((0, 0.03, -0.14), (0, 0.062, -0.13), 0.04),
        cylinder((0, 0.02, 0), (0, 0.1, 0), 0.05),
    )
    return [
        ("white", column),
        ("white", taper),
        ("white", shin),
        ("white", dome((0, 0.09, 0), (0, 0.1299, 0), 0.0505)),
        ("gray", cylinder((0, 0.016, 0), (0, 0.021, 0), 0.048)),
    ]


def link6_parts() -> list[Part]:
    """The wrist: from the joint across the forearm's end out to the flange's axis."""
    root = dome((0, 0, -0.012), (0, 0, 0.0555), 0.0475)
    arm = hull(cylinder((0.02, 0, -0.012), (0.02, 0, 0.045), 0.038), cylinder((0.088, -0.01, 0), (0.088, 0.06, 0), 0.043))
    head = dome((0.088, 0, 0), (0.088, -0.0514, 0), 0.0438)
    status = cylinder((0.088, 0.06, 0), (0.088, 0.066, 0), 0.0442)
    collar = cylinder((0.088, 0.066, 0), (0.088, 0.0817, 0), 0.043)
    return [("white", root), ("white", arm), ("white", head), ("blue", status), ("white", collar)]


def link7_parts() -> list[Part]:
    """The flange and the pilot's button head next to it."""
    flange = cylinder((0, 0, 0.052), (0, 0, 0.1068), 0.0438, bevel=0.004)
    pilot = hull(rounded_box((0.0, -0.028, 0.056), (0.082, 0.028, 0.093), 0.008, (0, 0, 0.7853982)))
    return [("gray", cylinder((0, 0, 0.049), (0, 0, 0.052), 0.041)), ("white", flange), ("shell", pilot)]


def hand_parts() -> list[Part]:
    """The hand: wide and thin, widest where the fingers slide."""
    shell = loft(
        "z",
        [
            (-0.02, -0.028, 0.028, -0.045, 0.045),
            (0.012, -0.031, 0.031, -0.09, 0.09),
            (0.05, -0.0285, 0.0285, -0.101, 0.101),
            (0.06, -0.024, 0.024, -0.1, 0.1),
        ],
    )
    return [
        ("white", shell),
        ("gray", rounded_box((-0.018, -0.096, 0.058), (0.018, 0.096, 0.066), 0.002)),
        ("gray", cylinder((0, 0, -0.026), (0, 0, -0.016), 0.0316)),
    ]


def finger_parts(side: int) -> list[Part]:
    """Slider, bent bar and rubber tip."""
    inner, outer = sorted((side * 0.008, side * 0.026))
    slider = rounded_box((-0.0105, inner, 0), (0.0105, outer, 0.02), 0.002)
    pad = finger(side)[0]
    low, high = sorted((side * 0.003, side * 0.009))
    bar = hull(
        rounded_box((-0.0095, inner, 0.012), (0.0095, outer, 0.02), 0.001),
        rounded_box((-0.009, low, 0.034), (0.009, high, 0.044), 0.001),
    )
    return [("shell", slider), ("shell", bar), ("rubber", box_solid(pad))]


PARTS: dict[str, list[Part]] = {
    "panda_link0": base_parts(),
    "panda_link1": link1_parts(),
    "panda_link2": link2_parts(),
    "panda_link3": link3_parts(),
    "panda_link4": link4_parts(),
    "panda_link5": link5_parts(),
    "panda_link6": link6_parts(),
    "panda_link7": link7_parts(),
    "panda_hand": hand_parts(),
    "panda_leftfinger": finger_parts(1),
    "panda_rightfinger": finger_parts(-1),
    "camera": camera((-0.0125, -0.045, -0.0125), (0.0125, 0.045, 0.0125), ((-0.008, -0.02, -0.024), (0.006, 0.02, -0.01))),
}
