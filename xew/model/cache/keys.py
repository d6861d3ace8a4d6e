"""File names of the latent cache; each holds a hash of the sources of its content, so a stale file is never read."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from xew.config import digest
from xew.dataset import Episode
from xew.episode import Record, episode_folder
from xew.model.settings.parts import Encoding
from xew.protocol import HEAD, parse_change

CACHE_VERSION = 2
RUN_SCALES = "scales.json"
"""Name of the file in a run with the scales of its numeric conditions."""


def stream_path(encoding: Encoding, codec_hash: str, record: Record, stream: str) -> Path:
    """The file of one encoded stream of one episode."""
    inputs = encoding.inputs
    condition = inputs.conditions.get(stream)
    name = condition.name if condition else stream
    of_scene = condition is None or condition.make is None
    sources = (record.hashes["rgb"],) if of_scene else (record.hashes["states"], record.hashes["robot"])
    if not of_scene and record.camera.name != HEAD:
        sources = (*sources, record.table)
    change = parse_change(record.change)
    if not of_scene and change and change.factor == "height":  # of the table, on which the robot's shadows fall
        sources = (*sources, record.change)
    if condition is not None and condition.is_guess:
        sources = (*sources, record.hashes["rgb"])
    if condition is not None and (of_scene or condition.with_history):
        sources = (*sources, str(inputs.history))
    cut = digest(inputs.clip) if inputs.chunks == 1 else (digest(inputs.clip), "chunks")
    key = _hash((CACHE_VERSION, codec_hash, cut, name, *sources))
    return episode_folder(encoding.folder, record.task, record.seed, record.robot) / f"{name}-{key}.safetensors"


def scales_path(encoding: Encoding, episodes: Sequence[Episode]) -> Path:
    """The file of the scales of these episodes' numbers: in the cache, or in the run to adapt."""
    if encoding.start_from is not None:
        return encoding.start_from / RUN_SCALES
    names = sorted({condition.name for condition in encoding.inputs.conditions.values() if condition.scale != "none"})
    hashes = sorted(record.hashes["states"] for _, record in episodes)
    return encoding.folder / f"scales-{_hash((CACHE_VERSION, hashes, names))}.json"


def _hash(content: Any) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:12]
