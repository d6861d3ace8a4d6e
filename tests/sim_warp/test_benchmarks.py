"""Benchmarks run, and their workloads are what they say. What they compare with may be absent; then they say so."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.sim_warp.small import TASK, work_inline
from xew.episode import Record

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def benchmark(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"benchmarks_{name}", BENCHMARKS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look up their annotations
    spec.loader.exec_module(module)
    return module


def test_kinematics_agree_before_they_are_timed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    module = benchmark("kinematics")
    monkeypatch.setattr(module, "ROUNDS", 1)
    module.main(module.Args(device="cpu", robots=("piper",), configurations=64))
    told = capsys.readouterr().out
    assert "piper: 64 configurations of 8 joints, 11 links each; all agree to" in told
    assert "xew kernel" in told and "newton.eval_fk" in told


def test_kinematics_that_differ_are_refused() -> None:
    module = benchmark("kinematics")
    urdf = module.load_urdf(module.get_robot("piper").urdf)
    joint_pos = module.draw_configurations(urdf, 64)
    right = module.kernel_contender(urdf, joint_pos, "cpu")
    wrong = module.kernel_contender(urdf, joint_pos + 1e-3, "cpu")
    assert module.check(urdf, [right, right]) == 0
    with pytest.raises(AssertionError, match="differs from xew kernel"):
        module.check(urdf, [right, wrong])


def test_a_scene_is_the_same_both_ways_before_it_is_timed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    module = benchmark("scene")
    work_inline(monkeypatch)
    module.main(module.Args(("piper", "franka_panda"), TASK, workers=1, repeats=1))
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("one process") and told[1].startswith("robot by robot, 1 workers")
    assert told[2].startswith("2 robots: ") and told[2].endswith(" times as fast")
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
    module.check(scene, module.command_pass(module.Renderer("cpu"), own, 1)[0])


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
