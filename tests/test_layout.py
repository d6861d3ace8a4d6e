"""The house: who may import whom, and that every registry holds all that its folder holds."""

import ast
import importlib
import pkgutil
from pathlib import Path

import pytest

import xew

ROOT = Path(xew.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))

FORBIDDEN = {
    "sim_warp": {"jax", "flax", "optax", "orbax", "grain", "xew.model", "xew.metrics", "xew.analysis"},
    "model": {"warp", "newton", "mujoco", "mujoco_warp", "torch", "diffusers", "transformers", "xew.analysis"},
    "metrics": {"warp", "newton", "mujoco", "flax", "xew.model", "xew.sim_warp", "xew.analysis"},
    "exchange": {"jax", "flax", "optax", "orbax", "grain", "torch", "xew.model", "xew.metrics", "xew.analysis"},
    "analysis": {"jax", "flax", "warp", "newton", "mujoco", "xew.model", "xew.metrics"},
    "statistics": {"jax", "flax", "warp", "newton", "mujoco", "xew.model", "xew.metrics", "xew.sim_warp", "xew.analysis"},
    "": {"jax", "flax", "warp", "newton", "mujoco", "xew.model", "xew.metrics", "xew.sim_warp", "xew.analysis"},
}
"""Names that a room must not import; '' is the ground that all rooms stand on (episode, protocol, rollout, config)."""

CALIBRATION = {"calibrate", "perturbations"}
"""The files of `metrics` that ask other rooms to render and to encode; inside functions, so that they load without them."""
READERS = {"evaluate", "backends", "grade", "truth"}
"""The files at the root of `metrics` that may touch the disk or anything of ours outside the room."""


def room(path: Path) -> str:
    parts = path.relative_to(ROOT).parts
    return parts[0] if len(parts) > 1 else ""


def imports(path: Path, module_level_only: bool = False) -> set[str]:
    tree = ast.parse(path.read_text())
    nodes = tree.body if module_level_only else list(ast.walk(tree))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: import by the full name, as everywhere"
            names |= {f"{node.module}.{alias.name}" for alias in node.names} | {str(node.module)}
    return names


def touches(names: set[str], forbidden: str) -> bool:
    return any(name == forbidden or name.startswith(forbidden + ".") for name in names)


@pytest.mark.parametrize("path", FILES, ids=[str(path.relative_to(ROOT)) for path in FILES])
def test_a_file_imports_only_what_its_room_may(path: Path) -> None:
    names = imports(path, module_level_only=room(path) == "model" or (room(path) == "metrics" and path.stem in CALIBRATION))
    found = sorted(name for name in FORBIDDEN[room(path)] if touches(names, name))
    assert not found, f"{path.relative_to(ROOT)} imports {', '.join(found)}"


def test_only_latents_asks_the_simulation_to_render() -> None:
    """The one door between model and simulation; it stands inside functions, so that a model loads without Warp."""
    users = {path.stem for path in FILES if room(path) == "model" and touches(imports(path), "xew.sim_warp")}
    assert users <= {"latents", "pixels", "conditions"}


def test_metric_functions_know_nothing_of_ours_but_metrics() -> None:
    root = (path for path in FILES if path.parent == ROOT / "metrics")
    for path in (path for path in root if path.stem not in READERS | CALIBRATION):
        ours = {name for name in imports(path) if name.startswith("xew")}
        assert all(name.startswith("xew.metrics") for name in ours), f"{path.name} imports {sorted(ours)}"


def test_the_model_may_use_metrics_and_metrics_never_the_model() -> None:
    """LPIPS is a loss and grades a codec; the other way round would close a circle, lazy imports included."""
    users = [path for path in FILES if room(path) == "metrics" and touches(imports(path), "xew.model")]
    assert not users, f"{users} import the model; pass in what is needed, or name it as module:NAME"


@pytest.mark.parametrize("path", FILES, ids=[str(path.relative_to(ROOT)) for path in FILES])
def test_a_file_says_what_it_is_and_stays_readable(path: Path) -> None:
    text = path.read_text()
    assert ast.get_docstring(ast.parse(text)), f"{path} begins without a word on what it is"
    assert text.count("\n") <= 600, f"{path} has {text.count(chr(10))} lines, at most 600"


def test_every_function_is_annotated_and_short() -> None:
    wrong = []
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                bare = [a.arg for a in arguments if a.annotation is None and a.arg not in ("self", "cls")]
                length = (node.end_lineno or node.lineno) - node.lineno + 1
                if bare or length > 100:
                    wrong.append(f"{path.relative_to(ROOT)}:{node.lineno} {node.name} {bare} {length} lines")
    assert not wrong, "\n".join(wrong)


def test_the_registry_of_tasks_is_complete() -> None:
    tasks = importlib.import_module("xew.sim_warp.tasks")
    files = {module.name for module in pkgutil.iter_modules(tasks.__path__)} - {"task"}
    assert files <= {type(task).__module__.rpartition(".")[2] for task in tasks.TASKS.values()} | set(tasks.TASKS)


def test_the_registry_of_robots_is_complete() -> None:
    robots = importlib.import_module("xew.sim_warp.robots")
    files = {module.name for module in pkgutil.iter_modules(robots.__path__)}
    assert set(robots.ROBOTS) <= files and set(robots.ROBOTS) == set(importlib.import_module("xew.protocol").ROBOT_NAMES)


def test_the_registry_of_metrics_is_complete() -> None:
    metrics = importlib.import_module("xew.metrics")
    named = {"psnr", "ssim", "lpips", "mask_iou", "boundary_f1", "region_lpips", "pck", "pck_05", "keypoint_error", "ndtw"}
    assert set(metrics.METRICS) == named | {"coverage", "trajectory_error", "object_coverage"}
    assert {metric.inputs for metric in metrics.METRICS.values()} <= set(importlib.import_module("xew.metrics.metric").INPUTS)
    for metric in metrics.METRICS.values():
        assert getattr(metrics, metric.function.__name__) is metric.function
