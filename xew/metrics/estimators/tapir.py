"""TAPIR and BootsTAPIR as trackers: the offline networks of DeepMind's `tapnet`, in JAX.

Code and weights are Apache-2.0 and are not included: install the package `tapnet` and bring a checkpoint. The true points start
the tracks, at the frame where most are visible.
"""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import jax
import numpy as np
from PIL import Image

from xew.config import ConfigError
from xew.metrics.estimators.adapters import PointTracker, import_package
from xew.metrics.networks.pickles import first_line, read_arrays

SIDE = 256
"""Side [pixels] of the square for which the networks were trained."""
CHUNK = 64
INSTALL = "install it from the sources of github.com/google-deepmind/tapnet, with all that they ask for (it is not on PyPI)"
TAPIR = {"bilinear_interp_with_depthwise_conv": False, "pyramid_level": 0}
BOOTSTAPIR = {
    "bilinear_interp_with_depthwise_conv": False, "pyramid_level": 1, "extra_convs": True, "softmax_temperature": 10.0
}  # fmt: skip
"""Options by which the authors build BootsTAPIR (TAPIR above); it is known by its extra convolutions."""
ADMITTED = {
    *((f"numpy.{core}.multiarray", name) for core in ("core", "_core") for name in ("_reconstruct", "scalar")),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("collections", "OrderedDict"),
}
"""Names that a checkpoint may call, and no others: what arrays and dictionaries are made of."""


def open_tapir(checkpoint: Path) -> "Tapir":
    """TAPIR or BootsTAPIR from a local .npy of the authors, on JAX's default device.

    Raises:
        ConfigError: the package `tapnet` is absent, or the file is damaged, of another network, or holds more than arrays.
    """
    content = read_checkpoint(checkpoint)
    model = import_package("tapnet.models.tapir_model", "TAPIR", INSTALL)
    options = BOOTSTAPIR if any("extra_convs" in name for name in content["params"]) else TAPIR
    return Tapir(model.ParameterizedTAPIR, content["params"], content["state"], options)


class Tapir(PointTracker):
    """The tracker: see `xew.metrics.backends.Tracker`. Points that are more likely hidden or off than not are lost."""

    def __init__(self, network: Any, params: Any, state: Any, options: Mapping[str, Any]) -> None:
        self._weights = jax.device_put((params, state))
        self._run = jax.jit(functools.partial(_run, network, dict(options)))

    def follow(self, video: np.ndarray, frames: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Tracks [t n 2] and where they hold [t n], of points [n 2] given at frames [n] of a video [t h w 3] uint8."""
        scale = SIDE / np.array(video.shape[2:0:-1], np.float32)  # of x and y
        # Its pixels' centers are at halves, ours at whole numbers.
        x, y = ((points + 0.5) * scale).T
        queries = np.column_stack([frames, y, x]).astype(np.float32)
        tracks, seen = (np.asarray(array) for array in self._run(self._weights, _resize(video), queries))
        return (tracks / scale - 0.5).swapaxes(0, 1), seen.swapaxes(0, 1)


def _run(
    network: Any, options: dict[str, Any], weights: tuple[Any, Any], video: jax.Array, queries: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Tracks [k t 2] (x, y in the network's pixels) and where they hold [k t], of a video uint8 [t h w 3] and [k 3] t, y, x."""
    signed = video.astype("float32") / 127.5 - 1
    output = network(*weights, options)(
        video=signed[None], is_training=False, query_points=queries[None], query_chunk_size=CHUNK
    )
    visible, near = (jax.nn.sigmoid(-output[name][0]) for name in ("occlusion", "expected_dist"))
    return output["tracks"][0], visible * near > 0.5


def _resize(video: np.ndarray) -> np.ndarray:
    return np.stack([np.asarray(Image.fromarray(frame).resize((SIDE, SIDE))) for frame in video])


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The trees `params` and `state` of a checkpoint, which is a dictionary in a NumPy file, so a pickle.

    Raises:
        ConfigError: the file is something else, or asks for anything but arrays.
    """
    expected = "expected tapir_checkpoint_panning.npy or bootstapir_checkpoint_v2.npy"
    if "causal" in path.name:
        raise ConfigError(f"{path} is a causal network, which sees no whole video; {expected}.")
    try:
        with path.open("rb") as file:
            content = _read_object(file)
    except Exception as error:  # NumPy raises many types for damaged headers
        raise ConfigError(f"{path} is no checkpoint of TAPIR ({first_line(error)}); {expected}.") from error
    if not isinstance(content, dict) or not all(isinstance(content.get(part), Mapping) for part in ("params", "state")):
        raise ConfigError(f"{path} lacks the parameters of TAPIR (`params`, `state`); {expected}.")
    return content


def _read_object(file: IO[bytes]) -> Any:
    """The one object of a .npy file."""
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError("it is of another version of .npy")
    shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    if shape != () or not dtype.hasobject:
        raise ValueError(f"it holds {dtype} {shape}, not one dictionary")
    return read_arrays(file, ADMITTED).item()
