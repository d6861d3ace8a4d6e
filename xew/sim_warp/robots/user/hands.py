"""Conversion of linked and turning fingers, and of arms without a hand, to hands with two sliding fingers.

Physics has one hand for all robots: two fingers that slide apart by the same distance. `slide_fingers` puts links that mimic
joints move together onto two slides: closed, each link is where it was; both fingers open as far as their tips did. Turns of
the links are ignored; parallel grippers have none. `graft_hand` mounts the hand of one of xew's robots on an arm.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from xew.config import ConfigError
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.embodiment.urdf import Joint, Urdf, load_urdf
from xew.sim_warp.embodiment.xml_files import read_xml
from xew.sim_warp.geometry.poses import matrix_from_pose
from xew.sim_warp.kinematics.forward import joint_motion
from xew.sim_warp.robots.user.posed import moved_points, nearest_axis, pose_links

TIP = 0.02
"""Length of a fingertip [m]."""
LEAST_STROKE = 0.002
"""Least travel of a finger [m]."""
ON_AXIS = np.cos(np.radians(5))
FINGER_SPEED, FINGER_EFFORT = 0.3, 20.0
"""Limits of the slides [m/s], [N]; physics has its own."""
HAND = "hand_"
"""Prefix of the names of a grafted hand's links and joints."""
OTHER_HAND = "expected two that open equally. Mount one of xew's hands: --hand ur5_wsg."


@dataclass(frozen=True)
class Linkage:
    """Joints driven by one joint."""

    base: str
    """Common parent link."""
    driver: Joint
    joints: tuple[Joint, ...]
    """The driver and its mimics."""
    factors: Mapping[str, tuple[float, float]]
    """Factor and offset by joint: position = factor * driver's + offset."""

    def positions(self, driven: float) -> dict[str, float]:
        """Positions of the joints at a position of the driver [rad or m]."""
        return {name: factor * driven + offset for name, (factor, offset) in self.factors.items()}


def slide_fingers(tree: ElementTree.Element, urdf: Urdf) -> list[str]:
    """Put linked fingers on two slides per hand, except hands with two sliding fingers on one link, in the URDF's `tree`.

    Returns:
        A sentence for each changed hand.

    Raises:
        ConfigError: a driving joint has no limits, or only one finger moves.
    """
    return [_slide(tree, urdf, linkage, number) for number, linkage in enumerate(find_linkages(urdf), 1)]


def find_linkages(urdf: Urdf) -> list[Linkage]:
    """Fingers that move together by mimic joints, except pairs of slides on one link."""
    factors: dict[str, dict[str, tuple[float, float]]] = {}
    for joint in urdf.joints.values():
        name, factor, offset = joint.name, 1.0, 0.0
        while (mimic := urdf.joints[name].mimic) is not None:
            name, factor, offset = mimic[0], factor * mimic[1], factor * mimic[2] + offset
        drives = any(other.mimic is not None and other.mimic[0] == joint.name for other in urdf.joints.values())
        if joint.kind != "fixed" and (name != joint.name or drives):
            factors.setdefault(name, {})[joint.name] = (factor, offset)
    linkages = []
    for name, driven in factors.items():
        joints = tuple(urdf.joints[joint] for joint in driven)
        if not (len(joints) == 2 and {j.kind for j in joints} == {"prismatic"} and len({j.parent for j in joints}) == 1):
            linkages.append(Linkage(_common_link(urdf, joints), urdf.joints[name], joints, driven))
    return linkages


def _common_link(urdf: Urdf, joints: tuple[Joint, ...]) -> str:
    """The last common link of the chains to all joints."""
    ways = [[urdf.root, *(above.child for above in urdf.chain(joint.parent))] for joint in joints]
    return [links[0] for links in zip(*ways, strict=False) if len(set(links)) == 1][-1]


def _slide(tree: ElementTree.Element, urdf: Urdf, linkage: Linkage, number: int) -> str:
    driver = linkage.driver
    if not np.isfinite(driver.upper - driver.lower) or driver.upper - driver.lower < 1e-4:
        raise ConfigError(f"{urdf.path}: the finger joint {driver.name} has no limits; expected its closed and open positions.")
    tops = _topmost(urdf, linkage)
    ends = [_finger_points(urdf, linkage, tops, end) for end in (driver.lower, driver.upper)]
    fingers, approach = _choose_fingers(ends[0])
    if len(fingers) < 2:
        alone = f"only one finger of the hand on {linkage.base} moves ({driver.name})"
        raise ConfigError(f"{urdf.path}: {alone}; {OTHER_HAND}{urdf.mimic_hint}")
    gaps = [_tip(end[fingers[0]], approach) - _tip(end[fingers[1]], approach) for end in ends]
    shut = int(np.linalg.norm(gaps[1]) < np.linalg.norm(gaps[0]))
    closed = (driver.lower, driver.upper)[shut]
    moves = [_tip(ends[1 - shut][name], approach) - _tip(ends[shut][name], approach) for name in fingers]
    opening = _on_axis(moves[0] - moves[1], approach)
    stroke = float((moves[0] - moves[1]) @ opening) / 2
    if min(moves[0] @ opening, -moves[1] @ opening) < LEAST_STROKE:
        still = f"the fingers of the hand on {linkage.base} do not both move apart"
        raise ConfigError(f"{urdf.path}: {still}; {OTHER_HAND}{urdf.mimic_hint}")
    middle = (_tip(ends[shut][fingers[0]], approach) + _tip(ends[shut][fingers[1]], approach)) / 2
    frames = pose_links(urdf, linkage.positions(closed))
    for joint in linkage.joints:
        origin = joint.origin
        if joint in tops:
            side = float((ends[shut][joint.name].mean(0) - middle) @ opening)
            first = joint.name == fingers[0] or (joint.name != fingers[1] and side > 0)
            parent = _element(tree, joint).find("parent")
            parent.set("link", f"{linkage.base}_slide_{number}{'ab'[not first]}")  # type: ignore[union-attr]
            origin = np.linalg.inv(frames[linkage.base]) @ frames[joint.parent] @ origin
        _fix(tree, joint, origin @ joint_motion(joint, np.array([linkage.positions(closed)[joint.name]]))[0])
    for letter, sign in (("a", 1.0), ("b", -1.0)):
        _add_slide(tree, linkage.base, f"{linkage.base}_slide_{number}{letter}", sign * opening, stroke)
    turn = _turn(urdf, linkage, fingers[0])
    return (
        f"the hand on {linkage.base}, driven by {driver.name}, is replaced by two fingers that slide "
        f"{1000 * stroke:.0f} mm each; its fingertips turn by {turn:.0f} deg as they open, which is ignored"
    )


def _topmost(urdf: Urdf, linkage: Linkage) -> list[Joint]:
    """The joints of a linkage that are not below another of its joints."""
    names = {joint.name for joint in linkage.joints}
    return [j for j in linkage.joints if not any(above.name in names for above in urdf.chain(j.parent))]


def _finger_points(urdf: Urdf, linkage: Linkage, tops: list[Joint], driven: float) -> dict[str, np.ndarray]:
    """Points [k 3] m below each of the topmost joints, in the frame of the linkage's base."""
    poses = pose_links(urdf, linkage.positions(driven))
    return {top.name: moved_points(urdf, top.name, poses, poses[linkage.base]) for top in tops}


def _choose_fingers(points: Mapping[str, np.ndarray]) -> tuple[list[str], np.ndarray]:
    """The two branches of the farthest reach, and its direction [3]."""
    approach = np.mean([cloud.mean(0) for cloud in points.values()], axis=0)
    axis = nearest_axis(approach)
    return sorted(points, key=lambda name: -float((points[name] @ axis).max()))[:2], axis


def _tip(points: np.ndarray, approach: np.ndarray) -> np.ndarray:
    """The center [3] of a fingertip."""
    along = points @ approach
    return points[along > along.max() - TIP].mean(0)


def _on_axis(direction: np.ndarray, approach: np.ndarray) -> np.ndarray:
    """The unit vector across the approach nearest to a direction, snapped to a near axis of the base."""
    across = direction - approach * (direction @ approach)
    across /= max(float(np.linalg.norm(across)), 1e-12)
    axis = nearest_axis(across)
    return axis if axis @ across > ON_AXIS else across


def _turn(urdf: Urdf, linkage: Linkage, finger: str) -> float:
    """Turn of the last link of a finger from end to end [deg]."""
    last = max(urdf.links, key=lambda link: len(urdf.chain(link)) * (urdf.joints[finger] in urdf.chain(link)))
    positions = [linkage.positions(end) for end in (linkage.driver.lower, linkage.driver.upper)]
    ends = [pose_links(urdf, position)[last][:3, :3] for position in positions]
    return float(np.degrees(Rotation.from_matrix(ends[0].T @ ends[1]).magnitude()))


# --- Changes of the tree.


def _element(tree: ElementTree.Element, joint: Joint) -> ElementTree.Element:
    return next(entry for entry in tree.findall("joint") if entry.get("name") == joint.name)


def _fix(tree: ElementTree.Element, joint: Joint, origin: np.ndarray) -> None:
    """Make a joint a fixed one with an origin [4 4]."""
    entry = _element(tree, joint)
    entry.set("type", "fixed")
    _set_origin(entry, origin)
    for name in ("axis", "limit", "mimic", "dynamics", "safety_controller", "calibration"):
        for child in entry.findall(name):
            entry.remove(child)


def _add_slide(tree: ElementTree.Element, base: str, name: str, axis: np.ndarray, stroke: float) -> None:
    ElementTree.SubElement(tree, "link", name=name)
    joint = ElementTree.SubElement(tree, "joint", name=f"{name}_joint", type="prismatic")
    ElementTree.SubElement(joint, "parent", link=base)
    ElementTree.SubElement(joint, "child", link=name)
    ElementTree.SubElement(joint, "axis", xyz=_numbers(axis))
    limits = {"lower": 0.0, "upper": stroke, "velocity": FINGER_SPEED, "effort": FINGER_EFFORT}
    ElementTree.SubElement(joint, "limit", {key: f"{value:.6g}" for key, value in limits.items()})


def _set_origin(joint: ElementTree.Element, pose: np.ndarray) -> None:
    origin = joint.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(joint, "origin")
    origin.set("xyz", _numbers(pose[:3, 3]))
    origin.set("rpy", _numbers(_roll_pitch_yaw(pose[:3, :3])))


def _roll_pitch_yaw(rotation: np.ndarray) -> np.ndarray:
    """URDF's angles [3] rad of a rotation matrix; at the singularity yaw is 0."""
    across = np.hypot(rotation[0, 0], rotation[1, 0])
    pitch = np.arctan2(-rotation[2, 0], across)
    if across < 1e-9:
        return np.array([np.arctan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(rotation[2, 1], rotation[2, 2]), pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value + 0.0:.9g}" for value in np.round(values, 9))


# --- Hands of xew's robots.


def graft_hand(tree: ElementTree.Element, urdf: Urdf, robot: RobotSpec, last_joint: str | None = None) -> str:
    """Replace all moving links beyond an arm's last joint with a robot's hand, in the `tree` of a URDF of one arm.

    `last_joint` is the joint before the first branch by default. Returns a sentence on the hand's place.
    """
    if last_joint is not None and last_joint not in urdf.joints:
        raise ConfigError(f"{urdf.path} has no joint {last_joint}; it has {', '.join(urdf.joint_names)}.")
    last = urdf.joints[last_joint] if last_joint else _last_arm_joint(urdf)
    _cut_beyond(tree, urdf, last)
    flange, approach = _flange(urdf, last)
    theirs, arm = load_urdf(robot.urdf), robot.arms[0]
    hand = theirs.joints[arm.fingers[0]].parent
    poses = pose_links(theirs)
    tool = np.linalg.inv(poses[hand]) @ poses[arm.tool_link] @ matrix_from_pose(arm.tool_pose)
    turn, _ = Rotation.align_vectors([approach], [tool[:3, 0]])
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix()
    source = read_xml(theirs.path)
    hand_links = {hand, *(link for link in theirs.links if any(joint.parent == hand for joint in theirs.chain(link)))}
    tree.extend(_renamed(material) for material in source.findall("material"))
    tree.extend(_renamed_link(link, theirs) for link in source.findall("link") if link.get("name") in hand_links)
    tree.extend(_renamed_joint(joint) for joint in source.findall("joint") if _child(joint) in hand_links - {hand})
    mount = ElementTree.SubElement(tree, "joint", name=f"{HAND}mount", type="fixed")
    ElementTree.SubElement(mount, "parent", link=flange)
    ElementTree.SubElement(mount, "child", link=f"{HAND}{hand}")
    _set_origin(mount, pose)
    return f"the hand of {robot.title} is mounted on {flange}, pointing along {_numbers(approach)} of it"


def _last_arm_joint(urdf: Urdf) -> Joint:
    """The joint before the first branch of moving joints."""
    link, last = urdf.root, None
    while True:
        following = _next_moving(urdf, link)
        if len(following) != 1:
            break
        last = following[0]
        link = last.child
    if last is None:
        raise ConfigError(f"{urdf.path}: --hand is for a URDF of one arm; from {urdf.root} on, {len(following)} joints move.")
    return last


def _next_moving(urdf: Urdf, link: str) -> list[Joint]:
    """The first moving joints below a link."""
    moving: list[Joint] = []
    for joint in urdf.joints.values():
        if joint.parent == link:
            moving += _next_moving(urdf, joint.child) if joint.kind == "fixed" else [joint]
    return moving


def _cut_beyond(tree: ElementTree.Element, urdf: Urdf, last: Joint) -> None:
    """Remove all moving links beyond a joint."""
    gone = {
        link
        for link in urdf.links
        if last in (chain := urdf.chain(link)) and any(joint.kind != "fixed" for joint in chain[chain.index(last) + 1 :])
    }
    links = [entry for entry in tree.findall("link") if entry.get("name") in gone]
    tree.extend(material for link in links for material in link.iter("material") if len(material))  # others may name them
    for entry in [*links, *(entry for entry in tree.findall("joint") if _child(entry) in gone)]:
        tree.remove(entry)


def _child(joint: ElementTree.Element) -> str | None:
    """The name of a joint's child link."""
    child = joint.find("child")
    return None if child is None else child.get("link")


def _flange(urdf: Urdf, last: Joint) -> tuple[str, np.ndarray]:
    """The link for the hand and the direction [3] in it: z of tool0 and x of flange (ROS-Industrial's); else the last axis."""
    for name in ("tool0", "flange"):
        if name in urdf.links and last in urdf.chain(name):
            return name, np.array([0.0, 0.0, 1.0] if name == "tool0" else [1.0, 0.0, 0.0])
    ahead = float(last.origin[:3, 3] @ last.origin[:3, :3] @ last.axis)
    return last.child, last.axis * (-1.0 if ahead < -1e-3 else 1.0)


def _renamed_link(link: ElementTree.Element, urdf: Urdf) -> ElementTree.Element:
    copy = _renamed(link)
    for mesh in copy.iter("mesh"):
        mesh.set("filename", str(urdf.meshes[mesh.get("filename", "")].resolve()))
    for material in copy.iter("material"):
        material.set("name", f"{HAND}{material.get('name', '')}")
    return copy


def _renamed_joint(joint: ElementTree.Element) -> ElementTree.Element:
    copy = _renamed(joint)
    for name in ("parent", "child"):
        entry = copy.find(name)
        assert entry is not None
        entry.set("link", f"{HAND}{entry.get('link', '')}")
    for mimic in copy.findall("mimic"):
        mimic.set("joint", f"{HAND}{mimic.get('joint', '')}")
    return copy


def _renamed(entry: ElementTree.Element) -> ElementTree.Element:
    """A copy whose name begins with `HAND`."""
    copy = deepcopy(entry)
    copy.set("name", f"{HAND}{copy.get('name', '')}")
    return copy
