"""Kernels that are compiled together: what is noted, what is launched, and that the smallest pieces leave nothing out."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import warp as wp

from lab import compile_kernels as compile_command
from tests.sim_warp.small import TASK, InlineWorkers, launched_modules, produce
from xew.sim_warp.devices.kernels import Variant, compile_together, noted_launches
from xew.sim_warp.kinematics import inverse
from xew.sim_warp.physics.kernels import set_targets
from xew.sim_warp.production import warm_up
from xew.sim_warp.production.cells import Job
from xew.sim_warp.rendering.render import Renderer


@pytest.fixture(autouse=True)
def _new_solvers() -> None:
    """Solvers of earlier tests replay graphs instead of launching kernels."""
    inverse._problems.cache_clear()


@wp.kernel(module="unique", enable_backward=False)
def add_one(values: wp.array(dtype=float)):  # type: ignore[valid-type]
    values[wp.tid()] += 1.0


@wp.kernel(module="unique", enable_backward=False)
def halve(values: wp.array(dtype=float)):  # type: ignore[valid-type]
    values[wp.tid()] *= 0.5


def test_launches_are_noted_and_not_done() -> None:
    values, count = wp.zeros(3, dtype=float, device="cpu"), wp.ones(1, dtype=int, device="cpu")

    def launch(dim: int) -> None:
        wp.launch_tiled(halve, [dim], [values], block_dim=64)

    launched = wp.launch
    with noted_launches() as found:
        wp.launch(add_one, 3, [values])
        wp.launch(add_one, 3, [values])
        wp.capture_while(count, launch, dim=3)
        wp.capture_if(count, on_true=launch, dim=3)
    assert list(found) == [(add_one.module, 256), (halve.module, 64)]
    assert wp.launch is launched
    np.testing.assert_array_equal(values.numpy(), 0)


def test_what_is_compiled_together_is_loaded_and_then_launched() -> None:
    values = wp.zeros(3, dtype=float, device="cpu")

    def work() -> None:
        wp.launch(add_one, 3, [values], device="cpu")
        wp.launch(halve, 3, [values], device="cpu")

    with noted_launches() as found:
        work()
    assert len(found) == 2
    compile_together(found, wp.get_device("cpu"))
    assert add_one.module.execs and halve.module.execs
    np.testing.assert_array_equal(values.numpy(), 0)
    work()
    np.testing.assert_array_equal(values.numpy(), 0.5)


def test_the_smallest_pieces_launch_all_that_episodes_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(warm_up, "has_kernels", lambda device, module: False)
    with launched_modules(monkeypatch) as compiled:
        warm_up.compile_on_devices(InlineWorkers(2), dict.fromkeys(warm_up.PARTS, "cpu"), batch=1)  # type: ignore[arg-type]
    said = capsys.readouterr()
    assert wp.config.kernel_cache_dir in said.out
    assert "compiling kernels" in said.err and "0/3" in said.err and "3/3" in said.err
    with launched_modules(monkeypatch) as used:
        produce([Job(TASK, 0, ("piper",))], tmp_path, Renderer("cpu"))
    assert len(used) > 3
    assert used <= compiled


@pytest.mark.parametrize(
    ("cached", "parts"),
    [
        ([], [("physics", "cpu"), ("kinematics", "cpu"), ("rendering", "cuda:0")]),
        (["wp_xew.sim_warp.rendering.shading_kernels_1/a.sm90.cubin"], [("physics", "cpu"), ("kinematics", "cpu")]),
        (
            ["wp_newton._src.solvers.mujoco.kernels_1/a.sm90.cubin", "wp__lm_solve_tiled_7_20_1/a.cpu.o"],
            [("physics", "cpu"), ("rendering", "cuda:0")],
        ),
    ],
)
def test_missing_parts_are_compiled_side_by_side_on_the_devices_that_they_run_on(
    cached: list[str], parts: list[tuple[str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(wp, "get_device", lambda name: SimpleNamespace(is_cuda=name != "cpu"))
    for name in cached:
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    started: list[tuple[str, str]] = []
    waited: list[tuple[str, str]] = []
    pool = SimpleNamespace(
        run=lambda function, items: started.extend(items) or items,
        start=lambda function, item: started.append(item) or (lambda: waited.append(item)),
    )
    devices = {"physics": "cpu", "kinematics": "cpu", "rendering": "cuda:0"}
    wait = warm_up.compile_on_devices(cast(Any, pool), devices, 1, later="rendering")
    assert sorted(started) == sorted(parts) and not waited, "the renderer's compilation goes on"
    wait()
    assert waited == [part for part in parts if part[0] == "rendering"]


def test_inverse_kinematics_are_compiled_for_the_device_of_the_part(monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker's default device is another one where physics runs on the CPU and rendering on a GPU."""
    asked: list[str] = []

    def note_device(robot: object, device: str) -> Any:
        asked.append(device)
        return SimpleNamespace(solve=lambda *arguments: None)

    monkeypatch.setattr(warm_up, "arm_solver", note_device)
    warm_up.do_smallest_piece("kinematics", "cpu", 1)
    assert asked == ["cpu"]


@pytest.mark.skipif(90 not in wp.get_cuda_supported_archs(), reason="this build of Warp has no compiler for CUDA")
def test_kernels_are_compiled_for_a_gpu_that_is_not_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    values = wp.zeros(3, dtype=float, device="cpu")
    with compile_command.watched_launches() as found:
        wp.launch(add_one, 3, [values], device="cpu")
        wp.launch(halve, 3, [values], block_dim=64, device="cpu")
    np.testing.assert_array_equal(values.numpy(), 0.5)
    assert list(found) == [(add_one.module, 256), (halve.module, 64)]
    assert compile_command.compile_for([*found, (add_one.module, 32), (add_one.module, 32)], 90) == 3
    names = {module.get_module_identifier(size) for module, size in (*found, (add_one.module, 32))}
    assert {path.name for path in tmp_path.glob("*/*.cubin")} == {f"{name}.sm90.cubin" for name in names}
    assert all((tmp_path / name / f"{name}.meta").exists() for name in names)
    assert add_one.module.options["block_dim"] == 256


def test_the_pieces_compiled_for_a_gpu_are_all_that_episodes_launch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found: dict[str, list[Variant]] = {}
    for part in warm_up.PARTS:
        monkeypatch.setattr(compile_command, "compile_for", lambda variants, arch, part=part: found.update({part: [*variants]}))
        compile_command.compile_piece(part, arch=90, batch=2)
    names = {module.name for variants in found.values() for module, _ in variants}
    assert (set_targets.module, 256) in found["physics"] and len(found["physics"]) > 50
    assert any(block_dim == 32 for _, block_dim in found["kinematics"]), "products of small matrices, by a warp"
    with launched_modules(monkeypatch) as used:
        produce([Job(TASK, 0, ("piper",))], tmp_path, Renderer("cpu"))
    assert len(used) > 3
    assert used <= names


def test_an_architecture_that_warp_does_not_know_is_refused_in_a_line(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as left:
        compile_command.main(compile_command.Args(arch=13))
    assert left.value.code == 2
    assert "--arch is 13; Warp's compiler knows" in capsys.readouterr().err


@pytest.mark.parametrize("part", ["physics", "kinematics"])
def test_newton_s_kernels_have_no_adjoints(part: str) -> None:
    """Newton imports its solvers at first use, and makes kernels of inverse kinematics then."""
    with compile_command.watched_launches() as found:
        warm_up.do_smallest_piece(part, "cpu", 1)
    modules = [module for module, _ in found]
    assert any(module.name.startswith(warm_up.PARTS[part]) for module in modules)
    assert not any(module.options["enable_backward"] for module in modules)
