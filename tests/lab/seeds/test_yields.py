"""The page of yields: what it takes from docstrings, and how it counts; without physics."""

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from lab.power import HEADING as POWER
from lab.seeds.yields import YIELDS, Args, describe_task, find_kept, markdown, page, task_section, write_page
from tests.sim_warp.small import CLOSE, TASK, plan, success
from xew.episode import EpisodeError, Record
from xew.sim_warp.scene import Scene
from xew.sim_warp.tasks import Task

SEEN = "## How much of robots and objects is seen"
"""Heading of another section of the page."""


def record(seed: int, robot: str, failure: str | None = None, task: str = "grab_roller") -> Record:
    return Record(task, seed, robot, failure is None, failure, "because" if failure else "", device="CPU")


@pytest.fixture
def documented(monkeypatch: pytest.MonkeyPatch) -> Task:
    """A task of a module with a docstring of its own."""
    module = ModuleType("documented_task")
    module.__doc__ = """A title that is left out.

    Task: put the cube
      on the plate.
    Success: it lies there,
      and the hand is open.
    After the plate is full, nothing more happens.
    """
    monkeypatch.setitem(sys.modules, module.__name__, module)

    def sample(rng: np.random.Generator, seed: int) -> Scene:
        raise AssertionError("describing samples no scene")

    sample.__module__ = module.__name__
    return Task("documented", "put the {color} cube on the plate", sample, plan, success)


def test_paragraphs_are_found_by_their_first_word(documented: Task) -> None:
    assert describe_task(documented) == {
        "Task": "put the cube on the plate.",
        "Success": "it lies there, and the hand is open.",
        "After": "After the plate is full, nothing more happens.",
    }


def test_a_task_without_paragraphs_has_a_section_without_them() -> None:
    assert describe_task(CLOSE) == {}
    assert task_section(CLOSE) == "### `close`\n\n| Instruction | close both hands |\n|---|---|"


def test_a_section_lists_what_the_docstring_has(documented: Task) -> None:
    lines = task_section(documented).splitlines()
    assert lines[:3] == ["### `documented`", "", "| Instruction | put the {color} cube on the plate |"]
    assert lines[4:6] == ["| Task | put the cube on the plate. |", "| Success | it lies there, and the hand is open. |"]
    assert lines[-1].startswith("| Source | After the plate"), "the source comes last"


def test_tasks_are_lines_and_robots_columns_in_the_order_of_the_registry() -> None:
    records = [record(0, "piper", task="open_laptop"), record(0, "mine"), record(0, "aloha_agilex"), record(0, "piper")]
    lines = markdown(records).splitlines()
    assert lines[0] == "| task | `aloha_agilex` | `piper` | `mine` | all robots on the same seed |"
    assert lines[1] == "| " + " | ".join(["---"] * 5) + " |"
    assert lines[2].startswith("| `grab_roller` | 1/1 (100 %) | 1/1 (100 %) | 1/1 (100 %) |")
    assert lines[3] == "| `open_laptop` | – | 1/1 (100 %) | – | 1/1 (100 %) |"
    assert lines[4] == "| **all tasks** | 1/1 (100 %) | 2/2 (100 %) | 1/1 (100 %) | 2/2 (100 %) |"
    assert lines[-1] == "Nothing failed."


def test_a_seed_counts_for_all_only_if_every_robot_succeeds_on_it() -> None:
    records = [record(seed, robot) for seed in range(3) for robot in ("piper", "ur5_wsg")]
    records[3] = record(1, "ur5_wsg", "slip")
    lines = markdown(records).splitlines()
    assert lines[2].endswith("| 2/3 (67 %) | 3/3 (100 %) | 2/3 (67 %) |")


def test_failures_are_listed_by_task_robot_and_seed() -> None:
    failed = [record(4, "piper", "slip"), record(2, "piper", "grasp"), record(9, "arx_x5", "plan")]
    lines = markdown([record(0, "piper"), *failed]).splitlines()
    assert lines[-5:] == [
        "| task | robot | seed | failure | detail |",
        "|---|---|---|---|---|",
        "| `grab_roller` | `arx_x5` | 9 | plan | because |",
        "| `grab_roller` | `piper` | 2 | grasp | because |",
        "| `grab_roller` | `piper` | 4 | slip | because |",
    ]


def test_the_page_says_by_which_command_it_is_made() -> None:
    args = Args(tasks=(TASK,), robots=("piper",), seeds=7, first_seed=30)
    text = page([record(30, "piper", task=TASK)], args)
    assert "`python -m lab.seeds.yields --seeds 7 --first-seed 30 --page docs/reference/tasks.md`" in text
    assert "7 seeds from 30 of each task, in physics, on CPU:" in text
    assert text.index("### `close`") < text.index("## How often the experts succeed") < text.index("| **all tasks**")


def test_a_page_is_written_with_its_folder_or_the_option_is_named(tmp_path: Path) -> None:
    write_page(tmp_path / "new" / "tasks.md", "text")
    assert (tmp_path / "new" / "tasks.md").read_text() == "text"
    measured = "\n## How much is seen\nof surfaces\n\n## What the metrics can tell\nof metrics\n"
    write_page(tmp_path / "tasks.md", f"# Tasks\nold\n\n{YIELDS}\nold, too\n" + measured)
    assert find_kept(tmp_path / "tasks.md") == measured and find_kept(tmp_path / "new" / "tasks.md") == ""
    kept = find_kept(Path(__file__).parents[3] / "docs" / "reference" / "tasks.md")
    assert [line for line in kept.splitlines() if line.startswith("## ")] == [SEEN, POWER], "the page keeps what others write"
    assert find_kept(tmp_path / "none.md") == ""
    with pytest.raises(EpisodeError, match="Choose another file with --page"):
        write_page(tmp_path / "new", "text")
