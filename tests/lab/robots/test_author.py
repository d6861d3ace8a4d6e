"""The five robots' URDFs and meshes against the shapes that they are written from."""

import numpy as np
import pytest

from lab.robots.author import authored_files
from xew.sim_warp.robots import ROBOTS, RobotSpec


def triangles_of_stl(content: bytes) -> np.ndarray:
    """[f 12] float32 normals and corners [m] of a binary STL file."""
    return np.frombuffer(content, np.dtype([("numbers", "<f4", 12), ("attribute", "<u2")]), offset=84)["numbers"]


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_authored_files_are_up_to_date(robot: RobotSpec) -> None:
    """Text to the byte, triangles to a picometer: products of matrices are rounded otherwise by another processor's kernels."""
    expected = authored_files(robot.key)
    for path, content in expected.items():
        written = path.read_bytes()
        if path.suffix == ".stl" and len(written) == len(content):
            written, content = (triangles_of_stl(text) for text in (written, content))
            np.testing.assert_allclose(written, content, rtol=0, atol=1e-12, err_msg=path.name)
        else:
            assert written == content, f"{path.name}: run `python -m lab.robots.author`"
    folder = robot.urdf.parent / "meshes" / robot.key
    assert set(folder.iterdir()) | {robot.urdf} == set(expected)
