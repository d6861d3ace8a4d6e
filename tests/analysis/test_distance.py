"""Distances between robots: the published kinematic matrix from our URDFs, and what descriptors must respect."""

import subprocess
import sys
from itertools import combinations

import cv2
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from xew.analysis.distance import appearance_descriptor, chamfer, cosine_distance, mean_distances, workspace_cloud
from xew.protocol import ROBOT_NAMES
from xew.sim_warp.robots import ROBOTS

PUBLISHED = {
    ("aloha_agilex", "arx_x5"): (0.195, 0.0054),
    ("aloha_agilex", "ur5_wsg"): (0.123, 0.0037),
    ("aloha_agilex", "franka_panda"): (0.111, 0.0033),
    ("aloha_agilex", "piper"): (0.147, 0.0039),
    ("arx_x5", "ur5_wsg"): (0.059, 0.0014),
    ("arx_x5", "franka_panda"): (0.094, 0.0032),
    ("arx_x5", "piper"): (0.034, 0.0008),
    ("ur5_wsg", "franka_panda"): (0.053, 0.0014),
    ("ur5_wsg", "piper"): (0.046, 0.0010),
    ("franka_panda", "piper"): (0.070, 0.0028),
}
"""Metres, and the standard deviation of one draw of the cloud over 100 seeds."""

rng = np.random.default_rng(0)


@pytest.fixture(scope="module")
def clouds() -> dict[str, list[np.ndarray]]:
    return {name: [workspace_cloud(ROBOTS[name], seed) for seed in range(8)] for name in ROBOT_NAMES}


@pytest.mark.parametrize("pair", list(combinations(ROBOT_NAMES, 2)), ids="-".join)
def test_kinematic_distances_are_the_published_ones(pair: tuple[str, str], clouds: dict[str, list[np.ndarray]]) -> None:
    published, deviation = PUBLISHED[pair]
    drawn = [chamfer(a, b) for a, b in zip(clouds[pair[0]], clouds[pair[1]], strict=True)]
    # The published value is itself one draw, rounded to a millimetre.
    assert np.mean(drawn) == pytest.approx(published, abs=2 * deviation + 0.0005)


def test_clouds_are_reproducible_and_differ_by_seed(clouds: dict[str, list[np.ndarray]]) -> None:
    again = workspace_cloud(ROBOTS["piper"], 3)
    np.testing.assert_array_equal(again, clouds["piper"][3])
    assert again.shape == (4000, 3) and np.abs(again - clouds["piper"][4]).max() > 0


def test_chamfer_equals_brute_force_and_is_a_distance() -> None:
    a, b = rng.normal(size=(40, 3)), rng.normal(size=(55, 3))
    table = cdist(a, b)
    assert chamfer(a, b) == pytest.approx((table.min(1).mean() + table.min(0).mean()) / 2)
    assert chamfer(a, b) == chamfer(b, a) and chamfer(a, a) == 0
    assert chamfer(a, a + [0.001, 0, 0]) == pytest.approx(0.001, rel=1e-6)


def robot_picture(
    colour: tuple[int, int, int], length: int = 50, angle: float = 30, place: tuple[int, int] = (80, 60)
) -> np.ndarray:
    image = np.full((120, 160, 3), 255, np.uint8)
    box = cv2.boxPoints((place, (length, 14), 30))
    return cv2.fillPoly(image, [box.astype(np.int32)], colour)


def test_a_descriptor_sees_colour_and_shape_but_not_place() -> None:
    base = appearance_descriptor(robot_picture((200, 40, 40))[None])
    assert base.shape == (16 * 16 + 7,) and base[:256].sum() == pytest.approx(1)
    moved = appearance_descriptor(robot_picture((200, 40, 40), place=(60, 50))[None])
    blue = appearance_descriptor(robot_picture((40, 40, 200))[None])
    longer = appearance_descriptor(robot_picture((200, 40, 40), length=110)[None])
    near = cosine_distance(base, moved)
    assert near < 1e-3 and cosine_distance(base, blue) > 2 * near and cosine_distance(base, longer) > 2 * near
    assert cosine_distance(base, base) == pytest.approx(0, abs=1e-12)


def test_views_are_averaged_and_an_empty_one_is_an_error() -> None:
    views = np.stack([robot_picture((200, 40, 40)), robot_picture((40, 90, 40), length=90)])
    each = [appearance_descriptor(view[None]) for view in views]
    np.testing.assert_allclose(appearance_descriptor(views), np.mean(each, axis=0))
    with pytest.raises(ValueError, match="view 1 shows no robot"):
        appearance_descriptor(np.stack([views[0], np.full_like(views[0], 255)]))


def test_the_mean_distance_leaves_out_the_robot_itself() -> None:
    np.testing.assert_allclose(mean_distances([[0, 1, 2], [1, 0, 3], [2, 3, 0]]), [1.5, 2, 2.5])


def test_analysis_needs_neither_jax_nor_warp() -> None:
    code = "import sys, xew.analysis.report, xew.analysis.distance; print(sorted({'jax', 'warp', 'newton'} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
