"""The bundle: others find out whether a score table is what it says, and made of what it says."""

import json
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from tests.metrics.small import write_many
from xew.episode import episode_folder, read_video
from xew.metrics.evaluate import Args, main
from xew.metrics.grading.bundle import digest, means, read_bundle
from xew.rollout import write_rollout

METRICS = ("psnr", "mask_iou")


@pytest.fixture
def world(tmp_path: Path) -> Path:
    """Three graded episodes."""
    write_many(tmp_path, 3)
    main(Args((tmp_path / "rollouts",), tmp_path / "data", tmp_path / "scores.parquet", METRICS))
    return tmp_path


def check(world: Path, **settings: object) -> None:
    arguments = {"rollouts": (world / "rollouts",), "data": world / "data", "metrics": METRICS} | settings
    main(Args(check=world / "scores.bundle.json", **arguments))


def test_a_bundle_says_all_that_others_need(world: Path) -> None:
    bundle = read_bundle(world / "scores.bundle.json")
    rows = pd.read_parquet(world / "scores.parquet")
    assert bundle["protocol"] == rows.attrs["protocol"] and bundle["estimators"] == {"masks": "default", "tracks": "default"}
    assert len(bundle["samples"]) == 12 and {sample["model"] for sample in bundle["samples"]} == set(rows["model"])
    for mean in bundle["means"]:
        own = rows[(rows["model"] == mean["model"]) & (rows["metric"] == mean["metric"])]["value"]
        assert mean["mean"] == pytest.approx(own.mean(), rel=1e-12) and mean["episodes"] == 3
    assert bundle["means"] == means(bundle["samples"][::-1])


def test_it_is_checked_against_itself_the_videos_and_scores_graded_anew(world: Path, capsys: pytest.CaptureFixture) -> None:
    check(world, rollouts=())
    assert "12 videos" in capsys.readouterr().out
    check(world, regrade=4)
    assert "4 videos graded again: the same scores" in capsys.readouterr().out


def raised_value(bundle: dict) -> None:
    bundle["samples"][0]["values"]["psnr"] += 1


def raised_value_and_digest(bundle: dict) -> None:
    raised_value(bundle)
    bundle["digest"] = digest({key: value for key, value in bundle.items() if key != "digest"})


def raised_value_mean_and_digest(bundle: dict) -> None:
    raised_value(bundle)
    bundle["means"] = means(bundle["samples"])
    bundle["digest"] = digest({key: value for key, value in bundle.items() if key != "digest"})


def no_samples(bundle: dict) -> None:
    del bundle["samples"]


def other_format(bundle: dict) -> None:
    bundle["format"] = 99


CHANGES = [
    (raised_value, "was changed after"),
    (raised_value_and_digest, "means are not those"),
    (raised_value_mean_and_digest, "psnr is"),
    (no_samples, "no bundle of xew"),
    (other_format, "format is 99"),
]


@pytest.mark.parametrize(("change", "word"), CHANGES, ids=[change.__name__ for change, _ in CHANGES])
def test_a_changed_bundle_is_found_out(change: Callable, word: str, world: Path, capsys: pytest.CaptureFixture) -> None:
    path = world / "scores.bundle.json"
    bundle = json.loads(path.read_text())
    change(bundle)
    path.write_text(json.dumps(bundle))
    with pytest.raises(SystemExit):
        check(world, regrade=9)
    message = capsys.readouterr().err
    assert word in message and "scores.bundle.json" in message and "Traceback" not in message


def other_table(world: Path) -> None:
    (world / "scores.parquet").write_bytes((world / "scores.curves.parquet").read_bytes())


def other_video(world: Path) -> None:
    truth = read_video(episode_folder(world / "data", "wander", 1, "piper") / "rgb.mkv")
    write_rollout(world / "rollouts", "wander", 1, "piper", truth, {"model": "late"})


def other_truth(world: Path) -> None:
    path = episode_folder(world / "data", "wander", 2, "piper") / "episode.json"
    header = json.loads(path.read_text())
    header["hashes"]["rgb"] = "0" * 64
    path.write_text(json.dumps(header))


def one_video_less(world: Path) -> None:
    for file in episode_folder(world / "rollouts", "wander", 0, "piper").iterdir():
        file.unlink()
    episode_folder(world / "rollouts", "wander", 0, "piper").rmdir()


REPLACEMENTS = [
    (other_table, "another table"),
    (other_video, "late wander 1 piper has another prediction"),
    (other_truth, "wander 2 piper has another rgb"),
    (one_video_less, "late wander 0 piper is in the bundle and not here"),
]


@pytest.mark.parametrize(("replace", "word"), REPLACEMENTS, ids=[replace.__name__ for replace, _ in REPLACEMENTS])
def test_other_videos_data_and_tables_are_found_out(
    replace: Callable, word: str, world: Path, capsys: pytest.CaptureFixture
) -> None:
    replace(world)
    with pytest.raises(SystemExit):
        check(world)
    assert word in capsys.readouterr().err


def test_other_choices_are_found_out(world: Path, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        check(world, allow=("rate",))
    assert "allowed is [], here ['rate']" in capsys.readouterr().err
