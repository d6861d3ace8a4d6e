"""Shapes of the ALOHA-AgileX: black arms of the X5 family on an aluminum frame over a mobile base."""

from lab.robots.shapes import arx_x5
from lab.robots.shapes.parts import camera
from xew.sim_warp.robots.procedural.solids import Box, Part, Vector, box_solid, cylinder, hull, rounded_box

MATERIALS = {
    "black": (46, 46, 50),
    "dark": (86, 87, 92),
    "rubber": (20, 20, 22),
    "aluminum": (178, 182, 188),
    "panel": (226, 228, 230),
    "case": (150, 152, 156),
    "lens": (24, 24, 28),
}
ARM_LINKS = ("base_link", "link1", "link2", "link3", "link4", "link5", "link6", "link7", "link8")
ARMS = {"fl": "front", "fr": "front", "lr": "rear", "rr": "rear"}
MESH_NAMES = {f"{arm}_{link}": link for arm in ARMS for link in ARM_LINKS}
MESH_NAMES |= {f"{arm}_link7": "handle" for arm in ("lr", "rr")} | {
    f"{arm}_castor_link": "castor" for arm in ("fl", "fr", "rl", "rr")
}
MESH_NAMES |= {f"{arm}_wheel_link": "roller" for arm in ("fl", "fr", "rl", "rr")}
MESH_NAMES |= {
    "left_wheel_link": "wheel",
    "right_wheel_link": "wheel",
    "right_camera": "left_camera",
    "camera_link2": "camera_link1",
}

ARM_BOXES = {
    "link1": arx_x5.LINK1,
    "link2": arx_x5.LINK2,
    "link3": arx_x5.LINK3,
    "link4": arx_x5.LINK4,
    "link5": arx_x5.LINK5,
    "link6": arx_x5.PALM,
    "link7": arx_x5.finger(1, 0.1556 - 0.08457, 0.024493, 0.00010349),
    "link8": arx_x5.finger(-1, 0.1556 - 0.08457, 0.024496, 0.00010354),
}
COLLISIONS = {f"{arm}_{link}": boxes for arm in ("fl", "fr") for link, boxes in ARM_BOXES.items()}

ARM_PARTS: dict[str, list[Part]] = {
    "base_link": arx_x5.base_parts(),
    "link1": arx_x5.link1_parts(),
    "link2": arx_x5.link2_parts("black", "dark"),
    "link3": arx_x5.link3_parts("black", "dark"),
    "link4": arx_x5.link4_parts(),
    "link5": arx_x5.link5_parts(),
    "link6": arx_x5.palm_parts(),
}


def handle_parts() -> list[Part]:
    """What an operator holds on a teaching arm, in the frame of its last link: a grip under the palm's place."""
    grip = hull(cylinder((0.085, 0, -0.005), (0.085, 0, 0.01), 0.02), cylinder((0.1, 0, -0.09), (0.1, 0, -0.08), 0.014))
    return [("dark", grip), ("black", rounded_box((0.06, -0.035, -0.02), (0.1, 0.035, 0.02), 0.005))]


def base_parts() -> list[Part]:
    """The mobile base's hull, about the frame of base_link, 0.15 m over the ground."""
    chassis = rounded_box((-0.32, -0.245, -0.075), (0.26, 0.245, 0.0), 0.02)
    bumpers = [rounded_box((x, -0.24, -0.1), (x + 0.03, 0.24, -0.045), 0.01) for x in (-0.34, 0.25)]
    return [("panel", chassis), *[("black", solid) for solid in bumpers]]


def deck_parts() -> list[Part]:
    return [("black", rounded_box((-0.31, -0.24, 0.0), (0.25, 0.24, 0.012), 0.004))]


def profile(low: Vector, high: Vector) -> Part:
    """A length of aluminum profile on box2_Link, its corners given in the frame of `footprint`."""
    solid = box_solid(Box(low, high))
    solid.apply_translation((-0.158, 0.385, -0.015))
    return ("aluminum", solid)


def frame_parts() -> list[Part]:
    """Column, front beam under the working arms, rear beam under the teaching arms. Its proportions are ours."""
    posts = [profile((x, y, 0.162), (x + 0.04, y + 0.04, 0.742)) for x in (-0.2, 0.06) for y in (-0.16, 0.12)]
    rails = [profile((-0.33, y, 0.702), (0.25, y + 0.04, 0.742)) for y in (-0.16, 0.12)]
    front = profile((0.19, -0.36, 0.742), (0.27, 0.36, 0.781))
    rear = [profile((-0.35, -0.36, 0.862), (-0.27, 0.36, 0.902))]
    risers = [profile((-0.33, y, 0.742), (-0.29, y + 0.04, 0.862)) for y in (-0.16, 0.12)]
    cabinet = rounded_box((-0.31, 0.255, 0.147), (-0.1, 0.515, 0.62), 0.006)
    return [*posts, *rails, front, *rear, *risers, ("dark", cabinet)]


def mast_parts() -> list[Part]:
    """The pole of the cameras, behind the head camera and never in its image."""
    return [
        ("aluminum", rounded_box((-0.045, -0.02, 0), (-0.015, 0.02, 0.647), 0.003)),
        ("aluminum", rounded_box((-0.069, -0.035, -0.074), (0.025, 0.035, 0.004), 0.003)),
    ]


def wheel_parts() -> list[Part]:
    return [("rubber", cylinder((0, -0.02, 0), (0, 0.02, 0), 0.068))]


PARTS: dict[str, list[Part]] = {f"{arm}_{link}": parts for arm in ARMS for link, parts in ARM_PARTS.items()}
PARTS |= {f"{arm}_link7": arx_x5.finger_parts(1, ARM_BOXES["link7"]) for arm in ("fl", "fr")}
PARTS |= {f"{arm}_link8": arx_x5.finger_parts(-1, ARM_BOXES["link8"]) for arm in ("fl", "fr")}
PARTS |= {f"{arm}_link7": handle_parts() for arm in ("lr", "rr")}
PARTS |= {f"{side}_wheel_link": wheel_parts() for side in ("left", "right")}
PARTS |= {
    f"{side}_wheel_link": [("rubber", cylinder((0, 0, -0.014), (0, 0, 0.014), 0.035, sections=10))]
    for side in ("fl", "fr", "rl", "rr")
}
PARTS |= {
    f"{side}_castor_link": [("black", rounded_box((-0.035, 0.0, -0.02), (0.012, 0.06, 0.02), 0.004))]
    for side in ("fl", "fr", "rl", "rr")
}
PARTS |= {
    "base_link": base_parts(),
    "box1_Link": deck_parts(),
    "box2_Link": frame_parts(),
    "camera_base_link": mast_parts(),
    "camera_link1": camera(
        (-0.0125, -0.045, -0.0125), (0.0125, 0.045, 0.0125), ((-0.1, -0.008, -0.008), (-0.01, 0.008, 0.008))
    ),
    "camera_link2": camera(
        (-0.0125, -0.045, -0.0125), (0.0125, 0.045, 0.0125), ((-0.1, -0.008, -0.008), (-0.01, 0.008, 0.008))
    ),
    "left_camera": camera(
        (-0.0125, -0.077, -0.0125), (0.0125, 0.013, 0.0125), ((-0.008, -0.047, -0.045), (0.006, -0.017, -0.01))
    ),
    "right_camera": camera(
        (-0.0125, -0.077, -0.0125), (0.0125, 0.013, 0.0125), ((-0.008, -0.047, -0.045), (0.006, -0.017, -0.01))
    ),
}
