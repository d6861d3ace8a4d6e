"""What the tests of the simulator share: MuJoCo Warp on the CPU, compiled quickly."""

from collections.abc import Iterator

import pytest
import warp


@pytest.fixture(scope="module")
def quick_kernels() -> Iterator[None]:
    """For tests of MuJoCo Warp: its kernels, a hundred of which step a few frames, are compiled without optimizing them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(warp.config, "optimization_level", 0)
        yield
