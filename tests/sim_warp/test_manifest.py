"""The manifest: written from headers, read strictly, and obeyed by generate."""

import json
import sys
from pathlib import Path

import pytest

from lab.seeds.manifest import main, manifest_of, to_json
from xew.episode import EpisodeError, Record, write_episode
from xew.protocol import TEST_SEED_START
from xew.sim_warp.generate import Family
from xew.sim_warp.manifest import PACKAGED, Manifest, read_manifest

ROBOTS = ("piper", "ur5_wsg")


def header(seed: int, robot: str, failure: str | None = None) -> Record:
    return Record("grab_roller", seed, robot, failure is None, failure, device="here", versions={"xew": "0"})


RECORDS = [
    *(header(seed, robot) for seed in (0, 2, 5, TEST_SEED_START + 1) for robot in ROBOTS),
    header(1, "piper", "plan"),
    header(1, "ur5_wsg"),
    header(TEST_SEED_START, "piper", "slip"),
    header(TEST_SEED_START, "ur5_wsg", "plan"),
    header(7, "piper"),
]


def test_a_manifest_holds_what_the_headers_say_and_reads_back(tmp_path: Path) -> None:
    manifest = manifest_of(RECORDS)
    seeds = manifest.tasks["grab_roller"]
    assert (seeds.train, seeds.test) == ((0, 2, 5), (TEST_SEED_START + 1,)), "seed 7 has not been tried by all"
    assert seeds.rejected == {"1": {"piper": "plan"}, str(TEST_SEED_START): {"piper": "slip", "ur5_wsg": "plan"}}
    path = tmp_path / "seeds.json"
    path.write_text(to_json(manifest))
    assert read_manifest(path) == manifest
    assert manifest.failing("grab_roller", ["ur5_wsg"]) == {TEST_SEED_START}
    assert manifest.failing("grab_roller", ROBOTS) == {1, TEST_SEED_START}
    assert manifest.failing("open_laptop", ROBOTS) == frozenset()


def test_generate_leaves_out_what_is_known_to_fail() -> None:
    failing = manifest_of(RECORDS).failing("grab_roller", ROBOTS)
    assert [job.seed for job in Family("grab_roller", 0, 3, ROBOTS, failing).next_jobs()] == [0, 2, 3]
    assert [job.seed for job in Family("grab_roller", TEST_SEED_START, 1, ROBOTS, failing).next_jobs()] == [TEST_SEED_START + 1]
    assert [job.seed for job in Family("grab_roller", 0, 3, ROBOTS).next_jobs()] == [0, 1, 2]


def test_the_packaged_manifest_is_well_formed() -> None:
    for task, seeds in read_manifest(PACKAGED).tasks.items():
        assert len(seeds.train) >= 50 and len(seeds.test) >= 20, task


def broken(**changes: object) -> str:
    plain = json.loads(to_json(manifest_of(RECORDS)))
    plain["tasks"]["grab_roller"] |= changes
    return json.dumps(plain)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"tasks": 3}',
        '{"tusks": {}}',
        '{"tasks": {"../../etc": {"train": [], "test": []}}}',
        '{"tasks": {"/etc": {"train": [], "test": []}}}',
        '{"tasks": {"..": {"train": [], "test": []}}}',
        broken(train=[0, -1]),
        broken(train=[2, 2]),
        broken(train=[TEST_SEED_START]),
        broken(train=["../0"]),
        broken(test=[3]),
        broken(rejected={"../1": {"piper": "plan"}}),
        broken(rejected={"0": {"piper": "plan"}}),
        broken(rejected=[1]),
        broken(train=[1.5]),
        broken(train=[True]),
        '{"tasks": {"a": {"train": [1e400], "test": []}}}',
        '{"tasks": {"a\\u0000b": {"train": [], "test": []}}}',
        '{"tasks": ' + "[" * 200_000,
        "\udcff",
    ],
)
def test_what_is_no_manifest_is_told_in_a_line(text: str, tmp_path: Path) -> None:
    path = tmp_path / "seeds.json"
    path.write_text(text, errors="surrogateescape")
    with pytest.raises(EpisodeError, match=r"is no manifest of seeds") as error:
        read_manifest(path)
    assert "\n" not in str(error.value)


def test_a_manifest_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(EpisodeError, match="is no manifest of seeds"):
        read_manifest(tmp_path / "none.json")
    assert Manifest().failing("grab_roller", ROBOTS) == frozenset()


def test_the_command_writes_where_it_is_told_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """And only there: the packaged manifest knows all tasks, a user's data set some."""
    packaged, out = PACKAGED.read_bytes(), tmp_path / "new" / "seeds.json"
    for record in RECORDS:
        write_episode(tmp_path / "data", record)
    monkeypatch.setattr(sys, "argv", ["manifest", str(tmp_path / "data"), "--out", str(out)])
    main()
    assert read_manifest(out) == manifest_of(RECORDS)
    assert "grab_roller: 3 training and 1 test seeds, 2 rejected" in capsys.readouterr().out
    for flags, told in (
        ((str(tmp_path / "data"),), "--out"),
        ((str(tmp_path / "none"), "--out", str(out)), "no episode under"),
        ((str(tmp_path / "data"), "--out", str(tmp_path)), "Choose another file with --out."),
    ):
        monkeypatch.setattr(sys, "argv", ["manifest", *flags])
        with pytest.raises(SystemExit) as left:
            main()
        assert left.value.code == 2 and told in capsys.readouterr().err
    assert PACKAGED.read_bytes() == packaged


def test_seeds_that_some_robot_has_not_tried_are_neither_accepted_nor_rejected() -> None:
    seeds = manifest_of([*RECORDS, header(9, "ur5_wsg", "slip")]).tasks["grab_roller"]
    assert 9 not in seeds.train and "9" not in seeds.rejected


def test_a_manifest_says_what_it_was_found_with() -> None:
    manifest = manifest_of(RECORDS)
    assert (manifest.robots, manifest.device, manifest.versions) == (ROBOTS, "here", {"xew": "0"})
    assert manifest_of([]) == Manifest()


def test_a_change_of_one_seed_changes_one_line() -> None:
    before = to_json(manifest_of(RECORDS)).splitlines()
    after = to_json(manifest_of([*RECORDS, *(header(8, robot) for robot in ROBOTS)])).splitlines()
    changed = [(old, new) for old, new in zip(before, after, strict=True) if old != new]
    assert [(old.strip(), new.strip()) for old, new in changed] == [('"train": [0, 2, 5],', '"train": [0, 2, 5, 8],')]


def test_tasks_stand_in_order_of_their_names_whatever_was_made_first() -> None:
    later = Record("a_task", 0, "piper", True, device="here", versions={"xew": "0"})
    assert list(manifest_of([*RECORDS, later]).tasks) == ["a_task", "grab_roller"]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"train": [0, -1]}, "grab_roller: seeds must be whole, ascending and from 0 to 999999, found (0, -1)…"),
        ({"test": [3]}, "from 1000000 to 1999999, found (3,)…"),
        ({"rejected": {"../1": {"piper": "plan"}}}, "rejected seeds must be whole numbers, found '../1'"),
        ({"rejected": {"0": {"piper": "plan"}}}, "seeds ['0'] are accepted and rejected"),
        ({"train": [True]}, "expected int, found bool True"),
    ],
)
def test_the_line_says_what_is_wrong_and_what_to_do(changes: dict[str, object], told: str, tmp_path: Path) -> None:
    path = tmp_path / "seeds.json"
    path.write_text(broken(**changes))
    with pytest.raises(EpisodeError) as error:
        read_manifest(path)
    assert told in str(error.value) and "pass another file with --manifest" in str(error.value)
