"""The style of the source: kernels, shapes in docstrings, lengths, `__init__` files, docstrings of constants, spelling.

Every check is a function from sources to a list of failures; it is held against xew and against planted violations.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

import xew
from tests.source import Function, Source, read_sources

ROOT = Path(xew.__file__).parent
REPOSITORY = ROOT.parent
SOURCES = read_sources(ROOT)

MOST_LINES_OF_A_FILE = 600
MOST_LINES_OF_A_FUNCTION = 60
LEAST_TEST_LINES = 0.4
"""Least share of test lines in source lines of sim_warp."""

JAXTYPING = r"(?:Float|Int|UInt|UInt8|Bool|Num|Real|Key|Shaped)\w*\["
ARRAY = re.compile(rf"\b(?:np\.ndarray|jax\.Array|NDArray|ArrayLike|wp\.array\w*|{JAXTYPING})|\bArray\b")
"""Annotations of arrays."""
SHAPE = re.compile(r"\[((?:\.\.\.|[A-Za-z_]\w*'*|\d+|[-+*/() ])+(?:, [^\[\]]+)?)\]")
"""Shape in brackets, perhaps with its unit behind a comma."""
UNITS = {"m", "mm", "m/s", "m/s^2", "rad", "rad/s", "s", "px", "pixel", "pixels", "kg", "dB", "N", "Nm"}
"""What stands in brackets and is a unit, not a shape."""
QUESTIONS = "So|How|What|Where|Who|Whom|Which|When|Why|By|As (?:many|much|far|long)|Not more|No more"
CONSTANT_OPENING = re.compile(rf"(?:{QUESTIONS})\b", re.IGNORECASE)
"""Openings of docstrings of constants that are no noun."""
KEPT_WORDS = ("analyse", "writeable")
"""Words that stay: the name of a study's last step in ledgers on disk and of its command, and NumPy's flag."""
SPELLED = (
    "xew",
    "tests",
    "docs",
    "examples",
    "benchmarks",
    "configs",
    "README.md",
    "CHANGELOG.md",
    "Makefile",
    "pyproject.toml",
)


def kernel_failures(sources: Iterable[Source]) -> list[str]:
    """Kernels without `# In` and `# Out` lines in the signature, or with an array whose shape is not behind it."""
    failures = []
    for source in sources:
        for node in source.functions():
            if any(ast.unparse(mark).split("(")[0] == "wp.kernel" for mark in node.decorator_list):
                failures += [f"{source.name}:{node.lineno} {node.name}: {wrong}" for wrong in _signature_failures(source, node)]
    return failures


def _signature_failures(source: Source, node: Function) -> list[str]:
    first, last = node.lineno, node.body[0].lineno - 1
    heads = {
        head: line
        for line in range(first, last + 1)
        for head in ("In", "Out")
        if re.match(rf"\s*# {head}\b", source.lines[line - 1])
    }
    if set(heads) != {"In", "Out"} or heads["In"] > heads["Out"]:
        return ["needs the lines `# In` and `# Out` in its signature, in this order"]
    arguments = node.args.args
    failures = [f"{a.arg} stands before `# In`" for a in arguments if a.lineno < heads["In"]]
    if not any(a.lineno > heads["Out"] for a in arguments):
        failures.append("has nothing behind `# Out`")
    for argument in arguments:
        comment = source.lines[(argument.end_lineno or argument.lineno) - 1].partition("#")[2]
        if "wp.array" in ast.unparse(argument.annotation or argument) and not has_shape(comment):
            failures.append(f"{argument.arg} needs its shape in brackets behind it")
    return failures


def has_shape(text: str) -> bool:
    """Whether a text gives the shape of an array in brackets."""
    return any(match[1].strip() not in UNITS for match in SHAPE.finditer(text))


def shape_failures(sources: Iterable[Source]) -> list[str]:
    """Public functions that take or return arrays and whose docstring gives no shape."""
    return [
        f"{source.name}:{node.lineno} {name}: its docstring needs the shapes of its arrays in brackets"
        for source in sources
        for name, node in source.public_functions()
        if handles_arrays(name, node) and not has_shape(ast.get_docstring(node) or "")
    ]


def handles_arrays(name: str, node: Function) -> bool:
    """Whether a function is public, is no Warp code, and has an array in its annotations."""
    if any(part.startswith("_") and part != "__call__" for part in name.split(".")):
        return False
    marks = {ast.unparse(mark).split("(")[0] for mark in node.decorator_list}
    if marks & {"wp.kernel", "wp.func", "override", "typing.override"}:
        return False
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs, node.args.vararg, node.args.kwarg]
    annotations = [argument.annotation for argument in arguments if argument is not None] + [node.returns]
    return any(ARRAY.search(_without_callables(annotation)) for annotation in annotations if annotation is not None)


def _without_callables(annotation: ast.expr) -> str:
    """Text of an annotation; what a callable takes and returns is said where it is made."""
    return re.sub(r"Callable\[.*", "Callable", ast.unparse(annotation))


def length_failures(sources: Iterable[Source]) -> list[str]:
    """Files and functions that are too long."""
    failures = []
    for source in sources:
        if len(source.lines) > MOST_LINES_OF_A_FILE:
            failures.append(f"{source.name}: {len(source.lines)} lines, at most {MOST_LINES_OF_A_FILE}")
        for node in source.functions():
            length = (node.end_lineno or node.lineno) - node.lineno + 1
            if length > MOST_LINES_OF_A_FUNCTION:
                failures.append(f"{source.name}:{node.lineno} {node.name}: {length} lines, at most {MOST_LINES_OF_A_FUNCTION}")
    return failures


def package_failures(sources: Iterable[Source]) -> list[str]:
    """Packages below the root whose `__init__` says too little or lists nothing."""
    failures = []
    for source in sources:
        if not source.is_package or source.path.parent == source.root:
            continue
        text = ast.get_docstring(source.tree) or ""
        if len(re.findall(r"[.:](?:\s|$)", text)) < 2 and len([line for line in text.splitlines() if line.strip()]) < 2:
            failures.append(f"{source.name}: its docstring needs two sentences on what the package promises")
        listed = _listed(source)
        if listed is None:
            failures.append(f"{source.name}: needs __all__")
            continue
        missing = sorted(set(listed) - _bound(source))
        if missing:
            failures.append(f"{source.name}: __all__ names {', '.join(missing)}, which the package does not have")
    return failures


def _listed(source: Source) -> list[str] | None:
    for node in source.tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        if any(isinstance(target, ast.Name) and target.id == "__all__" for target in targets):
            value = node.value  # type: ignore[attr-defined]
            return [item.value for item in value.elts] if isinstance(value, ast.List | ast.Tuple) else []
    return None


def _bound(source: Source) -> set[str]:
    """Names that a package has: its files and folders, what it defines and what it imports."""
    names = {path.stem for path in source.path.parent.iterdir()}
    for node in ast.walk(source.tree):
        if isinstance(node, Function | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names |= {alias.asname or alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
    return names


def docstring_failures(sources: Iterable[Source]) -> list[str]:
    """Files without a docstring, and docstrings of constants and attributes that do not begin with the noun."""
    failures = []
    for source in sources:
        if not ast.get_docstring(source.tree):
            failures.append(f"{source.name}: begins without a docstring")
        for node in ast.walk(source.tree):
            if not isinstance(node, ast.Module | ast.ClassDef):
                continue
            for before, here in zip(node.body, node.body[1:], strict=False):
                constant = isinstance(before, ast.Assign | ast.AnnAssign) and isinstance(here, ast.Expr)
                text = here.value.value if constant and isinstance(here.value, ast.Constant) else None
                if isinstance(text, str) and CONSTANT_OPENING.match(text):
                    failures.append(f"{source.name}:{here.lineno} begins with {text.split()[0]!r} and not with the noun")
    return failures


CHECKS: tuple[Callable[[Iterable[Source]], list[str]], ...] = (
    kernel_failures, shape_failures, length_failures, package_failures, docstring_failures,
)  # fmt: skip


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__.removesuffix("_failures"))
def test_the_source_keeps_the_style(check: Callable[[Iterable[Source]], list[str]]) -> None:
    failures = check(SOURCES)
    assert not failures, f"{len(failures)} failures:\n" + "\n".join(failures)


def test_tests_and_benchmarks_are_no_longer_than_600_lines() -> None:
    failures = [
        f"{folder}/{source.name}: {len(source.lines)} lines"
        for folder in ("tests", "benchmarks", "examples")
        for source in read_sources(REPOSITORY / folder)
        if len(source.lines) > MOST_LINES_OF_A_FILE
    ]
    assert not failures, "\n".join(failures)


def spelling_failures(paths: Iterable[Path]) -> list[str]:
    """Words that are not spelled as in American English, by codespell."""
    words = ",".join(KEPT_WORDS)
    options = [
        "--builtin",
        "en-GB_to_en-US",
        "--ignore-words-list",
        words,
        "--skip",
        "*.json,*.tsv,*.urdf,*.png,*.jpg,*.webp,*.npz,*.svg,*.safetensors,*.parquet",
    ]
    command = [sys.executable, "-m", "codespell_lib", *options, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode in (0, 65), done.stderr
    return done.stdout.splitlines()


def test_spelling_is_american() -> None:
    failures = spelling_failures(REPOSITORY / name for name in SPELLED)
    assert not failures, "\n".join(failures)


def test_the_simulation_is_tested() -> None:
    written = sum(len(source.lines) for source in SOURCES if source.room == "sim_warp")
    tested = sum(len(source.lines) for source in read_sources(REPOSITORY / "tests" / "sim_warp"))
    assert tested >= LEAST_TEST_LINES * written, f"{tested} test lines for {written} lines of sim_warp: {tested / written:.2f}"


GOOD = '''"""A file of the kind that passes."""

import numpy as np
import warp as wp

COUNT = 3
"""Number of things."""


@wp.kernel
def scale(
    # In
    values: wp.array(dtype=float),  # [n] m
    factor: float,
    # Out
    scaled: wp.array(dtype=float),  # [n] m
):
    i = wp.tid()
    scaled[i] = factor * values[i]


def mean(values: np.ndarray) -> np.ndarray:
    """Mean [w] float64 over the rows of `values` [h w]."""
    return values.mean(0)
'''
SHAPES = '"""Mean [w] float64 over the rows of `values` [h w]."""'
FIRST = "# [n] m\n    factor"
PLANTED: dict[str, tuple[Callable[[Iterable[Source]], list[str]], str, str, str]] = {
    "a kernel without groups": (kernel_failures, "    # In\n", "", "needs the lines"),
    "a kernel with one group": (kernel_failures, "# Out", "# In", "needs the lines"),
    "an argument before its group": (kernel_failures, "scale(", "scale(\n    first: float,", "first stands before"),
    "a kernel's array without a shape": (kernel_failures, FIRST, "# numbers\n    factor", "values needs its shape"),
    "a kernel's array with a unit alone": (kernel_failures, FIRST, "# [m]\n    factor", "values needs its shape"),
    "a kernel without results": (kernel_failures, "    scaled: wp.array(dtype=float),  # [n] m\n", "", "nothing behind"),
    "an array without a shape": (shape_failures, SHAPES, '"""Mean over the rows."""', "mean: its docstring"),
    "an array with a unit alone": (shape_failures, SHAPES, '"""Mean [m] over the rows."""', "mean: its docstring"),
    "an array function without a docstring": (shape_failures, f"    {SHAPES}\n", "", "mean: its docstring"),
    "a long function": (length_failures, "    return", "    values = values + 0\n" * 60 + "    return", "mean: 63 lines"),
    "a long file": (length_failures, "COUNT = 3", "#\n" * 600 + "COUNT = 3", "lines, at most 600"),
    "a constant that begins with so many": (docstring_failures, "Number of", "So many", "begins with 'So'"),
    "a constant that begins with how": (docstring_failures, "Number of", "How many", "begins with 'How'"),
    "a file without a docstring": (docstring_failures, '"""A file of the kind that passes."""', "", "without a docstring"),
}


def planted(folder: Path, text: str, name: str = "planted.py") -> list[Source]:
    """The sources of a package that holds one file of this text."""
    path = folder / "house" / name
    path.parent.mkdir(parents=True)
    path.write_text(text)
    return read_sources(folder / "house")


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_a_good_file_passes(check: Callable[[Iterable[Source]], list[str]], tmp_path: Path) -> None:
    assert check(planted(tmp_path, GOOD)) == []


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_violation_is_found(name: str, tmp_path: Path) -> None:
    check, old, new, message = PLANTED[name]
    assert old in GOOD
    failures = check(planted(tmp_path, GOOD.replace(old, new, 1)))
    assert len(failures) == 1 and message in failures[0], failures


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('__all__ = ["a"]\na = 1\n', "needs two sentences"),
        ('"""One sentence alone."""\n\n__all__ = ["a"]\na = 1\n', "needs two sentences"),
        ('"""One sentence. And another."""\n', "needs __all__"),
        ('"""One sentence. And another."""\n\n__all__ = ["absent"]\n', "names absent"),
    ],
)
def test_a_poor_package_is_found(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "house" / "room" / "__init__.py"
    path.parent.mkdir(parents=True)
    path.write_text(text)
    failures = package_failures(read_sources(tmp_path / "house"))
    assert len(failures) == 1 and message in failures[0], failures


def test_british_spelling_is_found(tmp_path: Path) -> None:
    british = "the " + "col" + "our of the neighb" + "our"
    (tmp_path / "page.md").write_text(british)
    assert len(spelling_failures([tmp_path])) == 2


TICS = re.compile(
    r"\b(?:told|beside|in place of|that of|those of|of (?:its|their|one's|your|our) own|of a user's own|from nothing"
    r"|trainings?(?= (?:of|is|are|was|were|each|differ|and|or|with|in|by|had|has)\b)|learned nothing|anew|by turns|goes? with"
    r"|likewise|so that|whatever|whoever|the former|the latter|looks(?= (?:of|and|are))|room(?:s)?(?= (?:of|is|that|holds|may))"
    r"|cannot be told|what (?:a|the) \w+ (?:is|was|has)|no(?:body|where) (?:else )?(?:has|is))\b",
    re.IGNORECASE,
)
"""Phrases that CONTRIBUTING.md advises against."""
PROSE = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
MOST_WORDS_OF_README, MOST_WORDS_OF_DOCS = 900, 25_000
MOST_TICS, MOST_MEAN, LONG_SENTENCE, MOST_LONG = 2.0, 20.0, 35, 20
"""Phrases per 1,000 words and words per sentence, at most, on any page; sentences over LONG_SENTENCE words, at most, in all."""


def prose(text: str) -> str:
    """Running text of a page: no code, tables, headings, link targets or HTML."""
    text = re.sub(r"^[ ]*```.*?^[ ]*```", "", text, flags=re.MULTILINE | re.DOTALL)
    lines = (line for line in text.splitlines() if not line.lstrip().startswith(("|", "#", "<", "!", "---", "    ")))
    return " ".join(re.sub(r"`[^`]*`", "CODE", re.sub(r"\]\([^)]*\)", "]", line)) for line in lines if line.strip())


def sentence_lengths(text: str) -> list[int]:
    """Words of each sentence of running text."""
    return [len(part.split()) for part in re.split(r"(?<=[.!?:])\s+(?=[A-Z*\[`])", text) if len(part.split()) > 2]


@pytest.mark.parametrize("page", PROSE, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_a_page_is_plain(page: Path) -> None:
    text = prose(page.read_text())
    lengths = sentence_lengths(text)
    assert 1000 * len(TICS.findall(text)) <= MOST_TICS * len(text.split()), TICS.findall(text)
    assert sum(lengths) <= MOST_MEAN * max(len(lengths), 1)


def test_pages_are_short() -> None:
    long = [n for page in PROSE for n in sentence_lengths(prose(page.read_text())) if n > LONG_SENTENCE]
    assert len(long) <= MOST_LONG
    assert len((REPOSITORY / "README.md").read_text().split()) <= MOST_WORDS_OF_README
    pages = [page for page in PROSE if page.name != "README.md" or page.parent != REPOSITORY]
    assert sum(len(prose(page.read_text()).split()) for page in pages if page.parent.name != "reference") <= MOST_WORDS_OF_DOCS


def test_tics_and_long_sentences_are_counted() -> None:
    text = prose("# Told\n\nIt is told so that it works. `told`\n\n```\ntold\n```\n| told |\n[a](told.md) b c.\n")
    assert TICS.findall(text) == ["told", "so that"] and sentence_lengths(text) == [7, 4]
