"""The command under way: stopped anywhere it ends in the same bytes, on several devices too, and its memory does not grow."""

import base64
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.metrics.quick import QUICK
from tests.metrics.small import write_many
from tests.synthetic import write_synthetic_data
from xew import files
from xew.dataset import find_accepted
from xew.episode import EpisodeError, read_video
from xew.metrics import evaluate
from xew.metrics.evaluate import Args, main
from xew.metrics.grading import grade_episodes, open_graders, settings, write_scores
from xew.metrics.grading.baselines import BASELINES
from xew.metrics.grading.grade_episodes import ThreadResources
from xew.metrics.grading.open_graders import PROCESSES, choose_processes, take_turns
from xew.rollout import write_rollout

ROOT = Path(__file__).parents[3]
ROBOTS = ("franka_panda", "piper")
SEEDS = tuple(range(1_000_000, 1_000_003))
METRICS = ("psnr", "mask_iou")
WRITTEN = ("parquet", "curves.parquet", "summary.md", "summary.csv", "pairs.csv", "power.csv", "bundle.json")
EPISODES = len(SEEDS) * len(ROBOTS)
CELLS = EPISODES * (1 + len(BASELINES))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes and a model that predicts noise."""
    root = tmp_path_factory.mktemp("world")
    write_synthetic_data(root / "data", tasks=("place_empty_cup",), seeds=SEEDS, robots=ROBOTS, frames=4)
    rng = np.random.default_rng(0)
    for folder, record in find_accepted(root / "data"):
        video = read_video(folder / "rgb.mkv")
        video[1:] //= rng.integers(1, 4, (len(video) - 1, 1, 1, 1), dtype=np.uint8)
        write_rollout(root / "rollouts", record.task, record.seed, record.robot, video, {"model": "dim"})
    return root


@pytest.fixture(autouse=True)
def no_baselines_are_kept(world: Path, whole: dict[str, bytes]) -> None:
    """Every test grades the baselines itself."""
    shutil.rmtree(world / "data-baselines")
    (world / "data-baselines").mkdir()


def arguments(world: Path, out: Path) -> Args:
    return Args((world / "rollouts",), world / "data", out, METRICS, masks=QUICK)


def read_all(out: Path) -> dict[str, bytes]:
    return {ending: out.with_suffix(f".{ending}").read_bytes() for ending in WRITTEN}


@pytest.fixture(scope="module")
def whole(world: Path) -> dict[str, bytes]:
    """What a run writes that nobody stops."""
    main(arguments(world, world / "whole" / "scores.parquet"))
    return read_all(world / "whole" / "scores.parquet")


def dying(function: Callable, at: int) -> Callable:
    """The function, which is stopped as by Ctrl-C at the call of this number."""
    calls = iter(range(1, 1 << 30))

    def dies(*args: object, **settings: object) -> object:
        if next(calls) == at:
            raise KeyboardInterrupt
        return function(*args, **settings)

    return dies


PLACES = [
    (grade_episodes, "grade", 1),
    (grade_episodes, "grade", 8),
    (files.os, "replace", 1),  # a cell that is written but does not have its name yet
    (files.os, "replace", 11),
    (files.os, "replace", CELLS + 1),  # the curves
    (files.os, "replace", CELLS + 2),  # the scores, whose curves are there
    (write_scores, "write_bundle", 1),
    (write_scores, "summarize_robots", 1),
]


@pytest.mark.parametrize(("module", "name", "at"), PLACES, ids=[f"{name}-{at}" for _, name, at in PLACES])
def test_stopped_anywhere_it_ends_in_the_same_bytes(
    module: object, name: str, at: int, world: Path, whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    args = arguments(world, tmp_path / "scores.parquet")
    with monkeypatch.context() as patch, pytest.raises(SystemExit, match="130"):
        patch.setattr(module, name, dying(getattr(module, name), at))
        main(args)
    main(args)
    assert read_all(args.out) == whole
    assert not list(tmp_path.glob(".*.partial"))


def test_killed_at_random_it_ends_in_the_same_bytes(world: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    out = tmp_path / "scores.parquet"
    command = [sys.executable, "-m", "xew.metrics.evaluate", world / "rollouts", "--data", world / "data", "--out", out]
    command += ["--metrics", *METRICS, "--masks", QUICK]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}  # the masker
    run = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wanted = random.randrange(1, CELLS - 2)
    deadline = time.monotonic() + 120
    while run.poll() is None and len(graded(out, world / "data")) < wanted and time.monotonic() < deadline:
        time.sleep(0.01)
    run.send_signal(signal.SIGKILL)
    run.wait()
    assert wanted <= len(graded(out, world / "data")) and not out.exists()
    main(arguments(world, out))
    assert read_all(out) == whole


def graded(out: Path, data: Path) -> list[Path]:
    """Files of graded videos: of models beside the table, of baselines beside the data."""
    folders = out.with_suffix(".cells"), data.with_name("data-baselines")
    return [path for folder in folders for path in folder.glob("*/*/*/[!.]*.json")]


def test_each_thread_has_estimators_of_its_own_and_a_network_serves_one_at_a_time() -> None:
    resources = ThreadResources(lambda: object(), lambda: object())
    maskers, overlaps, busy = [], [], []

    def slow(number: int) -> int:
        overlaps.append(bool(busy))
        busy.append(number)
        time.sleep(0.01)
        busy.remove(number)
        return number

    network = take_turns(slow)

    def work() -> None:
        maskers.append((resources.masker, resources.masker is resources.masker))
        network(threading.get_ident())

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({id(masker) for masker, _ in maskers}) == 4 and all(kept for _, kept in maskers)
    assert overlaps == [False] * 4


def test_a_second_run_grades_nothing_anew_and_metrics_come_beside_those_that_are_there(
    world: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[tuple[str, ...]] = []
    real = grade_episodes.grade

    def notes(comparison: object, metrics: tuple[str, ...]) -> object:
        asked.append(tuple(metrics))
        return real(comparison, metrics)

    monkeypatch.setattr(grade_episodes, "grade", notes)
    out = tmp_path / "scores.parquet"
    for metrics in (("psnr",), METRICS, METRICS):
        main(Args((world / "rollouts",), world / "data", out, metrics, masks=QUICK))
    assert asked == [("psnr",)] * CELLS + [("mask_iou",)] * CELLS
    assert read_all(out) == whole
    main(Args((world / "rollouts",), world / "data", out, METRICS, masks=QUICK, overwrite=True))
    assert len(asked) == 3 * CELLS and read_all(out) == whole


def test_baselines_are_graded_once_a_data_set(
    world: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    main(arguments(world, tmp_path / "first.parquet"))
    asked: list[object] = []
    real = grade_episodes.grade
    monkeypatch.setattr(grade_episodes, "grade", lambda comparison, metrics: asked.append(metrics) or real(comparison, metrics))
    main(arguments(world, tmp_path / "scores.parquet"))
    assert len(asked) == EPISODES
    assert read_all(tmp_path / "scores.parquet") == whole
    for i, choice in enumerate(({"allow": ("trim", "rate")}, {"allow": ("resize",), "keep_going": True}), 2):
        main(replace(arguments(world, tmp_path / f"scores{i}.parquet"), **choice))
        assert len(asked) == i * EPISODES, "what is allowed of videos changes no baseline"


def test_other_settings_are_graded_anew(world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "scores.parquet"
    main(Args((world / "rollouts",), world / "data", out, ("psnr",), baselines=False))
    before = out.read_bytes()
    monkeypatch.setattr(grade_episodes, "grade", lambda *_: pytest.fail("graded anew"))
    main(Args((world / "rollouts",), world / "data", out, ("psnr",), baselines=False))
    assert out.read_bytes() == before
    monkeypatch.setattr(settings, "GRADING_PROTOCOL", settings.GRADING_PROTOCOL + 1)
    with pytest.raises(pytest.fail.Exception, match="graded anew"):
        main(Args((world / "rollouts",), world / "data", out, ("psnr",), baselines=False))


def test_cells_of_earlier_versions_are_read(
    world: Path, whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their curves are lists of numbers, null where a frame has no value."""
    args = arguments(world, tmp_path / "scores.parquet")
    main(args)
    for path in graded(args.out, args.data):
        cell = json.loads(path.read_text())
        curves = {name: np.frombuffer(base64.b64decode(text), "<f4").tolist() for name, text in cell["curves"].items()}
        cell["curves"] = {name: [None if np.isnan(value) else value for value in curve] for name, curve in curves.items()}
        path.write_text(json.dumps(cell))
    monkeypatch.setattr(grade_episodes, "grade", lambda *_: pytest.fail("graded again"))
    main(args)
    assert read_all(args.out) == whole


def test_a_damaged_cell_is_graded_anew(world: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    args = arguments(world, tmp_path / "scores.parquet")
    main(args)
    first, *_, second = graded(args.out, args.data)
    first.write_text(first.read_text()[:100])
    second.write_text("[1, 2]")
    main(args)
    assert read_all(args.out) == whole


def test_processes_write_the_same_bytes_and_raise_mistakes(
    world: Path, whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PROCESSES, "2")
    several = arguments(world, tmp_path / "scores.parquet")
    main(several)
    assert read_all(several.out) == whole
    resolved = settings.resolve(replace(several, out=tmp_path / "other.parquet", metrics=("psnr",)))
    listing = evaluate.list_jobs(resolved, ())
    gone = [(replace(job, episode=tmp_path / "gone"), ("psnr",)) for job in listing.jobs[:2]]
    with pytest.raises(EpisodeError, match="gone"):
        list(evaluate.grade_groups(resolved, {}, [[job] for job in gone]))


@pytest.mark.parametrize("processes", ["1", "2"])
def test_progress_counts_videos_not_episodes(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processes: str
) -> None:
    monkeypatch.setenv(PROCESSES, processes)
    done: list[None] = []
    resolved = settings.resolve(arguments(world, tmp_path / "scores.parquet"))
    groups = grade_episodes.group_jobs(resolved, evaluate.list_jobs(resolved).jobs)
    results = evaluate.grade_groups(resolved, {}, groups, lambda: done.append(None))
    next(results)
    assert done, "before the last episode"
    assert len({episode for result in results for episode in result.episodes}) == EPISODES - 1 and len(done) == CELLS


@pytest.mark.parametrize(
    ("videos", "processes", "parts"),
    [
        ([5] * 2500, 48, [5] * 2500),
        ([15] * 84, 48, [9, 6] * 84),
        ([30], 8, [4] * 7 + [2]),
        ([1, 6], 2, [1, 4, 2]),
    ],
)
def test_few_episodes_with_many_videos_are_divided(videos: list[int], processes: int, parts: list[int]) -> None:
    groups = [[(None, (f"{i} {j}",)) for j in range(count)] for i, count in enumerate(videos)]
    divided = grade_episodes.split_groups(groups, processes)  # type: ignore[arg-type]
    assert list(map(len, divided)) == parts
    assert [job for part in divided for job in part] == [job for group in groups for job in group]


@pytest.mark.parametrize(
    ("cores", "free", "videos", "expected"),
    [
        (2, (), 600, 1),  # threads of this process
        (6, (), 600, 1),
        (16, (), 600, 16),
        (16, (), 20, 1),  # processes take longer to start
        (64, (), 600, 32),
        (16, (84.0,), 600, 9),  # by the memory of the GPU
        (16, (160.0,), 600, 12),
        (8, (160.0,), 600, 7),
        (32, (160.0, 44.0), 600, 8),  # there may be as many on either
        (16, (4.0,), 600, 1),
        (1, (160.0,), 600, 1),
    ],
)
def test_the_number_of_processes_follows_from_the_machine(
    cores: int, free: tuple[float, ...], videos: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(PROCESSES)
    monkeypatch.setattr(open_graders, "usable_cores", lambda: cores)
    monkeypatch.setattr(open_graders, "visible_gpus", lambda: tuple(map(str, range(len(free)))))
    monkeypatch.setattr(open_graders, "free_gpu_memory", lambda gpus: free)
    monkeypatch.setattr(open_graders.os, "sysconf", lambda name: {"SC_PAGE_SIZE": 4096}.get(name, 2**26))
    assert choose_processes(100, videos) == expected
    assert choose_processes(1, videos) == 1, "no more than there are episodes"


def test_memory_does_not_grow_with_the_number_of_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """160 episodes; what the process holds after 60 of them is what it holds after all, but for a few megabytes."""
    write_many(tmp_path, 160)
    held: list[float] = []
    real = grade_episodes.Grader.__call__

    def notes(*args: object, **settings: object) -> object:
        held.append(resident())
        return real(*args, **settings)

    monkeypatch.setattr(grade_episodes.Grader, "__call__", notes)
    args = Args((tmp_path / "rollouts",), tmp_path / "data", tmp_path / "scores.parquet", ("psnr", "mask_iou"))
    main(args)
    assert len(held) == 160 and len(graded(args.out, args.data)) == 640, "with three baselines: there is no other robot"
    assert np.median(held[-30:]) - np.median(held[60:90]) < 4, "megabytes: 40 kB an episode"
    assert resident() - held[-1] < 100, "megabytes, for the tables"


def resident() -> float:
    """Megabytes that this process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
