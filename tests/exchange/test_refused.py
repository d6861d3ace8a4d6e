"""RoboTwin files and folders from anybody: each line of refused.yaml ends in one line, and writes nothing."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml

from tests.exchange import robotwin_file
from xew.config import ConfigError
from xew.episode import EpisodeError
from xew.exchange import robotwin
from xew.exchange.hdf5 import read_robotwin

LINES = yaml.safe_load((Path(__file__).parent / "refused.yaml").read_text(encoding="utf-8"))


def put(value: Any) -> Callable[[h5py.File, str], None]:
    def write(file: h5py.File, name: str) -> None:
        file[name] = value

    return write


def put_nan(file: h5py.File, name: str) -> None:
    file[name] = np.full((robotwin_file.FRAMES, 7) if "endpose" in name else (3, 3) if "trinsic" in name else (4, 6), np.nan)


def put_huge(file: h5py.File, name: str) -> None:
    """An array of a terabyte of which nothing is stored."""
    file.create_dataset(name, (10**10, 6), np.float64, chunks=(1024, 6))


BECOMES: dict[str, Callable[[h5py.File, str], Any]] = {
    "text": put("a text"),
    "number": put(7.0),
    "group": lambda file, name: file.create_group(name),
    "nothing": lambda file, name: None,
    "nan": put_nan,
    "complex": put(np.zeros((4, 6), np.complex64)),
    "empty": lambda file, name: file.create_dataset(name, (0, 6), np.float64),
    "huge": put_huge,
    "external link": put(h5py.ExternalLink("/etc/hostname", "/x")),
    "soft circle": lambda file, name: file.__setitem__(name, h5py.SoftLink(f"/{name}")),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return robotwin_file.write_legacy(tmp_path_factory.mktemp("whole") / "place_cup/arx-x5/data/episode0.hdf5")


@pytest.mark.parametrize("line", LINES, ids=lambda line: line.get("folder") or f"{line['dataset']} {line['becomes']}")
def test_what_is_refused(line: dict[str, str], whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "root" / line.get("folder", "place_cup/arx-x5") / "data/episode0.hdf5"
    if ".." in path.parts:
        (tmp_path / "root").mkdir()
    path.parent.mkdir(parents=True)
    shutil.copy(whole, path)
    if "dataset" in line:
        with h5py.File(path, "a") as file:
            del file[line["dataset"]]
            BECOMES[line["becomes"]](file, line["dataset"])
        with pytest.raises(EpisodeError) as error:
            read_robotwin(path)
    else:
        with pytest.raises((EpisodeError, ConfigError)) as error:
            robotwin.import_episode(path, robotwin.Args(path, tmp_path / "out", instruction=""))
        assert not list(tmp_path.rglob("episode.json"))
    said = str(error.value)
    assert str(path) in said and line["says"] in said and "\n" not in said and len(said) < 600, said
