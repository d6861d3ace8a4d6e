"""Every benchmark runs at a tiny size, and its workload is what it says. Those whose peers are absent say so."""

import importlib
import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from importlib import import_module as load
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import node, utilization
from tests.commands import run_command
from tests.networks import TINY_CODEC
from tests.sim_warp.small import TASK, work_inline
from tests.synthetic import write_synthetic_data
from tests.torch_ops import make_torchvision_importable
from xew.analysis.studies.rates import find_rates, read_rates
from xew.episode import Record
from xew.protocol import VALIDATION_SEED_START

ROOT = Path(__file__).parents[1]
SHARED = ("common", "utilization")
ELSEWHERE = {"fresh_environments": "tests/test_wheel.py"}
"""Benchmarks that are tried by another file of tests."""
TINY = f"""--clip.frames 5 --clip.height 64 --clip.width 80 --codec.weights {TINY_CODEC} --model.size tiny --model.action none
  --model.embodiment none --model.history --model.reference frame --model.dtype float32 --train.batch 2 --train.log-every 2
  --train.optimizer adamw --train.motion-loss-weight 0 --rollout.sampler euler --rollout.steps 2 --rollout.max-frames 5"""
"""Overrides of the recommended recipe."""


def benchmark(name: str) -> ModuleType:
    return load(f"benchmarks.{name}")


def run_inside(command: Sequence[str], **options: Any) -> SimpleNamespace:
    """Run `python -m ...` in this process instead of in its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(options.get("cwd") or ".")
        run_command(*command[2:])
    return SimpleNamespace(returncode=0)


def use_inside(command: Sequence[str], *given: Any) -> utilization.Use:
    """As `run_sampled`, in this process."""
    run_inside(command)
    return utilization.Use(10.0, 0.5, None, "no GPU is used")


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Two robots, one of which is trained on, in a scene of each family of seeds."""
    write_synthetic_data(tmp_path / "data", seeds=(0, VALIDATION_SEED_START, 1_000_000), robots=("ur5_wsg", "piper"), frames=6)
    return tmp_path / "data"


def run_distance(module: ModuleType, tmp_path: Path) -> None:
    assert module.main(module.Args(seeds=12, workers=2, limit=600, bodies=2)) == 0


def run_estimators(module: ModuleType, tmp_path: Path) -> None:
    module.main(module.Args(frames=4, rounds=1))


def run_generate(module: ModuleType, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        work_inline(patch)
        module.main(module.Args("cpu", tasks=(TASK,), robots=("piper",), workers=1))


def run_grading(module: ModuleType, tmp_path: Path) -> None:
    write_synthetic_data(tmp_path / "data", seeds=(1_000_000,), robots=("ur5_wsg",), frames=4)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "subprocess", SimpleNamespace(run=run_inside, STDOUT=None))
        patch.setattr(module, "ProcessPoolExecutor", ThreadPoolExecutor)
        module.main(module.Args(tmp_path / "data", tmp_path / "out", episodes=1, ways=("default:1",)))


def run_kinematics(module: ModuleType, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "ROUNDS", 1)
        module.main(module.Args("cpu", robots=("piper",), configurations=64))


def run_lerobot_tools(module: ModuleType, tmp_path: Path) -> None:
    pytest.importorskip("lerobot", reason="needs LeRobot: pip install 'lerobot[training]'")
    write_synthetic_data(tmp_path / "data", seeds=(0, 1), robots=("ur5_wsg", "piper"), frames=12)
    run_command("xew.exchange.lerobot", tmp_path / "data", "--out", tmp_path / "export")
    run_command("benchmarks.lerobot_tools", tmp_path / "export", "--data", tmp_path / "data")


def run_metrics(module: ModuleType, tmp_path: Path) -> None:
    for package in ("fastdtw", "skimage", "torch"):
        pytest.importorskip(package, reason="needs the extra: pip install -e '.[reference]'")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "BATCHES", (4,))
        module.main(module.Args(frames=4, rounds=1))


def run_model(module: ModuleType, tmp_path: Path, side: str = "xew") -> None:
    sizes = {"streams": (2,), "dtypes": ("float32",), "vae_chunks": (0,), "size": "tiny", "vae": "tiny", "frames": 5}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "ROUNDS", 1)
        assert module.main(module.Args(**sizes, side=side)) == 0


def run_node(module: ModuleType, tmp_path: Path) -> None:
    """One robot in one scene of each family; a second call only prints the table."""
    asked = {"tasks": (TASK,), "robots": ("ur5_wsg",), "train_seeds": 1, "test_seeds": 1, "train_steps": 4}
    args = module.Args(tmp_path / "node", overrides=TINY, parts=("all",), rates=tmp_path / "rates.json", **asked)
    with pytest.MonkeyPatch.context() as patch:
        work_inline(patch)
        patch.setattr(module, "run_sampled", use_inside)
        module.main(args)
    module.main(replace(args, steps=()))
    (rates,) = read_rates(tmp_path / "rates.json")["tiny"]
    assert rates.kinds.keys() == set(module.STEPS) and "tests" not in find_rates("tiny", tmp_path / "rates.json").text


def run_physics(module: ModuleType, tmp_path: Path) -> None:
    module.main(module.Args("cpu", batches=(2,), frames=3, repeat=0))


def run_recipe(module: ModuleType, tmp_path: Path) -> None:
    write_synthetic_data(tmp_path / "data", seeds=(0, VALIDATION_SEED_START), robots=("ur5_wsg", "piper"), frames=6)

    def run_logged(command: Sequence[str], *_: Any) -> int:
        return run_inside(["python", "-m", f"xew.{command[0]}", *command[1:]]).returncode

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "run_logged", run_logged)
        patch.setattr(module, "ThreadPoolExecutor", lambda _: nullcontext(SimpleNamespace(map=map)))  # training needs signals
        args = module.Args(tmp_path / "data", tmp_path / "recipe", changes=("none",), steps=8, samplers=("euler:2",))
        assert module.main(replace(args, overrides=TINY + " --train.log-every 1")) == 0


def run_render(module: ModuleType, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "ROUNDS", 1)
        patch.setitem(module.VIEWS, "cpu", 1)
        module.main(module.Args("cpu", workloads=(0,), pictures=tmp_path))


def run_sapien_engine(module: ModuleType, tmp_path: Path) -> None:
    pytest.importorskip("sapien", reason="needs SAPIEN and a Vulkan device: pip install sapien")
    module.main(module.Args("cpu", frames=2, samples=1, denoiser="none"))


def run_scene(module: ModuleType, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        work_inline(patch)
        module.main(module.Args(("piper", "franka_panda"), TASK, workers=1, repeats=1))


CASES: Mapping[str, tuple[Callable[[ModuleType, Path], None], str]] = {
    "distance": (run_distance, "LPIPS by embeddings, 1 pairs"),
    "estimators": (run_estimators, "| truth, softened | warp, cpu |"),
    "generate": (run_generate, "1 episodes of 12 frames, 1 seeds tried"),
    "grading": (run_grading, "| default | 1 |"),
    "kinematics": (run_kinematics, "piper: 64 configurations of 8 joints, 11 links each; all agree to"),
    "lerobot_tools": (run_lerobot_tools, "two deleted: 2 episodes"),
    "metrics": (run_metrics, "whole suite"),
    "model": (run_model, '"case": "denoise"'),
    "node": (run_node, "| evaluate | "),
    "physics": (run_physics, "planning and inverse kinematics: "),
    "recipe": (run_recipe, "| none | "),
    "render": (run_render, "capsules: robot of "),
    "sapien_engine": (run_sapien_engine, "the robot's silhouettes agree to"),
    "scene": (run_scene, "2 robots: "),
}
"""How each benchmark is run at a tiny size, and what it then prints."""


def test_every_benchmark_is_run() -> None:
    scripts = {path.stem for path in (ROOT / "benchmarks").glob("*.py")}
    assert scripts == CASES.keys() | ELSEWHERE.keys() | set(SHARED)
    assert all(name in (ROOT / path).read_text() for name, path in ELSEWHERE.items())


@pytest.mark.loose_types("benchmarks and PyTorch's users mix types of arrays")
@pytest.mark.loose_ranks("benchmarks add axes")
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", CASES)
def test_a_benchmark_runs_at_a_tiny_size(name: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    run, printed = CASES[name]
    run(benchmark(name), tmp_path)
    assert printed in capsys.readouterr().out


@pytest.mark.lab
@pytest.mark.filterwarnings("ignore")
def test_the_peer_of_the_model_runs(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    library = make_torchvision_importable()
    torch = pytest.importorskip("torch")
    attention = pytest.importorskip("diffusers.models.attention_dispatch")
    with torch.compiler.set_stance("force_eager"), attention.attention_backend("native"):  # the peer leaves its choice set
        run_model(benchmark("model"), tmp_path, "diffusers")
    said = capsys.readouterr().out
    assert all(f'"case": "{case}"' in said for case in ("train", "denoise", "encode", "decode"))
    del library


def test_a_command_is_sampled_with_its_cores(tmp_path: Path) -> None:
    core = min(node.find_parts()["all"].cores)
    lines = ["import os, time", "print(sorted(os.sched_getaffinity(0)), flush=True)", "end = time.perf_counter() + 1.2"]
    lines += ["while time.perf_counter() < end:", "    pass"]
    use = utilization.run_sampled([sys.executable, "-c", "\n".join(lines)], tmp_path / "log", {}, [core], [])
    assert (tmp_path / "log").read_text() == f"[{core}]\n" and use.seconds > 1.2
    assert 0.02 < use.cpu <= 1.05 and use.gpu is None and use.gpu_source == "no GPU is used"
    program = "import subprocess, sys; subprocess.run([sys.executable, '-c', sys.argv[1]])"
    use = utilization.run_sampled([sys.executable, "-c", program, "\n".join(lines)], tmp_path / "log", {}, [core], [])
    assert use.cpu > 0.02, "work of a child counts"
    with pytest.raises(subprocess.CalledProcessError):
        utilization.run_sampled([sys.executable, "-c", "raise SystemExit(3)"], tmp_path / "log", {}, [core], [])


def test_gpus_that_cannot_be_read_leave_a_reason(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "pynvml", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    read, source = utilization.open_gpus(["0"])
    assert read() == [] and source.startswith("nvidia-ml-py: ") and "nvidia-smi: " in source
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\nprintf '50\\n100\\n'\n")
    tool.chmod(0o755)
    read, source = utilization.open_gpus(["0", "1"])
    assert read() == [0.5, 1.0] and source == "nvidia-smi"


def test_parts_of_a_node_are_a_gpu_with_its_cores_and_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node.os, "sched_getaffinity", lambda _: set(range(64)))
    cases = {(): ((), 16), ("0", "1", "2", "3"): (("0",), 16), ("4",): None}
    for gpus, one in cases.items():
        monkeypatch.setattr(node, "visible_gpus", lambda gpus=gpus: gpus)
        parts = node.find_parts()
        assert (parts["all"].gpus, len(parts["all"].cores)) == (gpus, 64)
        assert ((parts["one"].gpus, len(parts["one"].cores)) if "one" in parts else None) == one


def row(step: str, part: str, **changes: Any) -> node.Row:
    given = {"machine": f"{part} of it", "gpus": 4 if part == "all" else 1, "cores": 16, "size": "small", "measured": "today"}
    given |= {"items": 100, "unit": "episodes", "seconds": 60.0, "start_s": 10.0, "cpu": 0.5, "gpu": None, "gpu_source": "why"}
    return node.Row(step, part, **(given | {"item_mb": 1.0} | changes))


def test_the_table_has_scaling_of_whole_commands_and_after_the_start() -> None:
    rows = {("one", "rollout"): row("rollout", "one"), ("all", "rollout"): row("rollout", "all", seconds=20.0, gpu=0.75)}
    table = node.format_table(rows).splitlines()
    assert table[2] == "| rollout | one of it | 100 episodes | 60.0 | 1.67 | 10.0 | 2.00 |  | 50% |  |  |"
    assert table[3] == "| rollout | all of it | 100 episodes | 20.0 | 5.00 | 10.0 | 10.00 | 75% | 50% | 3.00 | 5.00 |"
    assert table[4] == "GPU utilization is not known: why"
    one, four = node.to_rates(list(rows.values()))
    assert (one.gpus, four.gpus) == (1, 4) and one.kinds["rollout"].seconds(100) == pytest.approx(60)


def test_pieces_are_merged_and_other_machines_are_not(tmp_path: Path) -> None:
    pieces = {"a": row("generate", "one"), "b": row("train", "one"), "c": row("train", "one", machine="other")}
    for folder, made in pieces.items():
        path = tmp_path / folder / made.part / "measured" / f"{made.step}.json"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(vars(made)))
    assert node.read_rows([tmp_path / "a", tmp_path / "b"]).keys() == {("one", "generate"), ("one", "train")}
    with pytest.raises(SystemExit, match="cannot be merged"):
        node.read_rows([tmp_path / "a", tmp_path / "c"])


def test_a_node_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    """A step that is asked for brings those before it whose product is not there or was not measured to its end."""
    pipeline = node.Pipeline(node.Args(tmp_path, steps=("rollout",)), node.Part("one", (), (0,)))
    assert pipeline.list_left() == ["generate", "latents", "train", "rollout"]
    for step in ("generate", "latents"):
        pipeline.record(step).parent.mkdir(parents=True, exist_ok=True)
        pipeline.record(step).write_text("{}")
        (pipeline.folder / node.PRODUCTS[step][0].rstrip("*")).mkdir()
    (pipeline.folder / "run").mkdir()  # of a training that was stopped
    assert pipeline.list_left() == ["train", "rollout"]
    pipeline.record("rollout").write_text("{}")
    assert pipeline.list_left() == []


def test_kinematics_that_differ_are_refused() -> None:
    module = benchmark("kinematics")
    urdf = module.load_urdf(module.get_robot("piper").urdf)
    joint_pos = module.draw_configurations(urdf, 64)
    right = module.kernel_contender(urdf, joint_pos, "cpu")
    wrong = module.kernel_contender(urdf, joint_pos + 1e-3, "cpu")
    assert module.check(urdf, [right, right]) == 0
    with pytest.raises(AssertionError, match="differs from xew kernel"):
        module.check(urdf, [right, wrong])


def test_scenes_that_differ_are_refused() -> None:
    module = benchmark("scene")
    others = [[Record(TASK, 0, "piper", True, hashes={"rgb": text})] for text in "01"]
    with pytest.raises(AssertionError, match="the ways made different episodes"):
        module.time_by_turns({"one": lambda: others[0], "other": lambda: others[1]}, 1)
    failed = [Record(TASK, 0, "piper", False, "grasp")]
    with pytest.raises(AssertionError, match="grasp"):
        module.time_by_turns({"one": lambda: failed}, 1)


def test_render_workloads_have_the_triangles_that_they_name() -> None:
    module = benchmark("render")
    capsules, own, heavy = module.workloads()
    assert all(thing.capsule is not None for thing in capsules.robot)
    assert all(len(thing.mesh.triangles) >= module.PER_LINK for thing in heavy.robot)
    assert max(len(thing.mesh.triangles) for thing in heavy.robot) < 1.01 * module.PER_LINK
    for light, refined in zip(own.robot, heavy.robot, strict=True):
        before, after = (np.ptp(thing.mesh.vertices, axis=0) for thing in (light, refined))
        assert np.allclose(before, after, atol=1e-6)
    scene = module.scene_pass(module.Renderer("cpu"), own, 1)[0]
    module.check(scene, module.command_pass(module.Renderer("cpu"), own, 1)[0], own.camera)


@pytest.mark.skipif(importlib.util.find_spec("sapien") is not None, reason="SAPIEN is installed")
def test_without_sapien_its_benchmark_says_what_to_do() -> None:
    module = benchmark("sapien_engine")
    with pytest.raises(SystemExit, match="pip install sapien"):
        module.main(module.Args(device="cpu"))


def test_parts_of_one_color_make_up_the_mesh() -> None:
    module = benchmark("sapien_engine")
    mesh = module.robot_bodies(module.get_robot("franka_panda"))[0].mesh
    parts = module.one_color_parts(mesh)
    assert len(parts) == len(np.unique(mesh.colors, axis=0)) > 1
    assert sum(len(part.faces) for part, _ in parts) == len(mesh.triangles)
    assert np.isclose(sum(part.area for part, _ in parts), module.trimesh.Trimesh(mesh.vertices, mesh.triangles).area)
