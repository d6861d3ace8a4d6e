"""Rolling out many episodes: reading in processes, and one process a GPU; GPUs are names here."""

import functools
import os
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from tests import synthetic
from xew.config import ConfigError
from xew.dataset import Episode
from xew.episode import EpisodeError, read_record
from xew.model import rollout
from xew.model.conditions import CONDITIONS, list_conditions
from xew.model.devices import parts
from xew.model.sampling import rolling
from xew.model.sampling.reading import EpisodeReader
from xew.model.settings.settings import Clip

GPUS = ("4", "7")


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> list[Episode]:
    data = tmp_path_factory.mktemp("world") / "data"
    synthetic.write_synthetic_data(data, seeds=(1_000_000,), frames=5)
    return [(path.parent, read_record(path.parent)) for path in sorted(data.glob("*/*/*/episode.json"))]


def items_of(episodes: Sequence[Episode], lengths: Sequence[int]) -> list[rolling.Item]:
    return [(episodes[0], {"frame_count": length}) for length in lengths]


def test_processes_read_what_threads_read(episodes: list[Episode]) -> None:
    conditions = {condition.stream: condition for condition in list_conditions(CONDITIONS["pasted_render"])}
    reader = EpisodeReader(conditions, Clip(5, 64, 80), gives_render=True)
    for one, other in zip(reader.read_ahead(episodes), reader.read_ahead(episodes, processes=2), strict=True):
        assert one[0] == other[0] and one[1].keys() == other[1].keys()
        for name, frames in one[1].items():
            np.testing.assert_array_equal(frames, other[1][name])


def open_note(folder: Path, written: Any, stop: Any) -> rolling.Part:
    """Write which GPU has which episodes."""

    def note(pending: Sequence[rolling.Item]) -> None:
        lengths = " ".join(str(header["frame_count"]) for _, header in pending)
        (folder / os.environ["CUDA_VISIBLE_DEVICES"]).write_text(lengths)
        for _ in pending:
            written.put(1)

    return note


def test_each_gpu_gets_as_many_episodes_of_every_length(episodes: list[Episode], tmp_path: Path) -> None:
    done: list[int] = []
    pending = items_of(episodes, [9, 1, 5, 6, 2, 8, 3])
    rolling.roll_out_on_gpus(functools.partial(open_note, tmp_path), pending, GPUS, lambda: done.append(1))
    found = sorted([int(length) for length in path.read_text().split()] for path in tmp_path.iterdir())
    assert found == [[1, 3, 6, 9], [2, 5, 8]] and len(done) == 7
    assert {path.name for path in tmp_path.iterdir()} == set(GPUS)


def open_failing(written: Any, stop: Any) -> rolling.Part:
    """Fail with the longest episode; the other process ends early, or never."""

    def fail(pending: Sequence[rolling.Item]) -> None:
        if pending[-1][1]["frame_count"] == 9:
            raise ConfigError("no memory")
        while not stop.is_set():
            time.sleep(0.01)

    return fail


def test_an_error_of_one_process_ends_the_others_and_is_told(episodes: list[Episode]) -> None:
    with pytest.raises(ConfigError, match=r"^no memory$"):
        rolling.roll_out_on_gpus(open_failing, items_of(episodes, [9, 8]), GPUS, lambda: None)


def open_killed(written: Any, stop: Any) -> rolling.Part:
    """As `open_failing`, but the process is killed."""

    def die(pending: Sequence[rolling.Item]) -> None:
        if pending[-1][1]["frame_count"] == 9:
            os.kill(os.getpid(), signal.SIGKILL)
        while not stop.is_set():
            time.sleep(0.01)

    return die


def test_a_killed_process_ends_the_others_and_is_told(episodes: list[Episode]) -> None:
    with pytest.raises(EpisodeError, match="a worker process was killed"):
        rolling.roll_out_on_gpus(open_killed, items_of(episodes, [8, 9]), GPUS, lambda: None)


def refuse() -> Any:
    raise AssertionError("the process that shares out needs no model")


@pytest.mark.parametrize("gpus", [(), ("0",), GPUS])
def test_only_several_gpus_have_processes(
    gpus: tuple[str, ...], episodes: list[Episode], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared: list[tuple[str, ...]] = []
    here: list[Any] = []
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu" if gpus else "cpu")
    monkeypatch.setattr(rolling, "visible_gpus", lambda: gpus)
    monkeypatch.setattr(rolling, "roll_out_on_gpus", lambda opener, pending, gpus, done: shared.append(gpus))
    monkeypatch.setattr(rolling, "predict_and_write", lambda predictor, *_: here.append(predictor))
    open_predictor: Callable[[], Any] = refuse if len(gpus) > 1 else lambda: "predictor"
    rolling.roll_out(open_predictor, items_of(episodes, [5, 5]), tmp_path)
    assert (shared, here) == (([GPUS], []) if len(gpus) > 1 else ([], ["predictor"]))


@pytest.mark.parametrize(
    ("backend", "cores", "memory", "episodes", "readers"),
    [
        ("cpu", 64, 0.0, 500, 0),
        ("gpu", 16, 84.0, 500, 8),
        ("gpu", 64, 84.0, 500, 12),
        ("gpu", 8, 84.0, 500, 4),
        ("gpu", 16, 67.0, 500, 2),
        ("gpu", 16, 40.0, 500, 0),
        ("gpu", 2, 84.0, 500, 0),
        ("gpu", 16, 84.0, 31, 0),
    ],
)
def test_processes_read_for_a_gpu_as_cores_memory_and_work_allow(
    backend: str, cores: int, memory: float, episodes: int, readers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(parts, "free_gpu_memory", lambda _: (memory,))
    monkeypatch.setattr(jax, "local_devices", lambda: [SimpleNamespace(memory_stats=lambda: {"bytes_limit": 64e9})])
    assert parts.choose_readers(episodes, min(rolling.MOST_READERS, cores // 2)) == readers


def test_the_latest_checkpoint_is_rolled_out(tmp_path: Path) -> None:
    for step in ("20", "100", "3.tmp"):
        (tmp_path / "checkpoints" / step).mkdir(parents=True)
    assert rollout.find_step(tmp_path, None) == 100 and rollout.find_step(tmp_path, 20) == 20
    assert rollout.find_step(tmp_path / "other", None) is None
    assert rollout.find_step(Path("configs/fixed.yaml"), 20) is None
