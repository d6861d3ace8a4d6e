"""Stage 3: commands to states, by MuJoCo Warp on a GPU and MuJoCo's C engine on a CPU, behind one function.

Reads  `World`s: robot, scene and commanded joints at every stored frame
Writes `Motion`s: what the joints, objects and contacts did

Both engines step the model that Newton compiles from the common template. The C engine steps one world after another and
repeats bit for bit; MuJoCo Warp steps all worlds of a batch together and, its contact order being free, does not.
"""

from dataclasses import dataclass

import mujoco
import newton
import numpy as np
import warp as wp

from xew.protocol import ARMS, FRAME_RATE
from xew.sim_warp.robots import RobotSpec
from xew.sim_warp.scene import Scene
from xew.sim_warp.template import ARM_JOINTS, FREE_SLOTS, add_world, new_builder

TIME_STEP = 0.004
"""s."""
STEPS_PER_FRAME = 15
SOLVER_OPTIONS = {
    "cone": "elliptic",
    "impratio": 10.0,
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
"""Places in the template's joint coordinates: both arms with fingers, the free bodies (xyz and quaternion w x y z),
the lid."""


@dataclass(frozen=True)
class World:
    """One cell to simulate."""

    robot: RobotSpec
    scene: Scene
    action: np.ndarray
    """[t 16] canonical commands at every stored frame; the first is where the robot stands when the world begins."""


@dataclass(frozen=True)
class Motion:
    """What physics made of a world, at every stored frame."""

    joint_pos: np.ndarray
    """[t 16] float32, measured, canonical layout [rad; grippers 0 to 1]."""
    joint_vel: np.ndarray
    """[t 16] float32 [rad/s; 1/s]."""
    object_pose: np.ndarray
    """[t o 7] float32, world, quaternion x y z w."""
    object_joint: np.ndarray
    """[t o] float32, hinge angles [rad], 0 without a hinge."""
    contact: np.ndarray
    """[t 2 o] bool, fingers of the left, right arm on each object."""
    overflow: bool
    """A contact or constraint buffer was too small at some step: the motion must not be used."""


def simulate(worlds: list[World], device: str | None = None) -> list[Motion]:
    """Step every world through its commands.

    Args:
        worlds: of any robots, tasks and lengths.
        device: "cpu" for MuJoCo's C engine, "cuda:0" for MuJoCo Warp; by default what Warp prefers.
    """
    if wp.get_device(device).is_cuda:
        from xew.sim_warp.physics_gpu import simulate_batch  # heavy, and of no use without a GPU

        return simulate_batch(worlds, device)
    return [_simulate_one(world) for world in worlds]


def finger_strokes(robot: RobotSpec, side: int) -> np.ndarray:
    """[2] how far each finger of an arm slides from gripper 0 to 1 [m]."""
    return np.abs(np.subtract(robot.arms[side].finger_open, robot.arms[side].finger_closed))


def template_joints(robot: RobotSpec, action: np.ndarray) -> np.ndarray:
    """Canonical [t 16] -> the template's robot joints [t 18]: seven arm joints and two fingers a side."""
    sides = [
        np.concatenate([action[:, arm], action[:, gripper, None] * finger_strokes(robot, side)], axis=-1)
        for side, (arm, gripper) in enumerate(ARMS)
    ]
    return np.concatenate(sides, axis=-1)


def canonical_joints(robot: RobotSpec, joints: np.ndarray) -> np.ndarray:
    """The template's robot joints [t 18], positions or velocities -> canonical [t 16] float32."""
    result = np.zeros((len(joints), 16), np.float32)
    for side, (arm, gripper) in enumerate(ARMS):
        start = side * JOINTS_PER_SIDE
        result[:, arm] = joints[:, start : start + ARM_JOINTS]
        fingers = joints[:, start + ARM_JOINTS : start + JOINTS_PER_SIDE]
        result[:, gripper] = (fingers / finger_strokes(robot, side)).mean(-1)
        result[:, arm.start + robot.arm_joint_count : arm.stop] = 0.0
    return result


def control_targets(robot: RobotSpec, action: np.ndarray) -> np.ndarray:
    """[t-1 15 36] actuator targets of every step: position and velocity of each robot joint in turn.

    Commands are linear between stored frames; their slope is fed forward as the velocity.
    """
    joints = template_joints(robot, action)
    share = (np.arange(STEPS_PER_FRAME) + 1) / STEPS_PER_FRAME
    step = np.diff(joints, axis=0)[:, None]
    position = joints[:-1, None] + share[:, None] * step
    velocity = np.broadcast_to(step * FRAME_RATE, position.shape)
    return np.stack([position, velocity], axis=-1).reshape(*position.shape[:2], -1)


def build_solver(worlds: list[World], device: str, **options: object) -> newton.solvers.SolverMuJoCo:
    """One Newton model of all worlds, compiled for MuJoCo's C engine ("cpu") or for MuJoCo Warp."""
    builder = new_builder()
    for world in worlds:
        add_world(builder, world.robot, world.scene)
    model = builder.finalize(device=device)
    solver = newton.solvers.SolverMuJoCo(model, **SOLVER_OPTIONS, **options)
    solver.mj_model.opt.timestep = TIME_STEP
    return solver


def shape_owners(labels: list[str]) -> np.ndarray:
    """What a collision shape belongs to: 0, 1 the fingers of the left, right arm, 2 + i object i, -1 anything else."""
    owners = np.full(len(labels), -1, np.int32)
    for shape, label in enumerate(labels):
        name = label.rsplit("/", 1)[-1]
        if "finger" in name:
            owners[shape] = 0 if name.startswith("left") else 1
        elif name.startswith("object"):
            owners[shape] = 2 + int(name.removeprefix("object"))
    return owners


def _simulate_one(world: World) -> Motion:
    solver = build_solver([world], "cpu", use_mujoco_cpu=True)
    model, data = solver.mj_model, solver.mj_data
    labels = solver.model.shape_label
    owners = shape_owners([labels[shape] for shape in solver.mjc_geom_to_newton_shape.numpy()[0]])
    data.qpos[:] = initial_joints(world, data.qpos)
    mujoco.mj_forward(model, data)
    frames = [_frame(data, owners, len(world.scene.objects))]
    for targets in control_targets(world.robot, world.action):
        for target in targets:
            data.ctrl[:] = target
            mujoco.mj_step(model, data)
        frames.append(_frame(data, owners, len(world.scene.objects)))
    qpos, qvel, contact = (np.stack(parts) for parts in zip(*frames, strict=True))
    overflow = bool(any(warning.number for warning in data.warning))
    return motion(world, qpos, qvel, contact, overflow)


def initial_joints(world: World, qpos: np.ndarray) -> np.ndarray:
    """The template's joint coordinates [40] when the world begins: `qpos` with the robot and the lid in their places."""
    qpos = qpos.copy()
    qpos[:ROBOT_DOFS] = template_joints(world.robot, world.action[:1])[0]
    for thing in world.scene.objects:
        if thing.hinge:
            qpos[HINGE_INDEX] = thing.hinge.start
    return qpos


def _frame(data: mujoco.MjData, owners: np.ndarray, object_count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joint coordinates, velocities, and [2 o] which fingers touch which objects."""
    contact = np.zeros((2, object_count), bool)
    touching = data.contact.geom[data.contact.dist < 0.001] if data.ncon else np.zeros((0, 2), int)
    pairs = np.sort(owners[touching], axis=-1)
    pairs = pairs[(pairs[:, 0] >= 0) & (pairs[:, 0] < 2) & (pairs[:, 1] >= 2)]
    contact[pairs[:, 0], pairs[:, 1] - 2] = True
    return data.qpos.copy(), data.qvel.copy(), contact


def motion(world: World, qpos: np.ndarray, qvel: np.ndarray, contact: np.ndarray, overflow: bool) -> Motion:
    """The template's joint coordinates [t 40] and velocities [t 37] as a `Motion` of the world's own objects."""
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
        overflow or not np.isfinite(qpos).all(),
    )
