"""Worlds to simulate, their motions, and the template's coordinates, shared by both physics engines."""

import warnings
from dataclasses import dataclass

import numpy as np

from xew.protocol import ARMS, FRAME_RATE
from xew.sim_warp.devices.newton import newton
from xew.sim_warp.physics.template import ARM_JOINTS, FREE_SLOTS, PARKED, add_world, new_builder
from xew.sim_warp.robots import RobotSpec
from xew.sim_warp.scene import Scene

TIME_STEP = 0.004
"""Length of a physics step [s]."""
STEPS_PER_FRAME = 15
"""Number of physics steps between stored frames."""
SOLVER_OPTIONS = {
    "cone": "elliptic",
    "impratio": 5.0,
    "iterations": 30,
    "ls_iterations": 20,
    "enable_multiccd": True,
    "integrator": "implicitfast",
    "kinematic_switchable_roots": False,
}
JOINTS_PER_SIDE = ARM_JOINTS + 2
ROBOT_DOFS = 2 * JOINTS_PER_SIDE
FREE_START = ROBOT_DOFS
HINGE_INDEX = FREE_START + 7 * FREE_SLOTS
"""First indices of the free bodies (xyz and quaternion wxyz) and of the lid in the template's joint coordinates, after the arms
with their fingers."""


@dataclass(frozen=True)
class World:
    """One cell to simulate."""

    robot: RobotSpec
    scene: Scene
    action: np.ndarray
    """[t 16] canonical commands at every stored frame [rad; grippers 0 closed, 1 open]; the robot starts at the first."""


@dataclass(frozen=True)
class Motion:
    """Simulated motion of a world at every stored frame."""

    joint_pos: np.ndarray
    """[t 16] float32 measured positions, canonical layout [rad; grippers 0 closed, 1 open]."""
    joint_vel: np.ndarray
    """[t 16] float32 measured velocities [rad/s; grippers 1/s]."""
    object_pose: np.ndarray
    """[t o 7] float32 xyz [m] and quaternion xyzw, world."""
    object_joint: np.ndarray
    """[t o] float32 hinge angles [rad], 0 without a hinge."""
    contact: np.ndarray
    """[t 2 o] bool, whether fingers of the left, right arm touch each object."""
    penetration: np.ndarray
    """[t o] float32 penetration of each object [m]."""
    table_overlap: float
    """Largest penetration of an arm and the table [m]."""
    arm_overlap: float
    """Largest penetration of the arms [m]."""
    overflow: bool
    """Whether a contact or constraint buffer was too small, or a number not finite; the motion is then invalid."""


def finger_strokes(robot: RobotSpec, side: int) -> np.ndarray:
    """[2] float64 travel of each finger of an arm from gripper 0 to 1 [m]."""
    return np.abs(np.subtract(robot.arms[side].finger_open, robot.arms[side].finger_closed))


def template_joints(robot: RobotSpec, action: np.ndarray) -> np.ndarray:
    """Canonical joints [t 16] rad, grippers 0 to 1 -> the template's [t 18]: seven arm joints [rad], two fingers [m] a side."""
    sides = [
        np.concatenate([action[:, arm], action[:, gripper, None] * finger_strokes(robot, side)], axis=-1)
        for side, (arm, gripper) in enumerate(ARMS)
    ]
    return np.concatenate(sides, axis=-1)


def canonical_joints(robot: RobotSpec, joints: np.ndarray) -> np.ndarray:
    """The template's robot joints [t 18] rad and m, or their velocities -> canonical [t 16] float32."""
    result = np.zeros((len(joints), 16), np.float32)
    for side, (arm, gripper) in enumerate(ARMS):
        start = side * JOINTS_PER_SIDE
        result[:, arm] = joints[:, start : start + ARM_JOINTS]
        fingers = joints[:, start + ARM_JOINTS : start + JOINTS_PER_SIDE]
        result[:, gripper] = (fingers / finger_strokes(robot, side)).mean(-1)
        result[:, arm.start + robot.arm_joint_count : arm.stop] = 0.0
    return result


def control_targets(robot: RobotSpec, action: np.ndarray) -> np.ndarray:
    """[t-1 15 36] float64 actuator targets of every step: position [rad, m] and velocity [rad/s, m/s] of each robot joint.

    The commands [t 16] are linear between stored frames; their slope is fed forward as the velocity.
    """
    joints = template_joints(robot, action)
    share = (np.arange(STEPS_PER_FRAME) + 1) / STEPS_PER_FRAME
    step = np.diff(joints, axis=0)[:, None]
    position = joints[:-1, None] + share[:, None] * step
    velocity = np.broadcast_to(step * FRAME_RATE, position.shape)
    return np.stack([position, velocity], axis=-1).reshape(*position.shape[:2], 2 * ROBOT_DOFS)


def build_solver(worlds: list[World], device: str, **options: object) -> "newton.solvers.SolverMuJoCo":
    """One Newton model of all worlds, compiled for MuJoCo's C engine ("cpu") or for MuJoCo Warp."""
    builder = new_builder()
    for world in worlds:
        add_world(builder, world.robot, world.scene)
    with warnings.catch_warnings():
        # The published inertia of the Panda's link 4 slightly violates the triangle inequality; Newton corrects it.
        warnings.filterwarnings("ignore", message="Inertia validation corrected")
        model = builder.finalize(device=device)
    solver = newton.solvers.SolverMuJoCo(model, **SOLVER_OPTIONS, **options)
    solver.mj_model.opt.timestep = TIME_STEP
    return solver


def initial_joints(world: World) -> np.ndarray:
    """[40] float64 initial joint coordinates of the template [rad, m]."""
    qpos = np.zeros(HINGE_INDEX + 1)
    qpos[:ROBOT_DOFS] = template_joints(world.robot, world.action[:1])[0]
    poses = [thing.pose for thing in world.scene.objects if not thing.is_fixed]
    poses += [PARKED[slot] for slot in range(len(poses), FREE_SLOTS)]
    for slot, pose in enumerate(poses):
        start = FREE_START + 7 * slot
        qpos[start : start + 7] = np.array(pose)[[0, 1, 2, 6, 3, 4, 5]]
    for thing in world.scene.objects:
        if thing.hinge:
            qpos[HINGE_INDEX] = thing.hinge.start
    return qpos


LEFT_FINGERS, RIGHT_FINGERS, FIRST_OBJECT, TABLE, LEFT_ARM_LINKS, RIGHT_ARM_LINKS = 0, 1, 2, -1, -2, -3
"""Owners of collision shapes; object i of a scene is `FIRST_OBJECT` + i."""


def shape_owners(labels: list[str]) -> np.ndarray:
    """[g] int32 owners of collision shapes, by their labels in the template."""
    return np.array([_owner(label.rsplit("/", 1)[-1]) for label in labels], np.int32)


def _owner(label: str) -> int:
    if label.startswith("object"):
        return FIRST_OBJECT + int(label.removeprefix("object"))
    if label.startswith("left"):
        return LEFT_FINGERS if "finger" in label else LEFT_ARM_LINKS
    if label.startswith("right"):
        return RIGHT_FINGERS if "finger" in label else RIGHT_ARM_LINKS
    return TABLE


def motion(
    world: World,
    qpos: np.ndarray,
    qvel: np.ndarray,
    contact: np.ndarray,
    penetration: np.ndarray,
    overlap: np.ndarray,
    overflow: bool,
) -> Motion:
    """A `Motion` of the world's own joints and objects.

    Args:
        qpos, qvel: [t 40], [t 37] the template's joint coordinates [rad, m] and velocities.
        contact: [t 2 o] bool.
        penetration: [t o] m.
        overlap: [2] m, of an arm and the table, of the arms.
    """
    objects = world.scene.objects
    pose = np.tile(np.array([thing.pose for thing in objects], np.float32), (len(qpos), 1, 1))
    angle = np.zeros((len(qpos), len(objects)), np.float32)
    slot = 0
    for index, thing in enumerate(objects):
        if not thing.is_fixed:
            start = FREE_START + 7 * slot
            pose[:, index] = qpos[:, start : start + 7][:, [0, 1, 2, 4, 5, 6, 3]]
            slot += 1
        if thing.hinge:
            angle[:, index] = qpos[:, HINGE_INDEX]
    return Motion(
        canonical_joints(world.robot, qpos[:, :ROBOT_DOFS]),
        canonical_joints(world.robot, qvel[:, :ROBOT_DOFS]),
        pose,
        angle,
        contact,
        penetration.astype(np.float32),
        float(overlap[0]),
        float(overlap[1]),
        overflow or not np.isfinite(qpos).all(),
    )
