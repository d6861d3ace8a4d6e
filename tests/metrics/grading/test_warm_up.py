"""What is compiled before the first video: what grading needs, once."""

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from tests.metrics.grading.graded import ASKED
from xew.metrics import METRICS, lpips_embedding
from xew.metrics.episode_cache import EpisodeCache
from xew.metrics.estimators.batched import compiling
from xew.metrics.grade import Comparison, grade
from xew.metrics.grading import list_jobs, open_graders, warm_up
from xew.metrics.grading.codecs import ModelCodec
from xew.metrics.grading.settings import Args, GradingSettings, resolve
from xew.metrics.grading.warm_up import CodecPrograms, Kernels, Programs
from xew.metrics.outcome.variants import instants
from xew.metrics.truth import Truth
from xew.protocol import CODEC_TRUTH

COMPILED = "/jax/core/compile/backend_compile_duration"


@pytest.fixture
def resolved(rollouts: Path, data: Path, tmp_path: Path) -> GradingSettings:
    return resolve(Args((rollouts,), data, tmp_path / "scores.parquet"))


@pytest.fixture
def jobs(resolved: GradingSettings, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[list_jobs.Job]:
    """Jobs on a machine with an H100 and empty caches."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(compiling, "gpu_names", lambda: ["NVIDIA H100"])
    monkeypatch.setattr(compiling, "missing_kernels", lambda modules: list(dict.fromkeys(modules)))
    return list(list_jobs.list_jobs(resolved).jobs)


def test_programs_are_those_of_all_videos_that_are_filled_up_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm_up, "is_on_cpu", lambda: False)
    frames, shape = 50, (64, 40, 48)
    metrics = tuple(name for name, metric in METRICS.items() if metric.inputs != "track")
    Programs(metrics, (shape,)).compile()
    compiled: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: compiled.append(event))
    rng = np.random.default_rng(1)
    video, prediction = rng.integers(0, 256, (2, frames, *shape[1:], 3), np.uint8)
    mask, nothing = np.zeros((frames, *shape[1:]), bool), np.zeros((frames, 0, 2), np.float32)
    mask[:, 3:36, 5:40] = True
    truth = Truth(video, mask, nothing, nothing[..., 0] > 0, nothing, nothing[..., 0] > 0)
    graded = grade(Comparison(prediction, EpisodeCache(truth, 0), lambda *_: ~mask, lambda *_: nothing), metrics)
    assert graded.values.keys() == set(metrics) and 0 < graded.values["region_lpips"] < 1
    lpips_embedding(prediction[instants(frames)], mask[instants(frames)])
    assert compiled.count(COMPILED) == 0


def test_parts_cover_the_metrics_of_frames_and_the_estimators(resolved: GradingSettings, jobs: list[list_jobs.Job]) -> None:
    parts = warm_up.missing_parts(resolved, jobs, {})
    programs = [part for part in parts if isinstance(part, Programs)]
    assert sorted(name for part in programs for name in part.metrics) == sorted(
        name for name in resolved.metrics if METRICS[name].inputs != "track"
    )
    assert {part.shapes for part in programs} == {((64, 240, 320),)} and ASKED < 64
    assert {part.module for part in parts if isinstance(part, Kernels)} == compiling.THREADS.keys()


@pytest.mark.parametrize(
    ("chosen", "modules"),
    [
        ({"metrics": ("psnr", "lpips")}, ()),
        ({"metrics": ("mask_iou",)}, (*compiling.OF_SURFACES, *compiling.OF_MASKS)),
        ({"metrics": ("pck",)}, compiling.OF_TRACKS),
        ({"masks": "opencv", "tracks": "opencv"}, compiling.OF_SURFACES),
    ],
)
def test_only_kernels_that_are_used(chosen: dict[str, Any], modules: tuple[str, ...], resolved: GradingSettings) -> None:
    settings = resolve(replace(resolved.args, **chosen))
    assert sorted(set(warm_up.list_kernels(settings))) == sorted(modules)


def test_parts_are_compiled_once(
    resolved: GradingSettings, jobs: list[list_jobs.Job], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    done: list[object] = []

    def compile_here(opener: Callable[[], object], parts: list[object], *_: object) -> list[object]:
        done.extend(parts)
        return parts

    monkeypatch.setattr(open_graders, "map_in_processes", compile_here)
    start = functools.partial(open_graders.warm_up, resolved, codecs=CODECS, gpus=("0",))
    start(jobs)
    assert len(done) == 10 and "compiled once on this machine, in 10 parts" in capsys.readouterr().out
    monkeypatch.setattr(compiling, "missing_kernels", lambda modules: [])
    start(jobs)
    assert len(done) == 10 and capsys.readouterr().out == ""
    start([replace(job, cell=replace(job.cell, frames=100)) for job in jobs])
    assert len(done) == 13, "longer videos need other programs"
    start([*jobs, *through_codecs(jobs)])
    assert done[13:] == [CodecPrograms("new", 25, Path("run")), CodecPrograms("old", 49, Path("run"))]
    start(through_codecs(jobs))
    assert len(done) == 15


class Coded:
    """A codec for tests, whose programs are for 24 frames and, without pieces, their multiples."""

    model = "coded"

    def __init__(self, digest: str) -> None:
        self.digest = digest

    def coded_length(self, frames: int) -> int:
        return 25 if self.digest == "new" else (frames + 22) // 24 * 24 + 1

    def compile(self, frames: int) -> None:
        pytest.fail("compiled by another process")

    def __call__(self, video: np.ndarray, episode: Path) -> np.ndarray:
        return video


CODECS = {name: ModelCodec(Coded(name), name, Path("run")) for name in ("new", "old")}


def through_codecs(jobs: list[list_jobs.Job]) -> list[list_jobs.Job]:
    """The truth of jobs through two codecs, at lengths that share a program."""
    cells = [
        (job, replace(job.cell, model=CODEC_TRUTH, condition=codec.key, frames=frames))
        for job in jobs
        for codec in CODECS.values()
        for frames in (40, 49)
    ]
    return [replace(job, cell=cell) for job, cell in cells]


def test_no_gpu_compiles_nothing(resolved: GradingSettings, jobs: list[list_jobs.Job], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(open_graders, "warm_up", lambda *_: pytest.fail("there is no GPU"))
    monkeypatch.setattr(open_graders, "visible_gpus", tuple)
    list(open_graders.grade_groups(resolved, {}, [[(jobs[0], ("psnr",))]]))
