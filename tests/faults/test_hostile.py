"""Data, runs, rollouts and score tables from anybody: they run no code, write nowhere else, and read no other file.

Inputs lie in names.yaml, a line each.
"""

import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import yaml

from lab.calibration.perturbations import render_perturbation
from tests import synthetic
from tests.exchange import robotwin_file
from tests.faults import reading
from xew import config
from xew.analysis.scores import read_scores
from xew.config import ConfigError, UntrustedError, read_yaml
from xew.dataset import read_dataset
from xew.episode import EpisodeError, complete_folder, episode_folder, place_episode, read_record, read_video
from xew.exchange import robotwin
from xew.exchange.hdf5 import read_robotwin
from xew.model import outside, rollout
from xew.model.experiment import load_experiment
from xew.model.runs.folder import claim_run, load_run_config
from xew.names import check_name, path_below
from xew.rollout import RolloutError, find_rollouts, read_rollout, write_rollout
from xew.sim_warp.inspect import read_headers
from xew.sim_warp.inspection.checks import find_problem
from xew.sim_warp.inspection.pictures import draw_pictures
from xew.sim_warp.manifest import read_manifest
from xew.sim_warp.production.surfaces import read_surfaces
from xew.sim_warp.robots import recorded_robot

NAMES = yaml.safe_load((Path(__file__).parent / "inputs/names.yaml").read_text(encoding="utf-8"))
REPOSITORY = Path(__file__).parents[2]
EVIL = "import pathlib\npathlib.Path({mark!r}).touch()\nTASK = SPLIT = SPEC = None\n"
SECRET = "the secret of this machine"


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one small episode; tests that change it take a copy."""
    (folder,) = synthetic.write_synthetic_data(tmp_path_factory.mktemp("data"), seeds=(0,), robots=("piper",), frames=3)
    return folder


@pytest.fixture
def own(episode: Path, tmp_path: Path) -> Path:
    """A copy of the episode in a data set of its own, which a test may spoil."""
    folder = tmp_path / "data" / episode.relative_to(episode.parents[2])
    shutil.copytree(episode, folder)
    return folder


@pytest.fixture
def evil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A module `evil_data.evil` that can be imported; the file that it would make when it is."""
    mark = tmp_path / "it-ran"
    (tmp_path / "evil_data").mkdir()
    (tmp_path / "evil_data" / "evil.py").write_text(EVIL.format(mark=str(mark)))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv(config.TRUST, "")
    yield mark
    for name in ("evil_data.evil", "evil_data"):
        sys.modules.pop(name, None)


def change(folder: Path, **values: Any) -> Path:
    """Change values of an episode's header; returns its folder, which has the header's name where a folder can have it."""
    path = folder / "episode.json"
    header = json.loads(path.read_text()) | values
    path.write_text(json.dumps(header))
    try:
        place = episode_folder(folder.parents[2], header["task"], header["seed"], header["robot"])
    except EpisodeError:
        return folder
    place.parent.mkdir(parents=True, exist_ok=True)
    return folder.rename(place)


# --- Names and paths.


def test_names_that_lead_elsewhere_are_refused_and_those_of_users_are_not() -> None:
    for name in NAMES["refused"]:
        with pytest.raises(EpisodeError, match="expected a key of letters"):
            check_name(name, "task")
    assert [check_name(name, "task") for name in NAMES["accepted"]] == NAMES["accepted"]


@pytest.mark.parametrize("key", ["task", "robot"])
def test_a_header_with_such_a_name_is_refused_by_its_reader(key: str, own: Path, record_property: Any) -> None:
    record_property("tried names in headers", len(NAMES["refused"]) + len(NAMES["accepted"]))
    for name in NAMES["refused"]:
        change(own, **{key: name})
        with pytest.raises(EpisodeError, match=r"episode.json is damaged") as error:
            read_record(own)
        assert "\n" not in str(error.value)
    for name in NAMES["accepted"]:
        own = change(own, **{key: name})
        assert getattr(read_record(own), key) == name


def test_such_names_and_seeds_make_no_path(record_property: Any) -> None:
    record_property("tried names of folders", 2 * len(NAMES["refused"]) + 2)
    for name in (name for name in NAMES["refused"] if isinstance(name, str)):
        for names in ((name, 0, "piper"), ("place_empty_cup", 0, name)):
            with pytest.raises(EpisodeError):
                episode_folder(Path("data"), *names)
    for seed in (-1, 2**63):
        with pytest.raises(EpisodeError, match="seed"):
            episode_folder(Path("data"), "place_empty_cup", seed, "piper")


def test_paths_that_links_lead_out_of_their_root_are_refused(tmp_path: Path) -> None:
    root, victim = tmp_path / "data", tmp_path / "victim"
    (victim / "0000000/piper").mkdir(parents=True)
    root.mkdir()
    (root / "task").symlink_to(victim)
    (root / "circle").symlink_to("circle")
    (root / "inside").symlink_to("other")
    for task, what in (("task", "not below"), ("circle", "cannot be resolved")):
        with pytest.raises(EpisodeError, match=what):
            place_episode(root, task, 0, "piper")
    assert place_episode(root, "inside", 0, "piper") == root / "inside/0000000/piper"
    for names in (("..",), ("../victim",), (str(victim),), (".",)):
        with pytest.raises(EpisodeError, match="not below"):
            path_below(root, *names)


@pytest.mark.parametrize("by", ["name", "link"])
def test_rollouts_and_pictures_of_hostile_data_replace_nothing(by: str, own: Path, tmp_path: Path) -> None:
    """What a header or a link names outside of the output stays as it was, and the command ends in one line."""
    victim, out, data = tmp_path / "victim/thesis", tmp_path / "out", own.parents[2]
    victim.mkdir(parents=True)
    (victim / "thesis.tex").write_text("years of work")
    out.mkdir()
    if by == "name":
        change(own, robot="../../../victim/thesis")
    else:
        (out / "place_empty_cup").symlink_to(tmp_path)
        (tmp_path / "0000000").mkdir()
        (tmp_path / "0000000/piper").symlink_to(victim)
    with pytest.raises(SystemExit) as stop:
        outside.main(["examples.own_model:freeze", "--data", str(data), "--split", "train", "--out", str(out)])
    assert stop.value.code == 2
    cells, damaged = read_headers(data)
    draw_pictures(cells, tmp_path / "sheets", 1)
    assert bool(damaged) == (by == "name") and [path.name for path in victim.iterdir()] == ["thesis.tex"]
    assert (victim / "thesis.tex").read_text() == "years of work"


def test_a_folder_that_holds_anything_else_is_not_replaced(own: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out/place_empty_cup/0000000/piper"
    folder.mkdir(parents=True)
    (folder / "rollout.mp4").write_text("of another model")
    with pytest.raises(EpisodeError, match=r"holds rollout.mp4, which xew did not write"):
        write_rollout(tmp_path / "out", "place_empty_cup", 0, "piper", np.zeros((2, 8, 8, 3), np.uint8), {})
    assert [path.name for path in folder.iterdir()] == ["rollout.mp4"]
    (folder / "rollout.mp4").rename(folder / "rgb.mkv")
    assert write_rollout(tmp_path / "out", "place_empty_cup", 0, "piper", np.zeros((2, 8, 8, 3), np.uint8), {}) == folder
    link = tmp_path / "link"
    link.symlink_to(own)
    with pytest.raises(EpisodeError, match="is not a folder; expected a folder or nothing"), complete_folder(link):
        pass
    assert (own / "episode.json").exists()


def test_trees_of_rollouts_score_tables_and_seeds_are_read_by_the_same_rule(tmp_path: Path) -> None:
    folder = tmp_path / "tree/a task/0000000/piper"
    folder.mkdir(parents=True)
    (folder / "rgb.mkv").touch()
    with pytest.raises(RolloutError, match="expected a key"):
        find_rollouts(tmp_path / "tree")
    names = [name for name in NAMES["refused"] if isinstance(name, str)]
    for name in names:
        seeds = {"tasks": {name: {"train": [1], "test": []}}}
        (tmp_path / "seeds.json").write_text(json.dumps(seeds))
        with pytest.raises(EpisodeError, match="no manifest"):
            read_manifest(tmp_path / "seeds.json")
    for column in ("task", "robot"):
        with pytest.raises(ConfigError, match=f"no score table of xew: the {column} is"):
            read_scores(write_scores(tmp_path, **{column: "../../x"}), ["../../x"])
    with pytest.raises(ConfigError, match="a path that leads out of its folder"):
        read_scores(write_scores(tmp_path, model="../x"))


def write_scores(folder: Path, **names: str) -> Path:
    """A score table of one row with these names."""
    row = {"model": "m", "condition": "c", "task": "lift_pot", "seed": 1, "robot": "piper", "metric": "psnr", "value": 20.0}
    rows = pd.DataFrame([row | {"frames": 5, "exact_frames": 0} | names])
    metric = {
        "dimension": "visual",
        "unit": "dB",
        "higher_is_better": True,
        "estimated": False,
        "low": 0,
        "high": None,
        "reference": "",
    }
    rows.attrs = {"protocol": 4, "metrics": {"psnr": metric}}
    curves = rows.assign(frame=1)[[*row, "frame"]]
    rows.to_parquet(folder / "scores.parquet")
    curves.to_parquet(folder / "scores.curves.parquet")
    return folder / "scores.parquet"


def test_the_importer_takes_no_path_from_folders_and_seeds(tmp_path: Path) -> None:
    made = robotwin_file.write_legacy(tmp_path / "task/arx-x5/data/episode0.hdf5")
    path = made.parents[1] / "data/../../../task/../arx-x5/data/episode0.hdf5"
    (tmp_path / "arx-x5").symlink_to(made.parents[1])
    _, refused = robotwin.import_all([path], robotwin.Args(path, tmp_path / "out"))
    assert len(refused) == 1 and "'..'" in refused[0] and str(path) in refused[0]
    (made.parents[1] / "seed.txt").write_text("9" * 400)
    with pytest.raises(EpisodeError, match=r"seed.txt has 1 entries and no seed of episode0.hdf5"):
        robotwin._seed(made)
    (made.parents[1] / "seed.txt").unlink()
    with pytest.raises(EpisodeError, match="expected a key"):
        robotwin.import_episode(made, robotwin.Args(made, tmp_path / "out", task="../../x"))
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").glob("**/episode.json"))


# --- Code.


def test_no_module_that_data_name_is_imported(own: Path, evil: Path) -> None:
    readers: list[Callable[[], Any]] = [
        lambda: find_problem(own),
        lambda: read_surfaces(own),
        lambda: render_perturbation(own, None),  # type: ignore[arg-type]
        lambda: recorded_robot(read_record(own).robot, own.parents[2]),
    ]
    own = change(own, task="evil_data.evil:TASK", robot="evil_data.evil:SPEC")
    for read in readers:
        with pytest.raises(UntrustedError, match=r"admit it: --trust evil_data\.evil"):
            read()
    assert not evil.exists() and "evil_data.evil" not in sys.modules


def test_no_module_that_a_run_names_is_imported(evil: Path, tmp_path: Path) -> None:
    plain = read_yaml(REPOSITORY / "configs/debug.yaml")
    run = tmp_path / "run"
    run.mkdir()
    for place in (("split",), ("model", "size"), ("model", "action"), ("codec", "name"), ("rollout", "sampler")):
        changed = json.loads(json.dumps(plain))
        inner = changed
        for key in place[:-1]:
            inner = inner.setdefault(key, {})
        inner[place[-1]] = "evil_data.evil:SPLIT"
        (run / "config.yaml").write_text(yaml.safe_dump(changed))
        with pytest.raises(UntrustedError, match=r"config.yaml names 'evil_data.evil:SPLIT'"):
            load_run_config(run)
        assert not evil.exists()
        with pytest.raises(SystemExit, match="2"):
            rollout.main([str(run)])
        assert not evil.exists()
        with pytest.raises(ConfigError):  # a config that the user names is trusted, and says that this is no split
            load_experiment(run / "config.yaml")
        assert evil.exists()
        evil.unlink()
        sys.modules.pop("evil_data.evil")


def test_what_the_user_admits_is_imported(own: Path, evil: Path) -> None:
    own = change(own, task="evil_data.evil:TASK")
    config.admit(["evil_data"])
    with pytest.raises(ConfigError, match="is a NoneType; expected a Task"):
        find_problem(own)
    assert evil.exists()
    with pytest.raises(ConfigError, match="is not a module name"):
        config.admit(["a b"])
    config.demand_admitted({"a": ["evil_data:X", "evil_data.evil.below:X"]}, "a file")
    with pytest.raises(UntrustedError):
        config.demand_admitted("evil_data_2:X", "a file")


def test_a_robot_in_data_is_no_path(own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.urdf").write_text("<robot/>")
    with pytest.raises(ConfigError, match="a path"):
        recorded_robot("arm.urdf", own.parents[2])


@pytest.mark.parametrize("how", ["urdf", "mesh", "link"])
def test_a_robot_in_data_reads_no_file_outside_of_its_folder(how: str, tmp_path: Path) -> None:
    from xew.sim_warp.robots import ROBOTS, keep_robot

    data = tmp_path / "data"
    kept = keep_robot(ROBOTS["piper"], data)
    robot = data / "robots/piper"
    robot.rename(robot.with_name("arm"))
    robot = robot.with_name("arm")
    assert recorded_robot("arm", data).arms == kept.arms
    urdf = robot / yaml.safe_load((robot / "robot.yaml").read_text())["urdf"]
    if how == "urdf":
        shutil.copy(urdf, tmp_path / "secret.urdf")
        (robot / "robot.yaml").write_text((robot / "robot.yaml").read_text().replace(urdf.name, "../../../secret.urdf"))
    elif how == "mesh":
        mesh = next((robot / "files").rglob("*.stl"))
        shutil.move(mesh, tmp_path / "secret.stl")
        urdf.write_text(urdf.read_text().replace(str(mesh.relative_to(urdf.parent)), str(tmp_path / "secret.stl")))
    else:
        shutil.move(urdf, tmp_path / "secret.urdf")
        urdf.symlink_to(tmp_path / "secret.urdf")
    os.utime(robot / "robot.yaml", ns=(1, 1))
    with pytest.raises(ConfigError, match="not below"):
        recorded_robot("arm", data)


# --- Other files of the machine.


def external_link(file: h5py.File, name: str, secret: Path) -> None:
    del file[name]
    file[name] = h5py.ExternalLink(str(secret), "stolen")


def soft_link_to_one(file: h5py.File, name: str, secret: Path) -> None:
    del file[name]
    file["elsewhere"] = h5py.ExternalLink(str(secret), "/")
    file[name] = h5py.SoftLink("/elsewhere/stolen")


def external_storage(file: h5py.File, name: str, secret: Path) -> None:
    shape, kind = file[name].shape, file[name].dtype
    del file[name]
    file.create_dataset(name, shape, kind, external=[(str(secret), 0, h5py.h5f.UNLIMITED)])


def virtual_dataset(file: h5py.File, name: str, secret: Path) -> None:
    layout = h5py.VirtualLayout(file[name].shape, file[name].dtype)
    layout[:] = h5py.VirtualSource(str(secret), "stolen", file[name].shape)
    del file[name]
    file.create_virtual_dataset(name, layout)


@pytest.mark.parametrize("steal", [external_link, soft_link_to_one, external_storage, virtual_dataset])
def test_hdf5_that_refers_to_other_files_is_refused(steal: Callable[..., None], tmp_path: Path) -> None:
    made = robotwin_file.write_legacy(tmp_path / "task/arx-x5/data/episode0.hdf5")
    assert read_robotwin(made)
    name = "joint_action/left_gripper"
    with h5py.File(tmp_path / "secret.hdf5", "w") as secret, h5py.File(made) as episode:
        secret["stolen"] = episode[name][()]
    with h5py.File(made, "a") as file:
        steal(file, name, tmp_path / "secret.hdf5")
    with pytest.raises(EpisodeError, match=r"expected a file that holds all of its data itself"):
        read_robotwin(made)


def test_a_video_that_is_a_playlist_of_other_files_is_refused(own: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret.mkv"
    shutil.move(own / "rgb.mkv", secret)
    tree = tmp_path / "tree/place_empty_cup/0000000/piper"
    tree.mkdir(parents=True)
    for playlist in (
        f"ffconcat version 1.0\nfile {secret}\n",
        f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile://{secret}\n#EXT-X-ENDLIST\n",
    ):
        (own / "rgb.mkv").write_text(playlist)
        shutil.copy(own / "rgb.mkv", tree)
        with pytest.raises(EpisodeError, match="no readable frame"):
            read_video(own / "rgb.mkv")
        with pytest.raises(EpisodeError, match="no readable frame"):
            from xew.rollout import read_rollout_video

            read_rollout_video(read_rollout(tree))
    shutil.copy(secret, own / "rgb.mkv")
    assert len(read_video(own / "rgb.mkv")) == 3


@pytest.mark.parametrize("reader", reading.READERS)
def test_a_fifo_or_a_device_in_place_of_a_file_is_refused_at_once(reader: str, tmp_path: Path) -> None:
    """Opened, they would hold the command for ever."""
    name, read = reading.READERS[reader]
    for kind in ("fifo", "device"):
        path = tmp_path / kind / name
        path.parent.mkdir(parents=True)
        os.mkfifo(path) if kind == "fifo" else path.symlink_to("/dev/zero")
        with reading.at_most_seconds(5), pytest.raises((EpisodeError, ConfigError, OSError)):
            read(path)


# --- What is removed.


def test_overwrite_removes_a_run_and_nothing_else(tmp_path: Path) -> None:
    experiment = load_experiment(REPOSITORY / "configs/debug.yaml")
    out = tmp_path / "thesis"
    out.mkdir()
    (out / "config.yaml").write_text("title: my thesis")
    (out / "thesis.tex").write_text("years of work")
    with pytest.raises(ConfigError, match="holds no run, so it is not replaced"):
        claim_run(out, experiment, load_experiment, resume=False, overwrite=True)
    assert (out / "thesis.tex").exists() and (out / "config.yaml").exists()

    run = tmp_path / "run"
    claim_run(run, experiment, load_experiment, resume=False, overwrite=False)
    (run / "checkpoints/4/params").mkdir(parents=True)
    (run / "checkpoints/4/params/data").touch()
    (run / "notes.md").write_text("what I saw")
    (run / "codec").symlink_to(out)
    with pytest.raises(OSError, match="is a link, and no link below"):
        claim_run(run, experiment, load_experiment, resume=False, overwrite=True)
    (run / "codec").unlink()
    claim_run(run, experiment, load_experiment, resume=False, overwrite=True)
    assert sorted(path.name for path in run.iterdir() if not path.name.startswith(".")) == ["config.yaml", "notes.md"]
    assert (run / "notes.md").read_text() == "what I saw" and (out / "thesis.tex").exists()


def test_data_as_they_were_still_open(own: Path) -> None:
    assert [record.robot for _, record in read_dataset(own.parents[2]).accepted] == ["piper"]
