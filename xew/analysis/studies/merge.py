"""Merges pieces of a study that ran in other folders, on machines that share no disk.

A piece is a folder that `xew.analysis.study` wrote elsewhere; data, latents, checkpoints and rollouts may be missing. Keys,
never times, decide whether a record holds for this study.
"""

from collections.abc import Mapping
from pathlib import Path

from xew.analysis.studies.ledger import Ledger, digest_product
from xew.analysis.studies.plan import Step, sort_steps
from xew.config import ConfigError
from xew.files import copy_file, copy_tree

SERVES_ALL = ("generate", "latents")
"""Kinds of steps whose products are not taken over: every machine has its own, and records tell whether they are the same."""
READ_LATER = ("baselines", "evaluate", "distances")
"""Kinds of steps whose products the analysis reads: without them a record is of no use."""


def merge_piece(steps: Mapping[str, Step], ledger: Ledger, piece: Path) -> list[str]:
    """Copy the products and records that a piece has and this study lacks; returns the names of these steps.

    Raises:
        ConfigError: the piece is no study, or a product does not match its record.
    """
    if not (piece / "state").is_dir():
        raise ConfigError(f"{piece} is no folder of a study: it has no state/.")
    there = Ledger(piece)
    outcomes: dict[str, str] = {}
    taken: list[str] = []
    for step in sort_steps(steps):
        outcome = ledger.noted_outcome(step, outcomes)
        if outcome is None:
            outcome = there.noted_outcome(step, outcomes)
            if step.kind in READ_LATER and not (piece / step.product.relative_to(ledger.out)).exists():
                outcome = None  # it was lost on the way
            if outcome is not None and step.kind != "analyse":
                _take_product(step, ledger.out, piece, outcome)
                if step.kind == "baselines":
                    _take_scores_by_video(steps["generate"].product, ledger.out, piece)
                ledger.take_record(step, there)
                taken.append(step.name)
        if outcome is not None:
            outcomes[step.name] = outcome
    return taken


def _take_scores_by_video(data: Path, out: Path, piece: Path) -> None:
    """Copy a piece's baseline scores next to its data, which later grading resumes from."""
    if data.is_relative_to(out):
        scores = data.with_name(f"{data.name}-baselines").relative_to(out)
        if (piece / scores).is_dir():
            copy_tree(piece / scores, out / scores, within=out)


def _take_product(step: Step, out: Path, piece: Path, outcome: str) -> None:
    """Copy a step's product from a piece, with the files next to it. Raises ConfigError as `merge_piece`."""
    if step.kind in SERVES_ALL:
        return
    source = piece / step.product.relative_to(out)
    found = digest_product(step.kind, source)
    if found not in (None, outcome):
        raise ConfigError(f"{source} is not what the records of {piece} say was made; bring the whole piece again.")
    if source.is_dir():
        copy_tree(source, step.product, within=out)
    name = "*" if step.kind == "distances" else f"{source.stem}.*"  # distances have their own folder
    siblings = [path for path in source.parent.glob(name) if path.is_file()]
    for path in {source, *siblings} if source.is_file() else ():
        copy_file(path, step.product.parent / path.name, within=out)
