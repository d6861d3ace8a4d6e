"""The command under way: stopped anywhere it ends in the same bytes, on several devices too, and its memory does not grow."""

import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
import types
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.commands import on_devices
from tests.metrics.quick import QUICK
from tests.metrics.small import write_many
from tests.synthetic import write_synthetic_data
from xew import files
from xew.dataset import find_accepted
from xew.episode import EpisodeError, read_video
from xew.metrics import evaluate
from xew.metrics.evaluate import Args, main
from xew.metrics.grading import grader, outcome
from xew.metrics.grading.baselines import BASELINES
from xew.metrics.grading.workers import Bench
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
    return Args((world / "rollouts",), world / "data", out, METRICS, masks=QUICK, workers=2)


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
    (grader, "grade", 1),
    (grader, "grade", 8),
    (files.os, "replace", 1),  # a cell that is written but does not have its name yet
    (files.os, "replace", 11),
    (files.os, "replace", CELLS + 1),  # the curves
    (files.os, "replace", CELLS + 2),  # the scores, whose curves are there
    (outcome, "write_bundle", 1),
    (outcome, "summarize", 1),
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


def test_killed_at_random_on_two_devices_it_ends_in_the_same_bytes(
    world: Path, whole: dict[str, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "scores.parquet"
    command = [sys.executable, "-m", "xew.metrics.evaluate", world / "rollouts", "--data", world / "data", "--out", out]
    command += ["--metrics", *METRICS, "--masks", QUICK, "--workers", "2"]
    environment = os.environ | on_devices(2)
    environment["PYTHONPATH"] = str(ROOT)  # the masker
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


def test_workers_are_shared_out_to_the_devices() -> None:
    """Each thread takes the next device; one that has an estimator of its own keeps it."""
    first, second = (types.SimpleNamespace(local_hardware_id=number) for number in range(2))
    bench = Bench(lambda _: object(), lambda _: object(), iter([first, second, first]))  # who opens it takes one too
    found = []
    threads = [threading.Thread(target=lambda: found.append((bench.device, bench.masker is bench.masker))) for _ in range(2)]
    for thread in threads:
        thread.start()
        thread.join()
    assert [kept for _, kept in found] == [True, True] and {device.local_hardware_id for device, _ in found} == {0, 1}


SHARING = """
import threading, time
from pathlib import Path
import jax
from xew.metrics.backends import Backend
from xew.metrics.grading.workers import make_opener

opened, busy, overlaps = [], set(), []

def open_network(name, checkpoint):
    number = len(opened)
    opened.append(jax.numpy.zeros(1).devices())
    def call():
        overlaps.append(number in busy)
        busy.add(number)
        time.sleep(0.01)
        busy.discard(number)
        return number
    return call

network = make_opener("mine", {"mine": Backend(open_network, "weights", "")}, open_network, Path("x"))
found = []

def work(device):
    for _ in range(3):
        found.append((device.id, network(device)()))

threads = [threading.Thread(target=work, args=(device,)) for device in (*jax.devices(), *jax.devices())]
for thread in threads: thread.start()
for thread in threads: thread.join()
assert len(opened) == 2 and opened[0] != opened[1] and len(found) == 12 and len(set(found)) == 2, (opened, found)
assert not any(overlaps)
"""


def test_a_network_is_opened_once_on_each_device_and_used_in_turn() -> None:
    environment = os.environ | on_devices(2)
    run = subprocess.run([sys.executable, "-c", SHARING], env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr


def test_a_second_run_grades_nothing_anew_and_metrics_come_beside_those_that_are_there(
    world: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[tuple[str, ...]] = []
    real = grader.grade

    def notes(comparison: object, metrics: tuple[str, ...]) -> object:
        asked.append(tuple(metrics))
        return real(comparison, metrics)

    monkeypatch.setattr(grader, "grade", notes)
    out = tmp_path / "scores.parquet"
    for metrics in (("psnr",), METRICS, METRICS):
        main(Args((world / "rollouts",), world / "data", out, metrics, masks=QUICK, workers=1))
    assert asked == [("psnr",)] * CELLS + [("mask_iou",)] * CELLS
    assert read_all(out) == whole
    main(Args((world / "rollouts",), world / "data", out, METRICS, masks=QUICK, workers=1, overwrite=True))
    assert len(asked) == 3 * CELLS and read_all(out) == whole


def test_baselines_are_graded_once_a_data_set(
    world: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    main(arguments(world, tmp_path / "first.parquet"))
    asked: list[object] = []
    real = grader.grade
    monkeypatch.setattr(grader, "grade", lambda comparison, metrics: asked.append(metrics) or real(comparison, metrics))
    main(arguments(world, tmp_path / "scores.parquet"))
    assert len(asked) == EPISODES
    assert read_all(tmp_path / "scores.parquet") == whole


def test_other_settings_are_graded_anew(world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "scores.parquet"
    main(Args((world / "rollouts",), world / "data", out, ("psnr",), baselines=False))
    before = out.read_bytes()
    monkeypatch.setattr(grader, "grade", lambda *_: pytest.fail("graded anew"))
    main(Args((world / "rollouts",), world / "data", out, ("psnr",), baselines=False))
    assert out.read_bytes() == before
    monkeypatch.setattr(evaluate, "GRADING_PROTOCOL", evaluate.GRADING_PROTOCOL + 1)
    with pytest.raises(pytest.fail.Exception, match="graded anew"):
        main(Args((world / "rollouts",), world / "data", out, ("psnr",), baselines=False))


def test_a_damaged_cell_is_graded_anew(world: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    args = arguments(world, tmp_path / "scores.parquet")
    main(args)
    first, *_, second = graded(args.out, args.data)
    first.write_text(first.read_text()[:100])
    second.write_text("[1, 2]")
    main(args)
    assert read_all(args.out) == whole


def test_processes_write_the_same_bytes_and_tell_mistakes(world: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    several = replace(arguments(world, tmp_path / "scores.parquet"), processes=2)
    main(several)
    assert read_all(several.out) == whole
    jobs = evaluate.find_jobs(several, ())
    gone = [(replace(job, episode=tmp_path / "gone"), ("psnr",)) for job in jobs[:2]]
    store = evaluate.CellStore(tmp_path / "cells", tmp_path / "baselines")
    with evaluate.open_graders(several, ("psnr",), store) as (_, grade_groups), pytest.raises(EpisodeError, match="gone"):
        list(grade_groups([[job] for job in gone]))


def test_processes_begin_before_the_jobs_are_known_where_there_is_no_table(
    world: Path, whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where there is one, they begin with what is to be graded, and not at all where that is nothing."""
    events: list[str | int] = []
    begin, find = evaluate.call_in_processes, evaluate.find_jobs
    monkeypatch.setattr(evaluate, "call_in_processes", lambda *given: events.append(given[1]) or begin(*given))
    monkeypatch.setattr(evaluate, "find_jobs", lambda *given: events.append("list") or find(*given))
    args = replace(arguments(world, tmp_path / "scores.parquet"), processes=EPISODES + 2)
    main(args)
    assert events == [EPISODES, "list"], "no more of them than there are episodes"
    events.clear()
    main(args)
    assert events == ["list"]
    for cell in sorted(args.out.with_suffix(".cells").glob("*/*/*/*.json"))[:2]:
        cell.unlink()  # the model's, of two episodes
    events.clear()
    main(args)
    assert events == ["list", 2] and read_all(args.out) == whole


def test_memory_does_not_grow_with_the_number_of_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """160 episodes; what the process holds after 60 of them is what it holds after all, but for a few megabytes."""
    write_many(tmp_path, 160)
    held: list[float] = []
    real = grader.Grader.__call__

    def notes(*args: object, **settings: object) -> object:
        held.append(resident())
        return real(*args, **settings)

    monkeypatch.setattr(grader.Grader, "__call__", notes)
    args = Args((tmp_path / "rollouts",), tmp_path / "data", tmp_path / "scores.parquet", ("psnr", "mask_iou"), workers=2)
    main(args)
    assert len(held) == 160 and len(graded(args.out, args.data)) == 640, "with three baselines: there is no other robot"
    assert np.median(held[-30:]) - np.median(held[60:90]) < 4, "megabytes: 40 kB an episode"
    assert resident() - held[-1] < 100, "megabytes, for the tables"


def resident() -> float:
    """Megabytes that this process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
