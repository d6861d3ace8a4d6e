"""torchvision beside a PyTorch of another build: its Python parts, where its compiled operators cannot be loaded.

PyPI's torchvision belongs to PyPI's CUDA build of PyTorch. Beside the CPU build it fails while it is imported, because it
registers shapes for two operators that its library would have defined. Defined here, they let networks such as RAFT, which
use none of them, be imported.
"""

import functools
import importlib.util
import pathlib

import pytest

SCHEMA = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"


@functools.cache
def make_torchvision_importable() -> object:
    """Returns what must stay alive. Skips the caller's module where PyTorch or torchvision is not installed."""
    torch = pytest.importorskip("torch", reason="needs the extra: pip install -e '.[reference]'")
    spec = importlib.util.find_spec("torchvision")
    if spec is None or not spec.submodule_search_locations:
        pytest.skip("needs torchvision, as the installed torch has it", allow_module_level=True)
    library = pathlib.Path(next(iter(spec.submodule_search_locations))) / "_C.so"
    try:
        torch.ops.load_library(library)
        return None
    except OSError:
        operators = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            operators.define(name + SCHEMA)
        return operators
