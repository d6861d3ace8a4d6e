"""The common template: one Newton world for any robot, task and seed, which all form one batch.

A world has two arms of seven revolute joints and two finger slides each, `FREE_SLOTS` free bodies, one hinged lid, and fixed
objects. MuJoCo Warp needs the same bodies and joints in every world; their frames, axes, limits, masses and convex hulls may
differ. Arms of six joints get a pinned seventh. Unused slots float below the table without gravity or shape.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
import warp as wp
from scipy.spatial.transform import Rotation

from xew.config import ConfigError
from xew.sim_warp.devices.newton import newton
from xew.sim_warp.embodiment.spec import Arm
from xew.sim_warp.embodiment.urdf import Joint, Urdf
from xew.sim_warp.geometry.poses import matrix_from_pose
from xew.sim_warp.robots import RobotSpec, load_urdf
from xew.sim_warp.scene import Scene, SceneObject
from xew.sim_warp.stage import TABLE_SIZE, TABLE_TOP

ARM_JOINTS = 7
FREE_SLOTS = 3
"""Number of free bodies."""
PARKED = tuple((0.3 * slot, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0) for slot in range(FREE_SLOTS))
"""Poses (xyz [m] and quaternion xyzw) of unused free bodies, below the table."""
PARKED_PARTS = (0.1, np.zeros(3), np.eye(3) * 1e-4)
"""Mass [kg], center [3] and inertia [3 3] kg m2 of an unused body."""
SIDES = ("left", "right")

ARM_STIFFNESS, ARM_DAMPING, ARM_ARMATURE = 4000.0, 120.0, 1.0
"""Position gain [N m/rad], velocity gain [N m s/rad] and reflected rotor inertia [kg m2] of every arm joint. With the commanded
velocity fed forward, joints follow commands within a few milliradians. The time step times the velocity gain must be small
compared with the inertia: MuJoCo's contact solver treats the gain explicitly, and held objects would jump ahead of the hand."""
CONTACT_TIME = 0.012
"""Time constant of soft contacts [s], three time steps: held objects sink 1 mm into a pad."""
PIN_STIFFNESS, PIN_DAMPING, PIN_ARMATURE = 20000.0, 500.0, 1.0
"""Gains and inertia of the pinned seventh joint of an arm that has six."""
FINGER_STIFFNESS, FINGER_DAMPING, FINGER_ARMATURE = 10000.0, 200.0, 0.5
"""Gains [N/m, N s/m] and inertia [kg] of a finger; a wall of 5 mm is held with the full force."""
FINGER_FORCE = 16.0
"""Largest force of a finger [N]; the objects are light."""
PAD_FRICTION = 1.2
"""Sliding friction of rubber pads on plastic or wood."""
LINK_FRICTION = 0.5
"""Sliding friction of all other links and of the table."""
HINGE_ARMATURE = 0.02
"""Inertia added to a hinge [kg m2]; without it the solver neglects the friction of a light lid."""
HINGE_SOLIMP = (0.99, 0.99, 0.001, 0.5, 2.0)
"""Impedance of a hinge's dry friction: with MuJoCo's default a light lid creeps shut at 4 degrees a second."""
FARTHEST_MASS = 0.3
"""Radius of gyration [m] beyond which a link's inertia is a placeholder (RoboTwin's UR5 gripper has 1 kg m2 for fingers of
100 g). The inertia of its collision shapes replaces it, as for inertias that are not positive."""

ROBOT_GROUP = {"left": -1, "right": -2}
OBJECT_GROUP = 1
"""Newton's collision groups; a negative group collides with every group but itself."""


@dataclass(frozen=True)
class RigidGroup:
    """Links between two moving joints, which move as one body."""

    parent_to_joint: np.ndarray
    """[4 4] joint frame in the frame of the parent group."""
    joint: Joint
    mass: float
    center: np.ndarray
    """[3] center of mass [m], frame of the joint."""
    inertia: np.ndarray
    """[3 3] inertia about the center of mass [kg m2]."""
    hulls: tuple[tuple[str, np.ndarray], ...]
    """Name and points [k 3] m of each convex piece, frame of the joint."""


@lru_cache(maxsize=512)
def arm_groups(path: Path, arm: Arm) -> tuple[list[RigidGroup], list[RigidGroup]]:
    """The rigid groups of an arm's revolute joints, base outwards, and of its two fingers."""
    urdf, moving = load_urdf(path), [*arm.joints, *arm.fingers]
    groups = {name: _rigid_group(urdf, urdf.joints[name], moving) for name in moving}
    return [groups[name] for name in arm.joints], [groups[name] for name in arm.fingers]


def _rigid_group(urdf: Urdf, joint: Joint, moving: list[str]) -> RigidGroup:
    """Mass and shapes of a joint's child and its fixed links, in the child's frame."""
    parts = [(joint.child, np.eye(4))]
    for link, pose in parts:  # grows while it is walked
        parts += [(j.child, pose @ j.origin) for j in urdf.joints.values() if j.parent == link and j.name not in moving]
    hulls = tuple(
        (collision.name, collision.points @ pose[:3, :3].T + pose[:3, 3])
        for link, pose in parts
        for collision in urdf.links[link].collisions
    )
    return RigidGroup(_from_last_moving(urdf, joint, moving), joint, *_mass_properties(urdf, parts, hulls), hulls)


def _from_last_moving(urdf: Urdf, joint: Joint, moving: list[str]) -> np.ndarray:
    """[4 4] the joint's frame in the child of the previous moving joint, or in the root."""
    pose = np.eye(4)
    for above in urdf.chain(joint.child):
        pose = pose @ above.origin
        if above.name in moving and above.name != joint.name:
            pose = np.eye(4)
    return pose


def _mass_properties(
    urdf: Urdf, parts: list[tuple[str, np.ndarray]], hulls: tuple[tuple[str, np.ndarray], ...]
) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, center and inertia of links together (parallel axes)."""
    known = [(inertial, pose) for link, pose in parts if (inertial := urdf.links[link].inertial) is not None]
    mass = sum((inertial.mass for inertial, _ in known), 0.0)
    if mass <= 0:
        return 0.05, np.zeros(3), np.eye(3) * 5e-5
    center, inertia = _combine(
        [inertial.mass for inertial, _ in known],
        [pose[:3, :3] @ inertial.center + pose[:3, 3] for inertial, pose in known],
        [pose[:3, :3] @ inertial.inertia @ pose[:3, :3].T for inertial, pose in known],
    )
    is_placeholder = np.sqrt(np.trace(inertia) / mass) > FARTHEST_MASS or np.linalg.eigvalsh(inertia).min() <= 0
    if is_placeholder and hulls:
        return solid(mass, [points for _, points in hulls])
    return mass, center, inertia


def _combine(
    masses: Sequence[float], centers: Sequence[np.ndarray], inertias: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Center [3] and inertia about it [3 3] of bodies together, from their own centers and inertias (parallel axes)."""
    center = np.asarray(sum(mass * middle for mass, middle in zip(masses, centers, strict=True)) / sum(masses))
    inertia = np.zeros((3, 3))
    for mass, middle, own in zip(masses, centers, inertias, strict=True):
        arm = middle - center
        inertia += own + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return center, inertia


def solid(mass: float, hulls: Sequence[np.ndarray]) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass [kg], center of mass [3] m and inertia about it [3 3] kg m2 of convex pieces [k 3] m of one density."""
    return _solid(mass, tuple(np.asarray(points, np.float32).tobytes() for points in hulls))


@lru_cache(maxsize=1024)
def _solid(mass: float, hulls: tuple[bytes, ...]) -> tuple[float, np.ndarray, np.ndarray]:
    """`solid` of float32 points: all robots of a seed meet the same objects."""
    pieces = [_convex(points) for points in hulls]
    volumes = [piece.volume for piece in pieces]
    center, inertia = _combine(volumes, [p.center_mass for p in pieces], [p.moment_inertia for p in pieces])
    return mass, center, inertia * mass / sum(volumes)


def new_builder() -> "newton.ModelBuilder":
    """A builder with the attributes that the template sets on MuJoCo's side."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, -9.81))
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    return builder


def add_world(builder: "newton.ModelBuilder", robot: RobotSpec, scene: Scene) -> None:
    """Append one world of the template. Raises ConfigError if the scene has too many objects."""
    builder.begin_world(label=f"{scene.task}/{scene.seed}/{robot.key}")
    for side, arm in zip(SIDES, robot.arms, strict=True):
        _add_arm(builder, side, arm, robot.urdf)
    _add_objects(builder, scene)
    builder.end_world()


def _add_arm(builder: "newton.ModelBuilder", side: str, arm: Arm, path: Path) -> None:
    links, fingers = arm_groups(path, arm)
    root = wp.transform(*arm.root_pose)
    joints: list[int] = []
    parent = -1
    for number, group in enumerate(links, 1):
        is_last_of_six = number == len(links) == ARM_JOINTS - 1
        frame = root * _transform(group.parent_to_joint) if parent < 0 else _transform(group.parent_to_joint)
        parent = _add_body(builder, side, f"link{number}", None if is_last_of_six else group)
        joints.append(_add_arm_joint(builder, f"{side}_joint{number}", joints, parent, frame, group.joint))
        if is_last_of_six:
            before, parent = parent, _add_body(builder, side, "link7", group)
            joints.append(_add_pin(builder, f"{side}_joint7", before, parent))
    for number, group in enumerate(fingers, 1):
        body = _add_body(builder, side, f"finger{number}", group)
        closed, opened = arm.finger_closed[number - 1], arm.finger_open[number - 1]
        joints.append(_add_finger_joint(builder, f"{side}_finger{number}", parent, body, group, closed, opened))
    builder.add_articulation(joints, label=f"{side}_arm")
    builder.set_joint_mimic(joints[-1], joints[-2])


def _add_body(builder: "newton.ModelBuilder", side: str, name: str, group: RigidGroup | None) -> int:
    """Add a body with a group's mass and shapes or, without a group, a small body for the pinned joint."""
    mass, center, inertia = (group.mass, group.center, group.inertia) if group else PARKED_PARTS
    body = builder.add_link(
        mass=mass,
        com=wp.vec3(*center),
        inertia=wp.mat33(*inertia.flatten()),
        lock_inertia=True,
        label=f"{side}_{name}",
        custom_attributes={"mujoco:gravcomp": 1.0},
    )
    has_pad = group is not None and "pad" in dict(group.hulls)  # without a pad, the whole finger of a user's URDF grips
    for label, points in group.hulls if group else ():
        friction = PAD_FRICTION if label == "pad" or (name.startswith("finger") and not has_pad) else LINK_FRICTION
        _add_hull(builder, body, points, friction, f"{side}_{name}", ROBOT_GROUP[side])
    return body


def _add_arm_joint(
    builder: "newton.ModelBuilder", label: str, before: list[int], child: int, frame: wp.transform, joint: Joint
) -> int:
    return builder.add_joint_revolute(
        child - 1 if before else -1,
        child,
        parent_xform=frame,
        axis=wp.vec3(*joint.axis),
        limit_lower=max(joint.lower, -20.0),
        limit_upper=min(joint.upper, 20.0),
        target_ke=ARM_STIFFNESS,
        target_kd=ARM_DAMPING,
        armature=ARM_ARMATURE,
        effort_limit=max(joint.effort, 50.0),
        actuator_mode=newton.JointTargetMode.POSITION_VELOCITY,
        label=label,
    )


def _add_pin(builder: "newton.ModelBuilder", label: str, parent: int, child: int) -> int:
    return builder.add_joint_revolute(
        parent,
        child,
        axis=wp.vec3(0, 0, 1),
        limit_lower=-0.01,
        limit_upper=0.01,
        target_ke=PIN_STIFFNESS,
        target_kd=PIN_DAMPING,
        armature=PIN_ARMATURE,
        actuator_mode=newton.JointTargetMode.POSITION_VELOCITY,
        label=label,
    )


def _add_finger_joint(
    builder: "newton.ModelBuilder", label: str, parent: int, child: int, group: RigidGroup, closed: float, opened: float
) -> int:
    """Add a slide whose position is the finger's distance from closed, for all robots."""
    frame = group.parent_to_joint.copy()
    frame[:3, 3] += frame[:3, :3] @ group.joint.axis * closed
    return builder.add_joint_prismatic(
        parent,
        child,
        parent_xform=_transform(frame),
        axis=wp.vec3(*(group.joint.axis * np.sign(opened - closed))),
        limit_lower=0.0,
        limit_upper=abs(opened - closed) + 0.001,
        target_ke=FINGER_STIFFNESS,
        target_kd=FINGER_DAMPING,
        armature=FINGER_ARMATURE,
        effort_limit=FINGER_FORCE,
        actuator_mode=newton.JointTargetMode.POSITION_VELOCITY,
        label=label,
    )


def _add_objects(builder: "newton.ModelBuilder", scene: Scene) -> None:
    table, *fixed = fixed_shapes(scene)
    _add_hull(builder, -1, *table, group=OBJECT_GROUP)
    free = free_objects(scene)
    hinged = [thing for thing in scene.objects if thing.hinge]
    if len(free) > FREE_SLOTS or len(hinged) > 1 or any(not thing.is_fixed for thing in hinged):
        raise ConfigError(
            f"the scene of {scene.task} has {len(free)} free and {len(hinged)} hinged objects; the template holds "
            f"{FREE_SLOTS} free ones and one hinge on a fixed object: raise its slots in {__name__}."
        )
    for slot in range(FREE_SLOTS):
        _add_free_slot(builder, slot, free[slot] if slot < len(free) else None, scene)
    _add_hinge_slot(builder, hinged[0] if hinged else None, scene)
    for shape in fixed:
        _add_hull(builder, -1, *shape, group=OBJECT_GROUP)


Shape = tuple[np.ndarray, float, str]
"""Points [k 3] of a convex piece in the frame of its body [m], sliding friction, and label."""


def fixed_shapes(scene: Scene) -> list[Shape]:
    """The shapes of the table and of fixed objects, in the world."""
    table = trimesh.creation.box((TABLE_SIZE[0], TABLE_SIZE[1], TABLE_SIZE[2]))
    shapes = [(table.vertices + [0, 0, TABLE_TOP + scene.raised - TABLE_SIZE[2] / 2], LINK_FRICTION, "table")]
    for thing in scene.objects:
        if thing.is_fixed:
            pose = matrix_from_pose(thing.pose)
            placed = [points @ pose[:3, :3].T + pose[:3, 3] for points in thing.shape.hulls]
            shapes += [(points, thing.friction, object_label(scene, thing)) for points in placed]
    return shapes


def free_objects(scene: Scene) -> list[SceneObject]:
    """The objects in the free slots, in order."""
    return [thing for thing in scene.objects if not thing.is_fixed]


def free_shapes(scene: Scene, thing: SceneObject) -> list[Shape]:
    """The shapes of a free object."""
    return [(points, thing.friction, object_label(scene, thing)) for points in thing.shape.hulls]


def object_label(scene: Scene, thing: SceneObject) -> str:
    """The label of all collision shapes of an object, its lid included."""
    return f"object{scene.index(thing.name)}"


def _add_free_slot(builder: "newton.ModelBuilder", slot: int, thing: SceneObject | None, scene: Scene) -> None:
    label = f"free{slot}"
    if thing is None:
        mass, center, inertia = PARKED_PARTS
        body = builder.add_link(
            mass=mass,
            com=wp.vec3(*center),
            inertia=wp.mat33(*inertia.flatten()),
            xform=wp.transform(*PARKED[slot]),
            lock_inertia=True,
            label=label,
            custom_attributes={"mujoco:gravcomp": 1.0},
        )
    else:
        mass, center, inertia = solid(thing.mass, list(thing.shape.hulls))
        body = builder.add_link(
            mass=mass,
            com=wp.vec3(*center),
            inertia=wp.mat33(*inertia.flatten()),
            xform=wp.transform(*thing.pose),
            lock_inertia=True,
            label=label,
        )
        for shape in free_shapes(scene, thing):
            _add_hull(builder, body, *shape, group=OBJECT_GROUP)
    builder.add_articulation([builder.add_joint_free(child=body, label=f"{label}_free")], label=label)


def _add_hinge_slot(builder: "newton.ModelBuilder", thing: SceneObject | None, scene: Scene) -> None:
    """Add a lid on a hinge in the world, or a pinned small body below the table."""
    if thing is None or thing.hinge is None:
        parts = PARKED_PARTS
        frame, axis = wp.transform((0, 0.3, 0.3), wp.quat_identity()), (0.0, 0.0, 1.0)
        settings = {"limit_lower": -1.0, "limit_upper": 1.0, "friction": 1.0, "damping": 1.0}
    else:
        hinge = thing.hinge
        mass, center, inertia = solid(hinge.mass, list(hinge.lid.hulls))
        parts = (mass, center - hinge.anchor, inertia)
        frame = wp.transform(*thing.pose) * wp.transform(hinge.anchor, wp.quat_identity())
        axis = hinge.axis
        settings = {
            "limit_lower": hinge.lower,
            "limit_upper": hinge.upper,
            "friction": hinge.friction,
            "damping": hinge.damping,
            "stiffness": hinge.stiffness,
            "rest_q": hinge.rest,
        }
    body = builder.add_link(
        mass=parts[0],
        com=wp.vec3(*parts[1]),
        inertia=wp.mat33(*parts[2].flatten()),
        lock_inertia=True,
        label="lid",
        custom_attributes={} if thing else {"mujoco:gravcomp": 1.0},
    )
    if thing is not None and thing.hinge is not None:
        for points in thing.hinge.lid.hulls:
            _add_hull(builder, body, points - thing.hinge.anchor, thing.friction, object_label(scene, thing), OBJECT_GROUP)
    joint = builder.add_joint_revolute(
        -1,
        body,
        parent_xform=frame,
        axis=wp.vec3(*axis),
        armature=HINGE_ARMATURE,
        label="lid_hinge",
        custom_attributes={"mujoco:solimpfriction": [HINGE_SOLIMP]},
        **settings,
    )
    builder.add_articulation([joint], label="lid")


def _add_hull(builder: "newton.ModelBuilder", body: int, points: np.ndarray, friction: float, label: str, group: int) -> None:
    builder.add_shape_convex_hull(
        body,
        mesh=hull_mesh(points),
        cfg=newton.ModelBuilder.ShapeConfig(
            mu=friction, density=0.0, gap=0.0, ke=CONTACT_TIME**-2, kd=2 / CONTACT_TIME, collision_group=group
        ),
        label=label,
        custom_attributes={"mujoco:condim": 4},
    )


def hull_mesh(points: np.ndarray) -> "newton.Mesh":
    """The convex hull of points [k 3] in float32; equal points share one mesh."""
    return _hull(np.asarray(points, np.float32).tobytes())


@lru_cache(maxsize=4096)
def _hull(points: bytes) -> "newton.Mesh":
    """The convex hull of float32 points [k 3], cached for the links of a batch."""
    hull = _convex(points)
    return newton.Mesh(hull.vertices.astype(np.float32), hull.faces.flatten().astype(np.int32), compute_inertia=False)


def _convex(points: bytes) -> trimesh.Trimesh:
    """The convex hull of float32 points [k 3]."""
    return trimesh.convex.convex_hull(np.frombuffer(points, np.float32).reshape(-1, 3).astype(float))


def _transform(matrix: np.ndarray) -> wp.transform:
    return wp.transform(tuple(matrix[:3, 3]), wp.quat(*Rotation.from_matrix(matrix[:3, :3]).as_quat()))
