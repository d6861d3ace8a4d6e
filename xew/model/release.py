"""Prepare a run for release: the network alone, in bfloat16, with a model card.

Reads  a run, its training episodes and, for the card, a summary of its scores
Writes a run folder with config, codec, scales, one checkpoint for inference, and the model card README.md
Command: python -m xew.model.release RUN --out FOLDER [--scores scores.summary.md]
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import tyro
from jinja2 import Environment, PackageLoader, StrictUndefined

from xew.config import ConfigError, admit, user_errors
from xew.dataset import read_dataset, view_folder
from xew.episode import Record
from xew.files import hold_lock, read_text, write_text
from xew.model.cache.scales import load_run_scales
from xew.model.codecs.codec import RUN_CODEC
from xew.model.episodes.choice import training_episodes
from xew.model.experiment import Experiment
from xew.model.runs.checkpoint import load_params, save_params, write_checkpoints
from xew.model.runs.folder import load_run, prepare_run
from xew.model.settings.settings import AdaptSettings

CARD = "README.md"
"""Name of the model card."""


def release(run: Path, out: Path, data: Path | None = None, scores: Path | None = None, step: int | None = None) -> int:
    """Write the network of a run in bfloat16 as a new run with a model card, and return its step; arguments as of `Args`.

    LoRA corrections are added to the network.

    Raises:
        ConfigError: there is no such run, checkpoint or summary, or `out` is in use.
        EpisodeError: the data has no training episodes.
    """
    experiment, codec = load_run(run)
    if experiment.out.resolve() != run.resolve():
        experiment = replace(experiment, out=run)
    if scores and not scores.is_file():
        raise ConfigError(f"--scores {scores} is not a file; expected scores.summary.md of `python -m xew.metrics.evaluate`.")
    episodes = training_episodes(read_dataset(view_folder(data or experiment.data, experiment.view)), experiment.choice)
    data_counts = count_by_task(record for _, record in episodes)
    summary = read_text(scores) if scores else ""
    params, step = load_params(run, experiment.network, step)
    weights = Path(RUN_CODEC) if experiment.codec.weights else None
    released = replace(
        experiment,
        out=out,
        data=Path("data"),
        cache=None,
        adapt=AdaptSettings(),
        codec=replace(experiment.codec, weights=weights),
    )
    prepare_run(released, codec, load_run_scales(experiment.conditions, run), resume=False, overwrite=False)
    with write_checkpoints(out) as checkpoints:
        save_params(checkpoints, step, jax.tree.map(lambda leaf: leaf.astype(jnp.bfloat16), params))
    size = sum(leaf.size for leaf in jax.tree.leaves(params))
    write_text(out / CARD, write_card(experiment, step, size, data_counts, summary), within=out)
    return step


def count_by_task(records: Iterable[Record]) -> dict[str, tuple[int, int]]:
    """Numbers of seeds and of episodes of each task, sorted by task."""
    seeds: dict[str, list[int]] = defaultdict(list)
    for record in records:
        seeds[record.task].append(record.seed)
    return {task: (len(set(of_task)), len(of_task)) for task, of_task in sorted(seeds.items())}


def write_card(experiment: Experiment, step: int, size: int, seen: dict[str, tuple[int, int]], summary: str) -> str:
    """The model card in Markdown.

    `size` is the number of parameters, `seen` are the numbers of seeds and episodes by task, and `summary` is the table of
    scores or ''.
    """
    loader = PackageLoader("xew.model", "templates")
    template = Environment(loader=loader, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    robots = experiment.robots.train_robots
    facts = {"step": step, "size": size, "seen": seen, "robots": robots, "summary": summary.strip()}
    return template.get_template("model_card.md").render(experiment=experiment, **facts).rstrip() + "\n"


@dataclass(frozen=True)
class Args:
    """Options of a release."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a trained run."""
    out: Path
    """Folder to write; it must be empty or not exist."""
    data: Path | None = None
    """Training data, for the card (default: the run's)."""
    scores: Path | None = None
    """Summary of the scores, as scores.summary.md of `python -m xew.metrics.evaluate`."""
    checkpoint: int | None = None
    """Step of the checkpoint (default: the latest)."""
    trust: tuple[str, ...] = ()
    """Custom modules, such as my_lab.models, that the run may name."""


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Write a run's network and its card."""
    args = tyro.cli(Args, args=arguments, prog="python -m xew.model.release", description=__doc__)
    admit(args.trust)
    with hold_lock(args.out):
        step = release(args.run, args.out, args.data, args.scores, args.checkpoint)
    megabytes = sum(file.stat().st_size for file in args.out.rglob("*") if file.is_file()) / 1e6
    print(f"{args.out}: step {step} in bfloat16, {megabytes:.0f} MB; its card is {args.out / CARD}")


if __name__ == "__main__":
    main()
