"""Every file is written beside its place and renamed: the source is walked for the opposite, and kills lose nothing.

Texts are read and written in a stated encoding, which the source is walked for, too.
"""

import ast
import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import xew
from tests.source import Source, read_sources
from xew.files import replacing, write_bytes, write_text

ROOT = Path(xew.__file__).parent
REPOSITORY = Path(__file__).parents[2]
WHOLE = {"replacing", "complete_folder"}
"""Context managers that give a name beside the file or folder."""
METHODS = {"write_text", "write_bytes", "touch", "to_parquet", "to_csv", "to_json", "tofile", "chmod", "savefig", "save"}
METHODS |= {"symlink_to", "hardlink_to"}
"""Methods of a path or table that write to the path that they are called on, or to their first argument."""
FUNCTIONS = {"np.savez", "np.savez_compressed", "np.save", "save_file", "cv2.imwrite", "write_video", "EventFileWriter"}
FUNCTIONS |= {"shutil.copyfile", "shutil.copy", "shutil.copy2", "shutil.copytree", "shutil.move", "os.open", "os.link"}
FUNCTIONS |= {"os.symlink", "pq.ParquetWriter", "parquet.ParquetWriter", "pq.write_table", "parquet.write_table"}
"""Functions that write to a path among their arguments."""
MAY_WRITE_IN_PLACE = {
    "xew/files.py": ("open_own", "_open_regular"),  # the one way
    "xew/config.py": ("_silence_closed_pipes",),  # into /dev/null
    "xew/episode.py": ("write_video",),  # into a folder that takes its name when it is complete
    "xew/exchange/lerobot.py": ("add", "_open", "_write_meta"),  # the same
    "xew/model/codecs/autoencoders.py": ("save",),  # calls save of its base class
    "xew/model/runs/checkpoint.py": ("save_state", "save_params"),  # Orbax writes beside and renames; a run holds no link
    "xew/model/runs/folder.py": ("prepare_run", "write_claim"),  # call save of codecs and configs, which are walked, too
    "xew/model/runs/log.py": ("__init__",),  # TensorBoard's events; a run holds no link
    "xew/sim_warp/embodiment/prepared.py": ("write_prepared",),  # into such a folder
}
"""Functions that write otherwise, by file, with why."""


def writes_in_place(source: Source) -> Iterator[str]:
    """Calls of a source that write to a path which is no name beside, as `file:line function`."""
    name = source.path.relative_to(source.root.parent).as_posix()
    allowed = MAY_WRITE_IN_PLACE.get(name, ())
    for function in source.functions():
        if function.name in allowed:
            continue
        beside = {"temporary"} if function.name.startswith("_write") else _buffers(function)
        for node in ast.walk(function):
            if isinstance(node, ast.withitem) and isinstance(node.context_expr, ast.Call) and node.optional_vars is not None:
                called = ast.unparse(node.context_expr.func)
                root = ast.unparse(node.context_expr).split(".")[0]
                if called in WHOLE or root in beside:
                    beside |= _names(node.optional_vars)
            if isinstance(node, ast.Assign) and _names(node.value) & beside:
                beside |= {name for target in node.targets for name in _names(target)}
        for node in ast.walk(function):
            if isinstance(node, ast.Call) and _writes(node) and not _names(node) & beside and not _into_memory(node):
                yield f"{name}:{node.lineno} {function.name}: {ast.unparse(node)[:80]}"


def _buffers(function: ast.AST) -> set[str]:
    """Names of a function that hold buffers in memory."""
    made = [node for node in ast.walk(function) if isinstance(node, ast.Assign)]
    opened = [node for node in made if ast.unparse(node.value).lstrip("(").startswith(("io.BytesIO", "io.StringIO"))]
    return {name for node in opened for target in node.targets for name in _names(target)}


def _names(node: ast.AST) -> set[str]:
    return {inner.id for inner in ast.walk(node) if isinstance(inner, ast.Name)}


def _writes(call: ast.Call) -> bool:
    text = ast.unparse(call.func)
    if text in FUNCTIONS:
        return True
    if isinstance(call.func, ast.Attribute) and call.func.attr in METHODS:
        return True
    if text == "open" or text.endswith((".open", ".File", "fdopen")):
        modes = [a.value for a in [*call.args, *(k.value for k in call.keywords)] if isinstance(a, ast.Constant)]
        return any(isinstance(mode, str) and mode[:1] in "wax" and len(mode) <= 3 for mode in modes)
    return False


def _into_memory(call: ast.Call) -> bool:
    """Tables become text where no path is given."""
    return isinstance(call.func, ast.Attribute) and call.func.attr in ("to_csv", "to_json") and not call.args


def test_the_source_writes_no_file_in_its_place() -> None:
    found = [line for source in read_sources(ROOT) for line in writes_in_place(source)]
    assert not found, "\n".join(found)


PLANTED = (
    "path.write_text('x')",
    "path.open('w')",
    "np.savez(path, a=1)",
    "table.to_parquet(path)",
    "open(path, mode='wb')",
    "h5py.File(path, 'w')",
    "av.open(str(path), 'w')",
    "shutil.copy2(other, path)",
    "pq.ParquetWriter(path, schema)",
    "picture.save(path)",
    "os.open(path, os.O_WRONLY)",
)


@pytest.mark.parametrize("line", PLANTED)
def test_a_planted_write_is_found(line: str, tmp_path: Path) -> None:
    (tmp_path / "xew").mkdir()
    (tmp_path / "xew/a.py").write_text(
        f"def f(path):\n    {line}\n\ndef g(path):\n    with replacing(path) as path:\n        {line}\n"
    )
    (source,) = read_sources(tmp_path / "xew")
    assert [text.split(":")[1].split(" ")[1] for text in writes_in_place(source)] == ["f"]


def texts_without_encoding(source: Source) -> Iterator[str]:
    """Calls of a source that read or write text in the encoding of the user's locale, as `file:line call`."""
    for node in ast.walk(source.tree):
        if isinstance(node, ast.Call) and _is_text(node) and not {"encoding", "within"} & {k.arg for k in node.keywords}:
            yield f"{source.path.relative_to(source.root.parent)}:{node.lineno} {ast.unparse(node)[:80]}"


def _is_text(call: ast.Call) -> bool:
    """Whether a call opens a file, or the output of a program, as text."""
    text = ast.unparse(call.func)
    if any(k.arg in ("text", "universal_newlines") for k in call.keywords) and text.startswith("subprocess."):
        return True
    if isinstance(call.func, ast.Attribute) and call.func.attr in ("read_text", "write_text"):
        return True
    given = [a.value for a in [*call.args, *(k.value for k in call.keywords)] if isinstance(a, ast.Constant)]
    modes = [mode for mode in given if isinstance(mode, str) and re.fullmatch("[rwax][bt+]*", mode)]
    opens = text == "open" or (text.endswith(".open") and bool(modes) and text != "av.open")  # FFmpeg has modes, too
    return opens and not any("b" in mode for mode in modes)


@pytest.mark.parametrize("folder", ["xew", "lab", "benchmarks", "examples"])
def test_every_text_states_its_encoding(folder: str) -> None:
    sources = read_sources(REPOSITORY / folder)
    found = [line for source in sources for line in texts_without_encoding(source)]
    assert sources and not found, "\n".join(found)


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("path.read_text()", True),
        ("path.read_text(errors='replace')", True),
        ("path.read_text(encoding='utf-8')", False),
        ("open(path)", True),
        ("open(path, 'rb')", False),
        ("path.open('a')", True),
        ("path.open('r', encoding='ascii')", False),
        ("subprocess.run(command, text=True)", True),
        ("subprocess.run(command, encoding='utf-8')", False),
    ],
)
def test_a_text_without_its_encoding_is_found(line: str, found: bool, tmp_path: Path) -> None:
    (tmp_path / "xew").mkdir()
    (tmp_path / "xew/a.py").write_text(line)
    (source,) = read_sources(tmp_path / "xew")
    assert bool(list(texts_without_encoding(source))) == found


def test_what_a_killed_process_has_left_is_swept_by_the_next_write(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    dead = tmp_path / f".config.yaml.{2**22 - 1}-0123abcd"
    alive, other, young = (
        tmp_path / f".config.yaml.{os.getppid()}",
        tmp_path / ".other.yaml.99",
        tmp_path / ".config.yaml.4194302-ff",
    )
    for left in (dead, alive, other, young):
        left.write_text("half")
    for left in (dead, alive, other):
        os.utime(left, (1, 1))
    write_text(path, "whole", within=tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted([path, alive, other, young])


def test_a_kill_before_the_rename_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bytes(tmp_path / "a", b"old", within=tmp_path)

    class Killed(BaseException):
        """As SIGKILL, it runs no handler of ours."""

    def kill(*_: object) -> None:
        raise Killed

    monkeypatch.setattr(os, "replace", kill)
    with pytest.raises(Killed), replacing(tmp_path / "a", within=tmp_path) as temporary:
        temporary.write_bytes(b"new")
    assert (tmp_path / "a").read_bytes() == b"old"
