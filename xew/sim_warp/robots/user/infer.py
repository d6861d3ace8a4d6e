"""Inference from a URDF: its hands, the joints of its arms, its tool frame, which way its fingers close.

Reads  a Urdf
Writes the fields of an Arm that a draft leaves open. Where the URDF leaves more than one reading, a ConfigError says which
field of robot.yaml decides.
"""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from xew.config import ConfigError
from xew.sim_warp.embodiment.urdf import Joint, Urdf
from xew.sim_warp.geometry.poses import Pose
from xew.sim_warp.kinematics.forward import link_matrices

ARM_JOINTS = (6, 7)
TIP_MARGIN = 0.015
"""Distance of the tool frame behind the finger tips [m], as on our own robots."""
SNAP = math.cos(math.radians(20))
"""Cosine of the largest angle at which an approach direction is taken to be the axis of the hand that is nearest: 20 degrees.
"""
LARGEST_ANGLE = 2 * math.pi
"""Largest position limit [rad]; one beyond it is a placeholder."""
LARGEST_SPEED, DEFAULT_SPEED = 10.0, 3.0
"""Largest speed limit [rad/s], and the one that is used where the URDF has none, 0 or a larger one: those are placeholders."""


def find_fingers(urdf: Urdf) -> list[tuple[str, str]]:
    """The finger joints of every hand, the left hand first: two prismatic joints on one link, of robots that look along x.

    Raises:
        ConfigError: there is no hand, or more than two.
    """
    by_hand: dict[str, list[str]] = {}
    for joint in urdf.joints.values():
        if joint.kind == "prismatic":
            by_hand.setdefault(joint.parent, []).append(joint.name)
    hands = {hand: fingers for hand, fingers in by_hand.items() if len(fingers) == 2}
    if not 1 <= len(hands) <= 2:
        raise ConfigError(
            f"{urdf.path}: found {len(hands)} hands (a link with two prismatic finger joints), expected one or two; "
            "name them in a robot.yaml as arms: [{fingers: [A, B]}, {fingers: [C, D]}]."
        )
    frames = link_matrices(urdf, np.zeros((1, len(urdf.joint_names))))
    ordered = sorted(hands, key=lambda hand: -frames[hand][0, 1, 3])
    return [(hands[hand][0], hands[hand][1]) for hand in ordered]


def arm_joints(urdf: Urdf, fingers: tuple[str, str]) -> tuple[str, ...]:
    """The turning joints from the root to a hand. Raises ConfigError if they are not six or seven."""
    turning = [joint.name for joint in urdf.chain(hand_link(urdf, fingers)) if joint.kind in ("revolute", "continuous")]
    if len(turning) not in ARM_JOINTS:
        raise ConfigError(
            f"{urdf.path}: {len(turning)} joints turn on the way to {hand_link(urdf, fingers)} ({', '.join(turning) or '-'}), "
            "expected six or seven; name those of the arm in a robot.yaml as arms: [{joints: [...]}, {joints: [...]}]."
        )
    return tuple(turning)


def hand_link(urdf: Urdf, fingers: tuple[str, str]) -> str:
    """The link that carries the fingers."""
    return urdf.joints[fingers[0]].parent


def finger_ends(urdf: Urdf, fingers: tuple[str, str]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Positions (closed, open) of both finger joints [m]: closed is the end at which a finger is nearer to the other.

    Raises:
        ConfigError: a finger has no limits or no way to go.
    """
    middles = {name: _middle_position(urdf.joints[name], urdf) for name in fingers}
    closed, opened = [], []
    for name, other in (fingers, fingers[::-1]):
        ends = (urdf.joints[name].lower, urdf.joints[name].upper)
        away = _finger_points(urdf, other, middles).mean(0)
        distance = [np.linalg.norm(_finger_points(urdf, name, middles | {name: end}).mean(0) - away) for end in ends]
        near = int(np.argmin(distance))
        closed.append(ends[near])
        opened.append(ends[1 - near])
    return (closed[0], closed[1]), (opened[0], opened[1])


def _middle_position(joint: Joint, urdf: Urdf) -> float:
    """The middle of a finger's way [m]. Raises ConfigError if it has none."""
    if joint.kind != "prismatic" or not math.isfinite(joint.upper - joint.lower) or joint.upper - joint.lower < 1e-4:
        raise ConfigError(
            f"{urdf.path}: the finger {joint.name} is {joint.kind} from {joint.lower:g} to {joint.upper:g}; expected a "
            "prismatic joint with limits (meters) between which it opens."
        )
    return (joint.lower + joint.upper) / 2


def _finger_points(urdf: Urdf, name: str, positions: dict[str, float]) -> np.ndarray:
    """Points [k 3] m of all that a finger joint moves, in the frame of the hand; its origin if that has no shape."""
    row = np.array([[positions.get(joint, 0.0) for joint in urdf.joint_names]])
    frames = link_matrices(urdf, row)
    hand = np.linalg.inv(frames[urdf.joints[name].parent][0])
    points = [(hand @ frames[urdf.joints[name].child][0])[None, :3, 3]]
    for link in urdf.links.values():
        if urdf.joints[name] in urdf.chain(link.name):
            pose = hand @ frames[link.name][0]
            shapes = [shape.points for shape in link.collisions] or ([link.visual.vertices] if link.visual else [])
            points += [shape @ pose[:3, :3].T + pose[:3, 3] for shape in shapes]
    return np.concatenate(points[1:] or points)


def tool_frame(urdf: Urdf, joints: tuple[str, ...], fingers: tuple[str, str], closed: tuple[float, float]) -> Pose:
    """The tool frame in the link that carries the fingers: x out of the hand, y along which the fingers open, origin between
    the fingers, `TIP_MARGIN` behind their tips.

    Raises:
        ConfigError: the fingers do not show which way the hand points.
    """
    hand = hand_link(urdf, fingers)
    opening = urdf.joints[fingers[0]].origin[:3, :3] @ urdf.joints[fingers[0]].axis
    both = [_finger_points(urdf, name, dict(zip(fingers, closed, strict=True))) for name in fingers]
    low, high = np.concatenate(both).min(0), np.concatenate(both).max(0)
    frames = link_matrices(urdf, np.zeros((1, len(urdf.joint_names))))
    wrist = np.linalg.inv(frames[hand][0]) @ frames[urdf.joints[joints[-1]].child][0]
    approach = (low + high) / 2 - wrist[:3, 3]
    approach -= opening * (approach @ opening)
    if np.linalg.norm(approach) < 1e-3:
        raise ConfigError(f"{urdf.path}: cannot tell which way {hand} points; give tool_pose in a robot.yaml.")
    approach = _snap_to_axis(approach / np.linalg.norm(approach), opening)
    return tool_at_tips(urdf, hand, np.stack([approach, opening, np.cross(approach, opening)], axis=1), fingers, closed)


def tool_at_tips(urdf: Urdf, link: str, rotation: np.ndarray, fingers: tuple[str, str], closed: tuple[float, float]) -> Pose:
    """A tool frame in `link` of the orientation `rotation` [3 3], its origin between the fingers, behind their tips."""
    row = np.zeros((1, len(urdf.joint_names)))
    frames = link_matrices(urdf, row)
    hand = np.linalg.inv(frames[link][0]) @ frames[hand_link(urdf, fingers)][0]
    both = [_finger_points(urdf, name, dict(zip(fingers, closed, strict=True))) for name in fingers]
    points = (np.concatenate(both) @ hand[:3, :3].T + hand[:3, 3]) @ rotation
    center = np.array([points[:, 0].max() - TIP_MARGIN, *((points.min(0) + points.max(0)) / 2)[1:]])
    x, y, z = (rotation @ center).tolist()
    return (x, y, z, *Rotation.from_matrix(rotation).as_quat(canonical=True).tolist())


def _snap_to_axis(direction: np.ndarray, opening: np.ndarray) -> np.ndarray:
    """The nearest axis of the hand that is square to `opening`, if it is near, else the direction itself."""
    axis = np.zeros(3)
    axis[np.argmax(np.abs(direction))] = np.sign(direction[np.argmax(np.abs(direction))])
    return axis if axis @ direction > SNAP and abs(axis @ opening) < 1e-6 else direction


def joint_limits(urdf: Urdf, joints: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower and upper position limits [d] rad and speed limits [d] rad/s that experts keep.

    Raises:
        ConfigError: a joint does not turn, or has no limits.
    """
    found = [urdf.joints[name] for name in joints]
    for joint in found:
        if joint.kind not in ("revolute", "continuous"):
            raise ConfigError(f"{urdf.path}: the arm's joint {joint.name} is {joint.kind}; expected revolute or continuous.")
        if joint.kind == "revolute" and not joint.lower < joint.upper < math.inf:
            raise ConfigError(
                f"{urdf.path}: the arm's joint {joint.name} has no limits (from {joint.lower:g} to {joint.upper:g}); "
                'give it <limit lower="…" upper="…" velocity="…" effort="…"/> in radians.'
            )
    lower = np.maximum([joint.lower for joint in found], -LARGEST_ANGLE)
    upper = np.minimum([joint.upper for joint in found], LARGEST_ANGLE)
    speed = np.array([joint.velocity for joint in found])
    return lower, upper, np.where((speed > 0) & (speed <= LARGEST_SPEED), speed, DEFAULT_SPEED)
