"""Measured rates of the steps of a study: of this machine, as `benchmarks/node.py` writes them, else documented ones.

    ~/.cache/xew/rates.json           of this machine ($XDG_CACHE_HOME); another file by `study --machine.rates`
    xew/analysis/studies/rates.json   documented ones, with their source

Both hold for each network size one entry for a part of the machine and one for all of it.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from xew.config import CONVERTER, ConfigError, parse
from xew.files import cache_folder, read_json, write_text

DOCUMENTED = Path(__file__).with_name("rates.json")
SCALING = 0.86
"""Exponent of the speed by the number of GPUs where one number was measured: training is 3.3 times as fast on four H100."""


@dataclass(frozen=True)
class Rate:
    """Measured time and space of one kind of step."""

    start_s: float
    """Time from the start of a command to its first result, with compilation [s]."""
    item_s: float
    """Time of an episode, an encoded stream of one, a sample of a training batch, or a graded video [s]."""
    item_mb: float = 0.0
    """Space of an item, or of a whole training run [MB]."""
    scaling: float = 0.0
    """Exponent of the speed by the number of GPUs: 1 if twice as many take half the time."""

    def seconds(self, items: float, gpus: int = 1) -> float:
        """Time of a command on a number of GPUs, or without any."""
        return self.start_s + items * self.item_s / max(1, gpus) ** self.scaling


@dataclass(frozen=True)
class Rates:
    """The rates of one machine, or a part of it, at one network size."""

    machine: str
    measured: str
    """Source: date and version, or page."""
    gpus: int
    """Number of GPUs that were used; 0 without any."""
    kinds: dict[str, Rate]
    """Rates by kind of step."""
    episode_frames: int = 178
    """Mean number of frames of an episode."""


@dataclass(frozen=True)
class Source:
    """The rates that a study is estimated by."""

    kinds: dict[str, Rate]
    """Rates by kind of step, on one GPU or without any."""
    episode_frames: int
    text: str
    """One line on where they come from."""


def rates_path() -> Path:
    """File of this machine's rates."""
    return cache_folder("rates.json")


def find_rates(size: str, path: Path | None = None) -> Source:
    """The rates of a network size: measured ones, and documented ones of the kinds of steps that were not measured.

    Args:
        size: key of the network's size.
        path: file of measured rates that must exist; default: this machine's, if it exists.
    """
    documented = read_rates(DOCUMENTED)
    sources = [documented.get(size, documented["small"])]
    if path is not None or rates_path().is_file():
        sources.insert(0, read_rates(path or rates_path()).get(size, ()))
    kinds: dict[str, Rate] = {}
    for entries in sources:
        kinds = join_rates(entries) | kinds
    first = next(entries for entries in sources if entries)
    measured = join_rates(first).keys()
    text = f"the rates of: {' and '.join(entry.machine for entry in first)} ({first[0].measured})"
    if first is sources[-1]:
        text += f"; nothing of size {size} was measured here, python -m benchmarks.node does it"
    elif others := sorted(kinds.keys() - measured):
        text += f"; {', '.join(others)}: documented rates of {sources[-1][0].machine}"
    return Source(kinds, first[-1].episode_frames, text)


def read_rates(path: Path) -> dict[str, tuple[Rates, ...]]:
    """The entries of a file of rates by network size, by growing number of GPUs. Raises ConfigError."""
    try:
        content = read_json(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read the rates {path}: {error}; python -m benchmarks.node writes such a file.") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: expected network sizes, found {type(content).__name__}.")
    entries = {size: [parse(Rates, entry, f"{path}, {size}") for entry in listed] for size, listed in content.items()}
    return {size: tuple(sorted(rates, key=lambda entry: entry.gpus)) for size, rates in entries.items()}


def write_rates(path: Path, size: str, entries: Sequence[Rates]) -> None:
    """Replace the entries of one network size in a file of rates. Kinds of steps that were not measured stay as they were."""
    content = read_json(path) if path.is_file() else {}
    before = {entry.gpus: entry.kinds for entry in read_rates(path).get(size, ())} if content else {}
    merged = [replace(entry, kinds=before.get(entry.gpus, {}) | entry.kinds) for entry in entries]
    content[size] = [CONVERTER.unstructure(entry) for entry in merged]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(content, indent=1) + "\n", within=path.parent)


def join_rates(entries: Sequence[Rates]) -> dict[str, Rate]:
    """One rate for each kind of step, on one GPU, with the scaling between the smallest and the largest number of GPUs.

    Of entries with the same number, which are parts of a machine without GPUs, the last counts.
    """
    kinds = dict.fromkeys(kind for entry in entries for kind in entry.kinds)
    return {kind: _join({max(1, e.gpus): e.kinds[kind] for e in entries if kind in e.kinds}) for kind in kinds}


def _join(by_gpus: dict[int, Rate]) -> Rate:
    fewest, most = min(by_gpus), max(by_gpus)
    few, many = by_gpus[fewest], by_gpus[most]
    scaling = SCALING
    if most > fewest and min(few.item_s, many.item_s) > 0:
        scaling = math.log(few.item_s / many.item_s) / math.log(most / fewest)
    return Rate(max(few.start_s, many.start_s), few.item_s * fewest**scaling, few.item_mb, max(0.0, scaling))
