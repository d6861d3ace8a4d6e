"""The robots' URDFs against the published chains, their grippers, homes and shapes, and a user's own URDF."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from xew.config import ConfigError
from xew.sim_warp.geometry.camera import HEAD_CAMERA, project
from xew.sim_warp.geometry.poses import matrix_from_pose
from xew.sim_warp.kinematics.forward import joint_positions, link_matrices, link_poses, tool_pose
from xew.sim_warp.robots import ROBOTS, RobotSpec, UrdfError, get_robot, load_urdf

CHAINS = json.loads((Path(__file__).parents[1] / "data" / "chains.json").read_text())["robots"]
LINK_COUNTS = {"aloha_agilex": 54, "arx_x5": 11, "ur5_wsg": 18, "franka_panda": 14, "piper": 11}
WORK_FRONT = -0.30
"""Objects lie beyond this y, with room to spare [m]."""
robots = pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)


def home_row(robot: RobotSpec, gripper: float) -> np.ndarray:
    row = np.zeros((1, 16))
    for start, arm in zip((0, 8), robot.arms, strict=True):
        row[0, start : start + len(arm.home)] = arm.home
        row[0, start + 7] = gripper
    return row


def collision_points(robot: RobotSpec, row: np.ndarray, arm: int) -> np.ndarray:
    """World points [k 3] of all collision corners that one arm moves."""
    urdf, poses = load_urdf(robot.urdf), link_poses(robot, row)
    frames = poses[min(arm, len(poses) - 1)]
    base = robot.arms[arm].joints[0]
    moved = [name for name, link in urdf.links.items() if link.collisions and base in [j.name for j in urdf.chain(name)]]
    points = []
    for name in moved:
        matrix = matrix_from_pose(frames[name])[0]
        points += [shape.points @ matrix[:3, :3].T + matrix[:3, 3] for shape in urdf.links[name].collisions]
    return np.concatenate(points)


def pads(robot: RobotSpec, arm: int, gripper: float) -> list[np.ndarray]:
    """Corners [8 3] of both gripping faces in the tool frame."""
    side, urdf = robot.arms[arm], load_urdf(robot.urdf)
    (joint_pos, *others) = joint_positions(robot, home_row(robot, gripper))
    frames = link_matrices(urdf, others[0] if arm and others else joint_pos)
    tool = frames[side.tool_link][0] @ matrix_from_pose(side.tool_pose)
    found = []
    for name, link in urdf.links.items():
        if set(side.fingers) & {joint.name for joint in urdf.chain(name)}:
            relative = np.linalg.inv(tool) @ frames[name][0]
            found += [s.points @ relative[:3, :3].T + relative[:3, 3] for s in link.collisions if s.name == "pad"]
    return found


@robots
def test_tree_is_that_of_the_reference(robot: RobotSpec) -> None:
    urdf, chain = load_urdf(robot.urdf), CHAINS[robot.key]
    assert len(urdf.links) == LINK_COUNTS[robot.key] == chain["links"]
    assert urdf.root == chain["root"]
    rows = {row[0]: row for row in chain["joints"]}
    assert list(rows) == list(urdf.joints)
    for name, joint in urdf.joints.items():
        kind, parent, child = rows[name][1:4]
        assert (joint.kind, joint.parent, joint.child) == (kind, parent, child)
        for value, expected in zip((joint.lower, joint.upper), rows[name][13:15], strict=True):
            assert expected is None or value == pytest.approx(expected, abs=1e-8)
        for value, expected in zip((joint.velocity, joint.effort), rows[name][15:17], strict=True):
            assert value == (np.inf if expected is None else pytest.approx(expected))


@robots
def test_masses_are_those_of_the_reference(robot: RobotSpec) -> None:
    urdf = load_urdf(robot.urdf)
    masses = {name: link.inertial.mass for name, link in urdf.links.items() if link.inertial}
    assert masses == pytest.approx(CHAINS[robot.key]["mass"], rel=1e-6)
    for name, link in urdf.links.items():
        if link.inertial:
            moments = np.linalg.eigvalsh(link.inertial.inertia)
            assert moments.min() > 0, name
            assert np.allclose(link.inertial.inertia, link.inertial.inertia.T)


@robots
def test_links_that_move_have_mass(robot: RobotSpec) -> None:
    """A joint needs inertia below it, at the latest in what is fixed to its child."""
    urdf = load_urdf(robot.urdf)
    for joint in urdf.joints.values():
        if joint.kind != "fixed":
            fixed_below = [name for name in urdf.links if joint in urdf.chain(name)]
            assert any(urdf.links[name].inertial for name in fixed_below), joint.name


@robots
def test_limits_that_experts_keep(robot: RobotSpec) -> None:
    urdf, chain = load_urdf(robot.urdf), CHAINS[robot.key]
    for arm in robot.arms:
        joints = [urdf.joints[name] for name in arm.joints]
        for joint, low, high, speed, home in zip(
            joints, robot.joint_lower, robot.joint_upper, robot.joint_velocity, arm.home, strict=True
        ):
            assert joint.lower - 1e-9 <= low < high <= joint.upper + 1e-9
            assert low < home < high
            assert 0 < speed <= joint.velocity
    assert (np.array(robot.joint_lower) >= np.array(chain["real_lower"]) - 1e-9).all()
    assert (np.array(robot.joint_upper) <= np.array(chain["real_upper"]) + 1e-9).all()
    assert (np.array(robot.joint_velocity) <= np.array(chain["real_velocity"]) + 1e-9).all()


@robots
@pytest.mark.parametrize("arm", (0, 1))
def test_pads_meet_at_the_tool_frame(robot: RobotSpec, arm: int) -> None:
    closed = sorted(pads(robot, arm, 0), key=lambda corners: corners[:, 1].mean())
    assert len(closed) == 2
    assert closed[0][:, 1].max() == pytest.approx(0, abs=2e-5)
    assert closed[1][:, 1].min() == pytest.approx(0, abs=2e-5)
    for corners in closed:
        assert corners[:, 0].min() == pytest.approx(-0.020, abs=2e-4)
        assert corners[:, 0].max() == pytest.approx(0.015, abs=2e-4)
        assert corners[:, 2].min() == pytest.approx(-0.011, abs=2e-4)
        assert corners[:, 2].max() == pytest.approx(0.011, abs=2e-4)


@robots
@pytest.mark.parametrize("arm", (0, 1))
def test_gripper_opens(robot: RobotSpec, arm: int) -> None:
    opened = sorted(pads(robot, arm, 1), key=lambda corners: corners[:, 1].mean())
    left, right = opened[0][:, 1].max(), opened[1][:, 1].min()
    assert right - left >= 0.08 - 1e-6
    assert left == pytest.approx(-right, abs=1e-4)
    half = sorted(pads(robot, arm, 0.5), key=lambda corners: corners[:, 1].mean())
    assert half[1][:, 1].min() == pytest.approx(right / 2, abs=2e-5)


@robots
def test_collision_shapes(robot: RobotSpec) -> None:
    """One or two convex shapes a link, boxes or small hulls, only where the arms move; each near the visual surface."""
    urdf = load_urdf(robot.urdf)
    arm_joints = {arm.joints[0] for arm in robot.arms}
    for name, link in urdf.links.items():
        assert len(link.collisions) <= 2
        assert all(len(shape.points) <= 32 for shape in link.collisions)
        if link.collisions:
            assert arm_joints & {joint.name for joint in urdf.chain(name)}, name
            assert link.visual is not None
            corners = np.concatenate([shape.points for shape in link.collisions])
            assert np.abs(corners.min(0) - link.visual.vertices.min(0)).max() < 0.03, name
            assert np.abs(corners.max(0) - link.visual.vertices.max(0)).max() < 0.03, name


@robots
def test_shapes_are_light_enough_to_render(robot: RobotSpec) -> None:
    urdf = load_urdf(robot.urdf)
    count = sum(len(link.visual.triangles) for link in urdf.links.values() if link.visual)
    assert 1000 < count * len(link_poses(robot, home_row(robot, 1))) <= 8000


@robots
def test_home_hovers_over_the_near_table(robot: RobotSpec) -> None:
    row = home_row(robot, 1)
    sides = [collision_points(robot, row, arm) for arm in (0, 1)]
    for arm, points in enumerate(sides):
        side = robot.arms[arm]
        home = tool_pose(robot, arm, np.array([side.home]))[0]
        assert np.allclose(home[:3], [0.34 * arm - 0.17, -0.24, 0.88], atol=1e-3)
        assert (points[points[:, 1] > WORK_FRONT, 2] > 0.85).all(), "clear of what lies on the table"
        assert (points[:, 0] * (1 - 2 * arm) < 0).all(), "on its own side"
        pixel, depth = project(HEAD_CAMERA, home[None, :3])
        assert depth[0] > 0
        assert (pixel > 0).all() and (pixel < [HEAD_CAMERA.width, HEAD_CAMERA.height]).all()


def test_unknown_robots_are_named() -> None:
    with pytest.raises(ConfigError, match="did you mean 'piper'"):
        get_robot("pipper")
    with pytest.raises(ConfigError, match="franka_panda"):
        get_robot("xyz")
    with pytest.raises(ConfigError, match="cannot import"):
        get_robot("no_such_module:SPEC")
    with pytest.raises(ConfigError, match="expected a RobotSpec"):
        get_robot("xew.sim_warp.robots:ROBOTS")
    assert get_robot("xew.sim_warp.robots.piper:SPEC") is ROBOTS["piper"]


OWN = """<?xml version="1.0"?>
<robot name="own">
  <material name="orange"><color rgba="1 0.5 0 1"/></material>
  <link name="base"/>
  <link name="arm">
    <visual>
      <origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/>
      <geometry><mesh filename="{mesh}" scale="0.001 0.001 0.001"/></geometry>
      <material name="orange"/>
    </visual>
    <collision name="block"><geometry><mesh filename="{mesh}" scale="0.001 0.001 0.001"/></geometry></collision>
    <inertial><origin xyz="0 0 0" rpy="1.5707963267948966 0 0"/><mass value="2"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="2" iyz="0" izz="3"/></inertial>
  </link>
  <joint name="turn" type="revolute">
    <parent link="{parent}"/><child link="arm"/><origin xyz="0 0 0.5"/><axis xyz="0 0 2"/>
    <limit lower="-1" upper="1" velocity="2" effort="3"/>
  </joint>
</robot>
"""


def write_own(folder: Path, mesh: str = "meshes/block.stl", parent: str = "base") -> Path:
    (folder / "own_description" / "meshes").mkdir(parents=True, exist_ok=True)
    trimesh.creation.box((100, 200, 300)).export(folder / "own_description" / "meshes" / "block.stl")
    path = folder / "own_description" / "own.urdf"
    path.write_text(OWN.format(mesh=mesh, parent=parent))
    return path


@pytest.mark.parametrize("mesh", ("meshes/block.stl", "package://own_description/meshes/block.stl"))
def test_users_own_urdf_loads(tmp_path: Path, mesh: str) -> None:
    urdf = load_urdf(write_own(tmp_path, mesh))
    assert urdf.root == "base" and urdf.joint_names == ("turn",)
    link, joint = urdf.links["arm"], urdf.joints["turn"]
    assert link.visual is not None and link.inertial is not None
    assert np.ptp(link.visual.vertices, 0) == pytest.approx([0.2, 0.1, 0.3], abs=1e-6)
    assert link.visual.vertices[:, 2].mean() == pytest.approx(1, abs=1e-6)
    assert (link.visual.colors == [255, 128, 0]).all()
    assert np.ptp(link.collisions[0].points, 0) == pytest.approx([0.1, 0.2, 0.3], abs=1e-6)
    assert link.collisions[0].name == "block"
    assert np.diag(link.inertial.inertia) == pytest.approx([1, 3, 2])
    assert joint.axis == pytest.approx([0, 0, 1])
    assert (joint.lower, joint.upper, joint.velocity, joint.effort) == (-1, 1, 2, 3)


def test_a_changed_urdf_is_read_again(tmp_path: Path) -> None:
    path = write_own(tmp_path)
    first = load_urdf(path)
    assert load_urdf(path) is first
    path.write_text(path.read_text().replace('name="own"', 'name="other"'))
    assert load_urdf(path).name == "other"


def test_errors_of_urdfs_speak(tmp_path: Path) -> None:
    with pytest.raises(UrdfError, match=r"nothing\.urdf does not exist"):
        load_urdf(tmp_path / "nothing.urdf")
    with pytest.raises(UrdfError, match=r"link arm names the mesh meshes/none\.stl, which does not exist"):
        load_urdf(write_own(tmp_path / "a", mesh="meshes/none.stl"))
    with pytest.raises(UrdfError, match="joints name links that do not exist: nobody"):
        load_urdf(write_own(tmp_path / "b", parent="nobody"))
    with pytest.raises(UrdfError, match="must form one tree; no way leads from base to arm"):
        load_urdf(write_own(tmp_path / "c", parent="arm"))
    broken = write_own(tmp_path / "d")
    broken.write_text("<robot><link")
    with pytest.raises(UrdfError, match="not a URDF that can be read"):
        load_urdf(broken)
    damaged = write_own(tmp_path / "e")
    (damaged.parent / "meshes" / "block.stl").write_bytes(b"not a mesh")
    with pytest.raises(UrdfError, match=r"link arm: .*block\.stl"):
        load_urdf(damaged)
