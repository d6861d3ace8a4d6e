"""JSON files that xew writes and reads again: a whole one of each kind, and who reads it."""

import contextlib
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as parquet

from xew.analysis.scores import read_scores
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.plan import Step
from xew.episode import Record, read_record
from xew.metrics.grading.bundle import differences, read_bundle, write_bundle
from xew.metrics.grading.scores import Cell, CellStore, _curve_table, _row_table
from xew.model.cache.scales import read_scales
from xew.model.codecs.autoencoders import ConvAutoencoderCodec, WanVaeCodec
from xew.model.codecs.codec import load_kept_codec
from xew.model.codecs.conv_autoencoder import AUTOENCODERS
from xew.model.codecs.vae import VAES
from xew.model.conditions import ACTIONS, list_conditions
from xew.model.rollout import is_done
from xew.model.runs.checkpoint import find_damage
from xew.model.runs.folder import EPISODES, START, check_episodes, trace_start
from xew.rollout import read_rollout, read_rollout_video
from xew.sim_warp.manifest import read_manifest

REPOSITORY = Path(__file__).parents[2]
HEADER = Record("place_empty_cup", 0, "piper", True, frame_count=3, object_names=("cup",), hashes={"rgb": "a", "states": "b"})
CELL = Cell("m", "c", "place_empty_cup", 0, "piper", 3, "p", "r", "s", "settings")
STEP = Step("train", "x", (), (), {}, Path("runs/x"))


def header(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    place = folder / "place_empty_cup/0000000/piper"
    return place / "episode.json", asdict(HEADER), lambda: read_record(place)


def rollout(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    place = folder / "place_empty_cup/0000000/piper"
    place.mkdir(parents=True)
    np.savez(place / "v.npz", np.zeros((2, 8, 8, 3), np.uint8))
    content = {"model": "m", "condition": "c", "frame_count": 2, "source_hash": "a", "checkpoint_step": 4, "config": {}}
    episode = (place, HEADER)

    def read() -> None:
        is_done(folder, episode, content)
        read_rollout_video(read_rollout(place))

    return place / "rollout.json", content, read


def seeds(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    tasks = {"lift_pot": {"train": [1, 2], "test": [1_000_000], "rejected": {"3": {"piper": "plan"}}}}
    content = {"robots": ["piper"], "device": "cpu", "versions": {"xew": "1"}, "tasks": tasks}
    return folder / "seeds.json", content, lambda: read_manifest(folder / "seeds.json").failing("lift_pot", ["piper"])


def bundle(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    from xew.metrics.grading import bundle as bundles

    rows = pd.DataFrame([{name: getattr(CELL, name) for name in ("model", "condition", "task", "seed", "robot")}])
    rows = rows.assign(metric="psnr", value=20.0, exact_frames=0)
    rows.attrs = {"protocol": 4, "metrics": {"psnr": {}}, "estimators": {}, "frame_zero": "given", "allowed": []}
    (folder / "scores.parquet").touch()
    path = folder / "bundle.json"
    write_bundle(path, folder / "scores.parquet", rows, [CELL])
    content = json.loads(path.read_text())

    def read() -> None:
        with contextlib.suppress(ValueError, RecursionError):
            changed = json.loads(path.read_text())
            if isinstance(changed, dict) and "digest" in changed:  # whoever changes it can write its digest, too
                changed.pop("digest")
                path.write_text(json.dumps(changed | {"digest": bundles.digest(changed)}))
        choices = {name: content[name] for name in bundles.CHOICES}
        differences(read_bundle(path), choices, [CELL])

    return path, content, read


def start(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    return folder / START, {"run": "runs/x", "step": 4, "saved": None}, lambda: trace_start(folder, folder / "no-run")


def episodes(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    digests = {"place_empty_cup/0/piper": "0" * 16, "place_empty_cup/1/piper": "1" * 16}
    return folder / EPISODES, digests, lambda: check_episodes(folder, [(folder, HEADER)])


def scales(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    conditions = [c for entry in ACTIONS.values() if entry for c in list_conditions(entry) if c.scale != "none"][:1]
    content = {conditions[0].name: {"middle": [0.0, 1.0], "width": [1.0, 2.0], "limit": 1.0}}
    return folder / "scales.json", content, lambda: read_scales(folder / "scales.json", conditions, "make it again")


def ledger(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    kept = Ledger(folder)
    content = {"key": "k", "status": "done", "outcome": "o", "seconds": 1.5, "host": "h", "at": "2026-01-01 00:00:00"}
    return folder / "state/train/x.json", content, lambda: (kept.find_done(STEP), kept.record(STEP), kept.begin(STEP))


def scores(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    """The attributes of a score table; its file is made of them when it is read."""
    path = folder / "scores.parquet"
    metric = {
        "dimension": "visual",
        "unit": "dB",
        "higher_is_better": True,
        "estimated": False,
        "low": 0.0,
        "high": None,
        "reference": "r",
    }
    content = {"protocol": 4, "metrics": {"psnr": metric | {"title": "PSNR", "estimated": False, "reported": False}}}
    content |= {"versions": {"xew": "1"}, "estimators": {"mask": "default"}, "frame_zero": "given", "robots": ["piper"]}
    row = {"model": "m", "condition": "c", "task": "lift_pot", "seed": 1, "robot": "piper", "metric": "psnr", "value": 20.0}
    rows = pd.DataFrame([row | {"frames": 5, "exact_frames": 0}])
    rows.assign(frame=1).to_parquet(folder / "scores.curves.parquet")
    rows.to_parquet(path)
    table = parquet.read_table(path)

    def read() -> None:
        text = (folder / "attributes.json").read_bytes()
        parquet.write_table(table.replace_schema_metadata({**table.schema.metadata, b"PANDAS_ATTRS": text}), path)
        found = read_scores(path)
        assert found.measured_by and found.versions is not None

    return folder / "attributes.json", content, read


def cell(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    store = CellStore(folder / "cells", folder / "baselines")
    content = {"content": CELL.content, "exact_frames": 0, "values": {"psnr": 20.0}, "curves": {"psnr": [1.0, None]}}

    def read() -> None:
        if not store.missing(CELL, ["psnr"]) and (grades := store.read(CELL)):
            _row_table([(CELL, grades)], ["psnr"])
            _curve_table([(CELL, grades)], ["psnr"])

    return store._path(CELL), content, read


def vae(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    content = {"size": asdict(VAES["tiny"]), "dtype": "float32", "chunk": 8, "hash": "h"}
    return folder / "vae.json", content, lambda: load_kept_codec(WanVaeCodec, folder, "copy it again")


def autoencoder(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    content = {"size": asdict(next(iter(AUTOENCODERS.values()))), "dtype": "float32", "hash": "h"}
    return folder / "autoencoder.json", content, lambda: load_kept_codec(ConvAutoencoderCodec, folder, "copy it again")


def sums(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    return folder / "sums/4.json", {"params/a": "0" * 64, "top": "1"}, lambda: find_damage(folder, 4, ["params"])


def config(folder: Path) -> tuple[Path, Any, Callable[[], Any]]:
    """A config that the user names; YAML reads JSON."""
    from xew.config import read_yaml
    from xew.model.experiment import load_experiment

    content = read_yaml(REPOSITORY / "configs/debug.yaml")
    return folder / "config.yaml", content, lambda: load_experiment(folder / "config.yaml")


KINDS = {
    kind.__name__: kind
    for kind in (header, rollout, seeds, bundle, start, episodes, scales, ledger, scores, cell, vae, autoencoder, sums, config)
}
"""Functions of a folder to the path of a kind of file, its whole content, and a function that reads it."""
