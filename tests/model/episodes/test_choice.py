"""Which episodes a training looks at: nothing that is tuned reads test seeds."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from xew.config import ConfigError
from xew.dataset import Dataset, demand_one_motion
from xew.episode import EpisodeError, Record
from xew.model import latents
from xew.model.codecs.ceiling import Ceiling
from xew.model.episodes import choice
from xew.model.episodes.choice import choose_episodes, sample_episodes, training_episodes
from xew.model.settings.parts import EpisodeChoice, sample_roles
from xew.model.settings.settings import Clip
from xew.protocol import (
    FIXED,
    HELD_OUT_ROBOTS,
    ROBOT_NAMES,
    SEEN_ROBOTS,
    SPLITS,
    TEST_SEED_START,
    VALIDATION_SEED_START,
    join_fault,
    seed_split,
)

BODY, UNSEEN = "body_96", "body_64"
FAMILIES = {"train": 0, "validation": VALIDATION_SEED_START, "test": TEST_SEED_START}


def dataset(*families: str, robots: tuple[str, ...] = (*ROBOT_NAMES, BODY, UNSEEN)) -> Dataset:
    """Two seeds of each family, of one task."""
    seeds = [FAMILIES[family] + i for family in families for i in range(2)]
    records = (Record("lift_pot", seed, robot, True, hashes={"rgb": "x"}) for seed in seeds for robot in robots)
    return Dataset(Path("data"), tuple((Path("data") / str(record.seed) / record.robot, record) for record in records))


def test_samples_are_of_validation_seeds_of_training_robots_and_of_a_body() -> None:
    found = sample_episodes(dataset("train", "validation", "test"), sample_roles(FIXED))
    assert set(found) == {*(f"seen/{robot}" for robot in SEEN_ROBOTS), f"unseen/{BODY}"}
    assert {record.seed for _, record in found.values()} == {VALIDATION_SEED_START}


def test_without_validation_seeds_samples_are_of_training_seeds_and_never_of_test_seeds() -> None:
    for families in (("train", "test"), ("train",)):
        found = sample_episodes(dataset(*families, robots=ROBOT_NAMES), sample_roles(FIXED))
        assert set(found) == {f"seen/{robot}" for robot in SEEN_ROBOTS}
        assert {record.seed for _, record in found.values()} == {0}
    assert sample_episodes(dataset("test"), sample_roles(FIXED)) == {}


def test_samples_of_a_split_of_many_bodies_show_a_few_of_each_role() -> None:
    bodies = tuple(f"body_{i}" for i in range(12))
    data = dataset("train", robots=(*bodies, "piper"))
    found = sample_episodes(data, dict.fromkeys(bodies, "seen") | {"franka_panda": "unseen", "piper": "target"})
    assert list(found) == [*(f"seen/body_{i}" for i in range(8)), "target/piper"]


def test_nothing_is_trained_on_validation_or_test_seeds() -> None:
    episodes = training_episodes(dataset("train", "validation", "test"), EpisodeChoice(FIXED.train_robots))
    assert {seed_split(record.seed) for _, record in episodes} == {"train"}


def with_faults(*families: str) -> Dataset:
    """All families, and of each scene of some of them an episode of faulty commands too."""
    whole, faulty = dataset(*FAMILIES), dataset(*families)
    of_faults = [replace(r, seed=join_fault(3, r.seed), success=False, fault="stop:5", progress=0.4) for _, r in faulty.cells]
    return Dataset(whole.root, (*whole.cells, *((Path("data") / str(r.seed) / r.robot, r) for r in of_faults)))


def test_faulty_episodes_never_train() -> None:
    asked = EpisodeChoice(FIXED.train_robots, replay=("piper",), samples=sample_roles(FIXED))
    assert choose_episodes(with_faults(*FAMILIES), asked) == choose_episodes(dataset(*FAMILIES), asked)


def test_few_shots_are_the_experts() -> None:
    asked = EpisodeChoice(("piper",), shots=2)
    assert [record.seed for _, record in training_episodes(with_faults("train"), asked)] == [0, 1]
    with pytest.raises(ConfigError, match="there are only 2 training episodes of piper"):
        training_episodes(with_faults("train"), replace(asked, shots=3))


@pytest.mark.parametrize(("faults", "count"), [(True, 4), (False, 2)])
def test_rollouts_take_faulty_episodes_in_or_leave_them_out(faults: bool, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choice, "read_dataset", lambda data: with_faults("test"))
    chosen = choice.select_episodes(Path("data"), "test", ["piper"], faults)
    assert len(chosen) == count and {seed_split(record.seed) for _, record in chosen} == {"test"}
    assert len([record for _, record in chosen if record.fault]) == count - 2


@pytest.mark.parametrize(("robot", "rate"), [("ur5_wsg", 25.0), ("arx_x5", 250 / 14)])
def test_training_refuses_mixed_frame_rates(robot: str, rate: float) -> None:
    """Imported episodes of several rates, also where only replayed ones have the other."""
    whole = dataset("train", "test", robots=ROBOT_NAMES)
    cells = [(path, replace(record, frame_rate=rate) if record.robot == robot else record) for path, record in whole.cells]
    asked = EpisodeChoice(("ur5_wsg",), replay=("arx_x5",))
    assert len(choose_episodes(whole, asked).replayed) == 2
    with pytest.raises(EpisodeError, match=rf"data has episodes at 16.67 \(2\) and at {rate:.2f} \(2\) frames per second"):
        choose_episodes(Dataset(whole.root, tuple(cells)), asked)


def test_motion_is_never_mixed() -> None:
    """The split names the kind of motion."""
    shared = dataset("train")
    own = tuple((folder, replace(record, motion="own")) for folder, record in shared.cells if record.seed == 1)
    mixed = Dataset(shared.root, tuple(cell for cell in shared.cells if cell[1].seed == 0) + own)
    robots = SPLITS["fixed"].train_robots

    def read(data: Dataset, split: str, **settings: Any) -> int:
        return len(training_episodes(data, EpisodeChoice(robots, motion=SPLITS[split].motion, **settings)))

    assert read(shared, "fixed") == read(Dataset(shared.root, own * 2), "fixed_own") == 6
    for split in ("fixed", "fixed_own"):
        with pytest.raises(EpisodeError, match=r"episodes of shared motion \(3\) and of own motion \(3\)"):
            read(mixed, split)
    with pytest.raises(EpisodeError, match=r"episodes of shared motion \(6\), and the split is of own motion"):
        read(shared, "fixed_own")
    replayed = EpisodeChoice((HELD_OUT_ROBOTS[0],), 1, robots)
    with pytest.raises(EpisodeError, match="own motion"):
        choose_episodes(mixed, replayed)
    records = [record for _, record in mixed.cells]
    with pytest.raises(EpisodeError, match="cannot be compared; keep them in separate data sets"):
        demand_one_motion(mixed.root, records)


@pytest.mark.parametrize("families", [("train", "validation", "test"), ("train", "test")])
def test_the_ceiling_in_the_log_is_of_no_test_seed_and_of_no_held_out_robot(
    families: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    data, read = dataset(*families), []

    def measure(codec: object, videos: object, **clip: int) -> Ceiling:
        return Ceiling(20.0, 0.1, len(list(videos)))

    def source(folder: Path, record: Record, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        read.append(record)
        return {"rgb": np.zeros((1, 2, 2, 3), np.uint8)}

    monkeypatch.setattr(latents, "measure_ceiling", measure)
    experiment, cache = SimpleNamespace(robots=FIXED, clip=Clip(5, 48, 64), conditions={}), SimpleNamespace()
    cache.codec, cache.encoding = (
        SimpleNamespace(decoder_hash="its weights", sees_render=False),
        SimpleNamespace(folder=tmp_path),
    )
    training = training_episodes(data, EpisodeChoice(FIXED.train_robots))
    said = latents.report_ceiling(experiment, cache, data, training, source)
    expected = "validation" if "validation" in families else "train"
    assert {seed_split(record.seed) for record in read} == {expected} and said["of"].startswith(expected)
    assert not {record.robot for record in read} & {*HELD_OUT_ROBOTS, UNSEEN}
    # Of the same videos it is not measured again, and of another codec it is.
    count = len(read)
    (tmp_path / "header.json").write_text(
        json.dumps({"codec": "its weights", "clip": asdict(Clip(5, 48, 64)), "ceiling": said})
    )
    assert latents.report_ceiling(experiment, cache, data, training, source) == said and len(read) == count
    cache.codec.decoder_hash = "others"
    assert latents.report_ceiling(experiment, cache, data, training, source) == said and len(read) == 2 * count
