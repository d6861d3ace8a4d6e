"""Physics on a CPU: MuJoCo's C engine, one world at a time, the same bits every time."""

import mujoco
import numpy as np

from xew.sim_warp.physics.compiled import compile_world
from xew.sim_warp.physics.worlds import (
    FIRST_OBJECT,
    LEFT_ARM_LINKS,
    LEFT_FINGERS,
    RIGHT_ARM_LINKS,
    RIGHT_FINGERS,
    TABLE,
    Motion,
    World,
    control_targets,
    initial_joints,
    motion,
)

# Warnings are counted in `data.warning` and reported as overflow; by default MuJoCo also writes a log file.
mujoco.set_mju_user_warning(lambda message: None)

_ARMS = ((LEFT_FINGERS, LEFT_ARM_LINKS), (RIGHT_FINGERS, RIGHT_ARM_LINKS))


class Stepper:
    """A world in the engine, stepped through commands as they come; it starts at the first command of `world`."""

    def __init__(self, world: World) -> None:
        self._model, self._owners = compile_world(world)
        self.world, self._data = world, mujoco.MjData(self._model)
        self._data.qpos[:] = initial_joints(world)
        mujoco.mj_forward(self._model, self._data)
        self._frames = [self._record()]

    @property
    def frame_count(self) -> int:
        """Number of frames so far."""
        return len(self._frames)

    def step(self, action: np.ndarray) -> None:
        """Step through canonical commands [t 16], of which the first is the one in force."""
        for targets in control_targets(self.world.robot, action):
            for target in targets:
                self._data.ctrl[:] = target
                mujoco.mj_step(self._model, self._data)
            self._frames.append(self._record())

    def motion(self) -> Motion:
        """The motion so far."""
        qpos, qvel, contact, penetration, overlap = (np.stack(parts) for parts in zip(*self._frames, strict=True))
        overflow = any(warning.number for warning in self._data.warning)
        return motion(self.world, qpos, qvel, contact, penetration, overlap.max(0), overflow)

    def _record(self) -> "Frame":
        return _record_frame(self._data, self._owners, len(self.world.scene.objects))


def simulate_one(world: World) -> Motion:
    """Step one world through its commands."""
    stepper = Stepper(world)
    stepper.step(world.action)
    return stepper.motion()


Frame = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Joint coordinates [40] and velocities [37] of the template [rad, m], contacts of fingers and objects [2 o] bool, penetration
of each object [o] m, and penetrations of an arm and the table and of the arms [2] m."""


def _record_frame(data: mujoco.MjData, owners: np.ndarray, objects: int) -> Frame:
    """The engine's current state; `owners` [s] int32 of all collision shapes."""
    distance = np.array(data.contact.dist) if data.ncon else np.zeros(0)
    pairs = np.sort(owners[data.contact.geom], axis=-1) if data.ncon else np.zeros((0, 2), int)
    touching = pairs[distance < 0]
    contact = np.zeros((2, objects), bool)
    held = touching[_is_either(touching[:, 0], (LEFT_FINGERS, RIGHT_FINGERS)) & (touching[:, 1] >= FIRST_OBJECT)]
    contact[held[:, 0], held[:, 1] - FIRST_OBJECT] = True
    penetration = np.zeros(objects)
    for column in (0, 1):
        deep = (pairs[:, column] >= FIRST_OBJECT) & (pairs[:, 0] != pairs[:, 1])
        np.maximum.at(penetration, pairs[deep, column] - FIRST_OBJECT, -distance[deep])
    left, right = (_is_either(pairs, arm) for arm in _ARMS)
    wrong = ((left | right).any(1) & (pairs == TABLE).any(1), left.any(1) & right.any(1))
    overlap = np.array([-distance[those].min(initial=0.0) for those in wrong])
    return data.qpos.copy(), data.qvel.copy(), contact, penetration, overlap


def _is_either(owners: np.ndarray, two: tuple[int, int]) -> np.ndarray:
    """Whether each of some owners [...] is one of two; for few of them much faster than `np.isin`."""
    return (owners == two[0]) | (owners == two[1])
