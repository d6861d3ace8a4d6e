"""Every file is written beside its place and renamed: the source is walked for the opposite, and kills lose nothing."""

import ast
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

import xew
from tests.source import Source, read_sources
from xew.files import replacing, write_bytes, write_text

ROOT = Path(xew.__file__).parent
WHOLE = {"replacing", "complete_folder"}
"""Context managers that give a name beside the file or folder."""
METHODS = {"write_text", "write_bytes", "touch", "to_parquet", "to_csv", "to_json", "tofile", "chmod"}
"""Methods of a path or table that write to the path that they are called on, or to their first argument."""
FUNCTIONS = {"np.savez", "np.savez_compressed", "np.save", "save_file", "cv2.imwrite", "shutil.copyfile", "shutil.copy"}
"""Functions that write to a path among their arguments."""
MAY_WRITE_IN_PLACE = {
    "xew/files.py": ("write_text", "write_bytes", "_lock"),
    "xew/episode.py": ("write_video",),  # into a folder that takes its name when it is complete
    "xew/exchange/lerobot.py": ("add", "_open", "_write_meta"),  # the same
    "xew/model/runs/folder.py": ("write_claim",),  # an empty mark
    "xew/model/runs/log.py": ("__init__",),  # lines are appended; a cut one is left out when it is read
    "xew/sim_warp/embodiment/prepared.py": ("write_prepared",),  # into such a folder
    "xew/sim_warp/generate.py": ("_prepare_folder",),  # whether anything can be written
    "xew/analysis/studies/processes.py": ("_run", "wait_for_lock"),  # a log, and its lock
}
"""Functions that write otherwise, by file, with why."""


def writes_in_place(source: Source) -> Iterator[str]:
    """Calls of a source that write to a path which is no name beside, as `file:line function`."""
    name = source.path.relative_to(source.root.parent).as_posix()
    allowed = MAY_WRITE_IN_PLACE.get(name, ())
    for function in source.functions():
        if function.name in allowed:
            continue
        beside = {"temporary"} if function.name.startswith("_write") else set()
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


def _names(node: ast.AST) -> set[str]:
    return {inner.id for inner in ast.walk(node) if isinstance(inner, ast.Name)}


def _writes(call: ast.Call) -> bool:
    text = ast.unparse(call.func)
    if text in FUNCTIONS:
        return True
    if isinstance(call.func, ast.Attribute) and call.func.attr in METHODS:
        return True
    if text == "open" or text.endswith(".open"):
        modes = [a.value for a in [*call.args, *(k.value for k in call.keywords)] if isinstance(a, ast.Constant)]
        return any(isinstance(mode, str) and mode[:1] in "wax" and len(mode) <= 3 for mode in modes)
    return False


def _into_memory(call: ast.Call) -> bool:
    """Tables become text where no path is given."""
    return isinstance(call.func, ast.Attribute) and call.func.attr in ("to_csv", "to_json") and not call.args


def test_the_source_writes_no_file_in_its_place() -> None:
    found = [line for source in read_sources(ROOT) for line in writes_in_place(source)]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "line", ["path.write_text('x')", "path.open('w')", "np.savez(path, a=1)", "table.to_parquet(path)", "open(path, mode='wb')"]
)
def test_a_planted_write_is_found(line: str, tmp_path: Path) -> None:
    (tmp_path / "xew").mkdir()
    (tmp_path / "xew/a.py").write_text(
        f"def f(path):\n    {line}\n\ndef g(path):\n    with replacing(path) as path:\n        {line}\n"
    )
    (source,) = read_sources(tmp_path / "xew")
    assert [text.split(":")[1].split(" ")[1] for text in writes_in_place(source)] == ["f"]


def test_what_a_killed_process_has_left_is_swept_by_the_next_write(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    dead = tmp_path / f".config.yaml.{2**22 - 1}"
    alive, other, young = (
        tmp_path / f".config.yaml.{os.getppid()}",
        tmp_path / ".other.yaml.99",
        tmp_path / ".config.yaml.4194302",
    )
    for left in (dead, alive, other, young):
        left.write_text("half")
    for left in (dead, alive, other):
        os.utime(left, (1, 1))
    write_text(path, "whole")
    assert sorted(tmp_path.iterdir()) == sorted([path, alive, other, young])


def test_a_kill_before_the_rename_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bytes(tmp_path / "a", b"old")

    class Killed(BaseException):
        """As SIGKILL, it runs no handler of ours."""

    def kill(*_: object) -> None:
        raise Killed

    monkeypatch.setattr(os, "replace", kill)
    with pytest.raises(Killed), replacing(tmp_path / "a") as temporary:
        temporary.write_bytes(b"new")
    assert (tmp_path / "a").read_bytes() == b"old"
