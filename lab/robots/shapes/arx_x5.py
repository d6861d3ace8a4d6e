"""Shapes of the ARX-X5: black, its forearm white, after the link sizes of the vendor's meshes.

Each function gives one link in its frame; ALOHA's arms, of the same family, share them.
"""

from functools import partial

from lab.robots.shapes.parts import camera
from xew.sim_warp.robots.procedural import solids
from xew.sim_warp.robots.procedural.solids import (
    PAD_HALF_WIDTH,
    PAD_THICKNESS,
    Box,
    Part,
    box_solid,
    hull,
    loft,
    rounded_box,
)

cylinder = partial(solids.cylinder, sections=13)
"""Cylinders coarser than elsewhere: the ALOHA carries four of these arms."""

MATERIALS = {
    "black": (48, 48, 52),
    "dark": (84, 86, 91),
    "white": (238, 238, 234),
    "rubber": (20, 20, 22),
    "case": (150, 152, 156),
    "lens": (24, 24, 28),
}
MESH_NAMES: dict[str, str] = {}

LINK1 = (Box((-0.022, -0.039, 0), (0.037, 0.039, 0.058)),)
LINK2 = (Box((-0.294, -0.033, -0.03), (0.03, 0.037, 0.03)),)
LINK3 = (Box((-0.02, -0.038, -0.076), (0.06, 0.038, 0.02)), Box((0.06, -0.028, -0.085), (0.273, 0.028, -0.03)))
LINK4 = (Box((-0.0175, -0.031, -0.0845), (0.096, 0.029, 0.0175)),)
LINK5 = (Box((-0.03, -0.03, 0), (0.03, 0.03, 0.1106)),)
PALM = (Box((0, -0.033, -0.028), (0.062, 0.033, 0.03)), Box((0.0486, -0.087, -0.0125), (0.0667, 0.087, 0.0125)))


def finger(side: int, tip: float, face: float, middle: float) -> tuple[Box, ...]:
    """Pad and carriage of the finger that opens toward `side` (+1, -1) of y.

    Its tip is at x = tip, its face at y = -side * face, and its middle at z = middle, in the finger's frame.
    """
    low, high = sorted((-side * face, side * (PAD_THICKNESS - face)))
    pad = Box((tip - 0.035, low, middle - PAD_HALF_WIDTH), (tip, high, middle + PAD_HALF_WIDTH), name="pad")
    inner, outer = sorted((side * (0.004 - face), side * 0.0127))
    return (pad, Box((-0.015, inner, -0.016), (tip - 0.035, outer, 0.016)))


def base_parts() -> list[Part]:
    return [
        ("black", cylinder((0, 0, 0), (0, 0, 0.012), 0.038)),
        ("black", cylinder((0, 0, 0.012), (0, 0, 0.0585), 0.03)),
    ]


def link1_parts() -> list[Part]:
    """A turntable with two cheeks that hold the upper arm."""
    cheek = [
        hull(cylinder((0.02, y, 0.04), (0.02, y + 0.006, 0.04), 0.018), rounded_box((-0.02, y, 0), (0.03, y + 0.006, 0.02)))
        for y in (-0.0385, 0.0325)
    ]
    return [("dark", cylinder((0, 0, 0), (0, 0, 0.012), 0.031, bevel=0.002)), *[("black", solid) for solid in cheek]]


def link2_parts(shell: str, caps: str) -> list[Part]:
    """The upper arm: a beam of the material `shell` between two motors with end caps of the material `caps`."""
    beam = loft(
        "x",
        [
            (-0.262, -0.024, 0.03, -0.026, 0.026),
            (-0.2, -0.021, 0.027, -0.0235, 0.0235),
            (-0.06, -0.021, 0.027, -0.0245, 0.0245),
            (0, -0.026, 0.03, -0.026, 0.026),
        ],
    )
    motors = [("black", cylinder((x, -0.0305, 0), (x, 0.0305, 0), 0.03, bevel=0.003)) for x in (0, -0.264)]
    rims = [(caps, cylinder((x, -0.0338, 0), (x, 0.0338, 0), 0.02)) for x in (0, -0.264)]
    return [(shell, beam), *motors, *rims]


def link3_parts(shell: str, ends: str) -> list[Part]:
    """The forearm: from the elbow up and over to the wrist."""
    elbow = hull(
        cylinder((0, -0.038, 0), (0, 0.038, 0), 0.0178), rounded_box((0.02, -0.037, -0.0758), (0.072, 0.037, -0.03), 0.006)
    )
    tube = loft(
        "x",
        [
            (0.06, -0.03, 0.03, -0.0755, -0.034),
            (0.105, -0.0215, 0.0215, -0.0745, -0.036),
            (0.245, -0.0215, 0.0215, -0.077, -0.035),
        ],
    )
    wrist = cylinder((0.245, -0.024, -0.056), (0.245, 0.026, -0.056), 0.028, bevel=0.003)
    pin = cylinder((0, -0.0395, 0), (0, 0.0395, 0), 0.011)
    return [(shell, elbow), (shell, tube), (ends, wrist), (ends, pin)]


def link4_parts() -> list[Part]:
    """Two cheeks round the forearm's end, and the motor of the wrist's yaw."""
    cheeks = [
        hull(cylinder((0, y, 0), (0, y + 0.005, 0), 0.0175), rounded_box((0.03, y, -0.08), (0.06, y + 0.005, -0.045), 0.001))
        for y in (-0.0318, 0.0275)
    ]
    block = rounded_box((0.034, -0.03, -0.0845), (0.0957, 0.03, -0.044), 0.006)
    cap = cylinder((0.06775, 0, -0.0845), (0.06775, 0, -0.09), 0.022)
    return [*[("black", solid) for solid in cheeks], ("black", block), ("dark", cap)]


def link5_parts() -> list[Part]:
    """A post with the motor of the wrist's roll."""
    post = cylinder((0, 0, 0.002), (0, 0, 0.06), 0.0285, bevel=0.003)
    head = hull(
        rounded_box((-0.017, -0.0265, 0.05), (0.024, 0.0265, 0.1106), 0.006),
        cylinder((-0.01, 0, 0.0865), (0.0287, 0, 0.0865), 0.024),
    )
    return [("dark", post), ("black", head)]


def palm_parts() -> list[Part]:
    """The gripper's body and the rail across it."""
    body = loft(
        "x", [(0, -0.028, 0.028, -0.026, 0.026), (0.02, -0.033, 0.033, -0.028, 0.0295), (0.06, -0.033, 0.033, -0.026, 0.027)]
    )
    rail = rounded_box((0.0486, -0.087, -0.012), (0.0667, 0.087, 0.012), 0.003)
    return [("black", body), ("dark", rail)]


def finger_parts(side: int, boxes: tuple[Box, ...]) -> list[Part]:
    """The pad, and a bar that carries it from the rail."""
    pad = boxes[0]
    carriage = [sorted((side * -0.016, side * 0.0127))[index] for index in (0, 1)]
    slide = rounded_box((-0.015, carriage[0], -0.022), (0.01, carriage[1], 0.022), 0.003)
    root = [sorted((side * -0.016, side * 0.006))[index] for index in (0, 1)]
    back = (
        (pad.low[0], pad.low[1] + 0.003 * (side > 0), pad.low[2]),
        (pad.low[0] + 0.012, pad.high[1] - 0.003 * (side < 0), pad.high[2]),
    )
    bar = hull(rounded_box((0.004, root[0], -0.014), (0.01, root[1], 0.014), 0.002), rounded_box(*back, 0.001))
    return [("black", slide), ("black", bar), ("rubber", box_solid(pad))]


COLLISIONS = {
    "link1": LINK1,
    "link2": LINK2,
    "link3": LINK3,
    "link4": LINK4,
    "link5": LINK5,
    "link6": PALM,
    "link7": finger(1, 0.157 - 0.08657, 0.024896, 0.0002436),
    "link8": finger(-1, 0.157 - 0.08657, 0.0249, 0.00024366),
}
PARTS: dict[str, list[Part]] = {
    "base_link": base_parts(),
    "link1": link1_parts(),
    "link2": link2_parts("black", "white"),
    "link3": link3_parts("white", "dark"),
    "link4": link4_parts(),
    "link5": link5_parts(),
    "link6": palm_parts(),
    "link7": finger_parts(1, COLLISIONS["link7"]),
    "link8": finger_parts(-1, COLLISIONS["link8"]),
    "camera": camera((-0.0225, -0.045, -0.0125), (0.0025, 0.045, 0.0125), ((-0.02, -0.015, -0.028), (-0.008, 0.015, -0.01))),
}
