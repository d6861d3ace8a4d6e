"""Two processes on one folder: every command that writes takes a lock, which dies with it and says who holds it."""

import multiprocessing
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from tests import synthetic
from tests.commands import run_command
from tests.networks import TINY_CODEC
from xew.analysis.studies.config import load_study
from xew.config import save
from xew.episode import EpisodeError
from xew.files import hold_lock
from xew.model import latents, rollout
from xew.protocol import SEEN_ROBOTS

REPOSITORY = Path(__file__).parents[2]
CONFIGS = REPOSITORY / "configs"
WRITERS: tuple[tuple[str, str, str], ...] = (
    ("analysis.distance", "--out out --no-looks", "out"),
    ("analysis.report", "--paper --out out", "out"),
    ("analysis.study", f"{CONFIGS}/study_debug.yaml --out out", "out"),
    ("analysis.study_analyse", "study", "study/scores.parquet"),
    ("exchange.lerobot", "data --out out", "out"),
    ("exchange.robotwin", "data --out out", "out"),
    ("metrics.evaluate", "rollouts --data data --out out.parquet", "out.parquet"),
    ("model.export", "run --out out", "out"),
    ("model.outside", "examples.own_model:freeze --data data --out out", "out"),
    ("model.release", "run --out out", "out"),
    ("model.train", f"{CONFIGS}/debug.yaml --data data --out out", "out"),
    ("sim_warp.generate", "--device cpu --out out", "out"),
    ("sim_warp.inspect", "data --render", "data"),
    ("sim_warp.inspect", "data --pictures out", "out"),
    ("sim_warp.inspect", "data --grid out.png", "out.png"),
    ("sim_warp.inspect", "data --page out", "out"),
    ("sim_warp.robots.adopt", "mine.urdf --out out", "out/mine"),
)
"""Commands with options, and what they write, whose lock they take."""
OTHERS = {
    "model.latents": "waits: see below",
    "model.rollout": "needs a trained run: see below",
    "model.simulate": "writes as model.rollout",
    "__main__": "runs the others",
}
"""Other commands, with why they are none of WRITERS."""


def hold(path: Path, ready: "multiprocessing.synchronize.Event") -> None:
    with hold_lock(path):
        ready.set()
        multiprocessing.Event().wait(60)


@contextmanager
def held_by_another(path: Path) -> Iterator[multiprocessing.Process]:
    context = multiprocessing.get_context("fork")
    ready = context.Event()
    process = context.Process(target=hold, args=(path, ready))
    process.start()
    assert ready.wait(30)
    yield process
    process.kill()
    process.join()


def test_a_folder_is_written_by_one_process_and_the_message_names_it(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with held_by_another(out) as process:
        with (
            pytest.raises(EpisodeError, match=rf"out is being written by process {process.pid} on .*; wait for it"),
            hold_lock(out),
        ):
            pass
        process.kill()  # the lock dies with it
        process.join()
        with hold_lock(out):
            assert (tmp_path / ".out.lock").exists()
    assert not list(tmp_path.iterdir())
    with hold_lock(out), hold_lock(tmp_path / "other"):
        pass


def test_every_command_is_known() -> None:
    files = (path for path in (REPOSITORY / "xew").rglob("*.py") if '__name__ == "__main__"' in path.read_text())
    commands = {".".join(path.relative_to(REPOSITORY / "xew").with_suffix("").parts) for path in files}
    assert commands == {module for module, _, _ in WRITERS} | OTHERS.keys()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the commands find what they read before they write."""
    folder = tmp_path_factory.mktemp("world")
    synthetic.write_synthetic_data(folder / "data", seeds=(1_000_000,), robots=("piper",), frames=3)
    (folder / "rollouts").mkdir()
    (folder / "study").mkdir()
    (folder / "mine.urdf").write_text("<robot/>")
    save(load_study(CONFIGS / "study_debug.yaml"), folder / "study/study.yaml")
    return folder


LAB = (
    ("lab.calibration", "--data data --out out", "out"),
    ("lab.robots.bodies", "--count 1 --out out.npz", "out.npz"),
    ("lab.robots.sheet", "--robots piper --out out", "out"),
    ("lab.robots.sheet", "--robots piper --references out", "out"),
    ("lab.robots.sheet", "--robots piper --grid out.png", "out.png"),
    ("lab.seeds.manifest", "data --out out.json", "out.json"),
    ("lab.seeds.yields", "--tasks lift_pot --page out.md", "out.md"),
)
"""The same of the laboratory's commands."""


@pytest.mark.parametrize(
    ("module", "options", "held"),
    [
        *((f"xew.{module}", options, held) for module, options, held in WRITERS),
        *(pytest.param(*one, marks=pytest.mark.lab) for one in LAB),
    ],
    ids=lambda value: str(value).rpartition("/")[2],
)
def test_who_writes_what_another_writes_ends_in_one_line(
    module: str, options: str, held: str, world: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(world)
    monkeypatch.syspath_prepend(str(REPOSITORY))
    before = sorted(world.rglob("*"))
    with (
        held_by_another(world / held) as process,
        pytest.raises(
            AssertionError, match=rf"(?s)ended with 2:.*{held} is being written by process {process.pid} on "
        ) as told,
    ):
        run_command(module, *options.split())
    assert "Traceback" not in str(told.value)
    (world / held).with_name(f".{Path(held).name}.lock").unlink()  # its holder was killed
    for path in reversed(sorted(world.rglob("*"))):
        if path not in before:
            assert path.is_dir(), f"{path} was written"
            path.rmdir()


def test_a_rollout_into_a_folder_that_another_writes_ends_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    flags = SimpleNamespace(data=data, out=out, checkpoint=None, split="test", robots=(), faults=True)
    experiment = SimpleNamespace(instructions=SimpleNamespace(encode=list), view="head")
    monkeypatch.setattr(rollout, "parse_rollout", lambda *_: (tmp_path / "run", flags, experiment))
    monkeypatch.setattr(rollout, "select_episodes", lambda *_: [])
    with held_by_another(out) as process, pytest.raises(SystemExit, match="2"):
        rollout.main([])
    assert f"out is being written by process {process.pid} on" in capsys.readouterr().err and not out.exists()


def test_who_waits_for_a_lock_says_for_whom_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with held_by_another(tmp_path / "cache") as process:
        stop = threading.Timer(0.5, process.kill)
        stop.start()
        with hold_lock(tmp_path / "cache", wait=True):
            assert not process.is_alive() or process.join(5) is None
        stop.join()
    said = capsys.readouterr().err
    assert said.count("waiting:") == 1 and f"is being written by process {process.pid}" in said


def test_encoding_waits_for_others_of_the_same_streams(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, bool]] = []

    @contextmanager
    def note(path: Path, *, wait: bool = False) -> Iterator[None]:
        asked.append((path.name, wait))
        yield

    monkeypatch.setattr(latents, "hold_lock", note)
    synthetic.write_synthetic_data(tmp_path / "data", seeds=(0,), robots=SEEN_ROBOTS, frames=5)
    content = {"data": str(tmp_path / "data"), "out": str(tmp_path / "run"), "clip": {"frames": 5, "height": 32, "width": 48}}
    content |= {
        "codec": {"weights": str(TINY_CODEC)},
        "model": {"size": "tiny", "history": []},
        "train": {"steps": 1, "batch": 1},
    }
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(content))
    for embodiment in ("none", "reference_image", "nine_views"):
        latents.main([str(tmp_path / "config.yaml"), "--model.action", "optical_flow", "--model.embodiment", embodiment])
    assert all(wait for _, wait in asked)
    assert [name for name, _ in asked[::2]] == ["data-latents"] * 3
    held = ["optical_flow", "optical_flow-reference_image", "nine_views-optical_flow"]
    assert [name for name, _ in asked[1::2]] == [f"data-latents-rgb-{name}" for name in held], "others go on meanwhile"
