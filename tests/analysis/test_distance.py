"""Distances between robots: the published kinematic matrix from our URDFs, and what descriptors must respect."""

import subprocess
import sys
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from xew.analysis.distance import (
    Features,
    appearance_descriptor,
    appearance_matrix,
    chamfer,
    chamfer_floor,
    chamfer_matrix,
    cosine_distance,
    measure,
    perceptual_matrices,
    workspace,
    workspace_cloud,
)
from xew.analysis.distances.appearance import describe_views, descriptor_matrix
from xew.protocol import ROBOT_NAMES
from xew.sim_warp.robots import ROBOTS, UrdfError, load_urdf

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
"""Meters, and the standard deviation of one draw of the cloud over 100 seeds."""

rng = np.random.default_rng(0)


PUBLISHED_FEATURES = {
    "aloha_agilex": (6, 54, 1.644, 0.016, 1.430, 0.023),
    "arx_x5": (6, 11, 0.802, 0.009, 1.112, 0.026),
    "ur5_wsg": (6, 18, 1.084, 0.006, 2.667, 0.042),
    "franka_panda": (7, 14, 1.257, 0.004, 2.627, 0.029),
    "piper": (6, 11, 0.882, 0.003, 1.327, 0.018),
}
"""Joints and links as published; reach [m] and hull [m3] with the deviation of one draw, of an independent reproduction from
RoboTwin's own URDFs. All but two hulls (Aloha 1.374, UR5 2.771) are then within two deviations of the published."""


@pytest.fixture(scope="module")
def features() -> Features:
    return measure(ROBOTS, range(8), workers=1)


@pytest.mark.parametrize("pair", list(combinations(ROBOT_NAMES, 2)), ids="-".join)
def test_kinematic_distances_are_the_published_ones(pair: tuple[str, str], features: Features) -> None:
    published, deviation = PUBLISHED[pair]
    a, b = (features.robots.index(name) for name in pair)
    # The published value is itself one draw, rounded to a millimeter.
    assert features.kinematic[:, a, b].mean() == pytest.approx(published, abs=2 * deviation + 0.0005)


@pytest.mark.parametrize("robot", ROBOT_NAMES)
def test_features_are_those_of_the_robots(robot: str, features: Features) -> None:
    dof, links, reach, reach_deviation, volume, volume_deviation = PUBLISHED_FEATURES[robot]
    i = features.robots.index(robot)
    assert (features.dof[i], features.links[i]) == (dof, links)
    assert features.reach[:, i].mean() == pytest.approx(reach, abs=reach_deviation)
    assert features.volume[:, i].mean() == pytest.approx(volume, abs=volume_deviation)


def test_clouds_are_reproducible_and_differ_by_seed(features: Features) -> None:
    piper, panda = ROBOTS["piper"], ROBOTS["franka_panda"]
    first, other = workspace_cloud(piper, 3), workspace_cloud(piper, 4)
    np.testing.assert_array_equal(first, workspace_cloud(piper, 3))
    assert first.shape == (4000, 3) and np.abs(first - other).max() > 0
    between = features.kinematic[3, features.robots.index("piper"), features.robots.index("franka_panda")]
    assert between == pytest.approx(chamfer(first, workspace_cloud(panda, 3)))
    np.testing.assert_array_equal(features.kinematic, features.kinematic.transpose(0, 2, 1))


STICK = """<robot name="stick">
  <link name="floor"/> <link name="base"/> <link name="upper"/> <link name="lower"/> <link name="slide"/> <link name="lamp"/>
  <joint name="stand" type="fixed"><parent link="floor"/><child link="base"/><origin xyz="0 0 {height}"/></joint>
  <joint name="turn" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit lower="-3.1" upper="3.1" effort="1" velocity="1"/></joint>
  <joint name="bend" type="continuous"><parent link="upper"/><child link="lower"/><origin xyz="0.5 0 0"/><axis xyz="0 1 0"/>
  </joint>
  <joint name="finger" type="prismatic"><parent link="lower"/><child link="slide"/><origin xyz="0.3 0 0"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>
  <joint name="glow" type="revolute"><parent link="floor"/><child link="lamp"/><origin xyz="0 2 0"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""
"""An arm of 0.5 and 0.3 m on a stand, with one finger and a lamp beside it."""


def stick(folder: Path, height: float) -> Path:
    path = folder / f"stick_{height:g}.urdf"
    path.write_text(STICK.format(height=height))
    return path


def test_any_urdf_has_a_workspace(tmp_path: Path) -> None:
    low, high = (load_urdf(stick(tmp_path, height)) for height in (0, 1))
    found = workspace(low)
    # The arm's longest chain is sampled; the finger stays in, and the lamp, which does not move, where it is.
    assert found.reach == pytest.approx(2) and workspace(low, frame="arm_alone").reach == pytest.approx(0.8, abs=1e-3)
    assert workspace(high).reach == pytest.approx(2) and workspace(high, frame="arm_alone").reach < 0.8001
    np.testing.assert_allclose(workspace_cloud(high, 1, "arm_alone"), workspace_cloud(low, 1, "arm_alone"), atol=1e-12)
    # A torus of 0.3 m round a circle of 0.5 m, at whose hull points are dense.
    turned = np.pi**2 * 0.5 * 0.3**2 + 2 * np.pi * 0.3 * 0.5**2
    assert workspace(low, frame="arm_alone").volume == pytest.approx(turned, rel=0.15)
    between = measure({"low": low, "high": high}, range(2), "arm_alone")
    assert between.kinematic.max() < 1e-12 and between.dof.tolist() == [2, 2] and between.links.tolist() == [6, 6]
    assert measure({"low": low, "high": high}).kinematic.max() > 0.1
    # From the arm's base all other links are seen too: the floor below it, the lamp beside it.
    from_base = workspace(high, frame="arm_base")
    assert from_base.reach == pytest.approx(np.hypot(2, 1)) and len(np.unique(from_base.cloud, axis=0)) > 1000
    np.testing.assert_allclose(workspace_cloud(low, 1, "arm_base"), workspace_cloud(low, 1), atol=1e-12)


def test_a_robot_is_not_at_zero_from_its_own_next_draw() -> None:
    """The floor under all kinematic distances: for single arms a third to two thirds of the published ones."""
    names = ("aloha_agilex", "piper")
    aloha, piper = chamfer_floor({name: ROBOTS[name] for name in names}, range(3)).mean(axis=0)
    assert 0.02 < piper < 0.03, "4,000 points in 1.3 cubic meters"
    assert aloha < 0.012, "most of them are links that do not move"
    again = chamfer_floor({"piper": ROBOTS["piper"]}, range(1))
    assert again.shape == (1, 1) and again[0, 0] == chamfer_floor({"piper": ROBOTS["piper"]})[0, 0]


def test_robots_of_one_draw_share_their_random_numbers() -> None:
    """The page says so: a robot under a second name is at 0 from itself, and a variant nearer than another draw."""
    piper = ROBOTS["piper"]
    distances = measure({"piper": piper, "twin": replace(piper, key="twin")}, range(2), workers=1).kinematic
    assert (distances == 0).all()
    page = (Path(__file__).parents[2] / "docs" / "distances.md").read_text()
    assert "All robots of one draw share their random numbers" in page


def test_a_urdf_without_an_arm_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "stone.urdf"
    path.write_text('<robot name="stone"><link name="stone"/></robot>')
    with pytest.raises(UrdfError, match="no revolute joint"):
        workspace(load_urdf(path))


def test_a_workspace_in_a_plane_has_no_volume(tmp_path: Path) -> None:
    path = tmp_path / "flat.urdf"
    path.write_text(STICK.format(height=0).replace('<axis xyz="0 1 0"/>', '<axis xyz="0 0 1"/>'))
    assert workspace(load_urdf(path)).volume == 0


def test_chamfer_equals_brute_force_and_is_a_distance() -> None:
    a, b = rng.normal(size=(40, 3)), rng.normal(size=(55, 3))
    table = cdist(a, b)
    assert chamfer(a, b) == pytest.approx((table.min(1).mean() + table.min(0).mean()) / 2)
    assert chamfer(a, b) == chamfer(b, a) and chamfer(a, a) == 0
    # Points that occur several times count several times.
    again = np.concatenate([a, a[:7], a[:7]])
    assert chamfer(again, b) == pytest.approx((cdist(again, b).min(1).mean() + table.min(0).mean()) / 2)
    assert chamfer_matrix([a, b, again])[1, 2] == pytest.approx(chamfer(again, b))
    assert chamfer(a, a + [0.001, 0, 0]) == pytest.approx(0.001, rel=1e-6)
    clouds = [rng.normal(size=(30, 3)) for _ in range(5)]
    np.testing.assert_array_equal(chamfer_matrix(clouds, workers=-1), chamfer_matrix(clouds))


def robot_picture(
    color: tuple[int, int, int], length: int = 50, angle: float = 30, place: tuple[int, int] = (80, 60)
) -> np.ndarray:
    image = np.full((120, 160, 3), 255, np.uint8)
    box = cv2.boxPoints((place, (length, 14), 30))
    return cv2.fillPoly(image, [box.astype(np.int32)], color)


def test_a_descriptor_sees_color_and_shape_but_not_place() -> None:
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


def test_matrices_are_of_pairs() -> None:
    robots = [np.stack([robot_picture(color), robot_picture(color, length=90)]) for color in ((200, 40, 40), (40, 90, 40))]
    matrix = appearance_matrix(robots)
    assert matrix.shape == (2, 2) and matrix[0, 0] == 0
    assert matrix[0, 1] == matrix[1, 0] == cosine_distance(*(appearance_descriptor(views) for views in robots))
    described = np.stack([describe_views(views) for views in robots])
    np.testing.assert_array_equal(descriptor_matrix(described[:, 1:]), appearance_matrix([views[1:] for views in robots]))
    by_view = perceptual_matrices(robots, lambda images: images.astype(float).reshape(len(images), -1))
    assert by_view.shape == (2, 2, 2)
    assert by_view[1, 0, 1] == np.square(robots[0][1].astype(float) - robots[1][1]).sum()
    np.testing.assert_array_equal(by_view, by_view.transpose(0, 2, 1))


def test_analysis_needs_neither_jax_nor_warp() -> None:
    code = "import sys, xew.analysis.report, xew.analysis.distance; print(sorted({'jax', 'warp', 'newton'} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
