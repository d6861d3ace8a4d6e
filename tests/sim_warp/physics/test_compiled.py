"""Worlds compiled from a robot's one conversion are those that Newton converts one by one, to the bit."""

from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from xew.sim_warp import objects
from xew.sim_warp.changes.scenes import make_scene
from xew.sim_warp.physics import compiled, cpu
from xew.sim_warp.physics.worlds import World, shape_owners
from xew.sim_warp.rendering.streams import home_action
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.scene import Scene, SceneObject
from xew.sim_warp.tasks import TASKS, get_task

NUMBERED = ("geom_dataid", "geom_contype", "geom_conaffinity", "body_contype", "body_conaffinity")
"""Fields with numbers of meshes and with bits of colors, which two models may give in another order."""
COMPARED = ("body_", "jnt_", "dof_", "geom_", "actuator_", "eq_", "tendon_", "qpos")
"""How the names of fields begin that must be equal."""
FRAMES = 5


def world_of(robot: str, task: str, seed: int = 0) -> World:
    """A robot that sways at home and closes its hands over a task's scene."""
    action = np.tile(home_action(ROBOTS[robot]).astype(np.float32), (FRAMES, 1))
    action[1:, :6] += np.linspace(0, 0.1, FRAMES - 1, dtype=np.float32)[:, None]
    action[2:, [7, 15]] = 0.5
    return World(ROBOTS[robot], make_scene(get_task(task), task, seed), action)


def fields(model: mujoco.MjModel) -> Iterator[tuple[str, bytes]]:
    """The fields that physics depends on, without NUMBERED."""
    for name in dir(model):
        value = getattr(model, name)
        if name.startswith(COMPARED) and name not in NUMBERED and not callable(value):
            yield name, np.asarray(value).tobytes()


def shape(model: mujoco.MjModel, geom: int) -> tuple[bytes, ...]:
    """Vertices and frame of a shape's mesh."""
    mesh = model.geom_dataid[geom]
    vertices = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
    return tuple(part.tobytes() for part in (model.mesh_vert[vertices], model.mesh_pos[mesh], model.mesh_quat[mesh]))


def colliding(model: mujoco.MjModel) -> np.ndarray:
    """[g g] bool, pairs of shapes of different bodies that may collide by their masks, pairs in the world left out."""
    meets = (model.geom_contype[:, None] & model.geom_conaffinity) != 0
    body = model.geom_bodyid
    return (meets | meets.T) & (body[:, None] != body) & ((body[:, None] > 0) | (body > 0))


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("task", ["place_dual_shoes", "lift_pot", "beat_block_hammer", "place_bread_basket"])
def test_a_compiled_world_is_a_converted_one(task: str, robot: str, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled.compile_world(world_of(robot, "blocks_ranking_rgb", 3))  # what was compiled before leaves no trace
    world = world_of(robot, task, seed=1)
    found, owners = compiled.compile_world(world)
    expected = compiled.convert_world(world)
    assert dict(fields(found)) == dict(fields(expected))
    assert [shape(found, geom) for geom in range(found.ngeom)] == [shape(expected, geom) for geom in range(found.ngeom)]
    np.testing.assert_array_equal(colliding(found), colliding(expected))
    moved = cpu.simulate_one(world)
    monkeypatch.setattr(cpu, "compile_world", lambda world: (expected, owners))
    for name, part in vars(cpu.simulate_one(world)).items():
        np.testing.assert_array_equal(getattr(moved, name), part, err_msg=name)


def test_only_shapes_and_free_bodies_are_exchanged() -> None:
    plain = {task for task in TASKS if compiled._is_plain(make_scene(get_task(task), task, 0))}
    assert plain == set(TASKS) - {"open_laptop", "press_stapler"}  # have a hinge


def test_a_body_without_thickness_is_left_to_newton() -> None:
    """Newton corrects the inertia of a sheet, which no solid has."""
    for thickness, is_plain in ((0.02, True), (1e-5, False)):
        sheet = SceneObject("sheet", objects.block((0.2, 0.2, thickness), (0, 0, 0)), (0, 0, 1, 0, 0, 0, 1), mass=0.1)
        assert compiled._is_plain(Scene("sheet", 0, (sheet,))) == is_plain


def test_owners_are_those_of_the_labels() -> None:
    world = world_of("piper", "place_dual_shoes")
    model, owners = compiled.compile_world(world)
    names = [model.geom(index).name for index in range(model.ngeom)]
    assert [name for name, owner in zip(names, owners, strict=True) if owner == -1] == names[:1]
    assert set(owners[1:]) == set(
        shape_owners(
            [
                "left_link1",
                "right_link1",
                "left_finger1",
                "right_finger1",
                *(f"object{index}" for index in range(len(world.scene.objects))),
            ]
        )
    )


def test_a_raised_table_is_raised() -> None:
    world = world_of("ur5_wsg", "lift_pot")
    raised = replace(world, scene=replace(world.scene, raised=0.05))
    low, high = (compiled.compile_world(each)[0] for each in (world, raised))
    assert high.geom_pos[0, 2] - low.geom_pos[0, 2] == pytest.approx(0.05)
