"""Table, wall and lights: where they are, and that colors survive the way to linear light and back."""

import numpy as np
import pytest

from xew.sim_warp import stage
from xew.sim_warp.geometry.camera import HEAD_CAMERA, project
from xew.sim_warp.stage import LIGHTS, linear_from_srgb, srgb_from_linear, stage_mesh


def of_color(color: tuple[int, int, int]) -> np.ndarray:
    """[k 3] vertices of the stage's triangles of one color."""
    mesh = stage_mesh()
    return mesh.vertices[mesh.triangles[(mesh.colors == color).all(-1)]].reshape(-1, 3)


def test_every_srgb_value_comes_back() -> None:
    values = np.arange(256)
    np.testing.assert_array_equal(srgb_from_linear(linear_from_srgb(values)), values)


def test_linear_light_follows_the_standard() -> None:
    np.testing.assert_allclose(linear_from_srgb(np.array([0, 10, 128, 255])), [0, 0.003035, 0.215861, 1], atol=1e-6)
    assert (np.diff(linear_from_srgb(np.arange(256))) > 0).all()


def test_light_beyond_white_and_below_black_is_clipped() -> None:
    assert srgb_from_linear(np.array([-1.0, 0.0, 1.0, 7.0])).tolist() == [0, 0, 255, 255]


@pytest.mark.parametrize("shape", [(), (3,), (2, 4, 3)])
def test_colors_of_any_shape_keep_it(shape: tuple[int, ...]) -> None:
    assert linear_from_srgb(np.zeros(shape, np.uint8)).shape == shape
    assert srgb_from_linear(np.zeros(shape)).shape == shape and srgb_from_linear(np.zeros(shape)).dtype == np.uint8


def test_the_table_s_top_is_where_things_stand() -> None:
    table = of_color(stage.TABLE_COLOR)
    assert table[:, 2].max() == pytest.approx(stage.TABLE_TOP)
    np.testing.assert_allclose(np.ptp(table[table[:, 2] > stage.TABLE_TOP - 1e-6], axis=0)[:2], stage.TABLE_SIZE[:2], atol=1e-6)
    assert table[:, 2].min() == pytest.approx(0, abs=1e-6), "its legs reach the ground"


def test_the_wall_stands_behind_the_table_and_the_ground_below() -> None:
    wall, ground = of_color(stage.WALL_COLOR), of_color(stage.GROUND_COLOR)
    assert wall[:, 1].min() > stage.TABLE_SIZE[1] / 2
    assert ground[:, 2].max() == pytest.approx(0, abs=1e-6)
    assert np.ptp(ground[:, 0]) == pytest.approx(stage.GROUND_SIZE)


def test_lights_stand_above_the_table_and_shine_down() -> None:
    for light in LIGHTS:
        assert light.direction[2] < 0 and light.intensity > 0
        if light.position is not None:
            assert light.position[2] > stage.TABLE_TOP + 0.5
    assert sum(light.position is None for light in LIGHTS) == 1, "one of them is the sun"


def test_the_two_lamps_mirror_each_other() -> None:
    lamps = [light for light in LIGHTS if light.position is not None]
    mirrored = np.array([-1, 1, 1])
    np.testing.assert_array_equal(np.array(lamps[0].position) * mirrored, lamps[1].position)
    np.testing.assert_array_equal(np.array(lamps[0].direction) * mirrored, lamps[1].direction)
    assert lamps[0].intensity == lamps[1].intensity


def test_the_sun_s_shadow_map_covers_what_the_camera_sees_of_the_table() -> None:
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 25), np.linspace(-0.35, 0.35, 15))
    table = np.stack([x, y, np.full_like(x, stage.TABLE_TOP)], -1)
    pixels, _ = project(HEAD_CAMERA, table)
    seen = ((pixels >= 0) & (pixels <= (319, 239))).all(-1)
    away = np.abs(table[seen] - stage.SHADOW_CENTER).max(0)
    assert seen.sum() > 20 and (away[:2] < stage.SHADOW_WIDTH / 2).all()


def test_the_lit_table_stays_below_white() -> None:
    """Exposure times all that can arrive bends below the ceiling (`compress_highlight`), which is below white."""
    assert stage.KNEE < stage.CEILING < 1
    assert 0 < stage.SKY_SHARE < 1 and stage.AMBIENT * stage.EXPOSURE < stage.KNEE
