"""How the processes of a run find each other, and what a process says that was started alone."""

import os
import threading
from collections.abc import Callable
from typing import Any

import jax
import pytest

from xew.config import ConfigError
from xew.model.devices import sharding
from xew.model.devices.sharding import start_processes

SLURM = {"SLURM_STEP_NUM_TASKS": "2", "SLURM_NTASKS": "2", "SLURM_JOB_ID": "4711", "SLURM_PROCID": "0", "SLURM_LOCALID": "0"}
EACH = {"JAX_COORDINATOR_ADDRESS": "node1:12355", "JAX_NUM_PROCESSES": "2", "JAX_PROCESS_ID": "1"}


@pytest.fixture
def joined(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, dict[str, Any]]]:
    """The arguments with which JAX is initialized, which joins at once."""
    calls: list[tuple[Any, dict[str, Any]]] = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda address, **numbers: calls.append((address, numbers)))
    return calls


@pytest.mark.parametrize(
    ("environment", "address"),
    [
        ({}, "alone"),
        ({"JAX_NUM_PROCESSES": "1"}, "alone"),
        ({"SLURM_STEP_NUM_TASKS": "1", "SLURM_NTASKS": "2"}, "alone"),
        (SLURM | {"JAX_NUM_PROCESSES": "1"}, "alone"),
        (SLURM | {"SLURM_PTY_PORT": "4000", "JAX_NUM_PROCESSES": "1"}, "alone"),
        (SLURM, None),
        ({"OMPI_COMM_WORLD_SIZE": "4"}, None),
        (EACH, "node1:12355"),
        (EACH | {"JAX_COORDINATOR_ADDRESS": "[fe80::1]:12355"}, "[fe80::1]:12355"),
        (EACH | SLURM | {"SLURM_PTY_PORT": "4000"}, "node1:12355"),
    ],
)
def test_processes_join_if_a_launcher_started_several(
    environment: dict[str, str], address: str | None, joined: list[tuple[Any, dict[str, Any]]]
) -> None:
    start_processes(environment=environment)
    assert [call[0] for call in joined] == ([] if address == "alone" else [address])
    if address is not None and address != "alone":
        assert (joined[0][1]["num_processes"], joined[0][1]["process_id"]) == (2, 1)


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        (SLURM | {"SLURM_STEP_NUM_TASKS": "2(x1)"}, r"SLURM_STEP_NUM_TASKS is '2\(x1\)', expected a whole number"),
        (EACH | {"JAX_PROCESS_ID": "first"}, "JAX_PROCESS_ID is 'first', expected a whole number"),
        (EACH | {"JAX_COORDINATOR_ADDRESS": "node1"}, "is 'node1', expected host:port, such as node1:12355"),
        (EACH | {"JAX_COORDINATOR_ADDRESS": "node1:http"}, "is 'node1:http', expected host:port"),
        (EACH | {"JAX_COORDINATOR_ADDRESS": ":12355"}, "is ':12355', expected host:port"),
        (SLURM | {"SLURM_PTY_PORT": "4000"}, "a shell of a Slurm step of 2 tasks, where only one process was started"),
    ],
)
def test_wrong_variables_are_named(environment: dict[str, str], said: str, joined: list[tuple[Any, dict[str, Any]]]) -> None:
    with pytest.raises(ConfigError, match=said) as error:
        start_processes(environment=environment)
    assert not joined and "\n" not in str(error.value)


@pytest.mark.parametrize("fault", [KeyError("SLURM_STEP_NODELIST"), IndexError("list index out of range"), TypeError("None")])
def test_whatever_jax_raises_is_a_user_s_mistake(fault: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: Any, **options: Any) -> None:
        raise fault

    monkeypatch.setattr(jax.distributed, "initialize", fail)
    with pytest.raises(ConfigError, match="cannot join the other processes"):
        start_processes(environment=SLURM)


@pytest.mark.parametrize(
    ("environment", "waited_for"),
    [(SLURM, "1 other process of this run"), ({"OMPI_COMM_WORLD_SIZE": "4"}, "3 other processes of this run")],
)
def test_a_process_that_waits_says_so_and_ends(
    environment: dict[str, str], waited_for: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    ended = threading.Event()
    note: Callable[[int], None] = lambda code: ended.set() if code == 2 else None  # noqa: E731
    monkeypatch.setattr(sharding, "NOTICE_S", 0.01)
    monkeypatch.setattr(sharding, "JOIN_S", 0.05)
    monkeypatch.setattr(os, "_exit", note)
    monkeypatch.setattr(jax.distributed, "initialize", lambda *args, **options: ended.wait(10))
    start_processes(environment=environment)
    said = capfd.readouterr().err.splitlines()
    assert said[0].startswith(f"waiting up to 0.05 s for {waited_for}. Start all by Slurm's srun")
    assert said[1].startswith(f"error: {waited_for} did not come within 0.05 s.") and len(said) == 2
