"""Worlds for MuJoCo's C engine: Newton converts each robot once, and MuJoCo compiles it again with each scene's objects.

A conversion takes ten times as long as compiling. The worlds of a robot differ only in shapes and free bodies, so these are put
into Newton's specification, and Newton publishes the bodies' numbers as in a conversion. Physics are the same to the bit.
Scenes with a hinge, which is a joint, are converted each time.
"""

from collections.abc import Sequence
from functools import lru_cache
from unittest import mock

import mujoco
import numpy as np
import warp as wp

from xew.concurrency import PARSING
from xew.sim_warp.devices.newton import convert_quickly, newton
from xew.sim_warp.objects import block
from xew.sim_warp.physics.template import (
    FREE_SLOTS,
    PARKED,
    PARKED_PARTS,
    Shape,
    fixed_shapes,
    free_objects,
    free_shapes,
    hull_mesh,
    solid,
)
from xew.sim_warp.physics.worlds import FREE_START, TIME_STEP, World, build_solver, shape_owners
from xew.sim_warp.robots import RobotSpec
from xew.sim_warp.scene import Scene, SceneObject

CONVERSIONS = 32
"""Number of robots whose conversion is cached."""
BOX = SceneObject("box", block((0.05, 0.05, 0.05), (0, 0, 0)), PARKED[0], mass=0.1)
"""Object of the scene with which robots are converted: only then can shapes of objects collide with one another."""
SHARED = ("type", "contype", "conaffinity", "condim", "solref", "solimp", "size")
"""Attributes that the shapes of all objects share, by their names in a specification."""
FLATTEST = 1e-4
"""Least relative margin of an inertia to one that Newton corrects: of a body without thickness."""


def compile_world(world: World) -> tuple[mujoco.MjModel, np.ndarray]:
    """The engine's model of a world, and the owners [g] int32 of its collision shapes."""
    with PARSING:  # Newton's arrays are shared
        model = _conversion(world.robot).compile(world.scene) if _is_plain(world.scene) else convert_world(world)
    return model, shape_owners([model.geom(index).name.rsplit("_", 1)[0] for index in range(model.ngeom)])


def convert_world(world: World) -> mujoco.MjModel:
    """The engine's model of a world, all of it by Newton."""
    convert_quickly()
    return build_solver([world], "cpu", use_mujoco_cpu=True).mj_model


def _is_plain(scene: Scene) -> bool:
    """Whether a scene differs from others only in shapes and free bodies, whose inertias Newton does not correct."""
    free = free_objects(scene)
    if not 0 < len(free) <= FREE_SLOTS or any(thing.hinge for thing in scene.objects):
        return False
    moments = np.linalg.eigvalsh([_parts(thing)[2] for thing in free])
    margin = np.minimum(moments[:, 0], moments[:, 0] + moments[:, 1] - moments[:, 2])
    return bool((margin > FLATTEST * moments[:, 2]).all())


def _parts(thing: SceneObject | None) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, center and inertia of an object in a free slot, or of an empty slot."""
    return solid(thing.mass, list(thing.shape.hulls)) if thing else PARKED_PARTS


@lru_cache(maxsize=CONVERSIONS)
def _conversion(robot: RobotSpec) -> "_Conversion":
    """The process's conversion of a robot."""
    return _Conversion(robot)


class _Conversion:
    """Newton's conversion of a robot, with its specification for MuJoCo, from which the objects are removed."""

    def __init__(self, robot: RobotSpec) -> None:
        specs: list[mujoco.MjSpec] = []
        compile_spec = mujoco.MjSpec.compile

        def note(spec: mujoco.MjSpec) -> mujoco.MjModel:
            specs.append(spec)
            return compile_spec(spec)

        convert_quickly()
        with mock.patch.object(mujoco.MjSpec, "compile", note):
            world = World(robot, Scene("", 0, (BOX,)), np.zeros((1, 16)))
            self.solver = build_solver([world], "cpu", use_mujoco_cpu=True)
        self.spec = specs[0]
        objects = [geom for geom in self.spec.geoms if geom.name.startswith(("table", "object"))]
        self.shared = {name: np.copy(getattr(objects[0], name)) for name in SHARED}
        self.turning = objects[0].friction[1:].copy()  # friction against turning and rolling
        for geom in objects:
            self.spec.delete(geom)
        used = {geom.meshname for geom in self.spec.geoms}
        for mesh in self.spec.meshes:
            if mesh.name not in used:
                self.spec.delete(mesh)
        for pair in self.spec.excludes:  # bodies that had no shape
            if "free" in pair.bodyname1 + pair.bodyname2:
                self.spec.delete(pair)

    def compile(self, scene: Scene) -> mujoco.MjModel:
        """The engine's model of the robot with a scene's objects."""
        spec, solver, free = self.spec.copy(), self.solver, free_objects(scene)
        self._add_shapes(spec, spec.worldbody, fixed_shapes(scene))
        for slot in range(FREE_SLOTS):
            thing = free[slot] if slot < len(free) else None
            body = spec.body(f"free{slot}")
            self._place(slot, body, thing)
            if thing:
                self._add_shapes(spec, body, free_shapes(scene, thing))
        solver.mj_model = model = spec.compile()
        solver.mj_data = mujoco.MjData(model)
        solver._canonical_bvh_aabb = model.bvh_aabb.copy()
        solver._canonical_body_ipos, solver._canonical_body_iquat = model.body_ipos.copy(), model.body_iquat.copy()
        solver.notify_model_changed(newton.ModelFlags.ALL & ~newton.ModelFlags.SHAPE_PROPERTIES)
        model.opt.timestep = TIME_STEP
        return model

    def _place(self, slot: int, body: mujoco.MjsBody, thing: SceneObject | None) -> None:
        """Write mass and pose of a free slot into Newton's model, and from there as float32 into the specification."""
        model = self.solver.model
        index = model.body_label.index(f"free{slot}")
        pose = np.array(wp.transform(*(thing.pose if thing else PARKED[slot])), np.float32)
        values = (*_parts(thing), 0.0 if thing else 1.0, pose)
        arrays = (model.body_mass, model.body_com, model.body_inertia, model.mujoco.gravcomp, model.body_q)
        for array, value in zip(arrays, values, strict=True):
            array.numpy()[index] = value
        start = FREE_START + 7 * slot
        model.joint_q.numpy()[start : start + 7] = pose
        body.mass, body.ipos, inertia, body.gravcomp, _ = (array.numpy()[index] for array in arrays)
        body.pos, body.quat = pose[:3], pose[[6, 3, 4, 5]]
        if np.array_equal(inertia, np.diag(inertia.diagonal())):
            body.inertia, body.fullinertia = inertia.diagonal(), [np.nan, 0, 0, 0, 0, 0]
        else:
            body.inertia, body.fullinertia = np.zeros(3), [*inertia.diagonal(), *inertia[[0, 0, 1], [1, 2, 2]]]

    def _add_shapes(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, shapes: Sequence[Shape]) -> None:
        """Add shapes to a body as Newton does; equal shapes share a mesh."""
        for points, friction, label in shapes:
            hull, shell = hull_mesh(points), mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            mesh = f"mesh{id(hull)}"
            if spec.mesh(mesh) is None:
                vertices, faces = hull.vertices.flatten(), hull.indices.flatten()
                spec.add_mesh(name=mesh, uservert=vertices, userface=faces, maxhullvert=hull.maxhullvert, inertia=shell)
            name, parts = f"{label}_{len(spec.geoms)}", [np.float32(friction), *self.turning]
            body.add_geom(name=name, meshname=mesh, friction=parts, **self.shared)
