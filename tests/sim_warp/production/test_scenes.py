"""Scenes made in workers: simulated in shares, then written, and nothing rendered of a scene that one has failed."""

import pickle
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.sim_warp.small import CLOSE, SLOW, TASK, WITH_SLOW, InlineWorkers
from xew.episode import Record
from xew.sim_warp.production import cells as cells_module
from xew.sim_warp.production import produce
from xew.sim_warp.production.cells import Cell, Job
from xew.sim_warp.production.produce import Production, make_scenes, simulate_jobs

ROBOTS = ("franka_panda", SLOW)
PRODUCTION = Production(Path("nowhere"), WITH_SLOW)
CELL = {"task_name": TASK, "seed": 0, "robot_name": "piper", "failure": None}


def make(
    jobs: list[Job], monkeypatch: pytest.MonkeyPatch, production: Production = PRODUCTION
) -> tuple[list[tuple[list[Record], float]], list[tuple[Any, ...]]]:
    """What comes of some jobs, and the units of work in the order in which they were done; each takes a second."""
    done: list[tuple[Any, ...]] = []

    def simulate(share: list[Job], production: Production) -> tuple[list[list[Cell]], float]:
        done.extend(("simulate", job.seed, job.robots) for job in share)
        return simulate_jobs(share, replace(production, gpu_physics=False)), 1.0

    def write(cells: list[Cell], rejected: bool, production: Production) -> tuple[list[Record], float]:
        rejected = rejected or any(cell.failure for cell in cells)
        done.append(("write", cells[0].scene.seed, tuple(cell.robot_name for cell in cells), rejected))
        return [Record(cell.task_name, cell.scene.seed, cell.robot_name, cell.failure is None) for cell in cells], 1.0

    monkeypatch.setattr(produce, "_simulate", simulate)
    monkeypatch.setattr(produce, "_write", write)
    return list(make_scenes(cast(Any, InlineWorkers(1)), jobs, production)), done


def test_a_scene_is_written_as_soon_as_all_robots_are_simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    """The slow robot cannot do the odd seed, which is then rejected for the other one too."""
    made, done = make([Job(TASK, 0, ROBOTS), Job(TASK, 1, ROBOTS)], monkeypatch)
    assert [step[:2] for step in done] == [(kind, seed) for seed in (0, 1) for kind in ("simulate", "simulate", "write")]
    assert {step[2:] for step in done if step[0] == "simulate"} == {((robot,),) for robot in ROBOTS}
    assert [step[1:] for step in done if step[0] == "write"] == [(seed, ROBOTS, seed == 1) for seed in (0, 1)]
    assert [[(r.seed, r.robot, r.success) for r in records] for records, _ in made] == [
        [(0, "franka_panda", True), (0, SLOW, True)],
        [(1, "franka_panda", True), (1, SLOW, False)],
    ]
    assert [seconds for _, seconds in made] == [3, 3]


def test_scenes_are_simulated_before_the_renderer_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    monkeypatch.setattr(produce, "_simulate", lambda *_: order.append("simulate") or ([[SimpleNamespace(**CELL)]], 1.0))
    monkeypatch.setattr(produce, "_write", lambda *_: order.append("write") or ([Record(TASK, 0, "piper", True)], 1.0))
    pool = cast(Any, InlineWorkers(1))
    list(make_scenes(pool, [Job(TASK, 0, ("piper",))], PRODUCTION, lambda: order.append("wait")))
    assert order == ["simulate", "wait", "write"]


def test_a_scene_of_many_robots_is_written_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each worker holds the pictures of a few robots; what one robot fails is rejected in all parts."""
    monkeypatch.setattr(produce, "ROBOTS_TOGETHER", 1)
    made, done = make([Job(TASK, 0, ROBOTS), Job(TASK, 1, ROBOTS)], monkeypatch)
    assert [step[1:] for step in done if step[0] == "write"] == [
        (seed, (robot,), seed == 1) for seed in (0, 1) for robot in ROBOTS
    ]
    assert [[record.robot for record in records] for records, _ in made] == [list(ROBOTS)] * 2
    assert [seconds for _, seconds in made] == [4, 4]


def test_episodes_do_not_depend_on_the_parts_of_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = [Job(TASK, 0, ("piper", "franka_panda", "ur5_wsg"))]
    for together in (1, 2, 8):
        monkeypatch.setattr(produce, "ROBOTS_TOGETHER", together)
        list(make_scenes(cast(Any, InlineWorkers(1)), jobs, Production(tmp_path / str(together))))
    first, *others = (
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in sorted(tmp_path.iterdir())
    )
    assert len(first) > 9
    assert others == [first, first]


def test_what_a_robot_of_an_earlier_run_has_failed_stays_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    _, done = make([Job(TASK, 0, ROBOTS[:1], rejected=True)], monkeypatch)
    assert done[-1] == ("write", 0, ROBOTS[:1], True)


def test_a_gpu_gets_as_many_whole_scenes_as_it_steps_worlds() -> None:
    jobs = [Job(TASK, seed, ROBOTS) for seed in range(5)]
    batches = replace(PRODUCTION, gpu_physics=True, batch=8).shares(jobs)
    assert [[job.seed for job in share] for share in batches] == [[0, 1, 2, 3], [4]]
    assert (replace(PRODUCTION, gpu_physics=True).physics, PRODUCTION.physics) == (None, "cpu")


@pytest.mark.parametrize(
    ("scenes", "workers", "sizes"),
    [(1, 1, [1, 1]), (5, 1, [2, 2, 2, 2, 1, 1]), (5, 8, [1] * 10), (40, 1, [16, 16, 16, 16, 8, 8]), (40, 2, [10] * 8)],
)
def test_a_core_gets_one_robot_of_a_few_scenes(scenes: int, workers: int, sizes: list[int]) -> None:
    """There are at least four shares for each worker, so all end at about the same time."""
    jobs = [Job(TASK, seed, ROBOTS) for seed in range(scenes)]
    shares = PRODUCTION.shares(jobs, workers)
    assert [len(share) for share in shares] == sizes
    assert all(len({job.robots for job in share}) == 1 for share in shares)
    assert sorted((job.seed, *job.robots) for share in shares for job in share) == sorted(
        (job.seed, robot) for job in jobs for robot in ROBOTS
    )


def test_few_batches_are_in_flight_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes of a batch are written while the next ones are stepped, before the last batch begins."""
    jobs = [Job(TASK, 0, (robot,)) for robot in ROBOTS[:1]] + [Job(TASK, seed, ROBOTS[:1]) for seed in (2, 4, 6)]
    _, done = make(jobs, monkeypatch, replace(PRODUCTION, gpu_physics=True, batch=1))
    assert [step[:2] for step in done] == [(kind, seed) for seed in (0, 2, 4, 6) for kind in ("simulate", "write")]
    monkeypatch.setattr(produce, "BATCHES_PER_GPU", 2)
    handed: list[int] = []

    def run(function: Any, work: Any) -> Any:
        while work:
            handed.append(len(work))
            yield function(work.popleft())

    pool = cast(Any, SimpleNamespace(count=4, run=run))
    list(make_scenes(pool, jobs, replace(PRODUCTION, gpu_physics=True, batch=1)))
    assert max(handed) == 3, "two batches and a scene to write"


def test_a_cell_travels_without_its_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """A user's task may be of lambdas, which cannot be pickled; its name finds it on the other side."""
    with_lambda = replace(CLOSE, success=lambda scene, now: CLOSE.success(scene, now))
    monkeypatch.setattr(cells_module, "get_task", lambda name: with_lambda)
    ((cell,),) = simulate_jobs([Job(TASK, 0, ROBOTS[:1])], PRODUCTION)
    assert cell.failure is None
    again = pickle.loads(pickle.dumps(cell))
    assert again.task is with_lambda and again.failure is None
    assert (again.known_motion.joint_pos == cell.known_motion.joint_pos).all() and again.scene.names == cell.scene.names
