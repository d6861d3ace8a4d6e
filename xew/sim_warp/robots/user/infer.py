"""Inference from a URDF: hands, joints of arms, tool frames, closing direction of fingers, limits.

If a URDF is ambiguous, a ConfigError names the field of robot.yaml that decides.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from xew.config import ConfigError
from xew.sim_warp.embodiment.spec import Arm
from xew.sim_warp.embodiment.urdf import Joint, Urdf
from xew.sim_warp.geometry.poses import Pose
from xew.sim_warp.robots.user.draft import ArmDraft, RobotDraft
from xew.sim_warp.robots.user.posed import moved_points, nearest_axis, pose_links

ARM_JOINTS = (6, 7)
TIP_MARGIN = 0.015
"""Distance of the tool frame behind the fingertips [m], as for xew's robots."""
SNAP = math.cos(math.radians(20))
"""Cosine of the largest angle at which an approach direction snaps to the nearest axis of the hand."""
LARGEST_ANGLE = 2 * math.pi
"""Largest position limit [rad]; larger limits are placeholders."""
LARGEST_SPEED, DEFAULT_SPEED = 10.0, 3.0
"""Largest speed limit [rad/s], and the default if the URDF has none, 0 or a larger one, which are placeholders."""
IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
STROKE_TOLERANCE = 1e-3
"""Largest difference between the strokes of a hand's two fingers [m]."""


def complete_arms(draft: RobotDraft, urdf: Urdf, source: str) -> tuple[Arm, Arm]:
    """Left and right arm, complete except for homes and bases."""
    drafts = fill_right_arm(draft.arms)
    hands = [] if all(arm.fingers for arm in drafts) else find_fingers(urdf)
    arms: list[Arm] = []
    for side, given in enumerate(drafts):
        fingers = given.fingers or hands[min(side, len(hands) - 1)]
        _check_joints(urdf, fingers, source)
        joints = given.joints or arm_joints(urdf, fingers)
        _check_joints(urdf, joints, source)
        ends = finger_ends(urdf, fingers)
        closed, opened = given.finger_closed or ends[0], given.finger_open or ends[1]
        link = _find_link(urdf, given.tool_link, source) if given.tool_link else hand_link(urdf, fingers)
        tool = given.tool_pose or tool_frame(urdf, joints, fingers, ends[0])
        if given.tool_pose and given.tool_at_tips:
            tool = tool_at_tips(urdf, link, Rotation.from_quat(given.tool_pose[3:]).as_matrix(), fingers, ends[0])
        arms.append(
            Arm(
                root_pose=given.root_pose or IDENTITY,
                joints=joints,
                home=given.home or (0.0,) * len(joints),
                tool_link=link,
                tool_pose=tool,
                fingers=fingers,
                finger_closed=_clip_fingers(urdf, fingers, closed),
                finger_open=_clip_fingers(urdf, fingers, opened),
                rest=given.rest or (),
            )
        )
        _check_arm(urdf, arms[-1], source)
    return arms[0], arms[1]


def fill_right_arm(arms: tuple[ArmDraft, ArmDraft]) -> tuple[ArmDraft, ArmDraft]:
    """Both arms; a missing right arm is like the left, except for home and rest."""
    left, right = arms
    return (left, replace(left, home=None, rest=None)) if right == ArmDraft() else (left, right)


def _check_joints(urdf: Urdf, names: Sequence[str], source: str) -> None:
    if missing := [name for name in names if name not in urdf.joints]:
        raise ConfigError(
            f"{source}: {urdf.path.name} has no joint {', '.join(missing)}; it has {', '.join(urdf.joint_names)}."
        )


def _find_link(urdf: Urdf, name: str, source: str) -> str:
    """A link by its name, or by the name of its joint as in RoboTwin."""
    if name in urdf.links:
        return name
    if name in urdf.joints:
        return urdf.joints[name].child
    raise ConfigError(f"{source}: {urdf.path.name} has no link or joint {name}; expected the tool's link.")


def _clip_fingers(urdf: Urdf, fingers: tuple[str, str], positions: tuple[float, float]) -> tuple[float, float]:
    """Finger positions within the URDF's limits, which RoboTwin's scales exceed."""
    first, second = (
        min(max(position, urdf.joints[name].lower), urdf.joints[name].upper)
        for name, position in zip(fingers, positions, strict=True)
    )
    return first, second


def _check_arm(urdf: Urdf, arm: Arm, source: str) -> None:
    strokes = np.abs(np.subtract(arm.finger_open, arm.finger_closed))
    if min(strokes) < 1e-3 or abs(strokes[0] - strokes[1]) > STROKE_TOLERANCE:
        raise ConfigError(
            f"{source}: the fingers {', '.join(arm.fingers)} move {1000 * strokes[0]:.0f} and {1000 * strokes[1]:.0f} mm from "
            "closed to open; expected equal strokes of at least 1 mm. Check finger_closed and finger_open, or gripper_scale."
        )
    length = float(np.linalg.norm(arm.tool_pose[3:]))
    if not (np.isfinite(arm.tool_pose).all() and np.isfinite(arm.root_pose).all() and abs(length - 1) < 1e-3):
        raise ConfigError(f"{source}: tool_pose {arm.tool_pose} is invalid; expected a position and a unit quaternion x y z w.")
    chain = {joint.name for joint in urdf.chain(arm.tool_link)}
    if loose := [name for name in arm.joints if name not in chain]:
        raise ConfigError(f"{source}: {', '.join(loose)} do not lead to {arm.tool_link}; name the joints of this arm.")


def complete_limits(
    draft: RobotDraft, urdf: Urdf, arms: tuple[Arm, Arm], source: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower and upper position limits [d] rad and speed limits [d] rad/s of experts."""
    both = [joint_limits(urdf, arm.joints) for arm in arms]
    inferred = (np.maximum(both[0][0], both[1][0]), np.minimum(both[0][1], both[1][1]), np.minimum(both[0][2], both[1][2]))
    given = (draft.joint_lower, draft.joint_upper, draft.joint_velocity)
    lower, upper, speed = (limit if own is None else np.array(own) for limit, own in zip(inferred, given, strict=True))
    if not len(lower) == len(upper) == len(speed) == len(arms[0].joints) or not (lower < upper).all() or not (speed > 0).all():
        raise ConfigError(
            f"{source}: joint_lower, joint_upper and joint_velocity need {len(arms[0].joints)} numbers each, lower below "
            "upper and velocities above 0, for both arms. Use python -m xew.sim_warp.robots.adopt for arms with mirrored "
            "limits."
        )
    return lower, upper, speed


def check_own_motion(draft: RobotDraft, arms: tuple[Arm, Arm], lower: np.ndarray, upper: np.ndarray, source: str) -> None:
    """Raise ConfigError for invalid acceleration limits or rest postures of arms with limits [d] rad."""
    given = np.array(draft.joint_acceleration if draft.joint_acceleration is not None else [1.0] * len(lower))
    if len(given) != len(lower) or not (given > 0).all():
        raise ConfigError(f"{source}: joint_acceleration is {given.tolist()}; expected {len(lower)} numbers above 0.")
    for side, arm in zip(("left", "right"), arms, strict=True):
        rest = np.array(arm.rest or lower)
        if len(rest) != len(lower) or (rest < lower).any() or (rest > upper).any():
            raise ConfigError(
                f"{source}: the {side} arm's rest is {list(arm.rest)}; expected {len(lower)} joints within their limits."
            )


def find_fingers(urdf: Urdf) -> list[tuple[str, str]]:
    """The finger joints of every hand, the left hand first: two prismatic joints on one link, for robots that face +x.

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
            f"{urdf.path}: found {len(hands)} hands (a link with two prismatic finger joints), expected one or two. "
            f"python -m xew.sim_warp.robots.adopt {urdf.path.name} converts linked or turning fingers, and its --hand ur5_wsg "
            "mounts a hand; or name the joints in a robot.yaml as arms: [{fingers: [A, B]}, {fingers: [C, D]}]."
            + urdf.mimic_hint
        )
    poses = pose_links(urdf)
    ordered = sorted(hands, key=lambda hand: -poses[hand][1, 3])
    return [(hands[hand][0], hands[hand][1]) for hand in ordered]


def arm_joints(urdf: Urdf, fingers: tuple[str, str]) -> tuple[str, ...]:
    """The turning joints from the root to a hand. Raises ConfigError unless there are six or seven."""
    turning = [joint.name for joint in urdf.chain(hand_link(urdf, fingers)) if joint.kind in ("revolute", "continuous")]
    if len(turning) not in ARM_JOINTS:
        raise ConfigError(
            f"{urdf.path}: {len(turning)} joints turn on the way to {hand_link(urdf, fingers)} ({', '.join(turning) or '-'}), "
            "expected six or seven, for full poses of the hand. Name the joints "
            "of the arm in a robot.yaml as arms: [{joints: [...]}, {joints: [...]}]."
        )
    return tuple(turning)


def hand_link(urdf: Urdf, fingers: tuple[str, str]) -> str:
    """The link that carries the fingers."""
    return urdf.joints[fingers[0]].parent


def finger_ends(urdf: Urdf, fingers: tuple[str, str]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Positions (closed, open) of both finger joints [m]; closed is the end nearer to the other finger.

    Raises:
        ConfigError: a finger has no limits or no range.
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
    """The middle of a finger's range [m]. Raises ConfigError if it has none."""
    if joint.kind != "prismatic" or not math.isfinite(joint.upper - joint.lower) or joint.upper - joint.lower < 1e-4:
        raise ConfigError(
            f"{urdf.path}: the finger {joint.name} is {joint.kind} from {joint.lower:g} to {joint.upper:g}; expected a "
            "prismatic joint with limits (meters) between which it opens."
        )
    return (joint.lower + joint.upper) / 2


def _finger_points(urdf: Urdf, name: str, positions: dict[str, float]) -> np.ndarray:
    """Points [k 3] m of the links below a finger joint, in the frame of the hand."""
    poses = pose_links(urdf, positions)
    return moved_points(urdf, name, poses, poses[urdf.joints[name].parent])


def _closed_hand_points(urdf: Urdf, fingers: tuple[str, str], closed: tuple[float, float]) -> np.ndarray:
    """Points [k 3] m of both fingers of a closed hand, in the frame of the hand."""
    positions = dict(zip(fingers, closed, strict=True))
    return np.concatenate([_finger_points(urdf, name, positions) for name in fingers])


def tool_frame(urdf: Urdf, joints: tuple[str, ...], fingers: tuple[str, str], closed: tuple[float, float]) -> Pose:
    """The tool frame in the hand's link: x out of the hand, y opening direction, origin `TIP_MARGIN` behind the fingertips.

    Raises:
        ConfigError: the hand's direction is ambiguous.
    """
    hand = hand_link(urdf, fingers)
    opening = urdf.joints[fingers[0]].origin[:3, :3] @ urdf.joints[fingers[0]].axis
    points = _closed_hand_points(urdf, fingers, closed)
    low, high = points.min(0), points.max(0)
    poses = pose_links(urdf)
    wrist = np.linalg.inv(poses[hand]) @ poses[urdf.joints[joints[-1]].child]
    approach = (low + high) / 2 - wrist[:3, 3]
    approach -= opening * (approach @ opening)
    if np.linalg.norm(approach) < 1e-3:
        raise ConfigError(f"{urdf.path}: the direction of {hand} is ambiguous; set tool_pose in a robot.yaml.")
    approach = _snap_to_axis(approach / np.linalg.norm(approach), opening)
    return tool_at_tips(urdf, hand, np.stack([approach, opening, np.cross(approach, opening)], axis=1), fingers, closed)


def tool_at_tips(urdf: Urdf, link: str, rotation: np.ndarray, fingers: tuple[str, str], closed: tuple[float, float]) -> Pose:
    """A tool frame in `link` with the orientation `rotation` [3 3], its origin between the fingers, behind their tips."""
    poses = pose_links(urdf)
    hand = np.linalg.inv(poses[link]) @ poses[hand_link(urdf, fingers)]
    points = (_closed_hand_points(urdf, fingers, closed) @ hand[:3, :3].T + hand[:3, 3]) @ rotation
    center = np.array([points[:, 0].max() - TIP_MARGIN, *((points.min(0) + points.max(0)) / 2)[1:]])
    x, y, z = (rotation @ center).tolist()
    return (x, y, z, *Rotation.from_matrix(rotation).as_quat(canonical=True).tolist())


def _snap_to_axis(direction: np.ndarray, opening: np.ndarray) -> np.ndarray:
    """The nearest axis of the hand, if it is near and orthogonal to `opening`, else the direction."""
    axis = nearest_axis(direction)
    return axis if axis @ direction > SNAP and abs(axis @ opening) < 1e-6 else direction


def joint_limits(urdf: Urdf, joints: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower and upper position limits [d] rad and speed limits [d] rad/s of experts.

    Raises:
        ConfigError: a joint does not turn, or has no limits.
    """
    arm = [urdf.joints[name] for name in joints]
    for joint in arm:
        if joint.kind not in ("revolute", "continuous"):
            raise ConfigError(f"{urdf.path}: the arm's joint {joint.name} is {joint.kind}; expected revolute or continuous.")
        if joint.kind == "revolute" and not joint.lower < joint.upper < math.inf:
            raise ConfigError(
                f"{urdf.path}: the arm's joint {joint.name} has no limits (from {joint.lower:g} to {joint.upper:g}); "
                'give it <limit lower="…" upper="…" velocity="…" effort="…"/> in radians.'
            )
    lower = np.maximum([joint.lower for joint in arm], -LARGEST_ANGLE)
    upper = np.minimum([joint.upper for joint in arm], LARGEST_ANGLE)
    speed = np.array([joint.velocity for joint in arm])
    return lower, upper, np.where((speed > 0) & (speed <= LARGEST_SPEED), speed, DEFAULT_SPEED)
