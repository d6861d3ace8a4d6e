"""The folder of a run: claiming, resuming, replacing and reading it, and tracing the checkpoints of an adapted run.

<out>/config.yaml       the resolved config, itself a valid input
<out>/codec/            the codec that the latents were made with
<out>/scales.json       normalization of numeric conditions, if there are any
<out>/episodes.json     digests of the training episodes
<out>/sums/STEP.json    checksums of a checkpoint's files
<out>/.xew-run          mark of a run, without which no file is replaced
<out>/checkpoints/STEP  params, optimizer, position of the data, and ema if there is one
<out>/start.json        of an adapted run: the checkpoint that it started from
<out>/metrics.jsonl     training curves, next to TensorBoard's event files
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import jax
from flax import nnx
from jax.experimental import multihost_utils

from xew import config
from xew.config import ConfigError
from xew.dataset import Episode
from xew.files import demand_no_links, read_json, remove_written, write_text
from xew.model.cache.keys import RUN_SCALES
from xew.model.cache.scales import Scale, dump_scales, load_run_scales
from xew.model.codecs.codec import RUN_CODEC, RUN_REMEDY, codec_class, load_kept_codec
from xew.model.codecs.contract import Codec, CodecSettings
from xew.model.experiment import Experiment, load_recorded
from xew.model.network.dit import WorldModel
from xew.model.network.dit_layouts import check_dit
from xew.model.runs.layout import RUN_FILES, RUN_MARK, checkpoint_time, is_run, list_steps
from xew.model.settings.settings import AdaptSettings
from xew.model.weights.reading import read_tensors

T = TypeVar("T")

EPISODES = "episodes.json"
"""Name of the file in a run with the digests of its training episodes."""
START = "start.json"
"""Name of the file in an adapted run with the checkpoint that it started from."""
FREE_TO_CHANGE = (
    "data",
    "cache",
    "out",
    "codec.chunk",
    "codec.weights",
    "mesh.",
    "model.remat",
    "train.accumulate",
    "train.epochs",
    "train.seconds",
    "train.steps",
    "train.log_every",
    "train.save_every",
    "train.samples",
    "train.keep_checkpoints",
    "pictures.device_share",
    "pictures.host_gb",
    "report.",
    "rollout.",
)
"""Prefixes of the settings that a resumed run may change."""


def begin_run(
    experiment: Experiment,
    codec: Codec,
    scales: Mapping[str, Scale],
    episodes: Iterable[Episode],
    *,
    resume: bool,
    overwrite: bool,
) -> dict[str, Scale]:
    """Prepare the folder of a run on these episodes in the first process, as `prepare_run`, and return the run's scales.

    Raises:
        ConfigError: as `prepare_run` and `check_episodes`.
    """
    if jax.process_index() == 0:
        episodes = list(episodes)
        if resume:
            check_episodes(experiment.out, episodes)
        prepare_run(experiment, codec, scales, resume=resume, overwrite=overwrite)
        write_episodes(experiment.out, episodes)
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("run folder")
    return load_run_scales(experiment.conditions, experiment.out)


def prepare_run(experiment: Experiment, codec: Codec, scales: Mapping[str, Scale], *, resume: bool, overwrite: bool) -> None:
    """Claim a run folder as `check_claim` and `write_claim`, and write codec, scales and, of an adapted run, its start.

    A resumed run keeps its codec, scales and start.

    Raises:
        ConfigError: as `check_claim`, the run was begun with another codec, or the run to adapt has no checkpoint.
    """
    out, start, steps = experiment.out, experiment.adapt.start_from, list[int]()
    check_claim(out, experiment, load_recorded, resume=resume, overwrite=overwrite)
    run_codec = _find_codec(experiment, out) if resume and (out / RUN_CODEC).exists() else None
    if run_codec is not None and run_codec.hash != codec.hash:
        raise ConfigError(f"{out} was begun with another codec than the config's now; set it back, or choose --out.")
    if start is not None and not (resume and (out / START).exists()):
        steps = list_steps(start)
        if not steps:
            raise ConfigError(
                f"{start} has no checkpoint to start from; train it: python -m xew.model.train CONFIG --out {start}"
            )
    write_claim(out, experiment, overwrite=overwrite)
    try:
        (out / RUN_CODEC).mkdir(exist_ok=True)
        if run_codec is None:
            codec.save(out / RUN_CODEC)
    except OSError as error:
        raise ConfigError(f"cannot write the run {out}: {error}; choose another --out.") from error
    if start is not None and steps:
        note = StartNote(str(start), max(steps), checkpoint_time(start, max(steps)))
        write_text(out / START, json.dumps(dataclasses.asdict(note), indent=1) + "\n", within=out)
    if scales and not (out / RUN_SCALES).exists():
        write_text(out / RUN_SCALES, dump_scales(scales), within=out)


def check_episodes(out: Path, episodes: Iterable[Episode]) -> None:
    """Raise ConfigError if a run was begun with other training episodes. Runs of earlier versions do not name theirs."""
    path, present = out / EPISODES, _digest_episodes(episodes)
    if not path.exists():
        return
    try:
        begun = config.CONVERTER.structure(read_json(path), dict[str, str])
    except Exception as error:  # cattrs has many types
        raise ConfigError(f"{path} is damaged ({error}); copy the run again, or train it again with --overwrite.") from error
    groups = {
        "missing": begun.keys() - present.keys(),
        "new": present.keys() - begun.keys(),
        "of other content": {name for name in begun.keys() & present.keys() if begun[name] != present[name]},
    }
    if any(groups.values()):
        listed = ", ".join(f"{len(names)} {what} (such as {min(names)})" for what, names in groups.items() if names)
        raise ConfigError(
            f"{out} was begun with {len(begun)} episodes, and --data has others: {listed}. Resume with the same data, use "
            "--overwrite, or choose another --out."
        )


def write_episodes(out: Path, episodes: Iterable[Episode]) -> None:
    """Write the digests of a run's training episodes, unless it has them."""
    if not (out / EPISODES).exists():
        write_text(out / EPISODES, json.dumps(_digest_episodes(episodes), indent=1) + "\n", within=out)


def _digest_episodes(episodes: Iterable[Episode]) -> dict[str, str]:
    """Digests of what training reads of episodes, by task, seed and robot."""
    digests = {}
    for _, record in episodes:
        content = json.dumps([record.instruction, sorted(record.hashes.items())])
        name = f"{record.task}/{record.seed}/{record.robot}"
        digests[name] = hashlib.sha256(content.encode()).hexdigest()[:16]
    return digests


def check_one_of(resume: bool, overwrite: bool) -> None:
    """Raise ConfigError if both flags are set."""
    if resume and overwrite:
        raise ConfigError("--resume continues the run in --out, --overwrite replaces it; give one of them.")


def claim_run(out: Path, settings: T, read: Callable[[Path], T], *, resume: bool, overwrite: bool) -> None:
    """Claim a folder for a run with these settings: `check_claim`, then `write_claim`."""
    check_claim(out, settings, read, resume=resume, overwrite=overwrite)
    write_claim(out, settings, overwrite=overwrite)


def check_claim(out: Path, settings: T, read: Callable[[Path], T], *, resume: bool, overwrite: bool) -> None:
    """Check that a folder may become a run's.

    Raises:
        ConfigError: it holds other files, a run without either flag, or a run to resume with another config.
        OSError: it holds a link.
    """
    saved = out / "config.yaml"
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out} is a file; choose another --out.")
    demand_no_links(out)
    if saved.exists() and resume:
        _check_same(read(saved), settings, out)
    elif saved.exists() and not overwrite:
        raise ConfigError(
            f"{out} holds a run already; continue it with --resume, replace it with --overwrite, or choose --out."
        )
    elif not saved.exists() and out.exists() and not _is_bare(out):
        raise ConfigError(f"{out} is not empty and holds no run; choose another --out.")


def _find_codec(experiment: Experiment, out: Path) -> Codec | None:
    """The codec of a run; None if the run was killed before writing it whole, and so has no checkpoint."""
    try:
        return load_kept_codec(experiment.encoding.kind, out / RUN_CODEC, RUN_REMEDY)
    except ConfigError:
        if list_steps(out):
            raise
        return None


def _is_bare(out: Path) -> bool:
    """Whether a folder is empty, or holds only the mark, perhaps half written, of a run that was killed before its config."""
    names = [path.name for path in out.iterdir()]
    marked = any(name == RUN_MARK or name.startswith(f".{RUN_MARK}.") for name in names)
    return not names or (marked and all(name.startswith(".") for name in names))


def write_claim(out: Path, settings: Any, *, overwrite: bool) -> None:
    """Write the settings of a run into its folder as config.yaml; `overwrite` first removes the run there."""
    saved = out / "config.yaml"
    if overwrite and saved.exists():
        _remove_run(out)
    try:
        write_text(out / RUN_MARK, "", within=out)
        config.save(settings, saved)
    except OSError as error:
        raise ConfigError(f"cannot write the run {out}: {error}; choose another --out.") from error


def _remove_run(out: Path) -> None:
    """Remove a run's files from its folder. Raises ConfigError if the folder is not a run's or cannot be changed."""
    if not is_run(out):
        raise ConfigError(f"{out} has a config.yaml but holds no run, so it is not replaced; choose another --out.")
    try:
        foreign = remove_written(out, RUN_FILES)
    except OSError as error:
        raise ConfigError(f"cannot replace the run {out}: {error}; choose another --out.") from error
    if foreign:
        names = ", ".join(str(path.relative_to(out)) for path in foreign[:3])
        print(f"{out}: the run is replaced; other files stay there ({names})")


def check_start(experiment: Experiment) -> None:
    """Raise ConfigError unless the run to adapt, or the published weights, fit the network."""
    run, weights = experiment.adapt.start_from, experiment.model.weights
    if run is not None and run.resolve() == experiment.out.resolve():
        raise ConfigError(f"out is {experiment.out}, the run that adapt.start_from names; choose another --out.")
    if run is not None:
        _check_same_network(load_run_config(run), experiment, run)
        trace_run(run)
    if weights is not None:
        check_dit(nnx.eval_shape(lambda: WorldModel(experiment.network)), read_tensors(weights))


def _check_same(saved: Any, asked: Any, out: Path) -> None:
    """Raise ConfigError if settings differ that may not change."""
    before, after = dict(_flatten(saved)), dict(_flatten(asked))
    changed = [key for key in after if before[key] != after[key] and not key.startswith(FREE_TO_CHANGE)]
    if changed:
        changes = "; ".join(f"{key} was {before[key]!r}, is {after[key]!r}" for key in changed)
        raise ConfigError(f"{out} was begun with another config ({changes}); set it back, use --overwrite, or choose --out.")


def _check_same_network(source: Any, asked: Any, run: Path) -> None:
    """Raise ConfigError unless an adaptation has the network, clips and codec of the run."""
    before, after = dict(_flatten(source)), dict(_flatten(asked))
    compared = [key for key in after if key.startswith(("clip.", "codec.", "model.")) and not key.startswith(FREE_TO_CHANGE)]
    changed = [key for key in compared if before[key] != after[key] and key not in ("model.dtype", "model.weights")]
    if changed:
        differences = "; ".join(f"{key} is {before[key]!r} there, {after[key]!r} here" for key in changed)
        raise ConfigError(f"the network of {run} differs from the config's ({differences}); give both the same settings.")


def _flatten(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """All fields of nested settings, as ('train.steps', value)."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            yield from _flatten(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value


def load_run(out: Path) -> tuple[Experiment, Codec]:
    """Config and codec of a run. Raises ConfigError if they are missing."""
    experiment = load_run_config(out)
    return experiment, load_run_codec(out, experiment.codec)


def load_run_config(out: Path) -> Experiment:
    """The config of a run. Raises ConfigError if it is missing."""
    if not (out / "config.yaml").exists():
        raise ConfigError(f"{out} holds no run; train one: python -m xew.model.train CONFIG --out {out}")
    return load_recorded(out / "config.yaml")


def load_run_codec(out: Path, settings: CodecSettings) -> Codec:
    """The codec of a run, with these settings. Raises ConfigError if it is missing."""
    return load_kept_codec(codec_class(settings), out / RUN_CODEC, RUN_REMEDY)


@dataclass(frozen=True)
class KeptStep:
    """A checkpoint of a run."""

    run: Path
    step: int | None
    """Step; None for the latest."""
    adapt: AdaptSettings
    """Adaptation of that run; with LoRA the checkpoint holds corrections, otherwise the whole network."""


def trace_run(out: Path, step: int | None = None) -> list[KeptStep]:
    """The lineage of checkpoints whose sum is a run's network: a whole network, then LoRA corrections, the run's own last.

    Raises:
        ConfigError: a run that it was adapted from is missing or was trained again, start.json is missing, or the runs refer to
            one another in a circle.
    """
    own = KeptStep(out, step, load_run_config(out).adapt)
    return [*trace_start(out, own.adapt.start_from), own] if own.adapt.lora_rank else [own]


def trace_start(out: Path, run: Path | None) -> list[KeptStep]:
    """The lineage of checkpoints of `run` from which the adapted run `out` started. Raises ConfigError as `trace_run`."""
    lineage: list[KeptStep] = []
    traced = {out.resolve()}
    while run is not None:
        if run.resolve() in traced:
            raise ConfigError(f"{run} was adapted from itself, perhaps over other runs; copy the whole runs again.")
        traced.add(run.resolve())
        lineage.insert(0, _read_start(out, run))
        out, adapt = run, lineage[0].adapt
        run = adapt.start_from if adapt.lora_rank else None
    return lineage


@dataclass(frozen=True)
class StartNote:
    """Content of start.json."""

    run: str
    step: int
    saved: int | None


def _read_start(out: Path, run: Path) -> KeptStep:
    """Read from which checkpoint of `run` the run `out` was adapted. Raises ConfigError as `trace_run`."""
    try:
        note = config.parse(StartNote, read_json(out / START), str(out / START))
    except (OSError, ValueError, ConfigError) as error:
        raise ConfigError(
            f"{out} does not say from which checkpoint of {run} it was adapted ({error}); copy the whole run, or "
            "adapt again with --overwrite."
        ) from error
    if not (run / "config.yaml").exists() or checkpoint_time(run, note.step) != note.saved:
        raise ConfigError(
            f"{out} was adapted from step {note.step} of {run}, which no longer exists or was trained again; "
            "restore that run (a larger train.keep_checkpoints keeps the step), or adapt again with --overwrite."
        )
    return KeptStep(run, note.step, load_run_config(run).adapt)
