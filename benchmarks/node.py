"""The whole pipeline on this machine, command by command: seconds, rate, start-up, how busy GPUs and cores are, and scaling.

    python -m benchmarks.node --out node --train-seeds 50 --test-seeds 20             # the paper's 8,750 episodes
    python -m benchmarks.node --out node --parts one --steps generate latents          # in pieces: what is measured is kept
    python -m benchmarks.node --out node --steps --merge other_node                    # the table of what both have measured

Every step is a command as users run it, first on one GPU with its share of the cores, then on all (without GPUs: on a quarter
of the cores, then on all). Parts have their own data, so they may have different sizes; ratios are of rates. A step makes what
it needs and is not there, and measures that too. Start-up lasts until the first episode, stream, rollout or score is on disk;
in training it is what the steps at their median time leave over. The training batch is the config's for each GPU. On a new
machine run it on one task into another folder first: that compiles kernels and programs.

`baselines` grades the rollouts and all baselines of the data set, `evaluate` grades a further model on the same data.
Before a row is printed, its work is checked: numbers of episodes, streams, steps, videos and scores, hashes of a sample of
episodes, lengths and sources of rollouts, digests of score tables. The rates go to ~/.cache/xew/rates.json, from which
`python -m xew.analysis.study --dry-run` estimates.
"""

import json
import os
import shlex
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
import tyro

import xew
from benchmarks.common import check_episodes
from benchmarks.utilization import Use, run_sampled
from xew.analysis.studies.rates import Rate, Rates, rates_path, write_rates
from xew.analysis.study import stop_on_sigterm
from xew.concurrency import visible_gpus
from xew.dataset import read_dataset
from xew.files import read_json, write_text
from xew.metrics.grading.bundle import read_bundle
from xew.model.episodes.choice import training_episodes
from xew.model.experiment import Experiment, load_experiment
from xew.model.runs.layout import list_steps
from xew.protocol import BASELINES
from xew.rollout import find_rollouts, read_rollout_video
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.tasks import TASKS

StepName = Literal["generate", "latents", "train", "rollout", "baselines", "evaluate"]
PartName = Literal["one", "all"]
STEPS: tuple[StepName, ...] = get_args(StepName)
PRODUCTS = {
    "generate": ("data",),
    "latents": ("data-latents*",),
    "train": ("run",),
    "rollout": ("rollouts",),
    "baselines": ("data-baselines", "data-surfaces", "first.*"),
    "evaluate": ("further.*",),
}
"""Patterns of what each step makes in its part's folder."""
FIRST = {
    "generate": "data/*/*/*/episode.json",
    "latents": "data-latents/*/*/*/*.safetensors",
    "rollout": "rollouts/*/*/*/rollout.json",
    "baselines": "first.cells/**/*.json",
    "evaluate": "further.cells/**/*.json",
}
"""Pattern of the files of which the oldest ends a step's start-up."""
SAMPLE = 50
"""Number of rollouts that are decoded."""


@dataclass(frozen=True)
class Args:
    out: Path = Path("node")
    """Folder for data, run, rollouts, scores, logs and measurements of each part."""
    config: Path = Path("configs/fixed.yaml")
    """Experiment that is trained."""
    overrides: str = ""
    """Further overrides of the config, in one string, as --overrides="--model.size tiny"."""
    tasks: tuple[str, ...] = tuple(TASKS)
    robots: tuple[str, ...] = tuple(ROBOTS)
    """Robots of the training seeds."""
    test_robots: tuple[str, ...] = ()
    """Robots of the test seeds; default: the same."""
    train_seeds: int = 4
    test_seeds: int = 4
    generate: str = ""
    """Further options of `generate`, in one string, as --generate="--manifest tried.json"."""
    train_steps: int = 400
    parts: tuple[PartName, ...] = ("one", "all")
    """one: one GPU with its share of the cores; all: the whole machine."""
    steps: tuple[StepName, ...] = STEPS
    """Steps to measure; none to print the table."""
    again: bool = False
    """Measure these steps again."""
    minutes: float | None = None
    """Start no step after this time."""
    merge: tuple[Path, ...] = ()
    """Further --out folders of the same machine whose measurements are taken over."""
    rates: Annotated[Path | None, tyro.conf.arg(metavar="{None}|PATH")] = None
    """File that the rates are written to; default: where `study` looks for those of this machine."""


@dataclass(frozen=True)
class Part:
    """One GPU, or all; without GPUs a quarter of the cores, or all."""

    name: str
    gpus: tuple[str, ...]
    cores: tuple[int, ...]


@dataclass(frozen=True)
class Row:
    """What was measured of one step on one part."""

    step: str
    part: str
    machine: str
    gpus: int
    cores: int
    size: str
    """Size of the network."""
    measured: str
    items: int
    unit: str
    seconds: float
    start_s: float
    cpu: float
    gpu: float | None
    gpu_source: str
    item_mb: float

    @property
    def rate(self) -> float:
        """Items a second of the whole command."""
        return self.items / self.seconds

    @property
    def working_rate(self) -> float:
        """Items a second after the start-up."""
        return self.items / max(self.seconds - self.start_s, 1e-9)

    def to_rate(self) -> Rate:
        """As a study reads it."""
        return Rate(round(self.start_s, 1), round(1 / self.working_rate, 5), round(self.item_mb, 3))


def find_parts() -> dict[str, Part]:
    """The parts of this machine; a machine with one GPU, or with one core, has only all of it."""
    gpus, cores = visible_gpus(), tuple(sorted(os.sched_getaffinity(0)))
    one = Part("one", gpus[:1], cores[: max(1, len(cores) // (len(gpus) or 4))])
    everything = Part("all", gpus, cores)
    same = (one.gpus, one.cores) == (gpus, cores)
    return {"all": everything} if same else {"one": one, "all": everything}


def describe(part: Part) -> str:
    """Text such as `4 x NVIDIA H100 80GB HBM3, 64 cores`."""
    if not part.gpus:
        return f"{len(part.cores)} CPU core{'s' if len(part.cores) > 1 else ''}"
    query = ("nvidia-smi", "--query-gpu=name", "--format=csv,noheader", "-i", part.gpus[0])
    name = subprocess.run(query, capture_output=True, encoding="utf-8").stdout.strip() or "GPU"
    return f"{len(part.gpus)} x {name}, {len(part.cores)} cores"


@dataclass(frozen=True)
class Pipeline:
    """The steps on one part of the machine."""

    args: Args
    part: Part

    @property
    def folder(self) -> Path:
        return self.args.out / self.part.name

    @cached_property
    def experiment(self) -> Experiment:
        return load_experiment(self.args.config, self._overrides)

    @property
    def _overrides(self) -> list[str]:
        folders = {"data": "data", "out": "run", "cache": "data-latents"}
        named = [text for option, name in folders.items() for text in (f"--{option}", str(self.folder / name))]
        return [*named, *shlex.split(self.args.overrides)]

    @property
    def batch(self) -> int:
        """Samples of a training step: the config's for each GPU."""
        return self.experiment.train.batch * max(1, len(self.part.gpus))

    def command(self, step: StepName) -> list[str]:
        """The module and arguments of a step."""
        args, steps = self.args, str(self.args.train_steps)
        data, run, rollouts = (str(self.folder / name) for name in ("data", "run", "rollouts"))
        if step == "generate":
            seeds = ["--train-seeds", str(args.train_seeds), "--test-seeds", str(args.test_seeds), *shlex.split(args.generate)]
            robots = ["--robots", *args.robots, "--test-robots", *(args.test_robots or args.robots)]
            return ["xew.sim_warp.generate", "--tasks", *args.tasks, *robots, *seeds, "--out", data]
        if step == "latents":
            return ["xew.model.latents", str(args.config), *self._overrides]
        if step == "train":
            length = ["--train.steps", steps, "--train.save-every", steps, "--train.batch", str(self.batch)]
            return ["xew.model.train", str(args.config), *self._overrides, *length, "--train.samples", "0"]
        if step == "rollout":
            return ["xew.model.rollout", run, "--data", data, "--split", "test", "--out", rollouts]
        table = str(self.folder / f"{'first' if step == 'baselines' else 'further'}.parquet")
        return ["xew.metrics.evaluate", rollouts, "--data", data, "--codec", run, "--out", table]

    def check(self, step: StepName) -> tuple[int, str]:
        """Number of items of a step that is done, and their unit. Raises AssertionError if the work is not all there."""
        return {
            "generate": self._check_data,
            "latents": self._check_latents,
            "train": self._check_run,
            "rollout": self._check_rollouts,
            "baselines": lambda: self._check_scores("first"),
            "evaluate": lambda: self._check_scores("further"),
        }[step]()

    def _check_data(self) -> tuple[int, str]:
        args = self.args
        tested = len(args.test_robots or args.robots) * args.test_seeds
        expected = len(args.tasks) * (len(args.robots) * args.train_seeds + tested)
        return len(check_episodes(self.folder / "data", expected)), "episodes"

    def _check_latents(self) -> tuple[int, str]:
        header = read_json(self.folder / "data-latents" / "header.json")
        episodes = training_episodes(read_dataset(self.folder / "data"), self.experiment.choice)
        files, expected = list(self._files("latents")), len(episodes) * len(header["streams"])
        assert header["episodes"] == len(episodes) and len(files) == expected, f"{len(files)} streams, expected {expected}"
        assert all(path.stat().st_size for path in files)
        return expected, "streams"

    def _check_run(self) -> tuple[int, str]:
        losses = [line["loss/train"] for line in self._curve()]
        assert list_steps(self.folder / "run")[-1] == self.args.train_steps and np.isfinite(losses).all()
        return self.args.train_steps * self.batch, "samples"

    def _curve(self) -> list[dict[str, float]]:
        return [json.loads(line) for line in (self.folder / "run" / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]

    def _check_rollouts(self) -> tuple[int, str]:
        tested = read_dataset(self.folder / "data").select(robots=None, split="test")
        records = {(record.task, record.seed, record.robot): record for _, record in tested}
        rollouts = find_rollouts(self.folder / "rollouts")
        assert {(r.task, r.seed, r.robot) for r in rollouts} == records.keys(), "some test episodes have no rollout"
        for rollout in rollouts:
            assert rollout.header["source_hash"] == records[rollout.task, rollout.seed, rollout.robot].hashes["rgb"]
        for rollout in rollouts[:: max(1, len(rollouts) // SAMPLE)]:
            assert len(read_rollout_video(rollout)) == rollout.frame_count
        return len(rollouts), "episodes"

    def _check_scores(self, name: str) -> tuple[int, str]:
        """Check that a bundle is whole and has all rollouts and baselines."""
        samples = read_bundle(self.folder / f"{name}.bundle.json")["samples"]
        rollouts = len(find_rollouts(self.folder / "rollouts"))
        graded = [sample for sample in samples if sample["model"] not in BASELINES]
        others = len(samples) - len(graded)
        assert len(graded) == rollouts, f"{len(graded)} rollouts are graded, expected {rollouts}"
        assert others >= 3 * rollouts, f"{others} videos of baselines are graded for {rollouts} rollouts"
        return (rollouts if name == "further" else len(samples)), "videos"

    def start_s(self, step: StepName, begin: float, seconds: float) -> float:
        """Start-up of a step that began at a time of the clock."""
        if step == "train":
            step_s = statistics.median(line["workload/step_s"] for line in self._curve())
            return max(0.0, seconds - self.args.train_steps * step_s)
        return min(path.stat().st_mtime for path in self._files(step)) - begin

    def _files(self, step: StepName) -> Iterator[Path]:
        return self.folder.glob(FIRST[step])

    def remove(self, step: StepName) -> None:
        """Remove what a step has made."""
        for path in (path for pattern in PRODUCTS[step] for path in self.folder.glob(pattern)):
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def record(self, step: StepName) -> Path:
        """File of what was measured of a step."""
        return self.folder / "measured" / f"{step}.json"

    def list_left(self) -> list[StepName]:
        """Steps to run: those to measure, and before them those that were stopped or whose product is not there."""
        asked = [step for step in STEPS if step in self.args.steps and (self.args.again or not self.record(step).exists())]
        before = STEPS[: STEPS.index(asked[-1])] if asked else ()
        return [step for step in STEPS if step in asked or (step in before and not self._is_made(step))]

    def _is_made(self, step: StepName) -> bool:
        return self.record(step).exists() and any(self.folder.glob(PRODUCTS[step][0]))

    def measure(self, step: StepName) -> Row:
        """Run a step from nothing and check what it made."""
        self.remove(step)
        self.folder.mkdir(parents=True, exist_ok=True)
        begin, use = time.time(), self._run(step)
        items, unit = self.check(step)
        made = sum(path.stat().st_size for pattern in PRODUCTS[step] for path in self._tree(pattern)) / 1e6
        start = self.start_s(step, begin, use.seconds)
        return Row(
            step=step,
            part=self.part.name,
            machine=describe(self.part),
            gpus=len(self.part.gpus),
            cores=len(self.part.cores),
            size=str(self.experiment.model.size),
            measured=f"{time.strftime('%Y-%m-%d')}, xew {xew.__version__}",
            items=items,
            unit=unit,
            seconds=use.seconds,
            start_s=start,
            cpu=use.cpu,
            gpu=use.gpu,
            gpu_source=use.gpu_source,
            item_mb=made if step == "train" else made / items,
        )

    def _run(self, step: StepName) -> Use:
        log = self.folder / f"{step}.log"
        variables = os.environ | ({"CUDA_VISIBLE_DEVICES": ",".join(self.part.gpus)} if self.part.gpus else {})
        command = [sys.executable, "-m", *self.command(step)]
        try:
            with stop_on_sigterm():  # the command ends, too
                return run_sampled(command, log, variables, self.part.cores, self.part.gpus)
        except subprocess.CalledProcessError as error:
            end = log.read_text(encoding="utf-8")[-2000:]
            raise SystemExit(f"{step} ended with {error.returncode}: {end}") from error

    def _tree(self, pattern: str) -> Iterator[Path]:
        for path in self.folder.glob(pattern):
            yield from (file for file in (path.rglob("*") if path.is_dir() else [path]) if file.is_file())


def measure_all(args: Args, parts: Sequence[Part]) -> None:
    """Measure the steps that are asked for and not measured yet, each after the steps whose product it needs."""
    begin = time.monotonic()
    for pipeline in (Pipeline(args, part) for part in parts):
        for step in pipeline.list_left():
            if args.minutes is not None and time.monotonic() - begin > 60 * args.minutes:
                print(f"{pipeline.part.name}: {step} is left for the next time", flush=True)
                return
            row = pipeline.measure(step)
            write_text(pipeline.record(step), json.dumps(asdict(row), indent=1) + "\n", within=args.out)
            print(f"{row.part}: {step}, {row.items} {row.unit} in {row.seconds:.1f} s", flush=True)


def read_rows(folders: Sequence[Path]) -> dict[tuple[str, str], Row]:
    """All measurements below some folders, by part and step; of one that is there twice the last."""
    paths = [path for folder in folders for path in sorted(folder.glob("*/measured/*.json"))]
    rows = [Row(**read_json(path)) for path in paths]
    for part in get_args(PartName):
        machines = {row.machine for row in rows if row.part == part}
        if len(machines) > 1:
            raise SystemExit(f"measurements of {' and '.join(sorted(machines))} cannot be merged; choose another --out.")
    return {(row.part, row.step): row for row in rows}


COLUMNS: dict[str, Callable[[Row], str]] = {
    "step": lambda row: row.step,
    "on": lambda row: row.machine,
    "items": lambda row: f"{row.items:,} {row.unit}",
    "seconds": lambda row: f"{row.seconds:.1f}",
    "items/s": lambda row: f"{row.rate:.2f}",
    "start-up [s]": lambda row: f"{row.start_s:.1f}",
    "items/s after it": lambda row: f"{row.working_rate:.2f}",
    "GPU": lambda row: "" if row.gpu is None else f"{row.gpu:.0%}",
    "CPU": lambda row: f"{row.cpu:.0%}",
}


def format_table(rows: dict[tuple[str, str], Row]) -> str:
    """Markdown: a line for each step and part; the scaling of a step's rates, whole and after its start-up."""
    heads = [*COLUMNS, "scaling", "after start-up"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for step in STEPS:
        one = rows.get(("one", step))
        for row in (rows[part, step] for part in get_args(PartName) if (part, step) in rows):
            ratios = one is not None and row is not one and (row.rate / one.rate, row.working_rate / one.working_rate)
            cells = [write(row) for write in COLUMNS.values()] + [f"{ratio:.2f}" for ratio in ratios or ()]
            lines.append("| " + " | ".join([*cells, *[""] * (len(heads) - len(cells))]) + " |")
    unread = {row.gpu_source for row in rows.values() if row.gpus and row.gpu is None}
    return "\n".join([*lines, *(f"GPU utilization is not known: {reason}" for reason in sorted(unread))])


def to_rates(rows: Sequence[Row]) -> list[Rates]:
    """The rates of each part, as a study reads them."""
    entries = []
    for part in get_args(PartName):
        own = [row for row in rows if row.part == part]
        if own:
            kinds = {row.step: row.to_rate() for row in own}
            entries.append(Rates(own[-1].machine, own[-1].measured, own[-1].gpus, kinds))
    return entries


def main(args: Args) -> None:
    parts = find_parts()
    measure_all(args, [parts[name] for name in args.parts if name in parts])
    rows = read_rows([*args.merge, args.out])
    if not rows:
        raise SystemExit(f"{args.out} has no measurements; name --steps.")
    print(format_table(rows))
    path = args.rates or rates_path()
    for size in {row.size for row in rows.values()}:
        write_rates(path, size, to_rates([row for row in rows.values() if row.size == size]))
    print(f"{path}: the rates that study --dry-run estimates by")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
