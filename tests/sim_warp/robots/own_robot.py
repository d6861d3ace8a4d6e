"""A robot of a user's own on disk: a small six-joint arm with a two-finger hand, as a URDF with meshes and a texture, and as
a RoboTwin embodiment folder. Its links are as long as those of the ARX X5; it looks like nothing in the project."""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml
from PIL import Image

STRIPES = ((210, 40, 30), (30, 60, 200))
"""Colors of the texture: left half, right half."""

JOINTS = (
    ("0 0 0.06", "0 0 0", "0 0 1", -3.1, 2.6),
    ("0.02 0 0.04", "0 0 0", "0 1 0", -0.05, 3.5),
    ("-0.264 0 0", "3.14159265 0 0", "0 1 0", -0.1, 3.2),
    ("0.245 0 -0.056", "0 0 0", "0 1 0", -1.6, 1.55),
    ("0.068 0 -0.0865", "0 0 0", "0 0 1", -1.57, 1.57),
    ("0.029 0 0.0865", "-3.14159265 0 0", "1 0 0", -2.0, 2.0),
)
"""origin xyz, rpy, axis, lower, upper of arm1 to arm6."""
BOXES = ((0.08, 0.08, 0.1), (0.26, 0.04, 0.04), (0.25, 0.04, 0.04), (0.06, 0.05, 0.05), (0.04, 0.04, 0.06), (0.06, 0.12, 0.05))
CENTERS = ("0 0 0", "-0.13 0 0", "0.12 0 -0.03", "0.03 0 -0.03", "0 0 0.03", "0.05 0 0")


def urdf(changes: dict[str, str] | None = None) -> str:
    """The text of the URDF, with pieces of it replaced."""
    links = [_link("base", "box.stl", "0.1 0.1 0.05", "0 0 0")]
    joints = []
    for number, ((xyz, rpy, axis, lower, upper), size, center) in enumerate(zip(JOINTS, BOXES, CENTERS, strict=True), 1):
        mesh = "skin.obj" if number == 3 else "box.stl"
        links.append(_link(f"link{number}", mesh, " ".join(map(str, size)), center))
        parent = "base" if number == 1 else f"link{number - 1}"
        joints.append(_joint(f"arm{number}", "revolute", parent, f"link{number}", xyz, rpy, axis, lower, upper))
    for name, side in (("a", 1), ("b", -1)):
        links.append(_link(f"finger_{name}", "box.stl", "0.08 0.012 0.024", f"0.025 {0.006 * side} 0"))
        joints.append(
            _joint(f"grip_{name}", "prismatic", "link6", f"finger_{name}", "0.08 0 0", "0 0 0", f"0 {side} 0", 0.0, 0.04)
        )
    text = "\n".join(['<?xml version="1.0"?>', '<robot name="small">', *links, *joints, "</robot>"])
    for old, new in (changes or {}).items():
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


def _link(name: str, mesh: str, scale: str, center: str) -> str:
    geometry = f'<origin xyz="{center}"/><geometry><mesh filename="meshes/{mesh}" scale="{scale}"/></geometry>'
    material = "" if mesh.endswith(".obj") else '<material name="gray"><color rgba="0.6 0.6 0.65 1"/></material>'
    inertia = '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/>'
    return (
        f'<link name="{name}"><inertial><mass value="0.3"/>{inertia}</inertial>'
        f"<visual>{geometry}{material}</visual><collision>{geometry}</collision></link>"
    )


def _joint(name: str, kind: str, parent: str, child: str, xyz: str, rpy: str, axis: str, lower: float, upper: float) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/>'
        f'<axis xyz="{axis}"/><limit lower="{lower}" upper="{upper}" velocity="4" effort="50"/></joint>'
    )


def write_urdf(folder: Path, changes: dict[str, str] | None = None) -> Path:
    """The URDF with its meshes: unit boxes, one of them with a texture of two stripes in a folder of its own."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    (folder / "textures").mkdir(exist_ok=True)
    trimesh.creation.box((1, 1, 1)).export(folder / "meshes" / "box.stl")
    texture = np.zeros((8, 8, 3), np.uint8)
    texture[:, :4], texture[:, 4:] = STRIPES
    Image.fromarray(texture).save(folder / "textures" / "skin.png")
    (folder / "meshes" / "skin.mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd ../textures/skin.png\n")
    (folder / "meshes" / "skin.obj").write_text(_textured_box())
    path = folder / "small.urdf"
    path.write_text(urdf(changes))
    return path


def _textured_box() -> str:
    """A unit box whose lower half (z < 0) wears the left stripe and whose upper half the right one."""
    lines = ["mtllib skin.mtl", "usemtl skin", "vt 0.25 0.5", "vt 0.75 0.5"]
    first = 1
    for coordinate, center in ((1, -0.25), (2, 0.25)):
        box = trimesh.creation.box((1, 1, 0.5))
        lines += [f"v {x} {y} {z + center}" for x, y, z in box.vertices]
        lines += ["f " + " ".join(f"{first + int(corner)}/{coordinate}" for corner in face) for face in box.faces]
        first += len(box.vertices)
    return "\n".join(lines) + "\n"


def robotwin_config() -> dict[str, Any]:
    """A config.yml as RoboTwin has it."""
    return {
        "urdf_path": "./small.urdf",
        "srdf_path": "./small.srdf",
        "joint_stiffness": 1000,
        "joint_damping": 200,
        "move_group": ["link6", "link6"],
        "ee_joints": ["arm6", "arm6"],
        "arm_joints_name": [[f"arm{number}" for number in range(1, 7)]] * 2,
        "gripper_name": [{"base": "grip_a", "mimic": [["grip_b", 1.0, 0.0]]}] * 2,
        "gripper_bias": 0.12,
        "gripper_scale": [-0.01, 0.045],
        "homestate": [[0, 0.9, 0.8, -1.0, 0, 0]] * 2,
        "delta_matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "global_trans_matrix": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
        "robot_pose": [[0, -0.35, 0.784, 0.707, 0, 0, 0.707]],
        "planner": "curobo",
        "dual_arm": False,
        "rotate_lim": [0, 1],
        "grasp_perfect_direction": ["front_right", "front_left"],
        "static_camera_list": [{"name": "head_camera", "type": "D435"}],
    }


def write_embodiment(folder: Path, **changes: Any) -> Path:
    """A RoboTwin embodiment folder; a change to None removes a key."""
    write_urdf(folder)
    config = robotwin_config() | changes
    (folder / "config.yml").write_text(yaml.safe_dump({key: value for key, value in config.items() if value is not None}))
    return folder
