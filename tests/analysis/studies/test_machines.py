"""The machines of a study: which GPUs a step takes, what it is told of them, launchers and Ray."""

import itertools
import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.analysis.studies.chains import ROOT, STEPS, chain, run
from xew.analysis.studies.config import Study, load_study
from xew.analysis.studies.machines import RayCluster, ThisMachine, open_machines
from xew.analysis.studies.plan import Step, plan
from xew.analysis.studies.processes import start_step
from xew.concurrency import visible_gpus
from xew.config import ConfigError

pytestmark = pytest.mark.usefixtures("cheap_steps")


def test_a_gpu_has_one_training_and_a_few_steps_beside(tmp_path: Path) -> None:
    machine = ThisMachine(("4", "7"), 1, {}, steps_per_gpu=2)
    shows = (sys.executable, "-c", "import os; print('on', os.environ['CUDA_VISIBLE_DEVICES'], flush=True)")
    steps = [Step(kind, name, (), (), None, tmp_path / name, launcher=shows) for kind, name in
             (("train", "a"), ("rollout", "b"), ("adapt", "c"), ("evaluate", "d"))]  # fmt: skip
    for step in steps:
        assert machine.has_room_for(step)
        machine.start(step, (), tmp_path / f"{step.variant}.log")
    assert not any(machine.has_room_for(step) for step in steps)
    while machine._running:
        machine.wait()
    used = [next(line for line in (tmp_path / f"{step.variant}.log").read_text().splitlines() if line.startswith("on "))
            for step in steps]  # fmt: skip
    assert used == ["on 4", "on 7", "on 7", "on 4"], "the least busy GPU first, and never two trainings on one"
    assert all(machine.has_room_for(step) for step in steps)


def test_gradings_beside_trainings_give_memory_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shows = (sys.executable, "-c", "import os; print('by', os.environ.get('XLA_PYTHON_CLIENT_ALLOCATOR'), flush=True)")
    allocators = {}
    for count, kind in itertools.product((1, 2), ("train", "evaluate")):
        machine, log = ThisMachine(("4",), 1, {}, steps_per_gpu=count), tmp_path / f"{kind}{count}.log"
        machine.start(Step(kind, "a", (), (), None, tmp_path / "a", launcher=shows), (), log)
        machine.wait()
        allocators[count, kind] = log.read_text().split("by ")[1].split()[0]
    assert allocators == {(1, "train"): "None", (1, "evaluate"): "None", (2, "train"): "None", (2, "evaluate"): "platform"}
    monkeypatch.setenv("XLA_PYTHON_CLIENT_ALLOCATOR", "default")
    machine.start(Step("evaluate", "a", (), (), None, tmp_path / "a", launcher=shows), (), tmp_path / "told.log")
    machine.wait()
    assert "by default" in (tmp_path / "told.log").read_text()


def test_a_launcher_starts_the_command(tmp_path: Path) -> None:
    """As srun would; here env, which also sets a variable."""
    process = start_step(
        ("json.tool", "--help"), tmp_path / "step.log", {}, method="spawn", launcher=("env", "PYTHONIOENCODING=utf-8")
    )
    process.join()
    assert process.exitcode == 0
    assert (tmp_path / "step.log").read_text().startswith("$ env PYTHONIOENCODING=utf-8 python -m json.tool")


def test_gpus_are_shared_out(study: Study) -> None:
    machine = ThisMachine(("2", "5", "7"), 1, {})
    one, two = Step("rollout", "a", (), (), None, study.out), Step("train", "b", (), (), None, study.out, gpus=2)
    assert machine.slots == 3 and machine.has_room_for(two)
    for step in (two, one):
        machine.start(step, (STEPS, str(study.out / step.variant), "x", "--wait", "0.2"), study.out / f"{step.variant}.log")
    assert machine._running["train/b"].slots == ("2", "5") and machine._running["rollout/a"].slots == ("7",)
    assert not machine.has_room_for(one)
    while machine._running:
        machine.wait()
    assert machine.has_room_for(Step("train", "c", (), (), None, study.out, gpus=3))


def test_a_step_has_the_cores_of_its_gpus(study: Study) -> None:
    """Of four GPUs' cores a step on one has a quarter, as far as there are so many; one on all has them all."""
    cores = sorted(os.sched_getaffinity(0))
    assert ThisMachine(("0", "1"), 1, {})._cores(("0", "1")) == tuple(cores)
    machine, log = ThisMachine(("0", "1"), 1, {}), study.out / "a.log"
    shows = (sys.executable, "-c", "import os; print('cores', sorted(os.sched_getaffinity(0)))")
    assert machine.start(Step("rollout", "a", (), (), None, study.out, launcher=shows), (), log) == 1
    machine.wait()
    assert f"cores {cores[: len(cores) // 2] or cores}" in log.read_text()


def test_data_are_made_on_every_gpu(study: Study) -> None:
    machine, generate = ThisMachine(("2", "5", "7"), 1, {}, steps_per_gpu=3), plan(study)["generate"]
    machine.start(generate, (STEPS, str(study.out / "x"), "x"), study.out / "generate.log")
    assert machine._running["generate"].slots == ("2", "5", "7")
    assert machine.has_room_for(Step("distances", "", (), (), None, study.out)), "others go beside"
    steps, shared = plan(study), plan(replace(study, machine=replace(study.machine, steps_per_gpu=3)))
    assert generate.gpus_of(3) == 3 and steps["distances"].gpus_of(3) == 1
    assert [step.gpus_of(3) for step in steps.values() if step.kind == "latents"][:2] == [3, 1], "others wait for the first"
    assert [planned["baselines"].gpus_of(3) for planned in (steps, shared)] == [1, 3], "what trains need not wait for them"
    while machine._running:
        machine.wait()
    assert ThisMachine((), 2, {}).has_room_for(generate)


def test_gpus_that_are_not_there(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert visible_gpus() == ()
    asked = load_study(ROOT / "configs" / "study_debug.yaml", ["--machine.gpus", "0", "--machine.gpus-per-training", "8"])
    with pytest.raises(ConfigError, match="gpus_per_training is 8, there are 1 GPUs"):
        open_machines(asked)


def test_cells_run_as_tasks_on_a_ray_cluster(study: Study) -> None:
    """Two nodes of one core each: two steps that wait for one another run at once, so on both; a failure is told."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        cluster.add_node(num_cpus=1)
        machines = RayCluster(cluster.address, {})
        try:
            assert machines.slots == 2
            left = ("--until", str(study.out / "right.begun"))
            right = ("--until", str(study.out / "left.begun"), "--fail")
            assert run(study, chain(study.out, left=left, right=right), machines) == {
                "train/right": "exit status 1",
                "train/end": "needs train/right",
            }
            assert (study.out / "left").read_text() == "left"
        finally:
            machines.stop()
    finally:
        cluster.shutdown()


def test_a_ray_cluster_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    with pytest.raises(ConfigError, match="ray start --head"):
        RayCluster("auto", {})
