"""The session that all tests share: strict arrays, checked shapes, few threads, and programs that are compiled once.

Strictness is the default. What needs an exception asks for it by name and with its reason:
`pytestmark = pytest.mark.loose_types("Flax adds float32 and int32 in ...")`, or a line of `filterwarnings` in pyproject.toml.
"""

import os
import threading
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from jaxtyping import install_import_hook

import tests.checking

XEW = Path(__file__).parents[1] / "xew"
CHECKED_ROOMS = ("metrics", "model")
"""Rooms whose annotated modules are checked at run time."""
CHECK_SHAPES = os.environ.get("XEW_CHECK_SHAPES", "1") != "0"
"""Whether shapes and types of arrays are checked at every call; benchmarks of tests turn it off by XEW_CHECK_SHAPES=0."""
LOOSE = (("loose_types", "jax_numpy_dtype_promotion", "standard"), ("loose_ranks", "jax_numpy_rank_promotion", "allow"))
"""Mark, option of JAX, and its value under the mark."""
LAB = (
    "tests/analysis/reports/test_study_report.py::test_all_distances_fit_a_desk",
    "tests/analysis/studies/test_machines.py::test_cells_run_as_tasks_on_a_ray_cluster",
    "tests/analysis/studies/test_study_debug.py",
    "tests/analysis/test_beyond.py::test_the_report_sets_both_motions_side_by_side",
    "tests/analysis/test_results.py::test_published_tables_and_sentences_are_those_of_the_scores[bodies]",
    "tests/analysis/test_results.py::test_published_tables_and_sentences_are_those_of_the_scores[own_motion]",
    "tests/analysis/test_results.py::test_published_tables_and_sentences_are_those_of_the_scores[remedies]",
    "tests/analysis/test_results.py::test_published_tables_and_sentences_are_those_of_the_scores[six_tasks]",
    "tests/faults/test_disks.py::test_what_a_disk_refuses_is_one_line_and_nothing_is_lost",
    "tests/lab/",
    "tests/metrics/estimators/batched/test_batched.py::test_scores_of_the_predictors_are_the_same",
    "tests/metrics/grading/test_resume.py::test_memory_does_not_grow_with_the_number_of_episodes",
    "tests/metrics/test_perceptual.py::test_features_shared_by_three_metrics_and_all_predictions_change_no_value[1-",
    "tests/metrics/test_perceptual.py::test_features_shared_by_three_metrics_and_all_predictions_change_no_value[3-0",
    "tests/metrics/test_perceptual.py::test_features_shared_by_three_metrics_and_all_predictions_change_no_value[3-1000",
    "tests/model/codecs/test_conv_autoencoder.py::test_order_within_a_group_is_kept",
    "tests/model/codecs/test_vae.py::test_causal[16",
    "tests/model/codecs/test_vae.py::test_decoding_in_chunks_is_decoding_at_once[3",
    "tests/model/codecs/test_vae.py::test_half_precision_is_near",
    "tests/model/codecs/test_vae.py::test_statistics",
    "tests/model/codecs/test_vae.py::test_the_last_frame_alone",
    "tests/model/devices/test_many_devices.py::test_killed_runs_repeat_the_straight_ones_on_any_devices",
    "tests/model/devices/test_many_devices.py::test_the_same_config_gives_the_same_numbers",
    "tests/model/devices/test_many_devices.py::test_two_processes_are_as_one",
    "tests/model/network/test_dit_parity.py::test_whole_network[False-16",
    "tests/model/test_rollout.py::test_two_devices_share_a_batch_and_give_the_same",
    "tests/model/test_systems.py::test_a_system_is_trained_and_rolled_out[bwm]",
    "tests/model/test_systems.py::test_a_system_is_trained_and_rolled_out[enerverse_ac]",
    "tests/model/test_systems.py::test_a_system_is_trained_and_rolled_out[irasim]",
    "tests/sim_warp/devices/test_compiling.py::test_the_pieces_compiled_for_a_gpu_are_all_that_episodes_launch",
    "tests/sim_warp/rendering/test_render.py::test_kernels_compile_for_cuda_without_fused_or_approximate_arithmetic",
    "tests/sim_warp/rendering/test_render.py::test_mask_and_depth_agree_with_ray_casting[ball",
    "tests/sim_warp/test_generate.py::test_a_run_killed_in_the_middle_is_taken_up_again",
    "tests/test_docs.py::test_a_page_does_what_it_says[add_a_robot]",
    "tests/test_docs.py::test_a_page_does_what_it_says[add_a_task]",
    "tests/test_docs.py::test_a_page_runs_on_data[score_a_pytorch_model]",
    "tests/test_session.py::test_shapes_are_not_checked_where_that_is_turned_off",
)
"""Beginnings of the names of tests that `make test-lab` runs and `make test` does not; single tests bear the mark `lab`."""
LONG_FILES = (
    "tests/test_wheel.py",
    "tests/lab/",
    "tests/test_adding.py",
    "tests/test_docs.py",
    "tests/test_benchmarks.py",
    "tests/model/training/test_training.py",
    "tests/model/test_pipeline.py",
    "tests/model/test_rollout.py",
    "tests/model/devices/",
    "tests/model/network/test_dit.py",
    "tests/model/network/test_mechanisms.py",
    "tests/metrics/grading/",
    "tests/metrics/estimators/test_sam2.py",
    "tests/sim_warp/tasks/",
    "tests/sim_warp/test_generate.py",
    "tests/analysis/",
    "tests/faults/",
)
"""Files and folders that are run first and in this order, so no worker begins a long file when the other has finished."""
XLA_FLAGS = (
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_backend_optimization_level=0",
    "--xla_llvm_disable_expensive_passes=true",
    "--xla_cpu_parallel_codegen_split_count=1",
    "--xla_cpu_max_isa=AVX",
)
"""Options of XLA under test, for subprocesses too. Programs of tests run for milliseconds, and most of the time is compiling,
which these make ten times faster (the gradient of the tiny network: 1.5 s instead of 14 s). AVX has no fused multiply-add:
without XLA's fusion emitters, equal numbers would otherwise be computed in two ways, and their difference would not be zero."""
PROGRAMS = Path(__file__).parents[1] / ".pytest_cache" / "jax"
"""Folder of compiled programs that workers, subprocesses and sessions share."""
CACHE_DAYS = 14
"""Number of days for which a compiled program that no session has written again is kept."""


def annotated_modules() -> list[str]:
    """Modules of the checked rooms that import jaxtyping, by their full names."""
    files = (path for room in CHECKED_ROOMS for path in sorted((XEW / room).rglob("*.py")))
    names = (".".join(path.relative_to(XEW.parent).with_suffix("").parts) for path in files if "jaxtyping" in path.read_text())
    return [name.removesuffix(".__init__") for name in names]


for pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(pool, "1")  # before NumPy loads: two workers with a pool of threads each only wait for one another
os.environ.setdefault("XEW_EVALUATE_PROCESSES", "1")  # evaluate grades in the test's own process, on any machine
os.environ.setdefault("XLA_FLAGS", " ".join(XLA_FLAGS))  # before JAX compiles anything
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(PROGRAMS))  # before JAX is imported, which reads it once
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")  # so is this: hundreds of small programs count, too
if CHECK_SHAPES:
    install_import_hook(annotated_modules(), f"{tests.checking.__name__}.check_annotations")


def pytest_configure(config: pytest.Config) -> None:
    """Name the marks, and clear old programs away."""
    config.addinivalue_line("markers", "loose_types(reason): arrays of different types may meet; says whose code needs that")
    config.addinivalue_line("markers", "loose_ranks(reason): arrays of different rank may meet; says whose code needs that")
    if not hasattr(config, "workerinput"):
        remove_old_files(Path(os.environ["JAX_COMPILATION_CACHE_DIR"]))


def remove_old_files(folder: Path) -> None:
    """Remove the files of a folder that are older than CACHE_DAYS."""
    for path in folder.glob("*"):
        if path.is_file() and time.time() - path.stat().st_mtime > CACHE_DAYS * 86_400:
            path.unlink(missing_ok=True)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests of lab/, deselect those whose package is not installed, and put long files first."""
    for item in items:
        if item.nodeid.startswith(LAB):
            item.add_marker(pytest.mark.lab)
    missing = [item for item in items if any(not find_spec(mark.args[0]) for mark in item.iter_markers("needs"))]
    if missing:
        config.hook.pytest_deselected(items=missing)
        items[:] = [item for item in items if item not in missing]
    items.sort(key=lambda item: next((n for n, long in enumerate(LONG_FILES) if item.nodeid.startswith(long)), len(LONG_FILES)))


@pytest.fixture(scope="session", autouse=True)
def strict_arrays() -> None:
    """JAX neither converts types nor adds axes silently, in fixtures of any scope and in threads too."""
    import jax

    jax.config.update("jax_numpy_dtype_promotion", "strict")
    jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(scope="session", autouse=True)
def no_origins_of_tracers() -> Iterator[None]:
    """Flax asks every tracer for an attribute that tracers lack, and JAX's error, which nobody sees, says at length where the
    tracer comes from: a tenth of the time of tracing a network."""
    from jax._src.interpreters.partial_eval import DynamicJaxprTracer

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DynamicJaxprTracer, "_origin_msg", lambda tracer: "")
        yield


@pytest.fixture(scope="session", autouse=True)
def one_context_a_thread() -> Iterator[None]:
    """JAX lowers each program in an MLIR context of its own, which it fills with all dialects first: a tenth of the time of
    tests that run networks operation by operation."""
    from jax._src.interpreters import mlir

    make_context, of_thread = mlir.make_ir_context, threading.local()

    def get_context() -> Any:
        if not hasattr(of_thread, "context"):
            of_thread.context = make_context()
        return of_thread.context

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mlir, "make_ir_context", get_context)
        yield


@pytest.fixture(autouse=True)
def named_exceptions(request: pytest.FixtureRequest) -> Iterator[None]:
    """Tests marked loose_types or loose_ranks run as JAX does by default; the mark gives the reason."""
    import jax

    loosened = {}
    for mark, option, loose in LOOSE:
        found = request.node.get_closest_marker(mark)
        if found is not None:
            assert found.args and isinstance(found.args[0], str), f"@pytest.mark.{mark} needs a reason"
            loosened[option] = getattr(jax.config, option)
            jax.config.update(option, loose)
    yield
    for option, strict in loosened.items():
        jax.config.update(option, strict)
