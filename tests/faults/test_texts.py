"""Texts from anybody: keys that stand twice, aliases that explode, names for terminals, other encodings, and other modules."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

from tests.faults.kept import KINDS
from tests.faults.reading import at_most_seconds
from tests.faults.test_hostile import write_scores
from xew.analysis.scores import read_scores
from xew.config import ConfigError, import_named, load, parse, parse_yaml, read_yaml, save, user_errors
from xew.episode import EpisodeError, Record, read_record
from xew.files import hold_lock, parse_json, write_text
from xew.metrics.grading.bundle import read_bundle
from xew.model.runs.checkpoint import open_checkpoints
from xew.names import LONGEST_LINE, MOST_LINES, UserError, plain_line, shorten
from xew.sim_warp.production.summary import yield_table

REPOSITORY = Path(__file__).parents[2]
LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{new}: &{new} [{','.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)

MERGES = "".join(
    f"{new}: &{new}\n  <<: [{','.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@dataclass(frozen=True)
class Settings:
    """A config."""

    numbers: tuple[int, ...] = ()
    text: str = ""
    path: Path = Path()
    inner: dict[str, Any] = field(default_factory=dict)


# --- YAML and JSON.


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: 1\nb: 2\na: 3\n", "the key 'a' stands there twice"),
        ("s:\n  lr: 1\n  lr: 2\n", "the key 'lr' stands there twice"),
        ("{x: 1, x: 2}", "the key 'x' stands there twice"),
        ("- {x: 1}\n- {y: {z: 1, 'z': 2}}\n", "the key 'z' stands there twice"),
        (LAUGHS, "more than 100,000 values"),
        ("a: &a {k: 1}\n" + MERGES, "more than 100,000 values"),
        ("m: &m {k: &m2 1}\nn: &n\n  <<: [*m, *m]\nn: 1\n", "the key 'n' stands there twice"),
        ("a: &a [1, *a]\n", "more than 100,000 values"),
        ("a: &a {b: *a}\n", "more than 100,000 values"),
    ],
)
def test_yaml_with_double_keys_or_exploding_aliases_is_refused(text: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(text)
    with at_most_seconds(5), pytest.raises(ConfigError, match=rf"c.yaml is not YAML: .*{reason}") as error:
        read_yaml(tmp_path / "c.yaml")
    assert "\n" not in str(error.value) and len(str(error.value)) < 500


def test_aliases_and_merged_keys_of_a_usual_config_are_read() -> None:
    text = "base: &b {lr: 1, steps: 2}\nsame: *b\nchanged:\n  <<: *b\n  lr: 3\ntwice: [*b, *b]\n"
    base = {"lr": 1, "steps": 2}
    assert parse_yaml(text) == {"base": base, "same": base, "changed": base | {"lr": 3}, "twice": [base, base]}
    assert parse_yaml("") is None and parse_yaml("1: a\n'1': b\n") == {1: "a", "1": "b"}


@pytest.mark.parametrize("text", ['{"a": 1, "a": 2}', '{"a": {"b": 1, "b": 1}}', '[{"c": 1}, {"a": [], "b": 0, "a": {}}]'])
def test_json_with_a_key_twice_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"it has the key '[ab]' twice"):
        parse_json(text)
    assert parse_json('[{"a": 1}, {"a": 2}]') == [{"a": 1}, {"a": 2}]


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("sums", "cell", "ledger")])
def test_no_reader_takes_the_second_of_two_keys(kind: str, tmp_path: Path) -> None:
    path, whole, read = KINDS[kind](tmp_path)
    path.parent.mkdir(parents=True, exist_ok=True)
    key, value = next(iter(whole.items()))
    path.write_text(f"{{{json.dumps(key)}: {json.dumps(value)}, {json.dumps(whole)[1:]}")
    with pytest.raises(UserError, match="twice"):
        read_bundle(path) if kind == "bundle" else read()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ({"numbers": [[["x"] * 9] * 9] * 9}, "expected int, found list"),
        ({"numbers": ["x" * 10**6]}, "expected int, found str 'xxx"),
        ({"numbers": {"a": 1}}, "expected a list, found dict"),
        ({f"key{number}": 0 for number in range(10**4)}, "unknown key 'key0';"),
        ({"k" * 10**6: 0}, "unknown key 'kkk"),
        ({"numbers": ["x"] * 10**4}, f"and {10**4 - MOST_LINES} more"),
        ({"text": "a\0b"}, "expected text without NUL characters"),
        ({"text": "\ud800"}, "expected text without NUL characters"),
        ({"path": "a\0b"}, "expected a path without NUL characters"),
        ({"path": 3}, "expected a path, found int 3"),
    ],
)
def test_a_message_does_not_grow_with_the_file(content: dict[str, Any], reason: str) -> None:
    with at_most_seconds(10), pytest.raises(ConfigError) as error:
        parse(Settings, content, "c.yaml")
    message = str(error.value)
    assert reason in message and len(message) < MOST_LINES * 200
    assert message.isprintable() or len(message.splitlines()) > 1


# --- Messages.


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain – text", "plain – text"),
        ("\x1b[2J\x1b]0;owned\x07evil", r"\x1b[2J\x1b]0;owned\x07evil"),
        ("two\n  lines\r\nmore", "two lines more"),
        ("tab\tand \x7f \x9b31m", r"tab\tand \x7f \x9b31m"),
        ("right\u202eleft\u2028line", r"right\u202eleft\u2028line"),
        ("not UTF-8: \udcff", r"not UTF-8: \udcff"),
    ],
)
def test_names_are_printed_on_one_line_without_control_characters(text: str, shown: str) -> None:
    assert plain_line(text) == shown
    for kind in (UserError, EpisodeError, ConfigError):
        assert str(kind(text)) == shown
    assert str(UserError(text, "second")) == f"{shown}\nsecond"


def test_long_lines_keep_their_beginning_and_their_end() -> None:
    line = plain_line(f"found {'x' * 10**6}; do this.")
    assert line.startswith("found xxx") and line.endswith("xxx; do this.") and len(line) <= LONGEST_LINE
    assert len(shorten(["x" * 10**6] * 10**6)) <= 81 and shorten("a") == "'a'"


def test_errors_of_the_system_are_printed_in_one_line(capsys: pytest.CaptureFixture, tmp_path: Path) -> None:
    def fail() -> None:
        raise FileNotFoundError(2, "does not exist", b"a\n\x1b[2Jb\xff")

    with pytest.raises(SystemExit, match="2"):
        user_errors(fail)()
    assert capsys.readouterr().err == "error: a \\x1b[2Jb\\udcff: does not exist; fix that, or choose another path.\n"


def test_a_damaged_header_below_a_hostile_folder_is_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "\x1b[2J\nevil"
    folder.mkdir()
    (folder / "episode.json").write_text('{"task": "\\u001b[31m", "seed": 1, "robot": "piper", "success": true}')
    with pytest.raises(EpisodeError) as error:
        read_record(folder)
    assert str(error.value).isprintable()


def test_the_table_of_a_data_set_prints_no_control_characters() -> None:
    table = yield_table([Record("lift_pot", 1, "piper", False, failure="\x1b[2J\nslip")])
    assert r"\x1b[2J slip 1" in table and all(line.isprintable() for line in table.splitlines())


# --- Score tables.


def change(path: Path, name: str, column: pa.Array) -> Path:
    table = parquet.read_table(path)
    parquet.write_table(table.set_column(table.column_names.index(name), name, column), path)
    return path


@pytest.mark.parametrize(
    ("name", "column", "reason"),
    [
        ("model", pa.array([["a"]]), "its column model is of type list<.*>, expected text"),
        ("task", pa.array([1]), "its column task is of type int64, expected text"),
        ("value", pa.array(["x"]), "its column value is of type string, expected numbers"),
        ("seed", pa.array([1.5]), "its column seed is of type double, expected whole numbers"),
        ("frames", pa.array([{"a": 1}]), "its column frames is of type struct<.*>, expected whole numbers"),
        ("robot", pa.array([None], pa.string()), "its column robot has empty cells"),
        ("condition", pa.array(["x" * 10**6]), "its column condition has a text of 1000000 bytes"),
        ("metric", pa.array([b"psnr"]), "its column metric is of type binary, expected text"),
    ],
)
def test_a_score_table_with_other_columns_is_refused(name: str, column: pa.Array, reason: str, tmp_path: Path) -> None:
    path = change(write_scores(tmp_path), name, column)
    with pytest.raises(ConfigError, match=f"scores.parquet cannot be read .*{reason}"):
        read_scores(path)


def test_curves_with_other_columns_are_refused_and_own_columns_left_out(tmp_path: Path) -> None:
    path, curves = write_scores(tmp_path), tmp_path / "scores.curves.parquet"
    whole = parquet.read_table(curves)
    for name in ("frame", "metric"):
        parquet.write_table(whole.drop_columns([name]), curves)
        with pytest.raises(ConfigError, match=f"scores.curves.parquet has no {name}; it is no score table"):
            read_scores(path)
    parquet.write_table(whole, curves)
    table = parquet.read_table(path)
    parquet.write_table(table.append_column("mine", pa.array([[1, 2]])), path)
    assert "mine" not in read_scores(path).rows


def test_a_table_that_declares_more_than_its_file_can_hold_is_not_read(tmp_path: Path) -> None:
    path = write_scores(tmp_path)
    row = pd.read_parquet(path)
    many = pa.Table.from_pandas(row).take(pa.array([0] * 2**21))
    parquet.write_table(many, path, compression="zstd")
    assert path.stat().st_size < 2**17
    with pytest.raises(ConfigError, match=r"it declares 2097152 rows and .* bytes, too many for a file of"):
        read_scores(path)


# --- The user's machine.


def run(code: str, folder: Path, **environment: str) -> "subprocess.CompletedProcess[str]":
    own = {name: value for name, value in os.environ.items() if not name.startswith(("LC_", "LANG", "PYTHON"))}
    own |= {"PYTHONPATH": str(REPOSITORY)} | environment
    return subprocess.run([sys.executable, "-c", code], cwd=folder, env=own, capture_output=True, encoding="utf-8", check=False)


def test_texts_are_utf8_whatever_the_locale(tmp_path: Path) -> None:
    save(Settings(text="für … 手"), tmp_path / "c.yaml")
    code = f"""
import locale
from pathlib import Path
from tests.faults.test_texts import Settings
from xew.config import load, save, user_errors
assert locale.getpreferredencoding() != "UTF-8", locale.getpreferredencoding()
read = load(Settings, Path({str(tmp_path / "c.yaml")!r}))
save(read, Path({str(tmp_path / "d.yaml")!r}))
user_errors(lambda: print(read.text))()
"""
    ended = run(code, tmp_path, LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    assert ended.returncode == 0 and ended.stdout == "f\\xfcr \\u2026 \\u624b\n", ended.stderr
    assert load(Settings, tmp_path / "d.yaml") == load(Settings, tmp_path / "c.yaml")


def test_a_path_that_is_not_utf8_is_written_and_read(tmp_path: Path) -> None:
    settings = Settings(path=Path(os.fsdecode(b"d\xff")))
    save(settings, tmp_path / "c.yaml")
    assert load(Settings, tmp_path / "c.yaml") == settings
    write_text(tmp_path / "page.html", f"of {settings.path}", within=tmp_path)
    assert (tmp_path / "page.html").read_text() == r"of d\udcff"


def test_an_output_that_is_not_utf8_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    out = tmp_path / os.fsdecode(b"run\xff")
    with pytest.raises(EpisodeError, match=r"run\\udcff is not UTF-8; rename"), hold_lock(out):
        pass
    with pytest.raises(EpisodeError, match=r"run\\udcff is not UTF-8; rename"):
        open_checkpoints(out)
    assert not list(tmp_path.iterdir())


START = """
import os, sys
sys.path.insert(0, os.getcwd())
sys.argv, sys.orig_argv = {argv}, {original}
import xew
print(os.getcwd() in sys.path, os.environ.get("PYTHONSAFEPATH"))
"""


@pytest.mark.parametrize(
    ("argv", "original", "printed"),
    [
        (["-m"], ["python", "-X", "dev", "-m", "xew.model.train", "c.yaml"], "False 1"),
        (["-m"], ["python", "-m", "xew"], "False 1"),
        (["/bin/xew", "train"], ["python", "/bin/xew", "train"], "False 1"),
        (["-m"], ["python", "-m", "my_lab.train", "-m", "xew"], "True None"),
        (["/my/train.py"], ["python", "/my/train.py"], "True None"),
        (["-c"], ["python", "-c", "import xew"], "True None"),
        ([""], ["python"], "True None"),
    ],
)
def test_commands_leave_the_current_folder_out_of_the_module_path(
    argv: list[str], original: list[str], printed: str, tmp_path: Path
) -> None:
    assert run(START.format(argv=argv, original=original), tmp_path).stdout == f"{printed}\n"


def test_a_clone_that_is_not_installed_stays_on_the_module_path(tmp_path: Path) -> None:
    (tmp_path / "xew").symlink_to(REPOSITORY / "xew")
    code = START.format(argv=["-m"], original=["python", "-m", "xew"])
    assert run(code, tmp_path, PYTHONPATH="").stdout == "True None\n"


def test_a_module_in_the_current_folder_does_not_run(tmp_path: Path) -> None:
    (tmp_path / "yaml.py").write_text("print('it ran')")
    command = [sys.executable, "-m", "xew", "--version"]
    said = subprocess.run(
        command, cwd=tmp_path, capture_output=True, encoding="utf-8", env=os.environ | {"PYTHONPATH": str(REPOSITORY)}
    )
    assert said.stdout.startswith("xew ") and "it ran" not in said.stdout, said.stderr


def test_a_module_that_the_user_names_is_found_in_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_named_lab.py").write_text("SPEC = 3")
    (tmp_path / "json.py").write_text("loads = None")
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    monkeypatch.chdir(tmp_path)
    assert import_named("my_named_lab:SPEC") == 3
    assert sys.path[-1] == str(tmp_path), "installed modules come first"
    for name in ("my_other_lab:SPEC", "my_named_lab:OTHER", "no_colon"):
        with pytest.raises((ImportError, AttributeError, ValueError)):
            import_named(name)
