"""Yields: which seeds succeed, and the page of the tasks."""

from pathlib import Path

import pytest

from lab.seeds.yields import PARAGRAPHS, Args, attempt_batch, attempt_seeds, describe_task, markdown, page, task_section
from tests.sim_warp.small import SLOW, TASK, WITH_SLOW
from xew.config import ConfigError
from xew.episode import EpisodeError, Record
from xew.sim_warp.production.cells import Job
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.tasks import TASKS

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "tasks.md"


# --- The page and the table of yields.


@pytest.mark.parametrize("name", TASKS)
def test_the_page_tells_what_the_docstrings_tell(name: str) -> None:
    assert all(describe_task(TASKS[name]).get(part) for part in PARAGRAPHS)
    assert task_section(TASKS[name]) in PAGE.read_text(), (
        "write docs/reference/tasks.md anew: python -m lab.seeds.yields --seeds 50 --page docs/reference/tasks.md"
    )


def test_the_page_shows_at_least_80_percent_everywhere() -> None:
    rows = [line.split("|")[2:-2] for line in PAGE.read_text().splitlines() if line.startswith("| `") and "/50 (" in line]
    counts = [int(cell.split("/")[0]) for row in rows for cell in row]
    assert len(counts) == len(TASKS) * len(ROBOTS) and min(counts) >= 40


def test_the_table_of_yields_counts_right() -> None:
    def record(seed: int, robot: str, failure: str | None = None) -> Record:
        return Record("grab_roller", seed, robot, failure is None, failure, "because" if failure else "")

    records = [
        record(0, "piper"),
        record(1, "piper", "slip"),
        record(0, "arx_x5"),
        record(1, "arx_x5"),
        record(2, "arx_x5", "plan"),
    ]
    lines = markdown(records).splitlines()
    assert lines[0] == "| task | `arx_x5` | `piper` | all robots on the same seed |"
    assert lines[2] == "| `grab_roller` | 2/3 (67 %) | 1/2 (50 %) | 1/3 (33 %) |"
    assert lines[-1] == "| `grab_roller` | `piper` | 1 | slip | because |"


def test_yields_try_every_robot_and_write_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    jobs = [Job(TASK, seed, ("ur5_wsg", SLOW)) for seed in (0, 1)]
    records = [record for seed in attempt_batch(jobs, 1, WITH_SLOW) for record in seed]
    assert [(record.robot, record.success) for record in records] == [
        ("ur5_wsg", True), (SLOW, True), ("ur5_wsg", True), (SLOW, False),
    ]  # fmt: skip
    text = page(records, Args(tasks=(TASK,), robots=("ur5_wsg", SLOW), seeds=2))
    assert (
        f"| `{TASK}` | 2/2 (100 %) | 1/2 (50 %) | 1/2 (50 %) |" in text
        and "2 seeds from 0 of each task, in physics, on CPU:" in text
        and "python -m lab.seeds.yields --seeds 2 --page docs/reference/tasks.md`" in text
    )
    assert not list(tmp_path.iterdir())


def test_yields_of_nothing_or_of_the_unknown_are_refused() -> None:
    with pytest.raises(EpisodeError, match="nothing to try"):
        next(attempt_seeds(Args(seeds=0)))
    with pytest.raises(ConfigError, match="unknown robot 'ur5'"):
        next(attempt_seeds(Args(robots=("ur5",))))
    with pytest.raises(EpisodeError, match="1 robots and 20 seeds from -1; name"):
        next(attempt_seeds(Args(robots=("piper",), first_seed=-1)))
    with pytest.raises(ConfigError, match="--device cuda:99: not on this machine, which has cpu"):
        next(attempt_seeds(Args(device="cuda:99")))
