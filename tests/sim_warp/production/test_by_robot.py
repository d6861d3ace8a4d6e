"""Scenes made robot by robot: simulated, then written, in what order, and nothing rendered of a scene that one has failed."""

import pickle
from dataclasses import replace
from typing import Any, cast

import pytest

from tests.sim_warp.small import CLOSE, SLOW, TASK, WITH_SLOW, InlineWorkers
from xew.episode import Record
from xew.sim_warp.production import cells as cells_module
from xew.sim_warp.production.by_robot import Timed, make_by_robot
from xew.sim_warp.production.cells import Cell, Job
from xew.sim_warp.production.produce import simulate_jobs
from xew.sim_warp.robots import RobotSpec

ROBOTS = ("franka_panda", SLOW)


def make(jobs: list[Job]) -> tuple[list[tuple[list[Record], float]], list[tuple[Any, ...]]]:
    """What comes of some jobs, and the shares of them in the order in which they were done; a share takes a second."""
    done: list[tuple[Any, ...]] = []

    def simulate(job: Job, robot: RobotSpec) -> Timed:
        ((cell,),) = simulate_jobs([job], "cpu", robots={job.robots[0]: robot})
        done.append(("simulate", job.seed, job.robots))
        return cell, 1.0

    def write(cell: Cell, rejected: bool) -> Timed:
        done.append(("write", cell.scene.seed, cell.robot_name, rejected))
        return Record(cell.task_name, cell.scene.seed, cell.robot_name, cell.failure is None), 1.0

    return list(make_by_robot(cast(Any, InlineWorkers(1)), jobs, WITH_SLOW, simulate, write)), done


def test_a_scene_is_written_as_soon_as_all_robots_are_simulated() -> None:
    """The slow robot cannot do the odd seed, which is then rejected for the other one too."""
    made, done = make([Job(TASK, 0, ROBOTS), Job(TASK, 1, ROBOTS)])
    assert [step[:2] for step in done] == [(kind, seed) for seed in (0, 1) for kind in ("simulate", "write") for _ in ROBOTS]
    assert {step[2:] for step in done if step[0] == "simulate"} == {((robot,),) for robot in ROBOTS}
    assert {step[1:] for step in done if step[0] == "write"} == {
        (seed, robot, seed == 1) for seed in (0, 1) for robot in ROBOTS
    }
    assert [[(r.seed, r.robot, r.success) for r in records] for records, _ in made] == [
        [(0, "franka_panda", True), (0, SLOW, True)],
        [(1, "franka_panda", True), (1, SLOW, False)],
    ]
    assert [seconds for _, seconds in made] == [4, 4]


def test_what_a_robot_of_an_earlier_run_has_failed_stays_rejected() -> None:
    _, done = make([Job(TASK, 0, ROBOTS[:1], rejected=True)])
    assert done[-1] == ("write", 0, "franka_panda", True)


def test_a_cell_travels_without_its_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """A user's task may be of lambdas, which cannot be pickled; its name finds it on the other side."""
    with_lambda = replace(CLOSE, success=lambda scene, now: CLOSE.success(scene, now))
    monkeypatch.setattr(cells_module, "get_task", lambda name: with_lambda)
    ((cell,),) = simulate_jobs([Job(TASK, 0, ROBOTS[:1])], "cpu", robots=WITH_SLOW)
    assert cell.failure is None
    again = pickle.loads(pickle.dumps(cell))
    assert again.task is with_lambda and "failure" in vars(again), "what is known of it is not found again"
    assert (again.known_motion.joint_pos == cell.known_motion.joint_pos).all() and again.scene.names == cell.scene.names
