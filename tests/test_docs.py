"""README and docs hold: pages that add something are run, snippets executed, commands parsed, links and paths looked up."""

import argparse
import ast
import importlib
import io
import re
import runpy
import shlex
import sys
import warnings
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tyro

from tests.commands import run_command
from tests.sim_warp.small import work_inline
from tests.synthetic import write_synthetic_data
from xew.episode import read_video
from xew.metrics import METRICS, evaluate
from xew.metrics.backends import open_masker, open_tracker
from xew.metrics.episode_cache import EpisodeCache
from xew.metrics.grade import Comparison, grade, input_kind
from xew.metrics.grading.settings import resolve
from xew.metrics.truth import read_truth
from xew.model import rollout
from xew.model.experiment import load_experiment
from xew.model.runs import folder as run_folder

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
WALKED = ("add_a_robot", "add_a_task")
"""Pages that are run as a whole, in a folder of their own."""
OUTSIDE = ("python -m xew.model.outside",)
WITH_DATA = {"add_a_condition": (), "add_a_metric": (), "add_a_model": OUTSIDE, "score_a_pytorch_model": OUTSIDE}
"""Pages whose Python is run in a folder with made-up data, each with the beginnings of the commands that are run too."""
NEEDS = {"score_a_pytorch_model": "torch"}
"""Packages without which a page is not run."""
WITH_ARRAYS = ("metrics",)
"""Pages whose snippets are run in order, and held against their comments, in tests/metrics/test_page.py."""
WITH_RUN = ("evaluate_a_policy",)
"""Pages whose snippets are run with a trained model, in tests/model/test_simulate.py."""
KEPT = ("XEW_TRUST", "XEW_ROBOTS")
"""Environment variables that a command or a block may set."""
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`([^`]+)`")
OPTIONAL = re.compile(r"\[(--[^\]]+)\]")
LINK = re.compile(r"\]\(([^)\s]+)\)")
PLACEHOLDER = re.compile(r"…|<\w+>")


def blocks(page: Path) -> list[tuple[str, str]]:
    """(language, text) of all code blocks of a page."""
    return [(match[1], match[2]) for match in BLOCK.finditer(page.read_text())]


def run_block(language: str, text: str, folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Write a `# file: NAME` block, run a `# run` block with Python, or each line of a bash block, all in this process.

    A new process would import for several seconds; that commands run in one is seen in tests/test_wheel.py.
    """
    if text.startswith("# file: "):
        path = folder / text.split("\n", 1)[0].removeprefix("# file: ")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return
    if language != "bash":
        exec(compile(text, "a page of the docs", "exec"), {"__name__": "page"})
        return
    for line in text.splitlines():
        python, flag, module, *options = line.split()
        assert (python, flag) == ("python", "-m") and module.startswith("xew.")
        for variable in KEPT:
            patch.setenv(variable, "")
            patch.delenv(variable)  # what one command admits and finds, the next does not know of
        said = run_command(module, *options)
        assert " 0 (0 %)" not in said, f"a page shows what works:\n{said}"


@pytest.mark.parametrize("page", WALKED)
def test_a_page_does_what_it_says(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    work_inline(monkeypatch)
    found = blocks(ROOT / "docs" / f"{page}.md")
    assert found and all(text.startswith(("# file: ", "# run\n")) for language, text in found if language != "bash")
    for language, text in found:
        run_block(language, text, tmp_path, monkeypatch)
    made = {"add_a_robot": "data/robots/embodiment/robot.yaml", "add_a_task": "data/my_tasks@TASK/0000000/piper/rgb.mkv"}
    assert (tmp_path / made[page]).is_file()
    forget_modules(tmp_path)


def forget_modules(folder: Path) -> None:
    """Let the modules of a folder be imported anew by whoever has others of these names."""
    for name in [name for name, module in sys.modules.items() if str(folder) in str(getattr(module, "__file__", ""))]:
        del sys.modules[name]


@pytest.fixture
def with_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder to be in, with data of the episodes that pages speak of; what pages register is forgotten after it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    write_synthetic_data(tmp_path / "data", seeds=(0, 1_000_000), robots=("piper",), frames=5)
    known = set(METRICS)
    yield tmp_path
    for name in set(METRICS) - known:
        del METRICS[name]
    forget_modules(tmp_path)


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=[pytest.mark.needs(NEEDS[page])] if page in NEEDS else []) for page in WITH_DATA]
)
def test_a_page_runs_on_data(page: str, with_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found, ran = blocks(ROOT / "docs" / f"{page}.md"), 0
    for language, text in sorted(found, key=lambda block: block[0] == "bash"):  # a page shows its commands first
        wanted = [line for line in text.splitlines() if line.startswith(WITH_DATA[page])] if WITH_DATA[page] else []
        if language != "bash":
            assert text.startswith(("# file: ", "# run\n"))
            run_block(language, text, with_data, monkeypatch)
        elif wanted:
            run_block(language, "\n".join(wanted), with_data, monkeypatch)
        ran += language != "bash" or bool(wanted)
    assert ran >= 2


def test_the_page_on_a_metric_grades_with_it(with_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its file is a command: it hands evaluate's arguments on, and the metric is graded from an episode's arrays."""
    page = ROOT / "docs" / "add_a_metric.md"
    (file,) = (text for _, text in blocks(page) if text.startswith("# file: "))
    (command,) = (line for _, text in blocks(page) for line in text.splitlines() if line.startswith("python my_metrics.py"))
    run_block("python", file, with_data, monkeypatch)
    given: list[evaluate.Args] = []
    monkeypatch.setattr(evaluate, "main", given.append)
    monkeypatch.setattr(sys, "argv", shlex.split(command)[1:])
    runpy.run_path("my_metrics.py", run_name="__main__")
    names = resolve(given[0]).metrics
    assert names == ("psnr", "robot_color")
    truth = read_truth(with_data / "data/place_empty_cup/1000000/piper", 5, {input_kind("robot_color")})
    darker = truth.rgb - np.minimum(truth.rgb, 20)
    graded = grade(Comparison(darker, EpisodeCache(truth), open_masker("default"), open_tracker("default")), names[1:])
    assert graded.values["robot_color"] == pytest.approx(20, abs=0.5)


SNIPPETS = [
    pytest.param(text, id=f"{page.stem}-{number}")
    for page in PAGES
    if page.stem not in (*WALKED, *WITH_DATA, *WITH_ARRAYS, *WITH_RUN)
    for number, (language, text) in enumerate(blocks(page))
    if language == "python"
]


@pytest.mark.parametrize("snippet", SNIPPETS)
def test_a_snippet_runs(snippet: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a folder with data of the episode that pages speak of, and with arrays of the names that they use."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"Path": Path, "np": np}
    if "data/" in snippet:
        (folder,) = write_synthetic_data(tmp_path / "data", seeds=(1_000_000,), robots=("piper",), frames=5)
        (tmp_path / "data/place_empty_cup/1000000").symlink_to(folder.parent) if "1000000" not in str(folder) else None
        names["video"] = read_video(folder / "rgb.mkv")
    target = np.random.default_rng(0).integers(0, 256, (2, 48, 64, 3), np.uint8)
    mask = target[..., 0] > 128
    names |= {"prediction": target[::-1], "target": target, "predicted_mask": ~mask, "target_mask": mask}
    given = set(names)
    exec(compile(snippet, "a snippet of the docs", "exec"), names)
    shown = set(names) - given - {"__builtins__"}
    assert shown and all(names[name] is not None for name in shown), "a snippet imports or makes something"


def normalize(command: str) -> str:
    """A command on one line, without its comment."""
    return re.sub(r"\s+", " ", command.replace("\\\n", " ").split("  #")[0].split(" # ")[0]).strip()


def commands_of(page: Path) -> list[str]:
    """The `python -m xew...` commands of a page, from its blocks and from its sentences."""
    text = page.read_text()
    found = []
    for _, block in blocks(page):
        found += [line for line in block.replace("\\\n", " ").splitlines() if line.strip().startswith("python -m xew.")]
    prose = BLOCK.sub("", text)
    found += [match[1] for match in INLINE.finditer(prose) if re.match(r"python\s+-m\s+xew\.", match[1])]
    return [normalize(command) for command in found]


COMMANDS = sorted({command for page in PAGES for command in commands_of(page)})


class Parsed(Exception):
    """The arguments of a command were accepted."""


def dry_run(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> str:
    """Give arguments to `python -m arguments[0]` and stop once they are parsed; returns what was printed."""
    parse, cli = argparse.ArgumentParser.parse_known_args, tyro.cli

    def parse_and_stop(parser: argparse.ArgumentParser, *given: Any, **named: Any) -> Any:
        parsed, rest = parse(parser, *given, **named)
        if type(parser) is argparse.ArgumentParser and not rest:
            raise Parsed
        return parsed, rest

    def cli_and_stop(*given: Any, **named: Any) -> Any:
        parsed = cli(*given, **named)
        if named.get("return_unknown_args") and parsed[1]:
            return parsed
        raise Parsed

    said = io.StringIO()
    importlib.import_module(arguments[0])  # before anything is replaced, which what is imported meanwhile would keep
    with monkeypatch.context() as patch, redirect_stdout(said), redirect_stderr(said), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the module may have been imported before
        # The runs that pages name do not exist, and the command reads a run's config before it parses its options.
        for module in (run_folder, rollout):
            patch.setattr(module, "load_run_config", lambda run: load_experiment(ROOT / "configs" / "fixed.yaml"))
        patch.setattr(argparse.ArgumentParser, "parse_known_args", parse_and_stop)
        patch.setattr(tyro, "cli", cli_and_stop)
        patch.setattr(sys, "argv", list(arguments))
        patch.chdir(ROOT)
        try:
            runpy.run_module(arguments[0], run_name="__main__", alter_sys=True)
        except Parsed:
            return "parsed"
        except SystemExit as stop:
            if stop.code:
                raise AssertionError(f"{' '.join(arguments)}\n{said.getvalue()}") from None
    return said.getvalue()


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_is_accepted(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Options in [brackets] are looked up in --help; without them the command's own parser takes all that stands there."""
    optional = OPTIONAL.findall(command)
    required = PLACEHOLDER.sub("", OPTIONAL.sub("", command))
    module, *arguments = shlex.split(required)[2:]
    if PLACEHOLDER.search(command):
        assert importlib.util.find_spec(module) is not None  # a form to fill in
    else:
        assert dry_run([module, *arguments], monkeypatch) == "parsed"
    if optional:
        helped = dry_run([module, "--help"], monkeypatch)
        for option in re.findall(r"--[\w.-]+", " ".join(optional)):
            assert option in helped, f"{module} --help knows no {option}"


def test_a_wrong_option_is_not_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(AssertionError, match="--batches"):
        dry_run(["xew.sim_warp.generate", "--batches", "256"], monkeypatch)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page: Path) -> None:
    links = [link for link in LINK.findall(BLOCK.sub("", page.read_text())) if not re.match(r"https?:|mailto:|#", link)]
    broken = [link for link in links if not (page.parent / link.split("#")[0]).exists()]
    assert not broken


@pytest.mark.parametrize(
    "page", [*PAGES, ROOT / "CITATION.cff", *sorted((ROOT / "configs").rglob("*.yaml"))], ids=lambda page: page.stem
)
def test_paths_and_modules_exist(page: Path) -> None:
    """Paths below xew, configs, examples, benchmarks and tests, and modules by their dotted names."""
    text = page.read_text()
    paths = re.findall(r"(?<![\w/.])((?:xew|configs|examples|benchmarks|tests)/[\w/.-]*\w)", text)
    keys = ("xew/robot", "xew/task", "xew/seed", "xew/motion", "xew/change", "xew/fault")  # columns of LeRobot exports
    missing = [path for path in paths if not (ROOT / path).exists() and path not in keys]
    names = re.findall(r"(?<![\w/.])(xew(?:\.[a-z]\w*)+)(?![\w:/]|\.\w)", text)
    missing += [name for name in names if not is_importable(name)]
    assert not missing


def is_importable(name: str) -> bool:
    """Whether a dotted name is a module of ours, or the name of something in one."""
    path = ROOT.joinpath(*name.split("."))
    if path.is_dir() or path.with_suffix(".py").is_file():
        return True
    module, _, attribute = name.rpartition(".")
    folder = ROOT.joinpath(*module.split("."))
    file = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    if not file.is_file():
        return False
    tree = ast.parse(file.read_text())
    named = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    named |= {alias.asname or alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names}
    return attribute in named | {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def test_the_page_on_errors_quotes_the_source() -> None:
    """Messages in the first column of its tables, whose … stands for any text; those of JAX are not ours."""
    nodes = [node for path in sorted((ROOT / "xew").rglob("*.py")) for node in ast.walk(ast.parse(path.read_text()))]
    messages = "\n".join(text for node in nodes if (text := message_text(node)))
    rows = [line for line in (ROOT / "docs" / "troubleshooting.md").read_text().splitlines() if line.startswith("| ")]
    cells = [line.split(" | ")[0] for line in rows]
    quoted = [match[1] for cell in cells if "(from JAX)" not in cell for match in INLINE.finditer(cell) if " " in match[1]]
    assert len(quoted) > 25
    patterns = {message: ".*".join(re.escape(part.strip()) for part in message.split("…")) for message in quoted}
    assert not [message for message, pattern in patterns.items() if not re.search(pattern, messages)]


def message_text(node: ast.AST) -> str:
    """The text of a string or an f-string of the source, with its values as {}; '' for other nodes."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    parts = node.values if isinstance(node, ast.JoinedStr) else []
    return "".join(message_text(part) if isinstance(part, ast.Constant) else "{}" for part in parts)
