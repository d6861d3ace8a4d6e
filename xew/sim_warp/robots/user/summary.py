"""Summary of a completed robot: its properties, warnings, and a robot.yaml that marks every entry as given or found."""

from collections.abc import Sequence
from dataclasses import asdict, fields

import numpy as np
import yaml

from xew.sim_warp.embodiment.spec import Arm, RobotSpec
from xew.sim_warp.embodiment.urdf import Urdf, load_urdf
from xew.sim_warp.geometry.poses import matrix_from_pose
from xew.sim_warp.robots.user.draft import ArmDraft, RobotDraft
from xew.sim_warp.robots.user.infer import fill_right_arm
from xew.sim_warp.robots.user.posed import moved_points, pose_links

TIP = 0.02
"""Length of the fingertips behind the tool frame's origin [m]."""
SMALL_OPENING = 0.04
"""Opening of a hand below which most objects do not fit [m]."""
LARGEST_GAP = 0.004
"""Distance between closed fingers at which they cannot hold the walls of cups and bowls [m]."""
FAR_LINK = 2.5
"""Distance from the root at which a link is probably misplaced [m]."""
PLACEHOLDER_SPEED = 1.0
"""Usual placeholder for unknown speed limits [rad/s]."""
FOUND = {
    "root_pose": "root link: x y z [m], quaternion x y z w; the place from which both arms follow most plans",
    "joints": "the turning joints on the way to the hand",
    "home": "brings the tool to where plans begin [rad]; remove it if you change root_pose or tool_pose",
    "tool_link": "the link that carries the fingers",
    "tool_pose": "in tool_link: x out of the hand, y along which it opens, 15 mm behind the fingertips",
    "fingers": "two joints that slide on one link",
    "finger_closed": "the end at which the fingers are nearer to each other [m]",
    "finger_open": "the other end [m]",
    "rest": "initial posture of own motion [rad]; empty: home",
    "joint_lower": "the URDF's, within a whole turn [rad]",
    "joint_upper": "the same",
    "joint_velocity": "the URDF's; 3 where it has none, 0 or more than 10 [rad/s]",
    "joint_acceleration": "15 where nothing is known [rad/s^2]",
    "title": "the URDF's name",
}
"""Meaning of each entry of a robot.yaml and how a missing one is found."""
HEAD = """\
# Description of this robot. Entries marked "found" were inferred: change them, or remove them to infer them again.
# Lengths in meters, angles in radians. Check the pictures next to this folder after each change.
"""


def robot_lines(robot: RobotSpec, problems: Sequence[str | None], reach: Sequence[float]) -> list[str]:
    """Lines on a robot's properties, its problems with `trials.trial_plans`, and each arm's share of reachable grasps."""
    speeds = ", ".join(f"{speed:.3g}" for speed in robot.joint_velocity)
    lines = []
    for side, arm, share in zip(("left", "right"), robot.arms, reach, strict=True):
        lines += [
            f"{side} base    {_numbers(arm.root_pose[:3])} m",
            f"{side} joints  {', '.join(arm.joints)}",
            f"{side} hand    {' and '.join(arm.fingers)} on {arm.tool_link}, opens {1000 * opening(arm):.0f} mm",
            f"{side} tool    {_numbers(arm.tool_pose[:3])} m in {arm.tool_link}",
            f"{side} reach   {100 * share:.0f} % of the grasps over the table",
        ]
    lines.append(f"speeds       {speeds} rad/s")
    follows = sum(problem is None for problem in problems)
    lines.append(f"plans        follows {follows} of {len(problems)}")
    lines += [f"             {problem}" for problem in dict.fromkeys(problem for problem in problems if problem)]
    return lines


def warning_lines(robot: RobotSpec) -> list[str]:
    """Warnings, one sentence each."""
    urdf = load_urdf(robot.urdf)
    warnings = list(urdf.notes)
    if {urdf.joints[name].velocity for arm in robot.arms for name in arm.joints} == {PLACEHOLDER_SPEED}:
        warnings.append("all joints have a speed limit of 1 rad/s, probably a placeholder: set joint_velocity in robot.yaml")
    for side, arm in zip(("left", "right"), robot.arms, strict=True):
        if opening(arm) < SMALL_OPENING:
            warnings.append(f"the {side} hand opens {1000 * opening(arm):.0f} mm; tasks have objects of up to 70 mm")
        if (gap := closed_gap(urdf, arm)) > LARGEST_GAP:
            apart = f"closed, the fingers of the {side} hand are {1000 * gap:.0f} mm apart"
            warnings.append(f"{apart}: thinner objects cannot be held")
        warnings += [
            f"no link that {name} moves has a collision shape: the {side} hand cannot hold objects"
            for name in arm.fingers
            if not any(link.collisions for link in urdf.moved_links(name))
        ]
    for name, pose in pose_links(urdf).items():
        if (visual := urdf.links[name].visual) is not None:
            center = pose[:3, :3] @ visual.vertices.mean(0) + pose[:3, 3]
            if (away := float(np.linalg.norm(center))) > FAR_LINK:
                warnings.append(f"link {name} is {away:.1f} m away from the root: check its joint's origin and its mesh")
    return list(dict.fromkeys(warnings))


def closed_gap(urdf: Urdf, arm: Arm) -> float:
    """Distance of the closed fingertips along their opening axis [m], negative if they overlap."""
    poses = pose_links(urdf, dict(zip(arm.fingers, arm.finger_closed, strict=True)))
    tool = poses[arm.tool_link] @ matrix_from_pose(arm.tool_pose)
    clouds = [moved_points(urdf, name, poses, tool) for name in arm.fingers]
    sides = [points[points[:, 0] > -TIP, 1] for points in clouds]
    first, second = sorted(sides, key=np.mean) if all(map(len, sides)) else ([0.0], [0.0])
    return float(np.min(second) - np.max(first))


def opening(arm: Arm) -> float:
    """Total travel of the fingers from closed to open [m]."""
    return float(np.abs(np.subtract(arm.finger_open, arm.finger_closed)).sum())


def commented_yaml(robot: RobotSpec, draft: RobotDraft, urdf: str) -> str:
    """A complete robot.yaml that marks each entry as given in the draft or found; `urdf` is the URDF's relative path."""
    lines = [f"urdf: {_plain(urdf)}", _entry("title", robot.title, draft.title), "arms:"]
    for arm, given in zip(robot.arms, fill_right_arm(draft.arms), strict=True):
        entries = [_entry(name, value, _given(given, name)) for name, value in asdict(arm).items()]
        lines += [f"{'  ' if number else '- '}{entry}" for number, entry in enumerate(entries)]
    for name in ("joint_lower", "joint_upper", "joint_velocity", "joint_acceleration"):
        lines.append(_entry(name, getattr(robot, name), getattr(draft, name)))
    return HEAD + "\n".join(lines) + "\n"


def _given(draft: ArmDraft, name: str) -> object:
    known = {field.name for field in fields(draft)}
    return None if name not in known or (name == "tool_pose" and draft.tool_at_tips) else getattr(draft, name)


def _entry(name: str, value: object, given: object) -> str:
    return f"{name}: {_plain(value)}  # {'found' if given is None else 'given'}; {FOUND[name]}"


def _plain(value: object) -> str:
    """A value as YAML on one line."""
    value = list(value) if isinstance(value, tuple) else value
    return yaml.safe_dump(value, default_flow_style=True, width=100_000).removesuffix("...\n").strip()


def _numbers(values: Sequence[float]) -> str:
    return ", ".join(f"{round(value, 3) + 0.0:g}" for value in values)
