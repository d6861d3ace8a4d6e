"""The session is as strict as tests/conftest.py says: of types, ranks, shapes and warnings; exceptions end with their test."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

from tests.conftest import CHECK_SHAPES, annotated_modules
from xew.model.diffusion.flow_matching import training_pair

ROOT = Path(__file__).parents[1]


def test_types_are_not_converted_silently() -> None:
    with pytest.raises(jax.dtypes.TypePromotionError):
        jnp.ones(3, jnp.float32) + jnp.ones(3, jnp.int32)


def test_axes_are_not_added_silently() -> None:
    with pytest.raises(ValueError, match="rank_promotion"):
        jnp.ones((2, 3)) + jnp.ones(3)


@pytest.mark.loose_types("an example")
@pytest.mark.loose_ranks("an example")
def test_an_exception_is_named() -> None:
    assert (jnp.ones((2, 3), jnp.float32) + jnp.ones(3, jnp.int32)).shape == (2, 3)


def test_an_exception_ends_with_its_test() -> None:
    assert jax.config.jax_numpy_dtype_promotion == "strict" and jax.config.jax_numpy_rank_promotion == "raise"


def test_warnings_are_errors() -> None:
    with pytest.raises(UserWarning, match="something"):
        warnings.warn("something", stacklevel=1)


@pytest.mark.skipif(not CHECK_SHAPES, reason="XEW_CHECK_SHAPES=0")
def test_a_wrong_shape_is_refused() -> None:
    """Names of axes hold over all arguments and results of a call, inside jitted functions too."""
    with pytest.raises(TypeCheckError):
        training_pair(jax.random.key(0), jnp.zeros((3, 2, 2, 4)), 5.0)
    with pytest.raises(TypeCheckError):
        jax.jit(training_pair, static_argnums=2)(jax.random.key(0), np.zeros((1, 3, 2, 2, 4), np.int32), 5.0)


def test_annotated_modules_are_found() -> None:
    found = annotated_modules()
    assert "xew.model.diffusion.flow_matching" in found
    assert all(name.startswith(("xew.model", "xew.metrics")) for name in found)


def test_shapes_are_not_checked_where_that_is_turned_off() -> None:
    code = "import tests.conftest, xew.model.diffusion.flow_matching as f; print(hasattr(f.training_pair, '__wrapped__'))"
    for value, checked in (("0", "False"), ("1", "True")):
        environment = os.environ | {"XEW_CHECK_SHAPES": value, "PYTHONPATH": str(ROOT)}
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
        assert done.stdout.strip() == checked, done.stderr


@pytest.mark.parametrize(("asked", "least"), [({}, "0.0"), ({"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "7"}, "7.0")])
def test_commands_keep_all_programs_unless_they_are_told_otherwise(asked: dict[str, str], least: str, tmp_path: Path) -> None:
    code = (
        "import jax, xew.compilation as c; c.keep_compiled_programs(); "
        "print(jax.config.jax_compilation_cache_dir, jax.config.jax_persistent_cache_min_compile_time_secs)"
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")} | asked
    environment |= {"XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.stdout.split() == [str(tmp_path / "xew" / "jax"), least], done.stderr


def test_compiled_programs_are_kept_for_other_workers() -> None:
    assert jax.config.jax_compilation_cache_dir == os.environ["JAX_COMPILATION_CACHE_DIR"]
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 0
