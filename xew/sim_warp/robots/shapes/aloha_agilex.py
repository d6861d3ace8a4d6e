"""Shapes of the ALOHA-AgileX: black arms of the X5 family on an aluminium frame and a white-topped mobile base."""

from xew.sim_warp.robots.shapes import arx_x5
from xew.sim_warp.robots.shapes.solids import Box, Part, box_solid

MATERIALS = {"black": (30, 30, 32), "aluminium": (168, 172, 178)}
MESH_NAMES: dict[str, str] = {}

ARM_BOXES = {
    "link1": arx_x5.LINK1,
    "link2": arx_x5.LINK2,
    "link3": arx_x5.LINK3,
    "link4": arx_x5.LINK4,
    "link5": (Box((-0.03, -0.03, 0.02), (0.035, 0.03, 0.12)),),
    "link6": arx_x5.PALM,
    "link7": arx_x5.finger(1, 0.071, 0.024493),
    "link8": arx_x5.finger(-1, 0.071, 0.024496),
}
COLLISIONS = {f"f{side}_{link}": boxes for side in "lr" for link, boxes in ARM_BOXES.items()}
PARTS: dict[str, list[Part]] = {link: [("black", box_solid(box)) for box in boxes] for link, boxes in COLLISIONS.items()}
PARTS["box2_Link"] = [("aluminium", box_solid(Box((-0.1, 0.1, 0.0), (0.1, 0.6, 0.72))))]
