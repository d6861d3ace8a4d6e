"""Link shapes of procedural bodies: solids by material, and the boxes that links collide with.

Meters, in the frame of the link; a link reaches from the joint that moves it to the next joint, or to the hand.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from xew.sim_warp.robots.procedural.design import BodyDesign, HandDesign, Look, Vector
from xew.sim_warp.robots.procedural.solids import (
    PAD_HALF_WIDTH,
    PAD_THICKNESS,
    Box,
    Part,
    box_solid,
    cylinder,
    dome,
    hull,
    loft,
    rounded_box,
)

LONG = 0.12
"""Length from which a link carries rings and a cable [m]."""
TIP_MARGIN = 0.015
"""Length of the fingertips beyond the tool center point [m]."""


@dataclass(frozen=True)
class LinkShape:
    """Visible parts and collision boxes of one link."""

    parts: list[Part]
    boxes: tuple[Box, ...]


def base_shape(design: BodyDesign) -> LinkShape:
    """The base: foot, column or wedge, the pedestal below the first joint, and the stand, if any."""
    radius, height = design.look.radii[0], design.joints[0].origin[2] - design.stand
    wide = 1.5 * radius
    parts: list[Part] = [("housing", cylinder((0, 0, 0), (0, 0, height), 1.15 * radius, radius))]
    if design.mount == "frame":
        post = rounded_box((-0.6 * wide, -0.6 * wide, -design.column), (0.6 * wide, 0.6 * wide, -0.01), 0.004)
        plate = rounded_box((-1.6 * wide, -1.2 * wide, -design.column), (0.9 * wide, 1.2 * wide, 0.015 - design.column), 0.003)
        parts += [("second", post), ("housing", plate)]
    if design.mount == "tilted":
        drop = wide * np.sin(abs(design.lean)) + 0.03
        level = rounded_box(
            (-1.3 * wide, -1.3 * wide, -drop - 0.012), (1.3 * wide, 1.3 * wide, -drop), 0.003, (0, -design.lean, 0)
        )
        parts.append(("second", hull(rounded_box((-wide, -wide, -0.02), (wide, wide, -0.01), 0.003), level)))
    parts.append(("body", rounded_box((-wide, -wide, -0.01), (wide, wide, 0.018), 0.005)))
    box = Box((-wide, -wide, -max(design.column, 0.01)), (wide, wide, height))
    if design.stand:
        return _on_stand(parts, design.stand, wide, height)
    return LinkShape(parts, (box,))


def _on_stand(parts: list[Part], stand: float, wide: float, height: float) -> LinkShape:
    """A base's parts at the top of a post, whose foot plate's underside is the root; `wide` is half the base's width [m]."""
    for _, solid in parts:
        solid.apply_translation((0, 0, stand))
    foot = 2.2 * wide if stand > 0.5 else 1.4 * wide
    plate = rounded_box((-foot, -foot, 0), (foot, foot, 0.025), 0.005)
    post = cylinder((0, 0, 0.02), (0, 0, stand - 0.008), 0.75 * wide, 0.6 * wide)
    boxes = Box((-wide, -wide, 0), (wide, wide, stand + height)), Box((-foot, -foot, 0), (foot, foot, 0.025))
    return LinkShape([*parts, ("second", post), ("housing", plate)], boxes)


def link_shape(design: BodyDesign, index: int) -> LinkShape:
    """The link that joint `index` moves, without the hand."""
    look, joint = design.look, design.joints[index]
    last = index == len(design.joints) - 1
    end = design.flange if last else design.joints[index + 1].origin
    radius = look.radii[index]
    next_radius = 0.85 * radius if last else look.radii[index + 1]
    next_axis = (1.0, 0.0, 0.0) if last else design.joints[index + 1].axis
    material = "body" if index % 2 == 0 else "second"
    start_housing = _housing((0, 0, 0), joint.axis, radius)
    parts: list[Part] = [("housing", start_housing)]
    length = float(np.linalg.norm(end))
    if length > 0.6 * radius:
        end_housing = _housing(end, next_axis, 0.96 * next_radius)
        widths = (look.slenderness * radius, look.slenderness * next_radius)
        parts += [(material, solid) for solid in _link_body(look.styles[index], end, widths, start_housing, end_housing)]
    if length > LONG:
        parts += _trimmings(look, end, look.slenderness * radius, joint.axis)
    parts += [("accent", cap) for cap in _caps(joint.axis, radius)] if look.styles[index] != "box" else []
    return LinkShape(parts, (_bounding_box(parts),))


def palm_shape(hand: HandDesign, flange: Vector) -> LinkShape:
    """The hand's body on the last link: a palm with the rail of the fingers."""
    depth, width, height = hand.palm
    x, y, z = flange
    body = loft(
        "x",
        [
            (x, y - 0.3 * width, y + 0.3 * width, z - 0.45 * height, z + 0.45 * height),
            (x + 0.5 * depth, y - 0.42 * width, y + 0.42 * width, z - 0.5 * height, z + 0.5 * height),
            (x + depth - 0.018, y - 0.5 * width, y + 0.5 * width, z - 0.5 * height, z + 0.5 * height),
        ],
    )
    low, high = (x + depth - 0.018, y - width / 2, z - 0.35 * height), (x + depth, y + width / 2, z + 0.35 * height)
    box = Box((x, y - width / 2, z - height / 2), (x + depth, y + width / 2, z + height / 2))
    return LinkShape([("body", body), ("housing", rounded_box(low, high, 0.002))], (box,))


def finger_shape(hand: HandDesign, side: int) -> LinkShape:
    """A finger with its frame at the meeting point of palm and closed pads; it opens toward `side` (+1, -1) of y."""
    length = hand.finger_length
    inner, outer = sorted((0.0, side * PAD_THICKNESS))
    pad = Box((length - 0.035, inner, -PAD_HALF_WIDTH), (length, outer, PAD_HALF_WIDTH), name="pad")
    near, far = sorted((side * 0.003, side * 0.0245))
    carriage = Box((0.001, near, -0.016), (length - 0.03, far, 0.016))
    parts: list[Part] = [("second", solid) for solid in _finger_bodies(hand, side)]
    return LinkShape([*parts, ("rubber", box_solid(pad))], (pad, carriage))


def tool_offset(hand: HandDesign) -> float:
    """Distance of the tool center point from the flange, along x [m]."""
    return round(hand.palm[0] + hand.finger_length - TIP_MARGIN, 6)


def _finger_bodies(hand: HandDesign, side: int) -> list[trimesh.Trimesh]:
    length = hand.finger_length

    def station(x: float, inner: float, outer: float, half: float) -> tuple[float, ...]:
        return (x, *sorted((side * inner, side * outer)), -half, half)

    if hand.finger == "bar":
        return [loft("x", [station(0, 0.004, 0.022, 0.01), station(length - 0.002, 0.003, 0.016, 0.01)], corner=0.2)]
    if hand.finger == "jaw":
        foot = loft("x", [station(0, 0.002, 0.026, 0.018), station(0.02, 0.002, 0.026, 0.018)], corner=0.2)
        return [foot, loft("x", [station(0.018, 0.006, 0.02, 0.014), station(length, 0.006, 0.014, 0.011)], corner=0.2)]
    if hand.finger == "wedge":
        return [loft("x", [station(0, 0.002, 0.03, 0.014), station(length - 0.001, 0.002, 0.01, 0.0115)], corner=0.25)]
    middle = station(0.5 * length, 0.002, 0.02, 0.019)
    return [loft("x", [station(0, 0.002, 0.024, 0.02), middle, station(length - 0.003, 0.0015, 0.0115, 0.0115)])]


def _housing(center: Vector, axis: Vector, radius: float) -> trimesh.Trimesh:
    """A short drum round a joint."""
    half = np.multiply(axis, 1.05 * radius)
    return cylinder(_vector(np.subtract(center, half)), _vector(np.add(center, half)), radius, bevel=0.12 * radius)


def _caps(axis: Vector, radius: float) -> list[trimesh.Trimesh]:
    """Lids on both ends of a joint that bends sideways."""
    if axis[1] == 0:
        return []
    ends = [np.multiply(axis, side * 1.05 * radius) for side in (1, -1)]
    return [dome(_vector(end), _vector(1.22 * end), 0.86 * radius) for end in ends]


def _link_body(
    style: str, end: Vector, widths: tuple[float, float], start_housing: trimesh.Trimesh, end_housing: trimesh.Trimesh
) -> list[trimesh.Trimesh]:
    """Solids from the link's start to `end`."""
    first, last = widths
    if style == "tube":
        return [cylinder((0, 0, 0), end, first, last)]
    if style == "box":
        return [hull(_cube((0, 0, 0), 0.9 * first), _cube(end, 0.9 * last))]
    if style == "frame":
        side = np.array([0.0, 1.0, 0.0]) if abs(end[1]) < 0.7 * np.linalg.norm(end) else np.array([0.0, 0.0, 1.0])
        plates = []
        for sign in (1, -1):
            shift = 0.8 * first * sign * side
            flat = 0.22 * side + (1 - side)
            plates.append(hull(_cube(_vector(shift), first, flat), _cube(_vector(end + shift), last, flat)))
        return plates
    return [_scaled_hull(start_housing, end_housing, end)]


def _scaled_hull(start: trimesh.Trimesh, end: trimesh.Trimesh, at: Vector) -> trimesh.Trimesh:
    """One smooth shell over both housings, a little inside them."""
    inner = [start.copy(), end.copy()]
    for solid, center in zip(inner, ((0, 0, 0), at), strict=True):
        solid.vertices = np.round(np.add(center, 0.93 * (solid.vertices - center)), 6)
    return hull(*inner)


def _cube(center: Vector, half: float, shape: np.ndarray | None = None) -> trimesh.Trimesh:
    size = half * (np.ones(3) if shape is None else shape)
    return rounded_box(_vector(np.subtract(center, size)), _vector(np.add(center, size)), 0.15 * half)


def _trimmings(look: Look, end: Vector, radius: float, axis: Vector) -> list[Part]:
    """Accent rings round a long link, and a cable along it."""
    parts: list[Part] = []
    for ring in range(look.rings):
        share = 0.38 + 0.1 * ring
        start, stop = np.multiply(end, share), np.multiply(end, share + 0.035)
        parts.append(("accent", cylinder(_vector(start), _vector(stop), 1.06 * radius)))
    if look.cable:
        side = np.cross(end, axis) if abs(float(np.dot(end, axis))) < 0.7 * np.linalg.norm(end) else np.array([0.0, 1.0, 0.0])
        shift = 1.05 * radius * side / np.linalg.norm(side)
        start, stop = np.multiply(end, 0.15) + shift, np.multiply(end, 0.85) + shift
        parts.append(("rubber", cylinder(_vector(start), _vector(stop), 0.006, sections=8)))
    return parts


def _bounding_box(parts: Sequence[Part]) -> Box:
    corners = np.array([solid.bounds for _, solid in parts])
    return Box(_vector(corners[:, 0].min(0)), _vector(corners[:, 1].max(0)))


def _vector(values: np.ndarray) -> Vector:
    x, y, z = (round(float(value), 6) for value in values)
    return x, y, z
