"""Compilation of Warp's kernels before the first job, if a machine has none: each part of the work runs its smallest job.

Each part runs in a separate process, because Warp compiles products of small matrices one at a time per process.
"""

import sys
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import warp as wp
from tqdm import tqdm

from xew.sim_warp.devices.kernels import has_kernels
from xew.sim_warp.devices.workers import Workers
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.kinematics.forward import tool_pose
from xew.sim_warp.kinematics.inverse import arm_solver
from xew.sim_warp.physics import World, simulate
from xew.sim_warp.rendering.observe import Recording, observe
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.rendering.streams import home_action
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.scene import scene_rng
from xew.sim_warp.tasks import TASKS

PARTS = {
    "physics": "newton._src.solvers.mujoco.kernels",
    "kinematics": "_lm_solve_tiled",
    "rendering": "xew.sim_warp.rendering.shading_kernels",
}
"""Parts of the work, by decreasing compile time on a GPU, and a module of kernels that each needs."""
ROBOT, TASK = "franka_panda", "open_laptop"
"""Robot and task of the smallest jobs; kernels serve all robots and tasks."""


def compile_on_devices(workers: Workers, devices: Mapping[str, str], batch: int, later: str = "") -> Callable[[], object]:
    """Compile the missing kernels of some of PARTS, each in a worker. Returns the function that waits for the part `later`.

    Args:
        workers: processes.
        devices: device of each part, by Warp's name.
        batch: number of worlds that a GPU steps together; its kernels depend on it.
        later: a part whose compilation may go on while others begin to work.
    """
    missing = [item for item in devices.items() if not has_kernels(wp.get_device(item[1]), PARTS[item[0]])]
    if not missing:
        return lambda: None
    print(f"Warp compiles its kernels once, into {wp.config.kernel_cache_dir}")
    compile_part = partial(_compile_part, batch=batch)
    going_on = [workers.start(compile_part, item) for item in missing if item[0] == later]
    first = [item for item in missing if item[0] != later]
    for _ in tqdm(workers.run(compile_part, first), desc="compiling kernels", unit="part", total=len(first)):
        pass
    return lambda: [wait() for wait in going_on]


def _compile_part(part_and_device: tuple[str, str], batch: int) -> None:
    do_smallest_piece(*part_and_device, batch)


def do_smallest_piece(part: str, device: str, batch: int) -> None:
    """Run the smallest job of one of PARTS, with all of its kernels."""
    robot = ROBOTS[ROBOT]
    {"physics": _simulate, "kinematics": _solve, "rendering": _render}[part](robot, wp.get_device(device), batch)


def _solve(robot: RobotSpec, device: wp.Device, batch: int) -> None:
    home = np.array([robot.arms[0].home])
    arm_solver(robot, device.alias).solve(0, tool_pose(robot, 0, home), home)


def standing_world(robot: RobotSpec) -> World:
    return World(robot, TASKS[TASK].sample(scene_rng(TASK, 0), 0), stand_at_home(robot, 2))


def _simulate(robot: RobotSpec, device: wp.Device, batch: int) -> None:
    world = standing_world(robot)
    if not device.is_cuda:
        simulate([world], device.alias)
        return
    from xew.sim_warp.physics.gpu import Batch  # slow to import, needed on a GPU only

    worlds = Batch([world] * batch, device)
    try:
        worlds.compile()
    except Exception as error:  # then `run` compiles the kernels one by one
        print(f"kernels of physics are compiled one after another ({type(error).__name__}: {error})", file=sys.stderr)
    worlds.run()


def _render(robot: RobotSpec, device: wp.Device, batch: int) -> None:
    observe(Renderer(device.alias), [Recording(robot, stand_at_home(robot, 1))])


def stand_at_home(robot: RobotSpec, frames: int) -> np.ndarray:
    """[t 16] float32 commands to stand at home with open grippers."""
    return np.tile(home_action(robot).astype(np.float32), (frames, 1))
