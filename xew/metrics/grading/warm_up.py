"""Compilation for a GPU before the first video: Warp's kernels and JAX's programs, in parts for as many processes.

Otherwise every process that grades would compile all of them, one after another. Both are cached, so this happens once.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import jax
import numpy as np

import xew
from xew.files import cache_folder, write_text
from xew.metrics import METRICS, perceptual
from xew.metrics.episode_cache import EpisodeCache, is_on_cpu
from xew.metrics.grade import JUDGED, ON_SURFACES, Comparison, grade, input_kind
from xew.metrics.grading.codecs import ModelCodec, open_codec
from xew.metrics.grading.list_jobs import Job
from xew.metrics.grading.settings import GradingSettings
from xew.metrics.metric import ACCELERATOR_CHUNK
from xew.metrics.outcome.variants import INSTANTS
from xew.metrics.truth import Truth
from xew.protocol import CODEC_TRUTH

DEFAULT = "default"
"""Name of the estimators that run in Warp's kernels."""


@dataclass(frozen=True)
class Kernels:
    """A module of Warp's kernels."""

    module: str

    def compile(self) -> None:
        """Compile it for this process's GPU."""
        _kernels().compile_kernels(self.module)


@dataclass(frozen=True)
class Programs:
    """JAX's programs of some metrics of frames, for videos of some shapes."""

    metrics: tuple[str, ...]
    shapes: tuple[tuple[int, int, int], ...]
    """Frames, height and width."""

    def compile(self) -> None:
        """Grade noise by these metrics, if JAX has a GPU."""
        for shape in () if is_on_cpu() else self.shapes:
            self._grade_noise(shape)

    def _grade_noise(self, shape: tuple[int, int, int]) -> None:
        target = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
        mask, points = np.zeros(shape, bool), np.zeros((shape[0], 0, 2), np.float32)
        mask[:, shape[1] // 4 : -shape[1] // 4, shape[2] // 4 : -shape[2] // 4] = True
        truth = Truth(target, mask, points, points[..., 0] > 0, points, points[..., 0] > 0)
        prediction = np.roll(target, 1, axis=0)
        grade(Comparison(prediction, EpisodeCache(truth, 0), lambda *_: mask, lambda *_: points), self.metrics)
        if any(METRICS[name].inputs == "variant_videos" for name in self.metrics):
            perceptual.lpips_embedding(target[:INSTANTS], mask[:INSTANTS])


@dataclass(frozen=True)
class CodecPrograms:
    """JAX's programs of a codec, for videos of one length."""

    digest: str
    length: int
    """Number of frames that are coded."""
    run: Path = field(compare=False, repr=False)
    """Folder of a run with this codec."""

    def compile(self) -> None:
        """Take a video through the codec, if JAX has a GPU."""
        if not is_on_cpu():
            open_codec(self.run).compile(self.length)


Part = Kernels | Programs | CodecPrograms


def missing_parts(settings: GradingSettings, jobs: Sequence[Job], codecs: Mapping[str, ModelCodec]) -> list[Part]:
    """What this machine's caches lack to grade some jobs, also through codecs, on its GPUs; nothing without a GPU."""
    programs: list[Part] = [*list_programs(settings, jobs), *list_codec_programs(jobs, codecs)]
    missing = [part for part in programs if not _marker(part).exists()]
    return [*map(Kernels, _kernels().missing_kernels(list_kernels(settings))), *missing]


def note_compiled(parts: Sequence[Part]) -> None:
    """Note which of these programs JAX's cache holds; Warp's cache tells by itself."""
    for part in parts:
        if not isinstance(part, Kernels):
            path = _marker(part)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, _describe(part), within=path.parent)


def list_kernels(settings: GradingSettings) -> list[str]:
    """Modules of kernels that the metrics need."""
    kinds, kernels = {input_kind(name) for name in settings.metrics}, _kernels()
    modules = [*kernels.OF_SURFACES] if kinds & {"mask", "bodies", *ON_SURFACES, *JUDGED} else []
    modules += kernels.OF_MASKS if "mask" in kinds and settings.args.masks == DEFAULT else []
    has_tracks = any(METRICS[name].inputs in ("track", *JUDGED) for name in settings.metrics)
    return modules + [*kernels.OF_TRACKS] * (has_tracks and settings.args.tracks == DEFAULT)


def list_programs(settings: GradingSettings, jobs: Sequence[Job]) -> list[Programs]:
    """Programs of metrics of frames in up to three parts that take about as long: LPIPS, whole videos, the rest."""
    parts: dict[str, list[str]] = {}
    for name in settings.metrics:
        metric = METRICS[name]
        of_network = metric.function.__module__ == perceptual.__name__ or metric.inputs == "variant_videos"
        if metric.inputs not in ("track", "outcome", "variants"):
            parts.setdefault("network" if of_network else "whole" if metric.whole else "frame", []).append(name)
    return [Programs(tuple(names), _find_shapes(settings, jobs)) for names in parts.values()]


def list_codec_programs(jobs: Sequence[Job], codecs: Mapping[str, ModelCodec]) -> list[CodecPrograms]:
    """Programs of the codecs that the truth goes through: a part for each codec and length of coded videos."""
    by_key = {codec.key: codec for codec in codecs.values()}
    through = {(by_key[job.cell.condition], job.cell.frames) for job in jobs if job.cell.model == CODEC_TRUTH}
    parts = {CodecPrograms(codec.digest, codec.roundtrip.coded_length(frames), codec.run) for codec, frames in through}
    return sorted(parts, key=lambda part: (part.digest, part.length))


def _find_shapes(settings: GradingSettings, jobs: Sequence[Job]) -> tuple[tuple[int, int, int], ...]:
    """Shapes of the jobs' graded videos, filled up as programs take them."""
    sizes = {(job.cell.frames - settings.first_frame, job.record.camera.size) for job in jobs}
    block = ACCELERATOR_CHUNK
    return tuple(sorted({(-(-frames // block) * block, height, width) for frames, (width, height) in sizes}))


def _marker(part: Part) -> Path:
    return cache_folder("evaluate") / hashlib.sha256(_describe(part).encode()).hexdigest()[:16]


def _describe(part: Part) -> str:
    """What compiled programs depend on, as text."""
    versions = xew.__version__, jax.__version__, *_kernels().gpu_names()
    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return "\n".join(map(str, (*versions, cache, part))) + "\n"


def _kernels() -> ModuleType:
    from xew.metrics.estimators.batched import compiling  # only here: the metrics load without Warp

    return compiling
