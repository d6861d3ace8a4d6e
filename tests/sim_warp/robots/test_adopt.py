"""Unknown robots made plain: linked fingers, hands by name, mirrored arms, packages, xacro; and what is said of them."""

import re
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from tests.sim_warp.robots.own_robot import urdf as urdf_text
from tests.sim_warp.robots.own_robot import write_urdf
from xew.config import ConfigError
from xew.sim_warp.embodiment.urdf import Urdf
from xew.sim_warp.kinematics.inverse import ArmSolver
from xew.sim_warp.robots import ROBOTS, adopt, load_robot, load_urdf
from xew.sim_warp.robots.adopt import Args
from xew.sim_warp.robots.user.draft import RobotDraft
from xew.sim_warp.robots.user.hands import graft_hand, slide_fingers
from xew.sim_warp.robots.user.infer import complete_arms
from xew.sim_warp.robots.user.own import complete_draft
from xew.sim_warp.robots.user.plain import read_description, unfold_mirrored
from xew.sim_warp.robots.user.summary import warning_lines

ROOT = [-0.2, -0.45, 0.75, 0, 0, 0.5**0.5, 0.5**0.5]
HOMES = ([-0.226, 0.8734, 0.7467, -0.9316, -0.1123, -0.1965], [0.2259, 0.8731, 0.7466, -0.9316, 0.1122, 0.1965])
"""A place and homes of the small arm, so that nothing is searched for."""
BAR, WAY = 0.05, 0.8
"""Length of the bars that carry the linked fingers [m], and the angle by which they turn [rad]."""


@pytest.fixture(autouse=True)
def nothing_slow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plans and reach are measured elsewhere."""
    monkeypatch.setattr(adopt, "check_plans", lambda robot: SimpleNamespace(problems=(None, "left joint 1 would turn")))
    monkeypatch.setattr(adopt, "work_reach", lambda robot, arm: np.array([1.0, 0.5]))


def placed_robot(folder: Path, urdf: str, **content: Any) -> Path:
    """A folder whose robot.yaml says where the robot stands."""
    right = [-ROOT[0], *ROOT[1:]]
    arms = [{"root_pose": ROOT, "home": HOMES[0]}, {"root_pose": right, "home": HOMES[1]}]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.yaml").write_text(yaml.safe_dump({"urdf": urdf, "arms": arms} | content))
    return folder


def linked_hand(gap: float = 0.0) -> str:
    """The small arm with fingers on two bars each that keep them parallel, all driven by one joint (as a Robotiq 2F-85's).

    `gap` is left between them when they are closed [m].
    """
    text = re.sub(r'<joint name="grip_[ab]".*?</joint>', "", urdf_text(), flags=re.DOTALL)
    pieces = []
    for name, side in (("a", 1), ("b", -1)):
        for bar, x in (("outer", 0.05), ("inner", 0.03)):
            drives = name == "a" and bar == "outer"
            mimic = "" if drives else f'<mimic joint="outer_a" multiplier="{side}"/>'
            pieces.append(f'<link name="{bar}_{name}"/><joint name="{bar}_{name}" type="revolute"><parent link="link6"/>')
            pieces.append(f'<child link="{bar}_{name}"/><origin xyz="{x} {gap / 2 * side} 0"/><axis xyz="0 0 1"/>{mimic}')
            pieces.append(f'<limit lower="0" upper="{WAY}" velocity="1" effort="1"/></joint>')
        pieces.append(f'<joint name="tip_{name}" type="revolute"><parent link="outer_{name}"/><child link="finger_{name}"/>')
        pieces.append(f'<origin xyz="{BAR} 0 0"/><axis xyz="0 0 1"/><mimic joint="outer_a" multiplier="{-side}"/>')
        pieces.append('<limit lower="-3" upper="3" velocity="1" effort="1"/></joint>')
    return text.replace("</robot>", "".join(pieces) + "</robot>")


def write_text(folder: Path, text: str, name: str = "small.urdf") -> Path:
    path = write_urdf(folder).with_name(name)
    path.write_text(text)
    return path


def changed(path: Path, tree: ElementTree.Element) -> Urdf:
    ElementTree.ElementTree(tree).write(path.with_name("changed.urdf"))
    return load_urdf(path.with_name("changed.urdf"))


# --- Hands.


def test_linked_fingers_become_a_gripper_of_one_number(tmp_path: Path) -> None:
    path = write_text(tmp_path, linked_hand())
    tree = ElementTree.parse(path).getroot()
    with pytest.raises(ConfigError, match=r"xew\.sim_warp\.robots\.adopt small\.urdf"):
        load_robot(path)
    (told,) = slide_fingers(tree, load_urdf(path))
    stroke = BAR * np.sin(WAY)
    assert told.startswith(
        f"the hand on link6, driven by outer_a, is replaced by two fingers that slide {1000 * stroke:.0f} mm"
    )
    assert "turn by 0 deg" in told
    urdf = changed(path, tree)
    arm, _ = complete_arms(RobotDraft("changed.urdf"), urdf, "here")
    assert arm.joints == tuple(f"arm{number}" for number in range(1, 7)) and arm.tool_link == "link6"
    assert arm.finger_closed == (0, 0) and arm.finger_open == pytest.approx((stroke, stroke), abs=2e-4)
    tips = 0.05 + BAR + 0.025 + 0.04
    assert arm.tool_pose == pytest.approx((tips - 0.015, 0, 0, 0, 0, 0, 1), abs=1e-4), "as far out as the closed fingers are"
    assert {joint.kind for name, joint in urdf.joints.items() if name.startswith(("outer", "inner", "tip"))} == {"fixed"}


def test_fingers_that_do_not_meet_are_told(tmp_path: Path) -> None:
    source = placed_robot(tmp_path / "in", "small.urdf")
    write_text(source, linked_hand(0.012))
    folder = adopt.adopt(Args(source, tmp_path / "out"))
    assert "closed, the fingers of the left hand are 12 mm apart: thinner objects cannot be held" in warning_lines(
        load_robot(folder)
    )


def test_a_jaw_that_moves_alone_is_told(tmp_path: Path) -> None:
    text = re.sub(r'<joint name="grip_b" type="prismatic"', '<joint name="grip_b" type="fixed"', urdf_text())
    mimic = '<link name="pin"/><joint name="pin" type="revolute"><parent link="finger_a"/><child link="pin"/>'
    text = text.replace("</robot>", f'{mimic}<axis xyz="0 0 1"/><mimic joint="grip_a"/></joint></robot>')
    path = write_text(tmp_path, text)
    with pytest.raises(ConfigError, match=r"only one finger of the hand on link6 moves \(grip_a\).*--hand ur5_wsg"):
        slide_fingers(ElementTree.parse(path).getroot(), load_urdf(path))


@pytest.mark.parametrize("hand", ["ur5_wsg", "franka_panda", "piper"])
def test_an_arm_takes_a_hand_by_name(hand: str, tmp_path: Path) -> None:
    """A bare arm or one with another hand: what moves beyond its last joint goes, and ours points along the joint's axis."""
    path = write_text(tmp_path, linked_hand())
    tree = ElementTree.parse(path).getroot()
    told = graft_hand(tree, load_urdf(path), ROBOTS[hand])
    assert told.startswith(f"the hand of {ROBOTS[hand].title} is mounted on link6, pointing along 1 0 0")
    urdf = changed(path, tree)
    assert not {"finger_a", "outer_a"} & set(urdf.links)
    arm, _ = complete_arms(RobotDraft("changed.urdf"), urdf, "here")
    assert all(name.startswith("hand_") for name in arm.fingers) and len(arm.joints) == 6
    theirs = load_urdf(ROBOTS[hand].urdf)
    slides = [theirs.joints[name.removeprefix("hand_")] for name in arm.fingers]
    ways = [slide.upper - slide.lower for slide in slides]
    assert np.abs(np.subtract(arm.finger_open, arm.finger_closed)).tolist() == pytest.approx(ways)
    for name in arm.fingers:
        moved = [link for link in urdf.links.values() if urdf.joints[name] in urdf.chain(link.name)]
        assert [shape.name for link in moved for shape in link.collisions].count("pad") == 1


def test_a_single_jaw_gives_way_to_a_hand(tmp_path: Path) -> None:
    """A jaw that turns beyond six joints in a row (as Unitree Z1's) is no seventh joint of the arm if its user says so."""
    text = re.sub(r'<joint name="grip_b" type="prismatic"', '<joint name="grip_b" type="fixed"', urdf_text())
    path = write_text(tmp_path, re.sub(r'<joint name="grip_a" type="prismatic"', '<joint name="grip_a" type="revolute"', text))
    tree = ElementTree.parse(path).getroot()
    graft_hand(tree, load_urdf(path), ROBOTS["franka_panda"], "arm6")
    urdf = changed(path, tree)
    assert "finger_a" not in urdf.links and len(complete_arms(RobotDraft("changed.urdf"), urdf, "here")[0].joints) == 6
    with pytest.raises(ConfigError, match="has no joint arm9; it has arm1"):
        graft_hand(ElementTree.parse(path).getroot(), load_urdf(path), ROBOTS["franka_panda"], "arm9")


def test_a_hand_that_is_not_ours_is_told(tmp_path: Path) -> None:
    path = write_urdf(tmp_path)
    with pytest.raises(ConfigError, match="--hand claw: there is no such robot; expected one of aloha_agilex"):
        adopt.adopt(Args(path, tmp_path / "out", hand="claw"))


# --- Two arms that mirror each other.


def mirrored_arms() -> str:
    """Two of the small arms on one base; the right one's joints about x and z count the other way."""
    left = urdf_text()
    body = left[left.index('<link name="link1">') : left.index("</robot>")]
    right = re.sub(r'(name|link)="(link\d|finger_[ab]|arm\d|grip_[ab])"', r'\1="right_\2"', body)

    def mirror(joint: re.Match[str]) -> str:
        text = joint[0]
        if 'axis xyz="0 0 1"' in text or 'axis xyz="1 0 0"' in text:
            low, high = (float(re.search(f'{name}="([^"]+)"', text)[1]) for name in ("lower", "upper"))  # type: ignore[index]
            text = re.sub(r'lower="[^"]+" upper="[^"]+"', f'lower="{-high}" upper="{-low}"', text)
        return text

    right = re.sub(r"<joint .*?</joint>", mirror, right, flags=re.DOTALL)
    right = right.replace('<origin xyz="0 0 0.06"', '<origin xyz="0 -0.4 0.06"', 1)
    return left.replace("</robot>", right + "</robot>")


def test_arms_that_mirror_each_other_get_the_same_limits(tmp_path: Path) -> None:
    path = write_text(tmp_path, mirrored_arms())
    tree, urdf = ElementTree.parse(path).getroot(), load_urdf(path)
    left, right = complete_arms(RobotDraft("small.urdf"), urdf, "here")
    assert left.joints[0] == "arm1" and right.joints[0] == "right_arm1"
    turned = unfold_mirrored(tree, list(zip(left.joints, right.joints, strict=True)), urdf)
    assert turned == ["right_arm1"], "the limits of arm5 and arm6 are symmetric"
    after = changed(path, tree)
    for one, two in zip(left.joints, right.joints, strict=True):
        assert (after.joints[one].lower, after.joints[one].upper) == (after.joints[two].lower, after.joints[two].upper)
    assert np.allclose(after.joints["right_arm1"].axis, [0, 0, -1])
    draft = replace(
        RobotDraft("changed.urdf"), arms=(replace(RobotDraft("a").arms[0], root_pose=tuple(ROOT), home=tuple(HOMES[0])),) * 2
    )
    robot = complete_draft(draft, after, "twins", "here")
    assert len(ArmSolver(robot).models) == 2, "axes differ, so each arm has a model"


# --- Files.


def test_a_package_that_lies_elsewhere_is_named(tmp_path: Path) -> None:
    path = write_urdf(tmp_path / "urdf")
    (tmp_path / "urdf" / "meshes").rename(tmp_path / "far")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "far").rename(tmp_path / "elsewhere" / "meshes")
    (tmp_path / "urdf" / "textures").rename(tmp_path / "elsewhere" / "textures")
    path.write_text(path.read_text().replace('filename="meshes/', 'filename="package://my_arm/meshes/'))
    with pytest.raises(ConfigError, match="--package my_arm=DIR"):
        load_urdf(path)
    tree = read_description(path, {"my_arm": tmp_path / "elsewhere"}, {})
    assert {Path(mesh.get("filename", "")).parent for mesh in tree.iter("mesh")} == {tmp_path / "elsewhere" / "meshes"}
    with pytest.raises(ConfigError, match=r"--package other=.*there is no such folder"):
        read_description(path, {"other": tmp_path / "none"}, {})


XACRO = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="x">
<xacro:arg name="n" default="a"/><link name="$(arg n)"/></robot>"""


def test_a_xacro_is_expanded_with_its_arguments(tmp_path: Path) -> None:
    pytest.importorskip("xacrodoc")
    (tmp_path / "arm.urdf.xacro").write_text(XACRO)
    tree = read_description(tmp_path / "arm.urdf.xacro", {}, {"n": "mine"})
    assert [link.get("name") for link in tree.findall("link")] == ["mine"]


def test_a_xacro_says_what_expands_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "arm.urdf.xacro"
    path.write_text(XACRO)
    with pytest.raises(ConfigError, match=r"is a xacro; python -m xew.sim_warp.robots.adopt arm.urdf.xacro expands it"):
        load_robot(path)
    monkeypatch.setitem(sys.modules, "xacrodoc", None)
    with pytest.raises(ConfigError, match=r"arm.urdf.xacro is a xacro and needs xacrodoc: python -m pip install xacrodoc"):
        read_description(path, {}, {})


# --- The command.


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def test_a_robot_is_worked_out_once(
    cache: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Printed, and kept in a folder that needs neither a search nor the files that it came from."""
    source = placed_robot(tmp_path / "lab" / "arm", "small.urdf")
    write_text(source, linked_hand())
    flags = [str(source), "--out", str(tmp_path / "robots")]
    monkeypatch.setattr(sys, "argv", ["adopt", *flags])
    adopt.main()
    printed = capsys.readouterr().out
    for told in (
        "left base    -0.2, -0.45, 0.75 m",
        "left hand    link6_slide_1a_joint and link6_slide_1b_joint on link6, opens 72 mm",
        "right reach   75 % of the grasps over the table",
        "speeds       4, 4, 4, 4, 4, 4 rad/s",
        "plans        follows 1 of 2\n             left joint 1 would turn",
        "note: the hand on link6, driven by outer_a",
    ):
        assert told in printed, told
    adopt.main()  # again: what it wrote is replaced
    folder = (tmp_path / "lab" / "arm").rename(tmp_path / "gone") and tmp_path / "robots" / "arm"
    monkeypatch.setattr("xew.sim_warp.robots.user.own._find_place", lambda *_: pytest.fail("a place is searched for"))
    robot = load_robot(folder)
    assert robot.key == "arm" and robot.arms[1].home == tuple(HOMES[1])
    text = (folder / "robot.yaml").read_text()
    assert re.search(r"root_pose: .*# given; ", text) and re.search(r"tool_pose: .*# found; in tool_link: x out of", text)
    assert all(file.is_relative_to(folder.resolve()) for file in load_urdf(robot.urdf).files)


def test_what_looks_wrong_is_told(tmp_path: Path) -> None:
    """Speeds of 1 rad/s throughout, a hand that opens little, a link far away, no collision shapes."""
    text = urdf_text().replace('velocity="4"', 'velocity="1"').replace('upper="0.04"', 'upper="0.01"')
    text = re.sub(r"<collision>.*?</collision>", "", text, flags=re.DOTALL)
    text = text.replace(
        "</robot>", '<link name="lamp"><visual><geometry><sphere radius="0.1"/></geometry></visual></link></robot>'
    )
    text = text.replace(
        "</robot>", '<joint name="lamp" type="fixed"><parent link="base"/><child link="lamp"/>@</joint></robot>'
    )
    folder = placed_robot(tmp_path, "small.urdf")
    write_text(folder, text.replace("@", '<origin xyz="4 0 0"/><axis xyz="0 0 0"/>'))
    told = "\n".join(warning_lines(load_robot(folder)))
    for words in (
        "it has no collision shapes: the convex hulls of its visuals collide instead",
        "all joints have a speed limit of 1 rad/s, probably a placeholder",
        "the left hand opens 20 mm; tasks have objects of up to 70 mm",
        "link lamp is 4.0 m away from the root",
    ):
        assert words in told, words
