"""Design of a procedural body from its number: the arm's joints, its appearance and its hand.

A body has two copies of one arm. At zero joint positions all link frames are parallel to the base: x ahead, z up. Lengths are
within the range of real arms (reaches of 0.6 to 0.95 m).

Numbers from `WIDE` on are of a second family with larger variation: the same kinds of arm with reaches from 0.5 to 1 m, on
bases of the first family or on stands, whose foot is the root.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from xew.sim_warp.robots.procedural.colors import draw_color

Vector = tuple[float, float, float]
Option = TypeVar("Option")
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)

STYLES = ("tube", "shell", "box", "frame")
"""Ways to shape a link: a tube with caps, a hull over its housings, a beam, two plates with a gap."""
FINGERS = ("paddle", "bar", "jaw", "wedge")
"""Shapes of fingers behind their pads."""
MOUNTS = ("upright", "tilted", "frame")
"""Kinds of base: a foot, a wedge that leans the base forward or back, a column of the base that ends below the root."""
WIDE = 1_000_000
"""Number of the first design of the wide family."""
WIDE_REACH = (0.5, 1.0)
"""Bounds of the distance from shoulder to hand of the wide family's arms, stretched out [m]."""
STANDS = {"pedestal": (0.1, 0.4), "stand": (0.6, 0.95)}
"""Bounds of the height of the stands of the wide family [m]: on a platform behind the table, and on the floor."""
SPEED = (3.0, 3.0, 3.0, 3.5, 3.5, 3.5, 3.5)
"""Joint speed limits from the base outwards [rad/s]."""


@dataclass(frozen=True)
class JointDesign:
    """One revolute joint."""

    origin: Vector
    """Position in the frame of the link before it [m]."""
    axis: Vector
    lower: float
    """Position limit [rad]."""
    upper: float


@dataclass(frozen=True)
class Look:
    """Appearance of the links."""

    styles: tuple[str, ...]
    """Style of each moving link, of STYLES."""
    body: tuple[int, int, int]
    """sRGB of the links; every second link has `second`."""
    second: tuple[int, int, int]
    housing: tuple[int, int, int]
    accent: tuple[int, int, int]
    radii: tuple[float, ...]
    """Radius of the housing of each joint [m]."""
    slenderness: float
    """Half width of a link between its joints, as a share of the housings' radius."""
    rings: int
    """Number of accent rings round each long link."""
    cable: bool
    """Whether long links have an outside cable."""


@dataclass(frozen=True)
class HandDesign:
    """A parallel gripper whose two fingers slide along y."""

    palm: Vector
    """Size of the palm along x, y, z [m]."""
    finger_length: float
    """From the palm to the fingertip [m]."""
    stroke: float
    """Travel of each finger from closed to open [m]."""
    finger: str
    """Shape, of FINGERS."""


@dataclass(frozen=True)
class BodyDesign:
    """A procedural robot without a place."""

    number: int
    family: str
    """Kind of its arm, of FAMILIES."""
    joints: tuple[JointDesign, ...]
    flange: Vector
    """Position of the hand in the frame of the last link [m]; the hand points along x."""
    mount: str
    """Kind of its base, of MOUNTS or STANDS."""
    column: float
    """Height of the base's column [m]; 0 but for the mount `frame`."""
    lean: float
    """Lean of the base towards the table [rad]; 0 but for the mount `tilted`."""
    look: Look
    hand: HandDesign
    stand: float = 0.0
    """Height of the arm's foot above the root [m]; 0 but for the mounts of STANDS, whose root is the foot of the stand."""


def design_body(number: int) -> BodyDesign:
    """The design of a body, numbered from 0; equal numbers give equal designs."""
    is_wide = number >= WIDE
    rng = _stream(number, "arm")
    family = _choose(rng, tuple(FAMILIES))
    joints, flange = FAMILIES[family](rng)
    size = float(rng.uniform(*WIDE_REACH)) / _reach(joints, flange) if is_wide else 1.0
    mount = _choose(rng, (*MOUNTS, *STANDS, "stand") if is_wide else MOUNTS)
    column = _length(rng, 0.18, 0.35) if mount == "frame" else 0.0
    lean = _rounded(rng.uniform(0.15, 0.5) * _choose(rng, (1, 1, -0.6))) if mount == "tilted" else 0.0
    stand = _length(rng, *STANDS[mount]) if mount in STANDS else 0.0
    look, hand = _look(_stream(number, "look"), len(joints)), _hand(_stream(number, "hand"))
    body = BodyDesign(number, family, joints, flange, mount, column, lean, look, hand, stand)
    return _widen(body, size) if is_wide else body


def _widen(body: BodyDesign, size: float) -> BodyDesign:
    """A body of the wide family: its arm times `size`, its foot on the stand, and housings to the arm's size."""
    joints, flange = _resize(body.joints, body.flange, size)
    x, y, z = joints[0].origin
    joints = (replace(joints[0], origin=(x, y, _rounded(z + body.stand))), *joints[1:])
    radii = tuple(_rounded(radius * min(max(size, 0.8), 1.2)) for radius in body.look.radii)
    return replace(body, joints=joints, flange=flange, look=replace(body.look, radii=radii))


def _reach(joints: tuple[JointDesign, ...], flange: Vector) -> float:
    """Distance from the shoulder to the hand along the links [m]."""
    return sum(float(np.linalg.norm(offset)) for offset in (*(joint.origin for joint in joints[2:]), flange))


def _resize(joints: tuple[JointDesign, ...], flange: Vector, size: float) -> tuple[tuple[JointDesign, ...], Vector]:
    """The arm with all offsets from the shoulder on times `size`; the base and the shoulder's height stay as they are."""

    def times(offset: Vector) -> Vector:
        x, y, z = (_rounded(size * value) for value in offset)
        return x, y, z

    return (*joints[:2], *(replace(joint, origin=times(joint.origin)) for joint in joints[2:])), times(flange)


def _stream(number: int, part: str) -> np.random.Generator:
    """Random numbers for one part of a body, independent of the other parts."""
    return np.random.Generator(np.random.Philox(key=[number, int.from_bytes(part.encode(), "big")]))


# --- Arms. Zero positions: upper arm up, forearm and hand ahead.


def _roll_wrist(rng: np.random.Generator) -> tuple[tuple[JointDesign, ...], Vector]:
    """Six joints; the wrist turns about the forearm, bends, and turns again (as Piper's)."""
    upper, fore = _length(rng, 0.24, 0.4), _length(rng, 0.22, 0.36)
    roll = _share(rng, fore, 0.45, 0.75)
    drop = _length(rng, 0.0, 0.06)
    joints = (
        *_shoulder(rng, 0.0, _length(rng, 0.0, 0.04)),
        JointDesign((0.0, 0.0, upper), Y, -2.9, 2.9),
        JointDesign((roll, 0.0, drop), X, -2.9, 2.9),
        JointDesign((_rounded(fore - roll), 0.0, 0.0), Y, -1.9, 1.9),
        JointDesign((_length(rng, 0.05, 0.1), 0.0, 0.0), X, -2.9, 2.9),
    )
    return joints, (_length(rng, 0.02, 0.05), 0.0, 0.0)


def _yaw_wrist(rng: np.random.Generator) -> tuple[tuple[JointDesign, ...], Vector]:
    """Six joints; the wrist bends, swings aside and turns (as ARX-X5's)."""
    upper, fore = _length(rng, 0.24, 0.38), _length(rng, 0.22, 0.34)
    joints = (
        *_shoulder(rng, 0.0, _length(rng, 0.0, 0.04)),
        JointDesign((0.0, 0.0, upper), Y, -2.9, 2.9),
        JointDesign((fore, 0.0, _length(rng, 0.0, 0.06)), Y, -2.0, 2.0),
        JointDesign((_length(rng, 0.06, 0.09), 0.0, 0.0), Z, -1.7, 1.7),
        JointDesign((_length(rng, 0.03, 0.06), 0.0, 0.0), X, -2.9, 2.9),
    )
    return joints, (_length(rng, 0.02, 0.05), 0.0, 0.0)


def _offset_wrist(rng: np.random.Generator) -> tuple[tuple[JointDesign, ...], Vector]:
    """Six joints with lateral offsets, as UR5's: three bend in parallel planes, then across, then along the hand."""
    upper, fore = _length(rng, 0.28, 0.42), _length(rng, 0.26, 0.39)
    side, back = _length(rng, 0.08, 0.13), _length(rng, 0.06, 0.11)
    joints = (
        *_shoulder(rng, side, 0.0),
        JointDesign((0.0, -back, upper), Y, -2.9, 2.9),
        JointDesign((fore, 0.0, 0.0), Y, -2.9, 2.9),
        JointDesign((0.0, _length(rng, 0.07, 0.1), 0.0), Z, -2.9, 2.9),
        JointDesign((0.0, 0.0, -_length(rng, 0.07, 0.1)), X, -2.9, 2.9),
    )
    return joints, (_length(rng, 0.05, 0.08), 0.0, 0.0)


def _seven_joints(rng: np.random.Generator) -> tuple[tuple[JointDesign, ...], Vector]:
    """Seven joints as Franka's: upper arm and forearm turn about themselves, the elbow stands out ahead."""
    upper, fore = _length(rng, 0.26, 0.34), _length(rng, 0.28, 0.4)
    elbow, wrist = _length(rng, 0.0, 0.09), _length(rng, 0.0, 0.09)
    turn, roll = _share(rng, upper, 0.4, 0.7), _share(rng, fore, 0.4, 0.7)
    joints = (
        *_shoulder(rng, 0.0, 0.0),
        JointDesign((0.0, 0.0, turn), Z, -2.8, 2.8),
        JointDesign((elbow, 0.0, _rounded(upper - turn)), Y, -2.8, 2.8),
        JointDesign((roll, 0.0, elbow), X, -2.8, 2.8),
        JointDesign((_rounded(fore - roll), 0.0, 0.0), Y, -2.2, 2.2),
        JointDesign((_length(rng, 0.05, 0.1), 0.0, -wrist), X, -2.8, 2.8),
    )
    return joints, (_length(rng, 0.03, 0.06), 0.0, 0.0)


FAMILIES: dict[str, Callable[[np.random.Generator], tuple[tuple[JointDesign, ...], Vector]]] = {
    "roll_wrist": _roll_wrist,
    "yaw_wrist": _yaw_wrist,
    "offset_wrist": _offset_wrist,
    "seven_joints": _seven_joints,
}


def _shoulder(rng: np.random.Generator, side: float, ahead: float) -> tuple[JointDesign, JointDesign]:
    """The base's turn and the shoulder, which bends the upper arm forwards."""
    return (
        JointDesign((0.0, 0.0, _length(rng, 0.06, 0.16)), Z, -2.9, 2.9),
        JointDesign((ahead, side, _length(rng, 0.03, 0.08)), Y, -1.9, 2.4),
    )


# --- Appearance and hands.


def _look(rng: np.random.Generator, joints: int) -> Look:
    thick = rng.uniform(0.03, 0.056)
    taper = rng.uniform(0.55, 0.9)
    radii = tuple(_rounded(thick * (1 - (1 - taper) * index / (joints - 1))) for index in range(joints))
    style = _choose(rng, STYLES)
    mixed = rng.random() < 0.4
    styles = tuple(_choose(rng, STYLES) if mixed else style for _ in range(joints))
    body = draw_color(rng)
    second = body if rng.random() < 0.55 else draw_color(rng)
    return Look(
        styles=styles,
        body=body,
        second=second,
        housing=draw_color(rng, plain=0.8),
        accent=draw_color(rng, plain=0.1),
        radii=radii,
        slenderness=_rounded(rng.uniform(0.55, 0.95)),
        rings=int(rng.integers(0, 4)),
        cable=bool(rng.random() < 0.3),
    )


def _hand(rng: np.random.Generator) -> HandDesign:
    stroke = _length(rng, 0.038, 0.05)
    width = _rounded(2 * stroke + rng.uniform(0.02, 0.05))
    palm = (_length(rng, 0.05, 0.09), width, _length(rng, 0.03, 0.06))
    return HandDesign(palm, _length(rng, 0.06, 0.09), stroke, _choose(rng, FINGERS))


def _choose(rng: np.random.Generator, options: tuple[Option, ...]) -> Option:
    return options[int(rng.integers(len(options)))]


def _length(rng: np.random.Generator, low: float, high: float) -> float:
    """Length between two bounds, in whole tenths of a millimeter [m]."""
    return round(float(rng.uniform(low, high)), 4)


def _share(rng: np.random.Generator, length: float, low: float, high: float) -> float:
    """Share of a length, in whole tenths of a millimeter [m]."""
    return round(length * float(rng.uniform(low, high)), 4)


def _rounded(value: float) -> float:
    return round(float(value), 4)
