"""The command that makes data: counts, resumes, and tells what is wrong; runs in worker processes as a user's would."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, cast

import pytest
import warp as wp

from tests.sim_warp.small import SLOW, TASK, WITH_SLOW, fill_disk, produce, work_inline
from tests.sim_warp.worker_jobs import half, name_of_own_device
from xew.config import ConfigError
from xew.dataset import find_accepted, find_records, view_folder
from xew.episode import EpisodeError, Record, episode_folder, read_record, verify_episode, write_episode
from xew.protocol import SEED_STARTS, TEST_SEED_START, VALIDATION_SEED_START, seed_split
from xew.sim_warp import generate as command
from xew.sim_warp.devices import workers
from xew.sim_warp.devices.workers import Workers
from xew.sim_warp.generate import Args, generate, main, plan_seeds
from xew.sim_warp.inspection.checks import find_problem
from xew.sim_warp.manifest import Manifest
from xew.sim_warp.production.cells import Job
from xew.sim_warp.production.produce import Production
from xew.sim_warp.production.seeds import MOST_UNPAIRED, SEEDS_OF_ROBOT, Family, demand_enough
from xew.sim_warp.production.summary import yield_table
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.robots import RobotSpec

ROOT = Path(__file__).parents[2]
ROBOTS = ("franka_panda", SLOW)
FLAGS = ("--tasks", TASK, "--robots", *ROBOTS, "--train-seeds", "3", "--test-seeds", "1", "--device", "cpu")
ACCEPTED = (0, 2, 4, TEST_SEED_START)
"""The slow robot cannot do odd seeds: three training seeds are had at the fifth try."""
REJECTED = (1, 3)


def arguments(out: Path) -> Args:
    return Args(tasks=(TASK,), robots=ROBOTS, train_seeds=3, test_seeds=1, out=out, workers=2, device="cpu")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed")
    families = generate(arguments(out))
    assert [family.accepted for family in families] == [3, 1]
    return out


def contents(out: Path) -> dict[str, tuple[Record, list[str]]]:
    """All cells with their headers and names of files; nothing else may lie in the tree."""
    cells = {str(folder.relative_to(out)): (record, sorted(os.listdir(folder))) for folder, record in find_records(out)}
    assert len(cells) == len(list(out.glob("*/*/*"))), "left-overs"
    return cells


def test_seeds_are_tried_until_enough_are_accepted(undisturbed: Path) -> None:
    records = [record for _, record in find_records(undisturbed)]
    assert {record.seed for record in records} == {*ACCEPTED, *REJECTED}
    assert {record.seed for _, record in find_accepted(undisturbed)} == set(ACCEPTED)
    assert len(records) == len(ROBOTS) * 6
    for folder, record in find_accepted(undisturbed):
        assert verify_episode(folder) == record and set(record.hashes) == {"states", "rgb", "robot"}


def test_own_motion_is_on_record_and_never_mixed_with_shared_motion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work_inline(monkeypatch)
    out = tmp_path / "own"
    asked = Args((TASK,), ("franka_panda",), 1, 0, out=out, device="cpu", motion="own", states_only=True)
    generate(asked)
    ((folder, record),) = find_records(out)
    assert record.motion == "own" and find_problem(folder) == "", "its holds are known again in its own time"
    with pytest.raises(EpisodeError, match="holds episodes of own motion, expected shared motion; choose another --out"):
        generate(replace(asked, motion="shared"))
    assert yield_table([record]).splitlines()[-1] == "motion: own 1"
    header = folder / "episode.json"
    fields = json.loads(header.read_text())
    header.write_text(json.dumps(fields | {"motion": "fast"}))
    with pytest.raises(EpisodeError, match="its motion is 'fast', expected shared or own"):
        read_record(folder)


def test_views_are_made_of_accepted_episodes_and_change_no_file(
    undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = Path(shutil.copytree(undisturbed, tmp_path / "data"))
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    flags = [*FLAGS, "--out", str(out), "--workers", "1", "--cameras", "head", "wrist_left", "--size", "96x64"]
    monkeypatch.setattr(sys, "argv", ["generate", *flags])
    main()
    assert all(path.read_bytes() == content for path, content in before.items())
    for view in ("head_96x64", "wrist_left_96x64"):
        seen = find_accepted(view_folder(out, view))
        assert {record.seed for _, record in seen} == set(ACCEPTED) and len(seen) == len(ROBOTS) * len(ACCEPTED)
        assert verify_episode(seen[0][0]).camera.size == (96, 64)


def test_what_was_rejected_is_on_record_with_its_reason(undisturbed: Path) -> None:
    failed = [record for _, record in find_records(undisturbed) if not record.success]
    assert [(record.seed, record.robot, record.failure) for record in failed] == [(seed, SLOW, "plan") for seed in REJECTED]
    lines = yield_table([record for _, record in find_records(undisturbed)]).splitlines()
    assert lines[1].split()[1:] == ["franka_panda", "6", "6", "(100", "%)", "12"]
    assert lines[2].split()[1:] == [SLOW, "6", "4", "(67", "%)", "12", "plan", "2"]
    assert lines[3].endswith("all robots together: 4 of 6 seeds accepted")


def test_neither_workers_nor_batches_change_a_byte(undisturbed: Path, tmp_path: Path) -> None:
    jobs = [Job(TASK, seed, ROBOTS) for seed in (4, 1, TEST_SEED_START)]
    produce(jobs, tmp_path, Renderer("cpu"), robots=WITH_SLOW)
    found, expected = contents(tmp_path), contents(undisturbed)
    assert len(found) == 6 and all(expected[name] == cell for name, cell in found.items())


def test_what_is_there_is_not_made_again(undisturbed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*args: object, **kwargs: object) -> None:
        raise AssertionError("nothing was missing")

    monkeypatch.setattr(command.Workers, "run", none)
    assert [family.accepted for family in generate(arguments(undisturbed))] == [3, 1]


def test_each_robot_is_found_once(undisturbed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []

    def find(name: str, data: Path) -> RobotSpec:
        found.append(name)
        return WITH_SLOW[name]

    monkeypatch.setattr(command, "get_robot", find)
    assert [family.robots for family in generate(arguments(undisturbed))] == [ROBOTS, ROBOTS]
    assert found == list(ROBOTS)


def test_what_is_deleted_is_made_again(undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cell of an accepted seed, the failed one of a rejected seed, and the good one of another."""
    out = tmp_path / "data"
    shutil.copytree(undisturbed, out)
    for seed, robot in ((2, SLOW), (1, SLOW), (3, "franka_panda")):
        shutil.rmtree(episode_folder(out, TASK, seed, robot))
    left_over = episode_folder(out, TASK, 0, "franka_panda").with_name(".writing-abc")
    left_over.mkdir()
    work_inline(monkeypatch)
    generate(arguments(out))
    assert contents(out) == contents(undisturbed)


def test_a_run_killed_in_the_middle_is_taken_up_again(
    undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = subprocess.Popen(
        [sys.executable, "-m", "xew.sim_warp.generate", *FLAGS, "--workers", "2", "--out", str(tmp_path)],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
    )  # fmt: skip
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("*/*/[!.]*/episode.json")):
        assert time.monotonic() < deadline and run.poll() is None, run.communicate()[0]
        time.sleep(0.01)
    run.send_signal(signal.SIGKILL)
    run.communicate()  # the pipe ends when the last worker has gone
    deadline = time.monotonic() + 20
    while alive(run.pid):  # the kernel takes a moment to clear a process away
        assert time.monotonic() < deadline, "workers outlive their parent"
        time.sleep(0.05)
    assert 0 < len(list(find_records(tmp_path))) < len(contents(undisturbed))
    work_inline(monkeypatch)
    generate(arguments(tmp_path))
    assert contents(tmp_path) == contents(undisturbed)


def alive(session: int) -> list[str]:
    """Commands of the processes of a session that still run."""
    listed = subprocess.run(["ps", "-o", "stat=,args=", "-s", str(session)], capture_output=True, text=True)
    return [line for line in listed.stdout.splitlines() if not line.startswith("Z")]


# --- What is told to a user.


def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, *flags: str) -> str:
    """What the command says when it refuses: one line, exit code 2."""
    monkeypatch.setattr(sys, "argv", ["generate", *flags])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    return capsys.readouterr().err.strip().splitlines()[-1]


def test_a_full_disk_in_a_worker_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    """A limit on the size of files, which the worker sets as it begins, stands for the disk."""
    monkeypatch.setattr(sys, "argv", ["generate", *FLAGS, "--workers", "1", "--out", str(tmp_path)])
    monkeypatch.setattr(workers, "_begin_worker", fill_disk)
    with pytest.raises(SystemExit) as left:
        main()
    said = capfd.readouterr().err
    assert left.value.code == 2 and "Traceback" not in said, said
    assert "cannot write the episode" in said and "Free some space or choose another --out" in said
    assert not [record for _, record in find_records(tmp_path) if record.hashes]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--tasks", "grab_rollers"), "error: unknown task 'grab_rollers'; did you mean 'grab_roller'?"),
        (("--robots", "panda"), "error: unknown robot 'panda';"),
        (("--robots", "tests.sim_warp.small:CLOSE"), "is a Task; expected a RobotSpec"),
        (("--train-seeds", "-1"), "tasks, 5 robots, -1 training"),
        (("--batch", "0"), "a batch from 1"),
        (("--faults", "99"), "error: --faults is 99; expected 2 to 32 commands a scene, or 0 for the expert's."),
        (("--cameras", "wrist"), "error: there is no camera 'wrist'; did you mean 'wrist_left'?"),
        (("--cameras", "side", "--size", "640"), "error: the size is '640'; expected WIDTHxHEIGHT such as 640x480"),
        (("--cameras", "side", "--states-only"), "error: --cameras makes videos, and --states-only stores none"),
        (("--device", "gpu"), "error: --device gpu: not on this machine, which has cpu"),
    ],
)
def test_mistakes_are_told_in_a_line(
    flags: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    assert message in refused(monkeypatch, capsys, *flags, "--out", str(tmp_path / "data"))


def test_a_file_for_a_folder_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "data").write_text("a file")
    line = refused(monkeypatch, capsys, *FLAGS, "--out", str(tmp_path / "data"))
    assert line == f"error: cannot write to {tmp_path / 'data'}: File exists. Choose another folder with --out."
    line = refused(monkeypatch, capsys, *FLAGS, "--out", str(tmp_path / "data" / "below"))
    assert "Not a directory. Choose another folder with --out." in line


def test_a_damaged_header_is_told_before_any_work(
    undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "data"
    shutil.copytree(undisturbed, out)
    broken = episode_folder(out, TASK, 2, SLOW) / "episode.json"
    broken.write_text(broken.read_text()[:100])
    line = refused(monkeypatch, capsys, *FLAGS, "--out", str(out))
    assert line.startswith(f"error: {broken} is damaged") and "delete its folder and run generate again" in line
    shutil.rmtree(broken.parent)
    broken.parent.with_name("franka_panda").rename(broken.parent)
    assert "in a folder that was copied or renamed" in refused(monkeypatch, capsys, *FLAGS, "--out", str(out))


def test_an_imported_episode_does_not_pass_for_a_robot_of_the_same_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    record = Record(TASK, 0, "piper_robotwin", True, hashes={"rgb": "0"}, source="elsewhere")
    folder = write_episode(tmp_path, record)
    line = refused(monkeypatch, capsys, *FLAGS, "--out", str(tmp_path))
    assert line.startswith(f"error: {folder} was imported (elsewhere)") and line.endswith("Choose another --out.")


# --- Families: which seeds are tried.


def outcome(seed: int, robot: str, success: bool = True, pictures: bool = True) -> Record:
    return Record("task", seed, robot, success, hashes={"rgb": "0"} if success and pictures else {})


def family(wanted: int, *records: Record) -> Family:
    made = Family("task", 10, wanted, ("a", "b"))
    for record in records:
        made.add(record)
    return made


def test_as_many_seeds_are_tried_as_could_be_accepted() -> None:
    assert [job.seed for job in family(2).next_jobs()] == [10, 11]
    assert family(0).next_jobs() == []
    tried = family(2, outcome(10, "a", pictures=False), outcome(10, "b", success=False), outcome(11, "a"), outcome(11, "b"))
    assert tried.accepted == 1 and tried.next_jobs() == [Job("task", 12, ("a", "b"))]


AB = dict.fromkeys(SEED_STARTS, ("a", "b"))
"""Two robots for all families of seeds."""


def test_validation_seeds_are_a_family_of_their_own_that_is_made_when_asked_for() -> None:
    args = Args(tasks=("grab_roller",), robots=("a", "b"), train_seeds=2, test_seeds=1, validation_seeds=3)
    families = plan_seeds(args, AB, Manifest())
    assert [(f.first_seed, f.wanted) for f in families] == [(0, 2), (VALIDATION_SEED_START, 3), (TEST_SEED_START, 1)]
    assert {seed_split(seed) for seed in families[1].tries} == {"validation"}
    assert len(plan_seeds(replace(args, validation_seeds=0), AB, Manifest())) == 2


def test_test_seeds_may_be_of_other_robots() -> None:
    args = Args(tasks=("grab_roller",), train_seeds=2, test_seeds=1)
    families = plan_seeds(args, AB | {"test": ("b", "c")}, Manifest())
    assert [(family.first_seed, family.robots) for family in families] == [(0, ("a", "b")), (TEST_SEED_START, ("b", "c"))]


def test_the_reserved_block_has_the_robots_of_the_test_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is made when asked for, from its first seed on."""

    def stop(args: Args, robots: dict[str, tuple[str, ...]], manifest: Manifest) -> list[Family]:
        planned = {seed_split(family.first_seed): family for family in plan_seeds(args, robots, manifest)}
        assert planned["final"].first_seed == SEED_STARTS["final"] and planned["final"].wanted == 2
        assert robots["final"] == robots["test"] == ("piper",) != robots["train"]
        raise InterruptedError

    monkeypatch.setattr(command, "plan_seeds", stop)
    with pytest.raises(InterruptedError):
        generate(Args(tasks=(TASK,), robots=ROBOTS[:1], test_robots=("piper",), final_seeds=2, out=tmp_path))


@pytest.mark.parametrize(
    ("physics", "cores", "device"),
    [
        ("cuda", 64, "cuda:0"),
        ("cpu", 4, "cpu"),
        (None, 15, "cuda:0"),
        (None, 16, "cpu"),
    ],
)
def test_physics_on_the_cpu_leaves_the_gpu_to_the_pictures(
    physics: Literal["cpu", "cuda"] | None, cores: int, device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Devices of the jobs and of the compiled kernels on a machine with two GPUs."""
    monkeypatch.setattr(workers, "usable_cores", lambda: cores)
    compiled: dict[str, str] = {}
    productions: list[Production] = []
    gpus = [SimpleNamespace(is_cuda=True, alias=f"cuda:{number}", total_memory=1e12) for number in range(2)]
    monkeypatch.setattr(command, "find_devices", lambda name: gpus)
    monkeypatch.setattr(command, "compile_on_devices", lambda pool, devices, batch, later: compiled.update(devices))
    monkeypatch.setattr(command, "make_scenes", lambda pool, jobs, production, _: productions.append(production) or [])
    work_inline(monkeypatch)
    args = Args((TASK,), ("a", "b"), out=tmp_path, batch=8, physics=physics)
    with command.start_workers(args, dict.fromkeys("ab", WITH_SLOW[SLOW])) as (_, make):
        assert list(make([Job(TASK, seed, ("a", "b")) for seed in range(5)])) == []
    (production,) = productions
    assert production.gpu_physics == (device != "cpu") and (production.batch, production.gpus) == (8, 2)
    assert compiled == {"physics": device, "kinematics": device, "rendering": "cuda:0"}


def test_unpaired_robots_share_no_seed(tmp_path: Path) -> None:
    """Each robot's seeds are its own however many are tried, and it waits for no other."""
    args = Args(tasks=("grab_roller",), robots=("a", "b"), train_seeds=MOST_UNPAIRED, test_seeds=1, unpaired=True)
    families = plan_seeds(args, AB, Manifest())
    assert [(f.robots, f.wanted) for f in families] == [
        (("a",), MOST_UNPAIRED),
        (("b",), MOST_UNPAIRED),
        (("a",), 1),
        (("b",), 1),
    ]
    tried = [set(f.tries) for f in families]
    assert len(set.union(*tried)) == sum(map(len, tried))
    assert families[1].first_seed == SEEDS_OF_ROBOT and families[3].first_seed == TEST_SEED_START + SEEDS_OF_ROBOT
    paired = plan_seeds(replace(args, unpaired=False), AB, Manifest())
    assert [(f.robots, f.first_seed) for f in paired] == [(("a", "b"), 0), (("a", "b"), TEST_SEED_START)]


def test_unpaired_episodes_are_made_once_and_for_their_robot_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work_inline(monkeypatch)
    args = replace(arguments(tmp_path), unpaired=True, train_seeds=1, test_seeds=0, robots=(SLOW, "franka_panda"))
    expected = [(0, SLOW), (SEEDS_OF_ROBOT, "franka_panda")]
    assert [(record.seed, record.robot) for _, record in made(args)] == expected
    assert [(record.seed, record.robot) for _, record in made(args)] == expected


def made(args: Args) -> list[tuple[Path, Record]]:
    assert all(family.accepted == family.wanted for family in generate(args))
    return sorted(find_records(args.out))


def test_only_what_is_missing_is_made() -> None:
    assert family(1, outcome(10, "a")).next_jobs() == [Job("task", 10, ("b",))]
    rejected = family(1, outcome(10, "a", success=False))
    assert rejected.next_jobs() == [Job("task", 10, ("b",), rejected=True), Job("task", 11, ("a", "b"))]
    without_pictures = family(1, outcome(10, "a", pictures=False))
    assert without_pictures.accepted == 0 and without_pictures.next_jobs() == [Job("task", 10, ("a", "b"))]


def test_a_robot_added_later_can_undo_an_accepted_seed() -> None:
    added = replace(family(1, outcome(10, "a"), outcome(10, "b")), robots=("a", "b", "c"))
    assert added.next_jobs() == [Job("task", 10, ("c",))]
    added.add(outcome(10, "c", success=False))
    assert added.accepted == 0 and added.next_jobs() == [Job("task", 11, ("a", "b", "c"))]


def test_a_hopeless_task_gives_up_and_says_so() -> None:
    hopeless = family(1)
    rounds = 0
    while jobs := hopeless.next_jobs():
        rounds += 1
        for job in jobs:
            hopeless.add(outcome(job.seed, "a", success=False))
            hopeless.add(outcome(job.seed, "b", pictures=False))
    assert rounds == len(hopeless.tries) == 23
    with pytest.raises(EpisodeError, match="task with a, b: only 0 of 1 seeds were accepted in 23 tries"):
        demand_enough([family(0), hopeless])


# --- Worker processes.


@pytest.mark.parametrize(
    ("cores", "gigabytes", "physics", "count"),
    [
        (16, [141], "cuda", 8),
        (32, [80], "cuda", 8),
        (32, [80, 80], "cuda", 16),
        (32, [80], "cpu", 26),
        (32, [80, 80], "cpu", 32),
        (16, [80], "cpu", 16),
        (1, [4], "cuda", 1),
    ],
)
def test_gpus_have_as_many_workers_as_cores_and_their_memory_allow(
    cores: int, gigabytes: list[int], physics: str, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "usable_cores", lambda: cores)
    gpus = [SimpleNamespace(is_cuda=True, total_memory=size * 1e9) for size in gigabytes]
    stepping = gpus[0] if physics == "cuda" else SimpleNamespace(is_cuda=False)
    assert workers.worker_count(cast(Any, gpus), cast(Any, stepping)) == count


def test_a_gpu_that_others_fill_is_refused() -> None:
    gpus = [SimpleNamespace(is_cuda=True, alias=f"cuda:{number}", total_memory=size) for number, size in enumerate([80e9, 0])]
    with pytest.raises(ConfigError, match=r"^cuda:1 has no memory left; end the programs"):
        workers.worker_count(cast(Any, gpus))


def test_physics_on_a_gpu_that_is_not_there_is_refused() -> None:
    devices = [wp.get_device("cpu")]
    with pytest.raises(ConfigError, match="--physics cuda needs a GPU, and the device is cpu; omit it"):
        workers.choose_physics("cuda", devices)
    assert workers.choose_physics(None, devices) == workers.choose_physics("cpu", devices) == devices[0]


def test_workers_have_the_gpus_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    shared: list[list[str]] = []
    monkeypatch.setattr(workers, "open_processes", lambda count, imported, begin, own: shared.append(own))
    gpus = [SimpleNamespace(alias=f"cuda:{number}", name="H100") for number in range(2)]
    Workers(3, cast(Any, gpus))
    assert shared == [["cuda:0", "cuda:1"]]
    monkeypatch.setattr(wp, "get_cuda_devices", lambda: [*gpus, SimpleNamespace(alias="cuda:2", name="T400")])
    assert workers.find_devices(None) == gpus
    assert [device.alias for device in workers.find_devices("cpu")] == ["cpu"]


def test_a_worker_has_its_device_as_warps_default() -> None:
    with Workers(1, [wp.get_device("cpu")]) as pool:
        assert list(pool.run(name_of_own_device, [0])) == ["cpu"]


def test_newton_is_imported_where_it_works_and_not_where_work_is_handed_out() -> None:
    """It takes seconds. Workers are forked from a process that has it."""
    code = (
        "import sys, xew.sim_warp.generate as command; from tests.sim_warp.worker_jobs import has_imported; "
        "here = has_imported('newton'); workers = command.Workers(1); "
        "print(here, *workers.run(has_imported, ['newton.solvers'])); workers.__exit__()"
    )
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False True", found.stderr


def test_workers_take_what_is_added_while_they_work() -> None:
    """What is put on the left is done before what waits, beyond the two jobs that each worker has under way."""
    jobs, found = deque([16, *range(40, 60, 2)]), []
    with Workers(1) as workers:
        for number in workers.run(half, jobs):
            found.append(number)
            if number in (8, 4, 2):
                jobs.appendleft(number)
    assert sorted(found) == [1, 2, 4, 8, *range(20, 30)] and found.index(1) < found.index(29)


def test_workers_hand_over_results_and_errors() -> None:
    with Workers(2) as workers:
        assert workers.start(half, 8)() == 4
        assert sorted(workers.run(half, [2, 4, 6])) == [1, 2, 3]
        with pytest.raises(ConfigError, match="thirteen"):
            list(workers.run(half, [13]))
        with pytest.raises(EpisodeError, match=r"a worker process was killed.*Completed work is stored"):
            list(workers.run(half, [2, 17, 4]))
