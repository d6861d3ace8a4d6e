"""Pieces of a study that ran in folders of their own, on machines that share no disk, brought together.

A piece is the folder that `xew.analysis.study` has written elsewhere, whole or without what is large: data, latents,
checkpoints and rollouts need not come along. What a piece has done is taken over with its record, which says from which inputs
it was made; whether it holds for this study is told by its key, never by times.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path

from xew.analysis.studies.ledger import Ledger, digest_product
from xew.analysis.studies.plan import Step, sort_steps
from xew.config import ConfigError

SERVES_ALL = ("generate", "latents")
"""Kinds of steps whose products are not taken over: every machine has its own, and records tell whether they are the same."""
READ_LATER = ("baselines", "evaluate", "distances")
"""Kinds of steps whose products the analysis reads: without them a record is of no use."""


def merge_piece(steps: Mapping[str, Step], ledger: Ledger, piece: Path) -> list[str]:
    """Take over what a piece has done and this study has not.

    Args:
        steps: of the study, whose products lie in its folder.
        ledger: of the study.
        piece: folder of the piece.

    Returns:
        Names of the steps that were taken over.

    Raises:
        ConfigError: the piece is no study, or has another product than its record says.
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
    """Copy what a piece has beside its data of the baselines' scores, which a grading that is left to do goes on from."""
    if data.is_relative_to(out):
        beside = data.with_name(f"{data.name}-baselines").relative_to(out)
        if (piece / beside).is_dir():
            shutil.copytree(piece / beside, out / beside, dirs_exist_ok=True)


def _take_product(step: Step, out: Path, piece: Path, outcome: str) -> None:
    """Copy what a piece has of a step's product, with what lies beside it. Raises ConfigError as `merge_piece`."""
    if step.kind in SERVES_ALL:
        return
    source = piece / step.product.relative_to(out)
    found = digest_product(step.kind, source)
    if found not in (None, outcome):
        raise ConfigError(f"{source} is not what the records of {piece} say was made; bring the whole piece again.")
    if source.is_dir():
        shutil.copytree(source, step.product, dirs_exist_ok=True, ignore=shutil.ignore_patterns(".*"))
    name = "*" if step.kind == "distances" else f"{source.stem}.*"  # distances have a folder of their own
    beside = [path for path in source.parent.glob(name) if path.is_file()]
    for path in {source, *beside} if source.is_file() else ():
        step.product.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, step.product.parent / path.name)
