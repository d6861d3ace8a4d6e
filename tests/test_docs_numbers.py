"""Numbers of the docs that a config, a registry or a command has too are the same there."""

import re
from pathlib import Path

import pandas as pd
import pytest
import yaml
from jax.sharding import AbstractMesh

from xew import episode, protocol
from xew.__main__ import COMMANDS
from xew.model.codecs.autoencoders import PACKAGED_WEIGHTS
from xew.model.devices.sharding import AXES, mesh_shape
from xew.model.diffusion.flow_matching import REFERENCE_NOISE
from xew.model.experiment import load_experiment
from xew.model.network.dit import MODELS
from xew.model.settings.optimizer import CLIP_NORM, WEIGHT_DECAY
from xew.model.training.memory import estimate_memory
from xew.model.training.step import make_trainer
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.tasks import TASKS

ROOT = Path(__file__).parents[1]
FIXED, DEBUG, WAN5B = (ROOT / "configs" / name for name in ("fixed.yaml", "debug.yaml", "wan5b/fixed.yaml"))


def page(name: str) -> str:
    return (ROOT / "docs" / f"{name}.md").read_text()


def cells(text: str, start: str) -> list[str]:
    """The cells of the first row of a table that begins so."""
    (row, *_) = (line for line in text.splitlines() if line.startswith(f"| {start} |"))
    return [cell.strip() for cell in row.strip("|").split("|")]


def header(config: Path) -> str:
    """What the comments at the head of a config say."""
    return " ".join(line.lstrip("# ") for line in config.read_text().splitlines() if line.startswith("#"))


@pytest.mark.parametrize("size", MODELS)
def test_sizes_of_the_network(size: str) -> None:
    shown = cells(page("model"), f"`{size}`")[1:4]
    assert shown == [str(number) for number in (MODELS[size].dim, MODELS[size].depth, MODELS[size].heads)]


def test_the_recipe() -> None:
    train = load_experiment(FIXED).train
    row = f"| `configs/fixed.yaml`, {train.steps:,} steps of {train.batch} clips, with compiling | 1 H200 | 8 min 34 s |"
    assert row in page("train_on_many_gpus")
    assert "| the same, 25 tasks, 4,800 steps | 1 H200 | 11 min 55 s |" in page("train_on_many_gpus")
    assert "4,800 steps with starting and compiling 11 minutes 55 s on one H200" in header(FIXED)
    assert f"| 8 min 34 s | the same, the recommended length | 0.025 / 0.047 / 0.057 | {train.steps:,} steps" in page(
        "speedrun"
    )
    assert cells(page("performance"), f"training step, batch {train.batch}")[1] == "151 ms"
    training = page("training")
    assert f"weight decay of {WEIGHT_DECAY}" in training and f"global norm of {CLIP_NORM:g}" in training
    assert f"`train.motion_loss_weight: {train.motion_loss_weight:g}`" in training and REFERENCE_NOISE > 0


def test_what_the_recipe_reaches() -> None:
    """The header of the config has five metrics on training robots and on unseen ones."""
    number = r"([\d.]+)"
    said = re.search(
        rf"training robots LPIPS {number}, PSNR {number} dB, mask IoU {number}, LPIPS of the robot {number}, "
        rf"strict object error {number} px; unseen Piper {', '.join([number] * 5)}; unseen Franka {', '.join([number] * 5)}\.",
        header(FIXED),
    )
    assert said is not None
    groups = [list(said.groups()[first : first + 5]) for first in (0, 5, 10)]
    names = ("LPIPS ↓", "PSNR [dB] ↑", "mask IoU ↑", "robot LPIPS ↓", "strict object error [px] ↓")
    for name, *numbers in zip(names, *groups, strict=True):
        assert [cell.split(" ")[0] for cell in cells(page("rollout"), name)[1:]] == numbers, name


def test_the_tutorial() -> None:
    """LPIPS of the debug recipe and of the frozen first frame, on UR5, Franka (Panda) and Piper."""
    said = header(DEBUG)
    scores = [
        re.search(rf"{robot} ([\d.]+) \(([\d.]+)\)", said) for robot in ("UR5", r"(?:Panda|Franka(?: \(Panda\))?)", "Piper")
    ]
    for column, row in enumerate(("LPIPS ↓, the model", "LPIPS, frozen first frame"), 1):
        assert cells(page("tutorial"), row)[1:] == [match[column] for match in scores if match], row
    debug = yaml.safe_load(DEBUG.read_text())
    text = page("tutorial")
    assert f"for {debug['train']['steps']} steps" in text and f"predicts {debug['rollout']['max_frames']} frames" in text
    makefile = (ROOT / "Makefile").read_text()
    for name in ("ROLLED_OUT", "TASKS"):
        (values,) = re.findall(rf"^{name} \?= (.*)$", makefile, re.MULTILINE)
        shown = re.search(rf"--{'robots' if name == 'ROLLED_OUT' else 'tasks'} ([\w ]+) --", text)
        assert shown is not None and set(shown[1].split()) == set(values.split()), name


OPTIONS = {
    "1 GPU, `--train.accumulate 8`": (1, ("--train.accumulate", "8")),
    "1 GPU, `--train.accumulate 8 --train.mu-dtype bfloat16`": (
        1,
        ("--train.accumulate", "8", "--train.mu-dtype", "bfloat16"),
    ),
    "4 GPUs": (4, ()),
    "8 GPUs": (8, ()),
    "16 GPUs, `--train.batch 16`": (16, ("--train.batch", "16")),
}
"""Rows of the table of memory: number of GPUs and options."""


@pytest.mark.parametrize("row", OPTIONS)
def test_memory_of_the_5b_network(row: str) -> None:
    devices, options = OPTIONS[row]
    experiment = load_experiment(WAN5B, options)
    mesh = AbstractMesh(mesh_shape(experiment.mesh, devices), AXES)
    memory = estimate_memory(make_trainer(experiment.spec, mesh), experiment.encoding)
    assert cells(page("train_on_many_gpus"), row)[1] == f"{memory.total / 1e9:.1f}"


def test_the_codec() -> None:
    assert f"{PACKAGED_WEIGHTS.stat().st_size / 1e6:.1f} MB" in page("codec")


def test_what_there_is() -> None:
    assert f"xew has {len(TASKS)} tabletop tasks" in page("tasks") and all(f"`{name}`" in page("tasks") for name in TASKS)
    assert f"{len(COMMANDS)} commands" in page("architecture") and all(f"`{key}`" in page("robots") for key in ROBOTS)
    scope = page("scope")
    assert f"{episode.WIDTH}x{episode.HEIGHT} pixels, at {protocol.FRAME_RATE:.1f} frames a second" in scope
    assert f"A command is {protocol.ACTION_DIM} numbers" in scope
    starts = {family: f"{start:,}" for family, start in protocol.SEED_STARTS.items()}
    for family, name in (("train", "training"), ("validation", "validation"), ("test", "test")):
        assert cells(page("tasks"), name)[1] == starts[family]


def test_table_2_of_the_paper() -> None:
    """Our value and the paper's in parentheses, as in the committed table of the study."""
    table = pd.read_csv(ROOT / "docs" / "results" / "six_tasks" / "tables" / "actions.csv")
    names = ["PSNR [dB] ↑", "LPIPS ↓", "Mask IoU ↑", "PCK ↑", "Object error [px] ↓"]
    table = table.assign(metric=table["column"].str.split(": ").str[1]).dropna(subset="paper")
    for row in table["row"].unique():
        ours = table[table["row"] == row].set_index("metric")
        assert cells(page("reproduce_the_paper"), row)[1:] == [
            f"{ours.loc[n, 'text']} ({ours.loc[n, 'paper']:g})" for n in names
        ]
