"""Files of a procedural body: its URDF and a mesh for each link and material, as bytes by relative path."""

import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np
import trimesh

from xew.sim_warp.geometry.meshes import Color
from xew.sim_warp.robots.procedural.design import SPEED, BodyDesign, JointDesign, Vector
from xew.sim_warp.robots.procedural.shapes import LinkShape, base_shape, finger_shape, link_shape, palm_shape
from xew.sim_warp.robots.procedural.solids import Box

URDF = "body.urdf"
DENSITY = 420.0
"""Mass of a link per volume of its collision boxes [kg/m^3]; arms of real size come to 3 to 12 kg."""
RUBBER = (24, 24, 26)
EFFORT, FINGER_EFFORT, FINGER_SPEED = 60.0, 20.0, 0.3


def body_files(design: BodyDesign) -> dict[str, bytes]:
    """URDF and meshes of a design by their path below the body's folder."""
    root = ElementTree.Element("robot", name=f"candidate_{design.number}")
    look = design.look
    colors = {"body": look.body, "second": look.second, "housing": look.housing, "accent": look.accent, "rubber": RUBBER}
    for name, color in colors.items():
        root.append(material_element(name, color))
    files: dict[str, bytes] = {}
    for name, shape in _links(design).items():
        root.append(_link(name, shape, files))
    for index, joint in enumerate(design.joints):
        root.append(_revolute(index, joint))
    for side, name in ((1, "left"), (-1, "right")):
        root.append(_prismatic(design, name, side))
    ElementTree.indent(root)
    return {URDF: ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"} | files


def _links(design: BodyDesign) -> dict[str, LinkShape]:
    links = {"base_link": base_shape(design)}
    last = len(design.joints)
    for index in range(last):
        links[f"link{index + 1}"] = link_shape(design, index)
    arm, palm = links[f"link{last}"], palm_shape(design.hand, design.flange)
    links[f"link{last}"] = LinkShape(arm.parts + palm.parts, arm.boxes + palm.boxes)
    return links | {f"{name}_finger": finger_shape(design.hand, side) for side, name in ((1, "left"), (-1, "right"))}


def _link(name: str, shape: LinkShape, files: dict[str, bytes]) -> ElementTree.Element:
    """The link's element; its meshes are added to `files`."""
    link = ElementTree.Element("link", name=name)
    link.append(_inertial(shape.boxes))
    solids = defaultdict(list)
    for material, solid in shape.parts:
        solids[material].append(solid)
    for material, pieces in solids.items():
        path = f"meshes/{name}_{material}.stl"
        files[path] = _mesh_bytes(trimesh.util.concatenate(pieces))
        link.append(visual_element(path, material))
    link.extend(collision_element(box) for box in shape.boxes)
    return link


def material_element(name: str, color: Color) -> ElementTree.Element:
    """A named color, sRGB 0 to 255."""
    material = ElementTree.Element("material", name=name)
    ElementTree.SubElement(material, "color", rgba=_numbers([channel / 255 for channel in color] + [1]))
    return material


def visual_element(mesh: str, material: str) -> ElementTree.Element:
    """A visual of the mesh file `mesh`, a path relative to the URDF, in a named material."""
    visual = ElementTree.Element("visual")
    ElementTree.SubElement(ElementTree.SubElement(visual, "geometry"), "mesh", filename=mesh)
    ElementTree.SubElement(visual, "material", name=material)
    return visual


def collision_element(box: Box) -> ElementTree.Element:
    """The collision shape of a box."""
    collision = ElementTree.Element("collision", {"name": box.name} if box.name else {})
    ElementTree.SubElement(collision, "origin", xyz=_numbers(box.center), rpy=_numbers(box.rpy))
    ElementTree.SubElement(ElementTree.SubElement(collision, "geometry"), "box", size=_numbers(box.size))
    return collision


def _mesh_bytes(solid: trimesh.Trimesh) -> bytes:
    """Binary STL of vertices rounded to hundredths of a millimeter, the same bytes on all machines."""
    rounded = trimesh.Trimesh(np.round(solid.vertices, 5) + 0.0, solid.faces, process=False)
    return bytes(rounded.export(file_type="stl"))


def _inertial(boxes: Sequence[Box]) -> ElementTree.Element:
    """Mass and inertia of solid boxes, approximated by their bounding box."""
    low, high = np.min([box.low for box in boxes], 0), np.max([box.high for box in boxes], 0)
    size = high - low
    mass = max(DENSITY * float(sum(np.prod(box.size) for box in boxes)), 0.05)
    moments = mass / 12 * (np.sum(size**2) - size**2)
    inertial = ElementTree.Element("inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_numbers((low + high) / 2), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=_numbers([mass]))
    names = dict(zip(("ixx", "iyy", "izz"), (_numbers([moment]) for moment in moments), strict=True))
    ElementTree.SubElement(inertial, "inertia", names | {"ixy": "0", "ixz": "0", "iyz": "0"})
    return inertial


def _revolute(index: int, joint: JointDesign) -> ElementTree.Element:
    parent = "base_link" if index == 0 else f"link{index}"
    element = _joint(f"joint{index + 1}", "revolute", parent, f"link{index + 1}", joint.origin, joint.axis)
    return _limited(element, joint.lower, joint.upper, SPEED[index], EFFORT)


def _prismatic(design: BodyDesign, name: str, side: int) -> ElementTree.Element:
    x, y, z = design.flange
    origin = (round(x + design.hand.palm[0], 6), y, z)
    parent = f"link{len(design.joints)}"
    element = _joint(f"{name}_finger_joint", "prismatic", parent, f"{name}_finger", origin, (0.0, float(side), 0.0))
    return _limited(element, 0.0, design.hand.stroke, FINGER_SPEED, FINGER_EFFORT)


def _limited(joint: ElementTree.Element, lower: float, upper: float, velocity: float, effort: float) -> ElementTree.Element:
    """The joint with limits."""
    limits = {"lower": lower, "upper": upper, "velocity": velocity, "effort": effort}
    ElementTree.SubElement(joint, "limit", {name: _numbers([value]) for name, value in limits.items()})
    return joint


def _joint(name: str, kind: str, parent: str, child: str, origin: Vector, axis: Vector) -> ElementTree.Element:
    element = ElementTree.Element("joint", name=name, type=kind)
    ElementTree.SubElement(element, "origin", xyz=_numbers(origin), rpy="0 0 0")
    ElementTree.SubElement(element, "parent", link=parent)
    ElementTree.SubElement(element, "child", link=child)
    ElementTree.SubElement(element, "axis", xyz=_numbers(axis))
    return element


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{round(float(value), 6) + 0.0:g}" for value in values)
