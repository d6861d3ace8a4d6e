"""The house: who may import whom, no circles, small folders, and that every registry holds all that its folder holds.

Every check is a function from sources to a list of failures; it is held against xew and against a temporary tree.
"""

import ast
import importlib
import inspect
import pkgutil
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import pytest

import xew
from tests.source import Source, read_sources

ROOT = Path(xew.__file__).parent
SOURCES = read_sources(ROOT)

MOST_FILES_OF_A_FOLDER = 12
MAY_BE_LARGE = ("sim_warp/tasks", "sim_warp/robots")
"""Folders of registries, in which every entry is a file."""
MAY_IMPORT: dict[str, set[str]] = {
    "": set(),
    "statistics": set(),
    "video": set(),
    "policies": set(),
    "sim_warp": set(),
    "model": {"sim_warp", "metrics"},
    "metrics": {"sim_warp"},
    "exchange": {"sim_warp"},
    "analysis": {"sim_warp"},
}
"""Rooms that a room may import; '' are the files at the root. All may import those and GROUND."""
GROUND = {"", "statistics", "video", "policies"}
LAZILY = {
    ("model", "sim_warp"): ("conditions", "latents", "cache", "episodes", "devices.parts", "video"),
    ("model", "metrics"): ("codecs.ceiling", "conditions", "training.samples", "weights.reading"),
    ("metrics", "sim_warp"): ("truth", "outcome.judge", "outcome.variants"),
}
"""Modules and packages of the first room that may import the second, and inside functions alone: the room loads without it."""
FORBIDDEN = {
    "": {"jax", "flax", "warp", "newton", "mujoco"},
    "statistics": {"jax", "flax", "warp", "newton", "mujoco"},
    "video": {"jax", "flax", "warp", "newton", "mujoco"},
    "policies": {"jax", "flax", "warp", "newton", "mujoco"},
    "sim_warp": {"jax", "flax", "optax", "orbax", "grain"},
    "model": {"warp", "newton", "mujoco", "mujoco_warp", "torch", "diffusers", "transformers"},
    "metrics": {"warp", "newton", "mujoco", "flax"},
    "exchange": {"jax", "flax", "optax", "orbax", "grain", "torch"},
    "analysis": {"jax", "flax", "warp", "newton", "mujoco"},
}
"""Libraries that a room does not import, inside functions neither."""
WITH_WARP = "xew.metrics.estimators.batched"
"""Package of `metrics` that may import Warp. Others import it inside functions: the room loads without Warp."""
WITH_TORCH = ("xew.model.weights.reading",)
"""Modules of `model` that may import PyTorch inside functions: files of weights that only it can read."""
REGISTRIES = {"analysis": ("xew.model.conditions", "xew.model.runs.layout")}
"""Modules of another room that a room may read at once, for titles and the files of runs; they load without JAX and Warp."""
JAX_GROUND = "xew.compilation"
"""The one file at the root that imports JAX; only rooms that import JAX anyway may import it."""
STATISTICS_STANDS_ON = ("xew.statistics", "xew.protocol", "xew.config")
METRIC_READERS = {"evaluate", "backends", "grade", "truth"}
"""Files at the root of `metrics` that may touch the disk or anything of ours outside the room; the others are pure."""

Sources = Iterable[Source]
Graph = dict[str, set[str]]


def touches(names: Iterable[str], module: str) -> bool:
    """Whether one of the imported names is a module or lies below it."""
    return any(name == module or name.startswith(module + ".") for name in names)


def room_failures(sources: Sources) -> list[str]:
    """Imports of a room or library that a file's room may not import, or may import lazily and does not."""
    failures = []
    for source in sources:
        if source.room not in MAY_IMPORT:
            failures.append(f"{source.name} lies in {source.room}, which is no room")
            continue
        package = source.root.name
        names, at_once = source.imports(), source.imports(module_level_only=True)
        libraries = FORBIDDEN[source.room] - (
            {"torch"} if source.module in WITH_TORCH and not touches(at_once, "torch") else set()
        )
        libraries -= {"jax"} if source.module == JAX_GROUND else set()
        in_warp = touches([source.module], WITH_WARP)
        libraries -= {"warp"} if in_warp else set()
        if touches(at_once, WITH_WARP) and not in_warp:
            failures.append(f"{source.name} imports {WITH_WARP} at once; only inside functions")
        libraries |= {JAX_GROUND} if "jax" in libraries else set()
        failures += [f"{source.name} imports {name}" for name in sorted(libraries) if touches(names, name)]
        names = {name for name in names if not any(touches([name], module) for module in REGISTRIES.get(source.room, ()))}
        for other in sorted(MAY_IMPORT.keys() - GROUND - {source.room}):
            if not touches(names, f"{package}.{other}"):
                continue
            if other not in MAY_IMPORT[source.room]:
                failures.append(f"{source.name} imports {package}.{other}")
            elif (source.room, other) in LAZILY:
                allowed = [f"{package}.{source.room}.{name}" for name in LAZILY[source.room, other]]
                if not any(touches([source.module], name) for name in allowed):
                    failures.append(f"{source.name} imports {package}.{other}, which only {', '.join(allowed)} may")
                elif touches(at_once, f"{package}.{other}"):
                    failures.append(f"{source.name} imports {package}.{other} at once; only inside functions")
    return failures


def ground_failures(sources: Sources) -> list[str]:
    """Imports of `statistics` beyond what it stands on, and imports of pure metric functions beyond their room."""
    failures = []
    for source in sources:
        ours = {name for name in source.imports() if touches([name], source.root.name)} - {source.root.name}
        if source.room == "statistics":
            stands_on: tuple[str, ...] = STATISTICS_STANDS_ON
        elif source.path.parent == source.root / "metrics" and source.path.stem not in METRIC_READERS:
            stands_on = ("xew.metrics", "xew.statistics")
        else:
            continue
        beyond = sorted(name for name in ours if not any(touches([name], module) for module in stands_on))
        failures += [f"{source.name} imports {name}" for name in beyond]
    return failures


def file_graph(sources: list[Source]) -> Graph:
    """Module -> modules of ours that it imports, in functions too."""
    modules = {source.module for source in sources}
    graph: Graph = {}
    for source in sources:
        found = {name for name in source.imports() if name in modules}
        # `from package import file` is the file; `from package import function` the package.
        own_parts = {f"{node.module}" for node in ast.walk(source.tree) if isinstance(node, ast.ImportFrom)}
        whole = {
            str(node.module)
            for node in ast.walk(source.tree)
            if isinstance(node, ast.ImportFrom) and any(f"{node.module}.{alias.name}" not in modules for alias in node.names)
        }
        graph[source.module] = {name for name in found if name not in own_parts or name in whole} - {source.module}
    return graph


def package_of(source: Source) -> str:
    """Node of a file among packages: itself for commands and for files at the root of a room, else its folder."""
    if source.is_command or source.is_package or source.module.count(".") <= 2:
        return source.module
    return source.module.rpartition(".")[0]


def room_graph(sources: list[Source], files: Graph) -> Graph:
    """Room -> rooms that it imports; what a command imports is not needed by those who import its room."""
    rooms = {source.module: source.room for source in sources if source.room}
    graph: Graph = {room: set() for room in rooms.values()}
    for source in sources:
        if source.room and not source.is_command:
            graph[source.room] |= {rooms[name] for name in files[source.module] if name in rooms} - {source.room}
    return graph


def circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Groups of nodes that reach one another, by Kosaraju's algorithm, without recursion."""
    order: list[str] = []
    seen: set[str] = set()
    for start in graph:
        stack: list[tuple[str, bool]] = [(start, False)]
        while stack:
            node, left = stack.pop()
            if left:
                order.append(node)
            elif node not in seen:
                seen.add(node)
                stack.append((node, True))
                stack += [(following, False) for following in graph.get(node, ()) if following not in seen]
    backward: Graph = {}
    for node, followings in graph.items():
        for following in followings:
            backward.setdefault(following, set()).add(node)
    groups, placed = [], set()
    for start in reversed(order):
        group, reached = [], [start]
        while reached:
            node = reached.pop()
            if node not in placed:
                placed.add(node)
                group.append(node)
                reached += backward.get(node, ())
        if len(group) > 1:
            groups.append(sorted(group))
    return sorted(groups)


def circle_failures(sources: Sources) -> list[str]:
    """Circles of imports among files, packages and rooms; imports inside functions count."""
    sources = list(sources)
    files = file_graph(sources)
    node = {source.module: package_of(source) for source in sources}
    packages: Graph = {name: set() for name in node.values()}
    for importing, imported in files.items():
        packages[node[importing]] |= {node[name] for name in imported} - {node[importing]}
    graphs = {"files": files, "packages": packages, "rooms": room_graph(sources, files)}
    return [f"a circle of {kind}: {', '.join(group)}" for kind, graph in graphs.items() for group in circles(graph)]


def folder_failures(sources: Sources) -> list[str]:
    """Folders of too many files, folders without an `__init__`, and an `__init__` that imports another room."""
    sources = list(sources)
    failures = []
    for folder, count in Counter(source.path.parent for source in sources).items():
        name = folder.relative_to(sources[0].root).as_posix()
        if count > MOST_FILES_OF_A_FOLDER and name not in MAY_BE_LARGE:
            failures.append(f"{name} has {count} files, at most {MOST_FILES_OF_A_FOLDER}")
        if not (folder / "__init__.py").is_file():
            failures.append(f"{name} has no __init__.py")
    for source in sources:
        others = sorted(MAY_IMPORT.keys() - GROUND - {source.room})
        wrong = [room for room in others if touches(source.imports(), f"{source.root.name}.{room}")]
        if source.is_package and wrong:
            failures.append(f"{source.name} imports {', '.join(wrong)}; an __init__ stays in its room")
    return failures


def annotation_failures(sources: Sources) -> list[str]:
    """Functions with arguments that have no annotation."""
    failures = []
    for source in sources:
        for node in source.functions():
            arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            bare = [a.arg for a in arguments if a.annotation is None and a.arg not in ("self", "cls")]
            if bare:
                failures.append(f"{source.name}:{node.lineno} {node.name}: {', '.join(bare)} without annotation")
    return failures


CHECKS: tuple[Callable[[Sources], list[str]], ...] = (
    room_failures, ground_failures, circle_failures, folder_failures, annotation_failures,
)  # fmt: skip


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__.removesuffix("_failures"))
def test_the_house_is_in_order(check: Callable[[Sources], list[str]]) -> None:
    failures = check(SOURCES)
    assert not failures, f"{len(failures)} failures:\n" + "\n".join(failures)


def test_names_of_test_files_are_unique() -> None:
    """pytest imports them by name where folders have no `__init__`."""
    names = Counter(path.name for path in Path(__file__).parent.rglob("test_*.py"))
    assert not [name for name, count in names.items() if count > 1]


LAB = read_sources(ROOT.parent / "lab")


@pytest.mark.parametrize(
    "check", (circle_failures, folder_failures, annotation_failures), ids=lambda check: check.__name__.removesuffix("_failures")
)
def test_the_laboratory_is_in_order(check: Callable[[Sources], list[str]]) -> None:
    failures = check(LAB)
    assert not failures, f"{len(failures)} failures:\n" + "\n".join(failures)


def test_xew_imports_nothing_of_the_laboratory() -> None:
    assert not [source.name for source in SOURCES if touches(source.imports(), "lab")]


def test_folders_of_tests_mirror_those_of_the_source() -> None:
    tests = ROOT.parent / "tests"
    folders = {path.parent.relative_to(tests) for path in tests.rglob("test_*.py")} - {Path("."), Path("faults")}
    missing = [folder for folder in folders if not (ROOT / folder).is_dir() and not (ROOT.parent / folder).is_dir()]
    assert not missing, "folders of tests without a folder of xew, or of lab for those in tests/lab"


Files = dict[str, str]
GOOD: Files = {
    "__init__.py": "",
    "episode.py": "import numpy\n",
    "statistics/__init__.py": "from xew.protocol import A\n",
    "protocol.py": "A = 1\n",
    "sim_warp/__init__.py": "",
    "sim_warp/scene.py": "from xew.episode import read\nfrom xew.sim_warp.inner import file\nimport warp\n",
    "sim_warp/inner/__init__.py": "",
    "sim_warp/inner/file.py": "def f(a: int) -> int:\n    from xew.sim_warp.inner.other import g\n    return a\n",
    "sim_warp/inner/other.py": "",
    "model/__init__.py": "",
    "model/conditions.py": "def f() -> None:\n    from xew.sim_warp import scene\n",
    "metrics/__init__.py": "",
    "metrics/image.py": "from xew.metrics import mask\nfrom xew.statistics import b\n",
    "metrics/mask.py": "import jax\n",
}
PLANTED: dict[str, tuple[Callable[[Sources], list[str]], Files, str]] = {
    "a library": (room_failures, {"sim_warp/a.py": "import jax.numpy as jnp\n"}, "sim_warp/a.py imports jax"),
    "a library in a function": (room_failures, {"model/a.py": "def f():\n    import warp as wp\n"}, "model/a.py imports warp"),
    "the ground with JAX": (room_failures, {"sim_warp/a.py": "from xew.compilation import f\n"}, "imports xew.compilation"),
    "a room": (room_failures, {"sim_warp/a.py": "from xew.model import b\n"}, "sim_warp/a.py imports xew.model"),
    "a room in a function": (room_failures, {"sim_warp/a.py": "def f():\n    from xew import model\n"}, "imports xew.model"),
    "a room from the ground": (room_failures, {"files.py": "from xew.analysis import b\n"}, "files.py imports xew.analysis"),
    "a lazy import at once": (room_failures, {"model/conditions.py": "from xew.sim_warp import scene\n"}, "inside functions"),
    "a lazy import elsewhere": (room_failures, {"model/a.py": "def f():\n    from xew.sim_warp import scene\n"}, "which only"),
    "Warp in the metrics": (room_failures, {"metrics/a.py": "def f():\n    import warp\n"}, "metrics/a.py imports warp"),
    "the batched estimators": (
        room_failures, {"metrics/a.py": "from xew.metrics.estimators.batched import masks\n"}, "only inside functions",
    ),
    "no room": (room_failures, {"kitchen/__init__.py": ""}, "is no room"),
    "statistics on episodes": (ground_failures, {"statistics/a.py": "from xew.episode import b\n"}, "imports xew.episode"),
    "a metric that reads": (ground_failures, {"metrics/a.py": "def f():\n    import xew.episode\n"}, "imports xew.episode"),
    "a circle of files": (
        circle_failures, {"metrics/mask.py": "def f():\n    from xew.metrics import image\n"}, "a circle of files",
    ),
    "a circle of packages": (
        circle_failures,
        {
            "sim_warp/one/__init__.py": "", "sim_warp/one/a.py": "from xew.sim_warp.two import c\n", "sim_warp/one/b.py": "",
            "sim_warp/two/__init__.py": "", "sim_warp/two/c.py": "", "sim_warp/two/d.py": "from xew.sim_warp.one.b import e\n",
        },
        "a circle of packages: xew.sim_warp.one, xew.sim_warp.two",
    ),
    "a circle of rooms": (
        circle_failures,
        {"model/a.py": "from xew.metrics.mask import b\n", "metrics/c.py": "from xew.model.conditions import d\n"},
        "a circle of rooms: metrics, model",
    ),
    "a large folder": (folder_failures, {f"metrics/a{n}.py": "" for n in range(10)}, "metrics has 13 files, at most 12"),
    "no init": (folder_failures, {"metrics/loose/a.py": ""}, "metrics/loose has no __init__.py"),
    "an init that goes out": (folder_failures, {"model/__init__.py": "from xew.sim_warp import scene\n"}, "stays in its room"),
    "no annotation": (annotation_failures, {"files.py": "def f(a, b: int) -> None: ...\n"}, "f: a without annotation"),
}  # fmt: skip


def planted(folder: Path, files: Files) -> list[Source]:
    """The sources of a small house with these files in it."""
    for name, text in (GOOD | files).items():
        path = folder / "xew" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return read_sources(folder / "xew")


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_a_good_house_passes(check: Callable[[Sources], list[str]], tmp_path: Path) -> None:
    assert check(planted(tmp_path, {})) == []


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_violation_is_found(name: str, tmp_path: Path) -> None:
    check, files, message = PLANTED[name]
    failures = check(planted(tmp_path, files))
    assert failures and message in failures[0], failures


def test_commands_stand_for_themselves_among_packages_and_rooms(tmp_path: Path) -> None:
    command = 'from xew.model.conditions import b\n\n\nif __name__ == "__main__":\n    b()\n'
    sources = planted(tmp_path, {"metrics/evaluate.py": command, "model/a.py": "from xew.metrics.mask import b\n"})
    assert circle_failures(sources) == []


def test_the_registry_of_tasks_is_complete() -> None:
    tasks = importlib.import_module("xew.sim_warp.tasks")
    files = {module.name for module in pkgutil.iter_modules(tasks.__path__)} - {"task"}
    assert files <= {type(task).__module__.rpartition(".")[2] for task in tasks.TASKS.values()} | set(tasks.TASKS)


def test_the_registry_of_robots_is_complete() -> None:
    robots = importlib.import_module("xew.sim_warp.robots")
    files = {module.name for module in pkgutil.iter_modules(robots.__path__)}
    assert set(robots.ROBOTS) <= files and set(robots.ROBOTS) == set(importlib.import_module("xew.protocol").ROBOT_NAMES)


def test_the_registry_of_metrics_is_complete() -> None:
    """Metrics of the paper are there, and no exported one of a family's file was forgotten."""
    metrics = importlib.import_module("xew.metrics")
    kinds = importlib.import_module("xew.metrics.metric")
    assert set(metrics.METRICS) >= set(importlib.import_module("xew.analysis.paper").read_paper().metrics)
    registered = {metric.function for metric in metrics.METRICS.values()}
    registered |= {metric.curve for metric in metrics.METRICS.values()}
    for name in metrics.__all__:
        function = getattr(metrics, name)
        signature = inspect.signature(function) if callable(function) else None
        if signature is None or signature.return_annotation not in (kinds.Scalar, kinds.ByFrame):
            continue
        compared = [parameter.annotation for parameter in signature.parameters.values()][:2]
        if len(compared) == 2 and compared[0] == compared[1]:
            assert function in registered, f"{name} compares a prediction with its target, and METRICS does not have it"


def test_an_entry_of_the_registry_of_metrics_agrees_with_its_function() -> None:
    metrics = importlib.import_module("xew.metrics")
    kinds = importlib.import_module("xew.metrics.metric")
    masked = {kind: ["target_mask"] for kind in ("region", "robot", "bodies")}
    of_two = ("video", "mask", "outcome", "variants", "variant_videos")
    others: dict[str, list[str]] = {"track": ["valid"]} | {kind: [] for kind in of_two} | masked
    assert set(others) == set(kinds.INPUTS)
    for name, metric in metrics.METRICS.items():
        exported = metric.function.__name__
        assert getattr(metrics, exported) is metric.function and exported in metrics.__all__, name
        taken = ["prediction", "target", *others[metric.inputs]]
        for function in filter(None, (metric.function, metric.curve, metric.parts)):
            assert list(inspect.signature(function).parameters)[: len(taken)] == taken, name
        assert (metric.curve is None) == (metric.inputs in ("track", "variants", "variant_videos")), name
        assert metric.range[0] < metric.range[1] and metric.dimension and metric.reference, name
        assert metric.suites and set(metric.suites) <= set(kinds.SUITES) and metric.points in kinds.POINTS, name
        options = inspect.signature(metric.function).parameters
        assert set(metric.options) == set(kinds.OPTIONS) & set(options), name
    titles = [metric.title or name for name, metric in metrics.METRICS.items()]
    assert len(set(titles)) == len(titles)
