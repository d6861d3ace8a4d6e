"""Episodes as a LeRobotDataset v3.0: read back with pyarrow and PyAV, and with LeRobot itself where it is installed."""

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pandas as pd
import pyarrow.parquet as parquet
import pytest

from tests.synthetic import write_synthetic_data, write_synthetic_view
from xew.dataset import find_accepted, view_episode
from xew.episode import HEIGHT, WIDTH, EpisodeError, Record, States, read_states, read_video, write_episode
from xew.exchange import lerobot
from xew.exchange.lerobot import Args, _color_statistics, color_counts, export, main
from xew.protocol import TEST_SEED_START, CameraSpec

TASKS, SEEDS, ROBOTS = ("place_empty_cup", "beat_block_hammer"), (0, 1), ("piper", "arx_x5")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data")
    write_synthetic_data(root, TASKS, SEEDS, ROBOTS)
    return root


@pytest.fixture(scope="module")
def exported(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "lerobot"
    assert export(Args(data, out, robot_video=True)) == (len(TASKS) * len(SEEDS) * len(ROBOTS), [])
    return out


def episodes(data: Path) -> list[tuple[Record, States, np.ndarray]]:
    return [(record, read_states(folder), read_video(folder / "rgb.mkv")) for folder, record in find_accepted(data)]


def decoded(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Frames [t h w 3] RGB and their times [t] s."""
    with av.open(str(path)) as container:
        frames = [(frame.to_ndarray(format="rgb24"), float(frame.pts * frame.time_base)) for frame in container.decode(video=0)]
    return np.stack([image for image, _ in frames]), np.array([time for _, time in frames])


def test_numbers_come_back_exactly(data: Path, exported: Path) -> None:
    rows = pd.read_parquet(exported / "data/chunk-000/file-000.parquet")
    start = 0
    for number, (_, states, _) in enumerate(episodes(data)):
        mine = rows[rows["episode_index"] == number]
        assert (mine["index"] == np.arange(start, start + states.frame_count)).all()
        assert (np.stack(mine["action"]) == states.action).all()
        assert (np.stack(mine["observation.state"]) == states.joint_pos).all()
        assert (np.stack(mine["observation.tool_pose"]) == states.tool_pose.reshape(-1, 14)).all()
        assert np.abs(mine["timestamp"] - mine["frame_index"] * 0.06).max() < 1e-5
        assert mine["next.done"].tolist() == mine["next.success"].tolist() == [False] * (states.frame_count - 1) + [True]
        start += states.frame_count
    assert len(rows) == start


def test_pictures_come_back_where_the_table_says(data: Path, exported: Path) -> None:
    table = parquet.read_table(exported / "meta/episodes").to_pylist()
    key = "videos/observation.images.head"
    for row, (record, states, rgb) in zip(table, episodes(data), strict=True):
        frames, times = decoded(
            exported / key / f"chunk-{row[f'{key}/chunk_index']:03d}/file-{row[f'{key}/file_index']:03d}.mp4"
        )
        assert len(frames) == row["length"] == states.frame_count
        assert np.abs(times - np.arange(states.frame_count) * 0.06).max() < 1e-6
        assert row[f"{key}/from_timestamp"] == 0 and row[f"{key}/to_timestamp"] == pytest.approx(len(frames) * 0.06)
        error = np.abs(frames.astype(int) - rgb)
        assert error.mean() < 2.5, "lossy, but the same pictures in the same colors"
        named = tuple(row[f"xew/{name}"] for name in ("robot", "task", "seed", "motion"))
        assert named == (record.robot, record.task, record.seed, "shared")
    assert table[-1]["dataset_to_index"] == sum(row["length"] for row in table)


def test_an_episode_has_files_of_its_own(exported: Path) -> None:
    """`lerobot-edit-dataset` copies such files, and encodes others anew, at a rate rounded down to 16 a second."""
    table = parquet.read_table(exported / "meta/episodes").to_pylist()
    for name in ("head", "robot"):
        key = f"videos/observation.images.{name}"
        places = [(row[f"{key}/chunk_index"], row[f"{key}/file_index"]) for row in table]
        files = list((exported / key).rglob("*.mp4"))
        assert len(set(places)) == len(files) == len(table)
        with av.open(str(files[0])) as container:
            assert container.streams.video[0].average_rate == Fraction(50, 3)


def test_every_view_has_a_video_by_robotwin_s_name(data: Path, tmp_path: Path) -> None:
    views = {"head": "cam_head", "wrist_left": "cam_left_wrist", "shelf_160x120": "shelf_160x120"}
    few = tmp_path / "data"
    write_synthetic_data(few, TASKS[:1], SEEDS[:1], ROBOTS)
    write_synthetic_view(few, CameraSpec("wrist_left", "left_tool"))
    write_synthetic_view(few, CameraSpec("shelf", size=(160, 120)))
    out = tmp_path / "lerobot"
    export(Args(few, out, views=tuple(views)))
    features = json.loads((out / "meta/info.json").read_text())["features"]
    folder = find_accepted(few)[0][0]
    for view, name in views.items():
        key = f"observation.images.{name}"
        expected = read_video(view_episode(folder, view) / "rgb.mkv")
        frames, _ = decoded(out / "videos" / key / "chunk-000/file-000.mp4")
        assert features[key]["shape"] == list(expected.shape[1:]) and features[key]["info"]["video.width"] == expected.shape[2]
        assert np.abs(frames.astype(int) - expected).mean() < 2.5
    with pytest.raises(EpisodeError, match=r"has no view 'side', but head, shelf_160x120, wrist_left; add it by"):
        export(Args(few, tmp_path / "other", views=("side",)))


def test_an_episode_carries_its_change(data: Path, exported: Path, tmp_path: Path) -> None:
    for (folder, record), change in zip(find_accepted(data), ("light:5", "clutter:40"), strict=False):
        write_episode(tmp_path / "data", replace(record, change=change), read_states(folder), read_video(folder / "rgb.mkv"))
    export(Args(tmp_path / "data", tmp_path / "out"))
    assert parquet.read_table(tmp_path / "out/meta/episodes")["xew/change"].to_pylist() == ["light:5", "clutter:40"]
    assert "xew/change" not in parquet.read_table(exported / "meta/episodes").column_names


def test_faulty_episodes_are_exported_if_asked_with_their_fault_and_outcome(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outcomes = {"": True, "stop:30": False}
    for (folder, record), (fault, success) in zip(find_accepted(data), outcomes.items(), strict=False):
        faulty = replace(record, fault=fault, success=success, progress=0.5 if fault else None)
        write_episode(tmp_path / "data", faulty, read_states(folder), read_video(folder / "rgb.mkv"))
    export(Args(tmp_path / "data", tmp_path / "out", faults=True))
    assert parquet.read_table(tmp_path / "out/meta/episodes")["xew/fault"].to_pylist() == list(outcomes)
    rows = parquet.read_table(tmp_path / "out/data").to_pandas().groupby("episode_index")
    assert rows["next.success"].sum().tolist() == [1, 0] and rows["next.done"].sum().tolist() == [1, 1]
    assert "omitted" not in capsys.readouterr().out
    assert export(Args(tmp_path / "data", tmp_path / "demonstrations"))[0] == 1
    assert "omitted: 1 episodes of faulty commands, which --faults exports too" in capsys.readouterr().out
    demonstrations = parquet.read_table(tmp_path / "demonstrations/meta/episodes")
    assert "xew/fault" not in demonstrations.column_names and len(demonstrations) == 1
    with pytest.raises(EpisodeError, match="no episode of these robots"):
        export(Args(tmp_path / "data", tmp_path / "none", robots=(faulty.robot,)))


def test_a_red_block_stays_red(tmp_path: Path) -> None:
    video = np.full((4, HEIGHT, WIDTH, 3), 255, np.uint8)
    video[:, 80:160, 100:200] = (200, 30, 20)
    film = lerobot._VideoFiles(tmp_path / "observation.images.head", Fraction(50, 3))
    film.add(video)
    frames, _ = decoded(tmp_path / "observation.images.head/chunk-000/file-000.mp4")
    assert np.abs(frames[:, 90:150, 110:190].reshape(-1, 3).astype(int) - (200, 30, 20)).max() <= 8


def test_frames_of_another_size_are_refused(tmp_path: Path) -> None:
    film = lerobot._VideoFiles(tmp_path / "observation.images.head", Fraction(25))
    film.add(np.zeros((2, 240, 320, 3), np.uint8))
    with pytest.raises(EpisodeError, match="frames of 640x480, expected 320x240"):
        film.add(np.zeros((2, 480, 640, 3), np.uint8))


def test_the_header_is_that_of_the_format(data: Path, exported: Path) -> None:
    information = json.loads((exported / "meta/info.json").read_text())
    assert information["codebase_version"] == "v3.0" and information["fps"] == pytest.approx(1000 / 60)
    assert information["total_episodes"] == 8 and information["robot_type"] == "several"
    assert information["features"]["action"]["names"][6:9] == ["left_joint7", "left_gripper", "right_joint1"]
    tasks = pd.read_parquet(exported / "meta/tasks.parquet")
    assert sorted(tasks["task_index"]) == list(range(information["total_tasks"]))
    rows = pd.read_parquet(exported / "data/chunk-000/file-000.parquet")
    stored = {feature for feature, about in information["features"].items() if about["dtype"] != "video"}
    assert set(rows.columns) == stored and information["total_frames"] == len(rows)


def test_statistics_are_those_of_all_frames(data: Path, exported: Path) -> None:
    stats = json.loads((exported / "meta/stats.json").read_text())
    actions = np.concatenate([states.action for _, states, _ in episodes(data)]).astype(float)
    pixels = np.concatenate([rgb.reshape(-1, 3) for _, _, rgb in episodes(data)]) / 255
    for name, expected in (("mean", actions.mean(0)), ("std", actions.std(0)), ("q90", np.quantile(actions, 0.9, axis=0))):
        assert np.allclose(stats["action"][name], expected)
    for name, expected in (("min", pixels.min(0)), ("max", pixels.max(0)), ("mean", pixels.mean(0)), ("std", pixels.std(0))):
        assert np.allclose(np.array(stats["observation.images.head"][name])[:, 0, 0], expected, atol=1e-6)
    assert stats["action"]["count"] == stats["observation.images.head"]["count"] == [len(actions)]


def test_quantiles_of_colors() -> None:
    video = np.random.default_rng(0).integers(0, 256, (2, 30, 40, 3)).astype(np.uint8)
    found = _color_statistics(color_counts(video), 2)
    for name, share in lerobot.QUANTILES.items():
        expected = np.quantile(video.reshape(-1, 3), share, axis=0, method="inverted_cdf") / 255
        assert np.allclose(np.array(found[name])[:, 0, 0], expected)


def test_files_are_closed_as_they_fill(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lerobot, "LARGEST_DATA", 0)
    monkeypatch.setattr(lerobot, "FILES_PER_CHUNK", 3)
    export(Args(data, tmp_path / "many", tasks=TASKS[:1]))
    tables = sorted(str(path.relative_to(tmp_path / "many/data")) for path in (tmp_path / "many/data").rglob("*.parquet"))
    assert tables == [f"chunk-00{n // 3}/file-00{n % 3}.parquet" for n in range(4)]
    for number, row in enumerate(parquet.read_table(tmp_path / "many/meta/episodes").to_pylist()):
        assert (row["data/chunk_index"], row["data/file_index"]) == (number // 3, number % 3)
        key = "videos/observation.images.head"
        film = tmp_path / f"many/{key}/chunk-00{row[f'{key}/chunk_index']}/file-00{row[f'{key}/file_index']}.mp4"
        assert len(decoded(film)[0]) == row["length"] and row[f"{key}/from_timestamp"] == 0


def with_rate(data: Path, out: Path, rates: dict[int, float]) -> Path:
    """A copy of the Piper's episodes of these seeds with other frame rates."""
    for folder, record in find_accepted(data):
        if record.robot == "piper" and record.seed in rates:
            changed = replace(record, frame_rate=rates[record.seed])
            write_episode(out, changed, read_states(folder), read_video(folder / "rgb.mkv"))
    return out


@pytest.mark.parametrize(("rate", "fps"), [(25.0, 25), (250 / 7, 250 / 7), (30000 / 1001, 30000 / 1001), (1000 / 60, 50 / 3)])
def test_the_episodes_rate_is_the_set_s(rate: float, fps: float, data: Path, tmp_path: Path) -> None:
    export(Args(with_rate(data, tmp_path / "data", {0: rate, 1: rate}), tmp_path / "out"))
    information = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert information["fps"] == pytest.approx(fps, rel=1e-5) and isinstance(information["fps"], type(fps))
    assert information["features"]["observation.images.head"]["info"]["video.fps"] == information["fps"]
    rows = pd.read_parquet(tmp_path / "out/data/chunk-000/file-000.parquet")
    assert rows["timestamp"][:3].tolist() == pytest.approx([0, 1 / fps, 2 / fps], rel=1e-5)
    _, times = decoded(next((tmp_path / "out").rglob("*.mp4")))
    assert times[1] == pytest.approx(1 / fps, rel=1e-3)
    row = parquet.read_table(tmp_path / "out/meta/episodes").to_pylist()[0]
    assert row["videos/observation.images.head/to_timestamp"] == pytest.approx(row["length"] / fps, rel=1e-5)


def test_mixed_rates_are_refused(data: Path, tmp_path: Path) -> None:
    mixed = with_rate(data, tmp_path / "data", {0: 25.0, 1: 50 / 3})
    with pytest.raises(
        EpisodeError, match=r"has episodes at 16.67 \(2\) and at 25.00 \(2\) frames per second, which cannot be"
    ):
        export(Args(mixed, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_what_an_import_does_not_know_is_left_out(data: Path, tmp_path: Path) -> None:
    folder, record = find_accepted(data)[0]
    states = read_states(folder)
    unknown = Record(**(record.__dict__ | {"unknown": ("joint_pos",), "source": "elsewhere"}))
    write_episode(tmp_path / "data", unknown, states, read_video(folder / "rgb.mkv"))
    assert export(Args(tmp_path / "data", tmp_path / "out")) == (1, ["observation.state"])
    assert "observation.state" not in json.loads((tmp_path / "out/meta/info.json").read_text())["features"]
    with pytest.raises(EpisodeError, match=r"has no video of the robot alone; omit --robot-video"):
        export(Args(tmp_path / "data", tmp_path / "out2", robot_video=True))


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (("--robots", "panda"), "--robots panda: not in"),
        (("--tasks", "no_task"), "--tasks no_task: not in"),
        (("--out", "{data}"), "exists; choose another --out"),
    ],
)
def test_mistakes_are_told_in_a_line(
    flags: tuple[str, ...],
    told: str,
    data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    out = () if "--out" in flags else ("--out", str(tmp_path / "out"))
    monkeypatch.setattr("sys.argv", ["lerobot", str(data), *(flag.format(data=data) for flag in flags), *out])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2 and told in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_training_seeds_go_without_test_seeds(tmp_path: Path) -> None:
    write_synthetic_data(tmp_path / "data", TASKS[:1], (0, TEST_SEED_START), ROBOTS[:1])
    for split, seed in (("train", 0), ("test", TEST_SEED_START)):
        out = tmp_path / split
        assert export(Args(tmp_path / "data", out, split=split)) == (1, [])
        assert parquet.read_table(out / "meta/episodes")["xew/seed"].to_pylist() == [seed]
    write_synthetic_data(tmp_path / "one", TASKS[:1], (0,), ROBOTS[:1])
    with pytest.raises(EpisodeError, match="has no episode of these robots, tasks and seeds"):
        export(Args(tmp_path / "one", tmp_path / "none", split="test"))


def test_nothing_half_written_remains(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: object, **kwargs: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(lerobot, "_write_meta", full)
    with pytest.raises(EpisodeError, match="No space left on device"):
        export(Args(data, tmp_path / "out"))
    assert not list(tmp_path.iterdir())


# --- With LeRobot itself.


@pytest.mark.needs("lerobot")
def test_lerobot_reads_it(data: Path, exported: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("xew/test", root=exported)
    start = 0
    for number, (record, states, rgb) in enumerate(episodes(data)):
        for frame in (0, states.frame_count // 2, states.frame_count - 1):
            item = dataset[start + frame]
            assert int(item["episode_index"]) == number and int(item["frame_index"]) == frame
            assert (item["action"].numpy() == states.action[frame]).all()
            assert (item["observation.state"].numpy() == states.joint_pos[frame]).all()
            assert item["task"] == (record.instruction or record.task)
            image = item["observation.images.head"].numpy().transpose(1, 2, 0) * 255
            assert np.abs(image - rgb[frame]).mean() < 2.5, "the right frame in the right colors"
        start += states.frame_count
    assert len(dataset) == start and dataset.num_episodes == number + 1
