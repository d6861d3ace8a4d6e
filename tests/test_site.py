"""The site of the documentation, without MkDocs: its nav, its links, what its hooks make of pages, and the notebooks it shows.

`make docs` builds it, and any warning ends that.
"""

import importlib.util
import json
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import yaml

from tests.sim_warp import small
from tests.synthetic import write_synthetic_data

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
CONFIG = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
PAGES = sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md"))
NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))
LARGEST_NOTEBOOK = 150_000
"""Bytes of a notebook with its pictures, so that the repository stays small."""
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)


def load(name: str) -> ModuleType:
    """A file of docs/site as a module."""
    spec = importlib.util.spec_from_file_location(f"docs_site_{name}", DOCS / "site" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


hooks, run_notebooks = load("hooks"), load("run_notebooks")


@pytest.fixture(scope="module")
def made() -> dict[str, str]:
    """Pages of the site that are no files of docs/, with their Markdown."""
    return hooks.made_pages()


def entries(nav: Any) -> Iterator[str]:
    """All pages of a nav."""
    if isinstance(nav, str):
        yield nav
    else:
        for part in nav.values() if isinstance(nav, dict) else nav:
            yield from entries(part)


def anchors(text: str) -> set[str]:
    """Anchors of a page's headings, as GitHub and MkDocs make them."""
    plain = (re.sub(r"[^\w\s-]", "", heading).strip().lower() for heading in HEADING.findall(hooks.FENCED.sub("", text)))
    return {re.sub(r"\s", "-", heading) for heading in plain}


def test_the_nav_has_every_page_once(made: dict[str, str]) -> None:
    shown = [page for page in made if not page.startswith("files/")]
    assert Counter(entries(CONFIG["nav"])) == Counter([*PAGES, *shown])


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str, made: dict[str, str]) -> None:
    """On GitHub, where they are paths of the repository, and in the site, where files outside of docs/ have pages."""
    text = (DOCS / page).read_text()
    for match in hooks.LINK.finditer(hooks.FENCED.sub("", text)):
        target = ((DOCS / page).parent / match[1]).resolve()
        assert target.is_file(), f"{page} links to {match[1]}"
        if match[2]:
            assert match[2][1:] in anchors(target.read_text()), f"{page} links to {match[1]}{match[2]}"
    for match in re.finditer(r"(?<=\]\()#([^)]+)(?=\))", hooks.FENCED.sub("", text)):
        assert match[1] in anchors(text), f"{page} links to #{match[1]}"
    assert_within_the_site(hooks.relink(text, DOCS / page, page), page, made)


def assert_within_the_site(text: str, page: str, made: dict[str, str]) -> None:
    for match in hooks.LINK.finditer(hooks.FENCED.sub("", text)):
        there = ((DOCS / page).parent / match[1]).resolve()
        assert there.is_file() or str(there.relative_to(DOCS)) in made, f"{page} links to {match[1]} in the site"


def test_made_pages_link_within_the_site(made: dict[str, str]) -> None:
    for page, text in made.items():
        assert_within_the_site(text, page, made)
    assert "](../metrics.md)" in made["notebooks/grade_a_video.md"] and made["changelog.md"].startswith("# Changelog")


def test_a_link_that_leaves_the_repository_is_an_error() -> None:
    with pytest.raises(ValueError, match="no file of the repository"):
        hooks.relink("[a](../../elsewhere.md)", DOCS / "index.md", "index.md")
    with pytest.raises(ValueError, match="no file of the repository"):
        hooks.relink("[a](../xew)", DOCS / "index.md", "index.md")


def test_links_are_told_from_code() -> None:
    text = "[a](../CHANGELOG.md#top) [b](study.md) [c](https://x.org/y) [d](#e)\n```\n[f](../README.md)\n```\n"
    assert hooks.relink(text, DOCS / "index.md", "index.md") == text.replace("../CHANGELOG.md", "changelog.md")
    plan = "results/plan.md"
    assert hooks.relink("[a](../../xew/episode.py)", DOCS / plan, plan) == "[a](../files/xew/episode.py.md)"
    assert hooks.relink("[a](docs/study.md#b)", ROOT / "CHANGELOG.md", "changelog.md") == "[a](study.md#b)"


def test_a_list_after_a_line_of_text_is_a_list() -> None:
    assert hooks.separate_lists("So:\n- one\n- two\n") == "So:\n\n- one\n- two\n"
    for text in ("- one\n- two\n", "- one\n  more\n- two\n", "# So\n- one\n", "```\nSo:\n- one\n```\n", "So - one\n"):
        assert hooks.separate_lists(text) == text


def test_docstrings_stay_what_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "griffe", SimpleNamespace(Extension=object, Object=object))
    as_markdown = load("plain_docstrings").as_markdown
    assert as_markdown("Reads  a `<b>` of <data>\nWrites 4*n") == "Reads  a `<b>` of &lt;data>  \nWrites 4\\*n"
    assert as_markdown("Such as\n\n    a * <b>\n\nand so on") == "Such as\n\n    a * <b>\n\nand so on"
    assert as_markdown("Args:\n    a: of <data>\n\n    b: 4*n") == "Args:\n    a: of &lt;data>\n\n    b: 4\\*n"
    assert as_markdown("[t h] of `[t h w]` [px]") == r"\[t h\] of `[t h w]` \[px\]"


def test_the_reference_names_modules_that_exist_once() -> None:
    named = [name for page in PAGES for name in re.findall(r"^::: (\S+)$", (DOCS / page).read_text(), re.MULTILINE)]
    assert len(named) > 20 and len(set(named)) == len(named)
    for name in named:
        path = ROOT.joinpath(*name.split("."))
        assert path.with_suffix(".py").is_file() or (path / "__init__.py").is_file(), name
    rooms = {path.parent.name for path in (ROOT / "xew").glob("*/__init__.py")}
    assert {name.split(".")[1] for name in named} >= rooms


def test_the_config_names_files_that_exist() -> None:
    options = next(plugin["mkdocstrings"] for plugin in CONFIG["plugins"] if isinstance(plugin, dict))["handlers"]["python"]
    named = [*CONFIG["hooks"], *options["options"]["extensions"], *(f"docs/{style}" for style in CONFIG["extra_css"])]
    assert all((ROOT / name).is_file() for name in named)


def test_warnings_end_the_build() -> None:
    """MkDocs counts no warnings where it is told to be quiet, and --strict then says nothing."""
    (command,) = (line for line in (ROOT / "Makefile").read_text().splitlines() if "mkdocs build" in line)
    assert "--strict" in command and "--quiet" not in command and " -q" not in command
    assert {value for part in CONFIG["validation"].values() for value in part.values()} == {"warn"}


def test_a_version_is_pinned_once() -> None:
    """Both files are constraints of make docs."""
    pins = [re.findall(r"^([\w.-]+)==", (ROOT / "requirements" / f"{name}.txt").read_text(), re.M) for name in ("test", "docs")]
    first, second = ({name.lower().replace("_", "-") for name in names} for names in pins)
    assert first and second and not first & second


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_small_and_shows_what_it_shows(path: Path) -> None:
    cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    assert path.stat().st_size < LARGEST_NOTEBOOK
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1)), "run docs/site/run_notebooks.py"
    assert sum("image/jpeg" in output.get("data", {}) for cell in cells for output in cell["outputs"]) >= 3


def run(name: str, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """The cells of a notebook after it was run with other settings."""
    notebook = json.loads((ROOT / "examples" / f"{name}.ipynb").read_text())
    run_notebooks.run_notebook(notebook, settings)
    return notebook["cells"]


def pictures(cells: list[dict[str, Any]]) -> int:
    return sum("image/jpeg" in output.get("data", {}) for cell in cells for output in cell.get("outputs", ()))


def test_the_notebook_that_grades_a_video_runs(tmp_path: Path) -> None:
    (episode,) = write_synthetic_data(tmp_path, seeds=(1_000_000,), robots=("piper",), frames=5)
    assert pictures(run("grade_a_video", {"EPISODE": episode, "FRAMES": 3})) == 3


def test_the_notebook_of_a_scene_runs() -> None:
    cells = run("a_scene_and_its_robots", {"TASK": small.TASK, "ROBOTS": ("piper",)})
    printed = [text for cell in cells for output in cell.get("outputs", ()) for text in output.get("text", ())]
    assert pictures(cells) == 4 and any("Piper" in text and "succeeds" in text for text in printed) and "True\n" in printed


def test_settings_that_a_notebook_lacks_are_told() -> None:
    with pytest.raises(AssertionError, match="FRAME"):
        run_notebooks.run_notebook({"cells": [{"cell_type": "code", "source": ["A = 1"]}]}, {"FRAME": 5})
