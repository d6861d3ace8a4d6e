"""Physics on a GPU: MuJoCo Warp steps all worlds of a batch together, with one CUDA graph per stored frame.

The same code runs on Warp's CPU device, slowly, for tests without a GPU.
"""

from collections.abc import Sequence

import mujoco_warp as mjw
import numpy as np
import warp as wp

from xew.protocol import FRAME_RATE
from xew.sim_warp.devices.kernels import Variant, compile_together, noted_launches
from xew.sim_warp.devices.waiting import wait_for
from xew.sim_warp.physics.kernels import advance_frame, record_contacts, record_joints, set_targets
from xew.sim_warp.physics.worlds import (
    ROBOT_DOFS,
    STEPS_PER_FRAME,
    TABLE,
    TIME_STEP,
    Motion,
    World,
    build_solver,
    initial_joints,
    motion,
    shape_owners,
    template_joints,
)

CONTACTS_PER_WORLD = 160
CONSTRAINTS_PER_WORLD = 768
"""Initial sizes of MuJoCo Warp's buffers, doubled for worlds that overflow."""
ATTEMPTS = 3
"""Largest number of attempts per world."""
SOLVER_LIMITS = mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS
"""Overflow flags that lose no contact: the solver used all of its iterations."""


def simulate_batch(worlds: Sequence[World], device: str | None = None, batch: int | None = None) -> list[Motion]:
    """Step worlds `batch` at a time (None: all together), and worlds whose buffers overflow again with larger ones.

    Kernels are compiled for a number of worlds: the last batch is filled up with copies, which are discarded.
    """
    size = batch or len(worlds)
    motions: dict[int, Motion] = {}
    todo = sorted(range(len(worlds)), key=lambda index: len(worlds[index].action))
    for attempt in range(ATTEMPTS):
        for start in range(0, len(todo), size):
            chunk = todo[start : start + size]
            filled = [worlds[index] for index in chunk] + [worlds[chunk[0]]] * (size - len(chunk))
            motions |= dict(zip(chunk, Batch(filled, wp.get_device(device), 2**attempt).run(), strict=False))
        todo = [index for index in todo if motions[index].overflow]
    return [motions[index] for index in range(len(worlds))]


class Batch:
    """Worlds on the device, with their recorded states."""

    def __init__(self, worlds: Sequence[World], device: wp.Device, scale: int = 1) -> None:
        self.worlds, self.device = worlds, device
        self.solver = build_solver(
            list(worlds), device, nconmax=scale * CONTACTS_PER_WORLD, njmax=scale * CONSTRAINTS_PER_WORLD
        )
        self.model, self.data = self.solver.mjw_model, self.solver.mjw_data
        self.model.opt.timestep.fill_(TIME_STEP)
        self.model.opt.warn_overflow = 0  # overflowing worlds are stepped again, or reported in `Motion.overflow`
        self.frame_count = max(len(world.action) for world in worlds)
        self.joints = self._array(np.stack([self._joints(world) for world in worlds]))
        self.owners = self._array(self._geom_owners(), wp.int32)
        self.frame = self._array(np.zeros(1), wp.int32)
        self.data.qpos.assign(np.stack([initial_joints(world) for world in worlds]).astype(np.float32))
        self.data.qvel.zero_()
        self.data.overflow.zero_()
        shape = (len(worlds), self.frame_count)
        self.qpos = self._array(np.zeros((*shape, self.data.qpos.shape[1])))
        self.qvel = self._array(np.zeros((*shape, self.data.qvel.shape[1])))
        self.contact = self._array(np.zeros((*shape, 2)), wp.int32)
        objects = max(len(world.scene.objects) for world in worlds)
        self.penetration = self._array(np.zeros((*shape, objects)))
        self.overlap = self._array(np.zeros((len(worlds), 2)))

    def compile(self) -> None:
        """Compile all kernels of `run` in parallel."""
        compile_together(self.list_kernels(), self.device)

    def list_kernels(self) -> list[Variant]:
        """The kernels that `run` launches."""
        with wp.ScopedDevice(self.device), noted_launches() as variants:
            self._begin()
            self._step_frame()
        return list(variants)

    def run(self) -> list[Motion]:
        """Step all worlds from their first command to the last of the longest."""
        with wp.ScopedDevice(self.device):
            self._begin()
            graph = None
            if self.device.is_cuda:
                with wp.ScopedCapture(self.device) as capture:
                    self._step_frame()
                graph = capture.graph
            for _ in range(self.frame_count - 1):
                wp.capture_launch(graph) if graph else self._step_frame()
        wait_for(self.device)
        return self._motions()

    def _begin(self) -> None:
        mjw.forward(self.model, self.data)
        self._record()

    def _step_frame(self) -> None:
        for step in range(STEPS_PER_FRAME):
            wp.launch(
                set_targets,
                (len(self.worlds), ROBOT_DOFS),
                [self.joints, self.frame, (step + 1) / STEPS_PER_FRAME, FRAME_RATE],
                [self.data.ctrl],
            )
            mjw.step(self.model, self.data)
        wp.launch(advance_frame, 1, [self.frame], [self.frame])
        self._record()

    def _record(self) -> None:
        data, contacts = self.data, self.data.contact
        width = max(data.qpos.shape[1], data.qvel.shape[1])
        wp.launch(record_joints, (len(self.worlds), width), [data.qpos, data.qvel, self.frame], [self.qpos, self.qvel])
        wp.launch(
            record_contacts,
            data.naconmax,
            [data.nacon, contacts.geom, contacts.worldid, contacts.dist, self.owners, self.frame],
            [self.contact, self.penetration, self.overlap],
        )

    def _motions(self) -> list[Motion]:
        qpos, qvel, contact = self.qpos.numpy(), self.qvel.numpy(), self.contact.numpy()
        penetration = self.penetration.numpy()
        overlap, overflow = self.overlap.numpy(), self.data.overflow.numpy() & ~int(SOLVER_LIMITS)
        motions = []
        for index, world in enumerate(self.worlds):
            frames = slice(len(world.action))
            objects = len(world.scene.objects)
            touched = (contact[index, frames, :, None] >> np.arange(objects)) & 1
            sunk = penetration[index, frames, :objects]
            parts = (qpos[index, frames], qvel[index, frames], touched.astype(bool), sunk)
            motions.append(motion(world, *parts, overlap[index], bool(overflow[index])))
        return motions

    def _joints(self, world: World) -> np.ndarray:
        """[t 18] commanded joints, extended at the last command."""
        joints = template_joints(world.robot, world.action)
        return np.concatenate([joints, np.repeat(joints[-1:], self.frame_count - len(joints), 0)])

    def _geom_owners(self) -> np.ndarray:
        labels = np.array([*shape_owners(self.solver.model.shape_label), TABLE])
        return labels[self.solver.mjc_geom_to_newton_shape.numpy()]

    def _array(self, values: np.ndarray, dtype: type = wp.float32) -> wp.array:
        return wp.array(values, dtype=dtype, device=self.device)
