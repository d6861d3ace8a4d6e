"""Stored arrays of other libraries, so parity is tested without installing them.

A test marked `parity` asks `golden(name, compute)` for the reference. `make test` reads it from `tests/golden/NAME.npz`.
`make test-lab` sets XEW_GOLDEN=live: the other library computes it again, it must equal the stored arrays, and the test
compares with it. After a change of a test's inputs, write the files again: XEW_GOLDEN=write python -m pytest -m parity
"""

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parent
MODE = os.environ.get("XEW_GOLDEN", "stored")
"""`stored` reads the files, `live` computes and compares with them, `write` computes and writes them."""
RELATIVE, ABSOLUTE = 1e-4, 2e-5
"""Most by which a live array may differ from the stored one, as of another processor's order of sums."""
assert MODE in ("stored", "live", "write"), f"XEW_GOLDEN is {MODE!r}; use stored, live or write"


def golden(name: str, compute: Callable[[], Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Arrays of another library by name. `compute` imports that library and is called in the modes live and write only."""
    path = FOLDER / f"{name}.npz"
    if MODE == "write":
        np.savez_compressed(path, **compute())
    with np.load(path) as file:
        stored = dict(file)
    if MODE == "stored":
        return stored
    live = {key: np.asarray(array) for key, array in compute().items()}
    assert live.keys() == stored.keys(), f"{path.name} holds {sorted(stored)}, the library gives {sorted(live)}"
    for key, array in live.items():
        np.testing.assert_allclose(array, stored[key], rtol=RELATIVE, atol=ABSOLUTE, err_msg=f"{path.name}: {key}")
    return live
