"""Links in folders from anybody: nothing is written, replaced or removed where they lead; an output that is a link is used.

Cases are a line each: what is written, and the name in the output folder that is a link.
"""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

from tests import synthetic
from tests.faults.kept import CELL, STEP
from tests.faults.reading import at_most_seconds
from tests.networks import TINY_CODEC
from xew.analysis.report import _write_report
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.processes import wait_for_lock
from xew.config import ConfigError, user_errors
from xew.dataset import remove_left_overs
from xew.episode import EpisodeError
from xew.files import check_place, copy_tree, hold_lock, open_own, replacing, write_text
from xew.metrics.grade import Grades
from xew.metrics.grading.scores import CellStore, baselines_folder, surfaces_folder
from xew.model import latents
from xew.model.experiment import load_experiment
from xew.model.runs.checkpoint import note_sums
from xew.model.runs.folder import claim_run
from xew.model.runs.log import RunLog
from xew.names import UserError
from xew.protocol import SEEN_ROBOTS
from xew.sim_warp.generate import _prepare_folder
from xew.sim_warp.inspection.films import write_film

WORK = "years of work"


def write_sums(out: Path) -> None:
    (out / "checkpoints/4").mkdir(parents=True, exist_ok=True)
    (out / "checkpoints/4/data").write_text("x")
    note_sums(out)


def write_cell(out: Path) -> None:
    CellStore(out / "s.cells", out / "s.baselines").write(CELL, Grades({"psnr": 1.0}, {"psnr": np.ones(2)}, 0))


def write_log(out: Path) -> None:
    log = RunLog(out, 0)
    log.scalars(1, {"train/loss": 1.0})
    log.close()


def replace_run(out: Path) -> None:
    (out / "config.yaml").write_text("{}")
    (out / ".xew-run").touch()
    claim_run(out, 0, lambda _: 0, resume=False, overwrite=True)


def copy_piece(out: Path) -> None:
    (out.parent / "piece/a").mkdir(parents=True)
    (out.parent / "piece/a/thesis.json").write_text("{}")
    copy_tree(out.parent / "piece", out, within=out)


WRITERS: tuple[tuple[str, Callable[[Path], object], tuple[str, ...]], ...] = (
    ("a text", lambda out: write_text(out / "a/b/thesis.json", "x", within=out), ("a", "a/b", "a/b/thesis.json")),
    ("a report", lambda out: _write_report(out, "", ("", {"figures/a.png": b""}), pd.DataFrame()), ("figures", "report.md")),
    ("sums", write_sums, ("sums", "sums/4.json")),
    ("a log", write_log, ("metrics.jsonl",)),
    ("a run", replace_run, ("checkpoints", "checkpoints/7", "codec", "sums", "pictures", "metrics.jsonl")),
    ("a step", lambda out: Ledger(out).begin(STEP), ("state", "state/train", "state/train/x.json")),
    ("a step again", lambda out: Ledger(out).forget(STEP), ("state", "state/train")),
    ("a cell", write_cell, ("s.cells", "s.cells/place_empty_cup")),
    ("a film", lambda out: write_film(out / "scenes/0.mp4", [np.zeros((16, 16, 3), np.uint8)], 10, within=out), ("scenes",)),
    ("data", _prepare_folder, (".writable", "task", "task/0000000")),
    ("left-overs", remove_left_overs, ("task", "task/0000000")),
    ("a piece of a study", copy_piece, ("a", "a/thesis.json")),
    ("a lock", lambda out: hold_lock(out / "run").__enter__(), (".run.lock",)),
    ("a lock of a step", lambda out: wait_for_lock(out / "x.lock").__enter__(), ("x.lock",)),
)
CASES = [pytest.param(write, name, id=f"{what}: {name}") for what, write, names in WRITERS for name in names]


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """A folder of somebody's work, with names that xew uses for its own files."""
    folder = tmp_path / "victim"
    for name in ("thesis.tex", "thesis.json", "4.json", "77.json", "train/x.json", "0000000/.writing-mine/x", ".writing-y/x"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(WORK)
    return folder


def content(folder: Path) -> dict[Path, str]:
    return {path: path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("write", "name"), CASES)
@pytest.mark.parametrize("target", ["folder", "file"])
def test_nothing_is_written_or_removed_where_a_link_leads(
    write: Callable[[Path], Any], name: str, target: str, victim: Path, tmp_path: Path
) -> None:
    out, before = tmp_path / "out", content(victim)
    (out / name).parent.mkdir(parents=True)
    (out / name).symlink_to(victim if target == "folder" else victim / "thesis.tex")
    with contextlib.suppress(OSError, UserError):
        write(out)
    assert content(victim) == before


@pytest.mark.parametrize("write", [pytest.param(write, id=what) for what, write, _ in WRITERS])
def test_without_a_link_each_of_them_writes(write: Callable[[Path], Any], tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    write(tmp_path / "out")


def test_an_output_that_is_a_link_itself_is_written(victim: Path, tmp_path: Path) -> None:
    (tmp_path / "out").symlink_to(victim)
    write_text(tmp_path / "out/a/b.txt", "new", within=tmp_path / "out")
    write_sums(tmp_path / "out")
    assert (victim / "a/b.txt").read_text() == "new" and '"data"' in (victim / "sums/4.json").read_text()


def test_a_link_below_the_output_is_named(victim: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "sums").symlink_to(victim)
    with pytest.raises(SystemExit, match="2"):
        user_errors(write_text)(out / "sums/1.json", "", within=out)
    said = capsys.readouterr().err
    assert (
        said.startswith(f"error: {out}/sums: is a link, and no link below {out} is followed to write") and said.count("\n") == 1
    )


def test_only_its_own_sums_are_removed(tmp_path: Path) -> None:
    (tmp_path / "sums").mkdir()
    for name in ("3.json", "thesis.json", "3.txt"):
        (tmp_path / "sums" / name).write_text("{}")
    write_sums(tmp_path)
    assert sorted(path.name for path in (tmp_path / "sums").iterdir()) == ["3.txt", "4.json", "thesis.json"]


def test_a_temporary_name_cannot_be_foreseen_and_exists_before_it_is_written(tmp_path: Path) -> None:
    names = []
    for _ in range(2):
        with replacing(tmp_path / "a", within=tmp_path) as temporary:
            names.append(temporary.name)
            assert temporary.stat().st_size == 0
            with pytest.raises(FileExistsError):
                open_own(temporary, "x")
    assert names[0] != names[1]


@pytest.mark.parametrize("kind", ["FIFO", "link to a FIFO", "folder"])
def test_an_output_that_is_no_regular_file_is_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "scores.parquet"
    if kind == "folder":
        path.mkdir()
    else:
        os.mkfifo(tmp_path / "fifo")
        path.symlink_to("fifo") if "link" in kind else (tmp_path / "fifo").rename(path)
    with at_most_seconds(5):
        with pytest.raises(OSError, match="expected a"):
            write_text(path, "x", within=tmp_path)
        if kind != "folder":
            with pytest.raises(OSError, match="is a FIFO, expected a regular file"), hold_lock(path):
                pass
            with pytest.raises(OSError, match=r"FIFO|Too many levels|No such device"):
                open_own(path, "a")
    assert path.is_symlink() or not path.is_file()


def test_a_lock_that_is_no_file_of_ours_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / ".out.lock")
    with (
        at_most_seconds(5),
        pytest.raises(EpisodeError, match=r"\.out\.lock is a link or no regular file"),
        hold_lock(tmp_path / "out"),
    ):
        pass
    with pytest.raises(OSError, match="root of the file system"), hold_lock(Path("/")):
        pass


def test_what_lies_beside_data_is_written_beside_the_table_where_it_is_a_link(victim: Path, tmp_path: Path) -> None:
    data, table = tmp_path / "data", tmp_path / "o/s.parquet"
    data.mkdir()
    assert surfaces_folder(data, table) == tmp_path / "data-surfaces"
    for name in ("data-surfaces", "data-baselines"):
        (tmp_path / name).symlink_to(victim)
    assert surfaces_folder(data, table) == tmp_path / "o/s.surfaces"
    assert baselines_folder(data, table) == tmp_path / "o/s.baselines"


def test_a_latent_cache_that_is_a_link_is_named_by_the_user(victim: Path, tmp_path: Path) -> None:
    synthetic.write_synthetic_data(tmp_path / "data", seeds=(0,), robots=SEEN_ROBOTS, frames=5)
    config: dict[str, Any] = {"data": str(tmp_path / "data"), "out": str(tmp_path / "run")}
    config |= {"clip": {"frames": 5, "height": 32, "width": 48}, "codec": {"weights": str(TINY_CODEC)}}
    config |= {"model": {"size": "tiny", "history": []}, "train": {"steps": 1, "batch": 1}}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    (tmp_path / "data-latents").symlink_to(victim)
    before = content(victim)
    with pytest.raises(ConfigError, match=rf"data-latents is a link; .* --cache {victim}"):
        latents.encode_experiment(load_experiment(tmp_path / "config.yaml"))
    assert content(victim) == before


def test_a_copy_takes_no_links_and_no_hidden_files(victim: Path, tmp_path: Path) -> None:
    (tmp_path / "piece/a").mkdir(parents=True)
    (tmp_path / "piece/a/link").symlink_to(victim / "thesis.tex")
    (tmp_path / "piece/a/.hidden").write_text("x")
    (tmp_path / "piece/a/file").write_text("x")
    copy_tree(tmp_path / "piece", tmp_path / "out", within=tmp_path / "out")
    assert [path.name for path in (tmp_path / "out/a").iterdir()] == ["file"]
    with pytest.raises(ValueError, match="subpath"):
        check_place(tmp_path / "elsewhere", within=tmp_path / "out")
