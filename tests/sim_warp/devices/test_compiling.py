"""Kernels that are compiled together: what is noted, what is launched, and that the smallest pieces leave nothing out."""

from pathlib import Path

import numpy as np
import pytest
import warp as wp

from tests.sim_warp.small import TASK, InlineWorkers, launched_modules
from xew.sim_warp.devices.kernels import compile_together, noted_launches
from xew.sim_warp.production import warm_up
from xew.sim_warp.production.cells import Job
from xew.sim_warp.production.produce import produce
from xew.sim_warp.rendering.render import Renderer


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

    assert compile_together(work, wp.get_device("cpu")) == 2
    assert add_one.module.execs and halve.module.execs
    np.testing.assert_array_equal(values.numpy(), 0)
    work()
    np.testing.assert_array_equal(values.numpy(), 0.5)


def test_the_smallest_pieces_launch_all_that_episodes_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(warm_up, "has_kernels", lambda device: False)
    device = wp.get_device("cpu")
    with launched_modules(monkeypatch) as compiled:
        warm_up.compile_kernels(InlineWorkers(2), device, batch=1)  # type: ignore[arg-type]
    said = capsys.readouterr()
    assert wp.config.kernel_cache_dir in said.out
    assert "compiling kernels" in said.err and "0/3" in said.err and "3/3" in said.err
    with launched_modules(monkeypatch) as used:
        produce([Job(TASK, 0, ("piper",))], tmp_path, Renderer("cpu"))
    assert len(used) > 3
    assert used <= compiled


def test_what_is_compiled_is_not_compiled_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm_up, "has_kernels", lambda device: True)
    with launched_modules(monkeypatch) as compiled:
        warm_up.compile_kernels(InlineWorkers(2), wp.get_device("cpu"), batch=1)  # type: ignore[arg-type]
    assert not compiled
