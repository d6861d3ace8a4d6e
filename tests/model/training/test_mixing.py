"""Faulty episodes in training: they are encoded and drawn where a part of the batch is of them, and nowhere else."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.model.training.test_training import CONFIG, FRAMES
from tests.synthetic import write_synthetic_data
from xew.config import ConfigError
from xew.dataset import read_dataset
from xew.model import latents, train
from xew.model.episodes.choice import choose_episodes
from xew.model.experiment import load_experiment
from xew.model.training.data import Batch, ClipSource
from xew.model.training.order import make_dataset
from xew.protocol import join_fault

FAULTY = (join_fault(3, 0), join_fault(3, 1_000_000))


@pytest.fixture(scope="module")
def failing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The config of data that also hold faulty episodes, of a training and of a test seed; nothing is encoded."""
    root = tmp_path_factory.mktemp("failing")
    write_synthetic_data(root / "data", seeds=(0, 1, 1_000_000), frames=FRAMES)
    for folder in write_synthetic_data(root / "data", seeds=FAULTY, frames=FRAMES):
        header = json.loads((folder / "episode.json").read_text())
        (folder / "episode.json").write_text(json.dumps(header | {"success": False, "fault": "stop:5", "progress": 0.5}))
    (root / "config.yaml").write_text(f"data: {root / 'data'}\nout: {root / 'run'}\n{CONFIG}")
    return root / "config.yaml"


def test_faulty_episodes_are_encoded_only_where_a_part_of_the_batch_is_of_them(
    failing: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    encoded = failing.parent / "data-latents/place_empty_cup"
    latents.main([str(failing)])
    assert {folder.name for folder in encoded.iterdir()} == {"0000000", "0000001"}
    with pytest.raises(SystemExit):
        train.main([str(failing), "--train.faults", "0.5"])
    assert "is not in the cache; run `python -m xew.model.latents" in capsys.readouterr().err
    assert not (failing.parent / "run").exists()
    latents.main([str(failing), "--train.faults", "0.5"])
    assert {folder.name for folder in encoded.iterdir()} == {"0000000", "0000001", str(FAULTY[0])}


def test_a_part_of_every_batch_is_faulty_and_goes_on_where_it_stopped(failing: Path) -> None:
    mixing = load_experiment(failing, ["--train.faults", "0.25"])
    episodes = choose_episodes(read_dataset(mixing.data), mixing.choice)

    class Names(ClipSource):
        def __getitem__(self, index: int) -> Batch:
            return Batch(np.array(bool(self.samples[index][0].fault)), {}, np.array(index))

    source = Names.open(mixing.encoding, mixing.instructions, episodes.fresh, episodes.mixed)
    batches = iter(make_dataset(source, 8, seed=0, mixed=mixing.spec.mixed))
    drawn, position = [next(batches) for _ in range(6)], batches.get_state()
    assert all(batch.latents.tolist() == [False] * 6 + [True] * 2 for batch in drawn)
    continued = iter(make_dataset(source, 8, seed=0, mixed=mixing.spec.mixed))
    continued.set_state(position)
    for _ in range(3):
        np.testing.assert_array_equal(next(continued).text, next(batches).text)


def test_batches_of_experts_are_those_of_earlier_versions() -> None:
    class Numbers:
        """Ten fresh samples, and five of faulty episodes."""

        fresh = 10

        def __len__(self) -> int:
            return 15

        def __getitem__(self, index: int) -> Batch:
            return Batch(np.float32(index), {}, np.int32(0))

    batches = iter(make_dataset(Numbers(), 4, seed=3))  # type: ignore[arg-type]
    assert [next(batches).latents.astype(int).tolist() for _ in range(3)] == [[4, 6, 9, 7], [5, 3, 1, 8], [2, 0, 8, 1]]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("0.9",), "train.faults is 0.9 of a batch of 2; it must be a part below 1 that leaves"),
        (("-0.1",), "train.faults is -0.1 of a batch of 2"),
        (("0.5", "--adapt.start-from", "x", "--adapt.robots", "piper"), "an adaptation has no faulty episodes"),
    ],
)
def test_parts_that_cannot_be_are_refused(failing: Path, options: tuple[str, ...], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load_experiment(failing, ["--train.faults", *options])
