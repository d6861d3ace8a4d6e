"""TAPIR's adapter: checkpoint, coordinates, queries and what counts as lost.

The package `tapnet` is not on PyPI, so a stand-in with the published signature is called: it follows colors in the network's
own coordinates. `test_the_real_network` runs where somebody has installed the package.
"""

import os
import sys
import types
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from tests.metrics.estimators.colored_squares import squares
from xew.config import ConfigError
from xew.metrics.backends import open_tracker
from xew.metrics.estimators.tapir import open_tapir, read_checkpoint

pytestmark = pytest.mark.loose_types("TAPIR and its stand-in add whole numbers and floats")


class StandIn:
    """Follows the color under each query, in pixels whose centers are at halves, as tolerantly as its parameter says."""

    options: dict[str, Any]

    def __init__(self, params: Any, state: Any, tapir_kwargs: dict[str, Any]) -> None:
        StandIn.options = tapir_kwargs
        self.tolerance = params["tapir"]["tolerance"]

    def __call__(self, video: Any, is_training: bool, query_points: Any, query_chunk_size: int) -> dict[str, Any]:
        assert video.shape[2:] == (256, 256, 3) and not is_training and query_chunk_size > 0
        t, y, x = query_points[0].astype(int).T
        colors = video[0, t, y, x]
        same = jnp.abs(video[0, None] - colors[:, None, None, None]).max(-1) < self.tolerance  # [k t h w]
        count = same.sum((2, 3))
        center = jnp.arange(256)[None, None] + 0.5
        tracks = jnp.stack([(same.sum(axis) * center).sum(-1) / jnp.maximum(count, 1) for axis in (2, 3)], -1)
        logit = jnp.where(count > 0, -5.0, 5.0)
        return {"tracks": tracks[None], "occlusion": logit[None], "expected_dist": jnp.full_like(logit, -5.0)[None]}


def save(path: Path, extra: bool = False, **more: Any) -> Path:
    """A checkpoint as published: a dictionary of trees of arrays in a .npy."""
    params = {"tapir": {"tolerance": np.float32(0.1)}} | ({"tapir/~/extra_convs": {"w": np.zeros(2)}} if extra else {})
    np.save(path, {"params": params, "state": {}} | more, allow_pickle=True)
    return path


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> None:
    """`tapnet.models.tapir_model` as somebody would have installed it."""
    model = types.ModuleType("tapnet.models.tapir_model")
    model.ParameterizedTAPIR = StandIn
    for name in ("tapnet", "tapnet.models"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, "tapnet.models.tapir_model", model)


@pytest.mark.usefixtures("package")
def test_points_are_followed_in_our_pixels(tmp_path: Path) -> None:
    """To a quarter of a pixel, which half a pixel too much or too little would break."""
    video, points, visible = squares()
    tracker = open_tracker("tapir", save(tmp_path / "tapir_checkpoint_panning.npy"))
    found = tracker(video, np.zeros_like(video), points, visible)
    assert found.shape == points.shape and found.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(found).any(-1), ~visible)
    np.testing.assert_allclose(found[visible], points[visible], atol=0.25)
    assert StandIn.options["pyramid_level"] == 0


@pytest.mark.usefixtures("package")
def test_a_bootstapir_is_told_by_its_tensors(tmp_path: Path) -> None:
    video, points, visible = squares()
    open_tapir(save(tmp_path / "any_name.npy", extra=True))(video, video, points, visible)
    assert StandIn.options["extra_convs"] and StandIn.options["softmax_temperature"] == 10


@pytest.mark.usefixtures("package")
def test_where_no_point_is_ever_seen_all_are_lost(tmp_path: Path) -> None:
    video, points, visible = squares()
    assert np.isnan(open_tapir(save(tmp_path / "t.npy"))(video, video, points, np.zeros_like(visible))).all()


def test_without_the_package_one_is_told_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tapnet", None)
    with pytest.raises(ConfigError, match=r"TAPIR needs the package tapnet .* github\.com/google-deepmind/tapnet"):
        open_tapir(save(tmp_path / "t.npy"))


def test_a_checkpoint_is_read_whole(tmp_path: Path) -> None:
    weights = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)
    content = read_checkpoint(save(tmp_path / "t.npy", state={"mean": {"average": weights}}))
    np.testing.assert_array_equal(content["state"]["mean"]["average"], weights)
    assert content["params"]["tapir"]["tolerance"] == np.float32(0.1)


class Malice:
    """Makes a folder where it is unpickled freely."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return (os.mkdir, (str(self.path),))


def test_a_checkpoint_that_would_run_code_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "t.npy", step=Malice(tmp_path / "ran"))
    with pytest.raises(ConfigError, match=r"asks for posix\.mkdir, which no file of arrays needs; it was not run"):
        read_checkpoint(path)
    assert not (tmp_path / "ran").exists()


def test_other_files_are_refused(tmp_path: Path) -> None:
    names = ("array", "text", "cut", "other", "causal_boots", "header")
    array, text, cut, other, causal, header = (tmp_path / f"{name}.npy" for name in names)
    np.save(array, np.zeros(3))
    text.write_text("no numpy")
    cut.write_bytes(save(tmp_path / "t.npy").read_bytes()[:200])
    np.save(other, {"weights": np.zeros(3)}, allow_pickle=True)
    save(causal)
    header.write_bytes(b"\x93NUMPY\x01\x00\x06\x00{'a(\n{}")
    reasons = (
        "not one dictionary",
        "no checkpoint of TAPIR",
        "no checkpoint of TAPIR",
        "lacks the parameters",
        "causal network",
        "no checkpoint of TAPIR",
    )
    for path, reason in zip((array, text, cut, other, causal, header), reasons, strict=True):
        with pytest.raises(ConfigError, match=reason) as caught:
            read_checkpoint(path)
        assert path.name in str(caught.value)


@pytest.mark.loose_ranks("TAPIR lets arrays of different rank meet")
@pytest.mark.needs("tapnet")
def test_the_real_network(tmp_path: Path) -> None:
    """Random weights of the published architecture, saved as published."""
    import haiku
    import jax
    from tapnet.models import tapir_model as model

    def forward(video: Any, queries: Any) -> Any:
        network = model.TAPIR(bilinear_interp_with_depthwise_conv=False, pyramid_level=0)
        return network(video=video, is_training=False, query_points=queries, query_chunk_size=64)

    video, points, visible = squares()
    params, state = haiku.transform_with_state(forward).init(
        jax.random.key(0), jnp.zeros((1, 5, 256, 256, 3)), jnp.zeros((1, 3, 3))
    )
    path = tmp_path / "tapir_checkpoint_panning.npy"
    np.save(path, jax.tree.map(np.asarray, {"params": dict(params), "state": dict(state)}), allow_pickle=True)
    found = open_tapir(path)(video, video, points, visible)
    assert found.shape == points.shape and np.isnan(found[:, 3]).all()
