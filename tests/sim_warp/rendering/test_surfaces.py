"""Points on surfaces: they go with their bodies, what lies before them hides them, and where few are left more are found."""

from dataclasses import fields, replace

import numpy as np
import pytest

from xew.sim_warp.geometry.camera import HEAD_CAMERA, Camera, project
from xew.sim_warp.geometry.meshes import box
from xew.sim_warp.production.warm_up import stand_at_home
from xew.sim_warp.rendering import surfaces
from xew.sim_warp.rendering.bodies import body_names
from xew.sim_warp.rendering.observe import Recording
from xew.sim_warp.rendering.render import Body, Renderer, World, nearest_pixel
from xew.sim_warp.rendering.surfaces import AIM_OF_ROBOT, AIM_OF_THING, SurfaceTracks, choose_points, track_surfaces
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.stage import TABLE_TOP

RED, BLUE = (200, 45, 40), (50, 90, 190)
CUBE, SCREEN = Body(box((0.05, 0.05, 0.05), RED), False), Body(box((0.3, 0.3, 0.01), BLUE), False)
FRAMES = 3
TURN = (0.0, 0.0, 0.0, 1.0)
UPRIGHT = (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))
"""A quarter turn about y, by which a plate that lies stands upright and shows the camera its edge."""
PLATE = Body(box((0.2, 0.3, 0.002), RED), False)
PIPER = ROBOTS["piper"]
BESIDE = 340
"""Number of pixels by which the image is moved so that it shows little of the robot."""


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer("cpu")


@pytest.fixture(scope="module")
def recording() -> Recording:
    """A cube that moves right by 30 mm a frame, and a screen that comes between it and the camera in the last."""
    poses = np.zeros((FRAMES, 2, 7), np.float32)
    poses[..., 3:] = TURN
    poses[:, 0, :3] = [(0.03 * t, 0.05, TABLE_TOP + 0.03) for t in range(FRAMES)]
    poses[:, 1, :3] = [(0, 0, -5)] * 2 + [(0.06, -0.15, 1.0)]
    return Recording(PIPER, stand_at_home(PIPER, FRAMES), (CUBE, SCREEN), poses)


@pytest.fixture(scope="module")
def tracks(recording: Recording, renderer: Renderer) -> SurfaceTracks:
    return track_surfaces([recording], [("cube", "screen")], renderer)[0]


@pytest.fixture(scope="module")
def edge_on() -> Recording:
    """A plate that is seen edge-on, a pixel wide and 110 pixels high, and moves up by 10 mm a frame."""
    x = HEAD_CAMERA.position[0] - 0.0008  # so that it covers the middle of a column of pixels, and neither side is seen
    poses = np.float32([[[x, 0.1, TABLE_TOP + 0.2 + 0.01 * t, *UPRIGHT]] for t in range(FRAMES)])
    return Recording(PIPER, stand_at_home(PIPER, FRAMES), (PLATE,), poses)


@pytest.fixture
def candidates_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """No frame is filled from a denser set."""
    monkeypatch.setattr(surfaces, "AIM_OF_ROBOT", 0)
    monkeypatch.setattr(surfaces, "AIM_OF_THING", 0)


def of(tracks: SurfaceTracks, name: str) -> np.ndarray:
    return tracks.body == tracks.names.index(name)


def count(tracks: SurfaceTracks, points: np.ndarray) -> np.ndarray:
    """[t] int, how many of some points [p] bool are visible."""
    return tracks.visible[:, points].sum(axis=1)


def assert_same(one: SurfaceTracks, other: SurfaceTracks) -> None:
    for field in fields(SurfaceTracks):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name), err_msg=field.name)


def test_points_go_with_their_body(tracks: SurfaceTracks) -> None:
    own = of(tracks, "cube")
    pixels = tracks.pixels[:, own]
    assert own.sum() >= 8 and tracks.visible[:2, own].sum(axis=1).min() >= 8
    assert (np.diff(pixels[..., 0], axis=0) > 5).all() and np.abs(np.diff(pixels[..., 1], axis=0)).max() < 2
    middle, _ = project(HEAD_CAMERA, np.array([0.0, 0.05, TABLE_TOP + 0.03]))
    assert np.linalg.norm(pixels[0].mean(axis=0) - middle) < 12
    index = tracks.names.index("cube")
    np.testing.assert_allclose(tracks.displacement[:, index], [0, 0.03, 0.06], atol=1e-6)
    np.testing.assert_allclose(tracks.step[:, index], [0, 0.03, 0.03], atol=1e-6)
    assert not tracks.is_robot[index]


def test_pixels_tell_whose_they_are(tracks: SurfaceTracks) -> None:
    """The pixel of every point that is seen shows its body."""
    for t in range(FRAMES):
        seen = tracks.visible[t]
        x, y = np.round(tracks.pixels[t, seen]).astype(int).T
        np.testing.assert_array_equal(tracks.shown[t, y, x], tracks.body[seen])
    assert (tracks.shown[0] == -1).mean() > 0.3 and tracks.shown.max() < len(tracks.names)


def test_another_object_hides_them(tracks: SurfaceTracks) -> None:
    assert not tracks.visible[2, of(tracks, "cube")].any()
    assert tracks.visible[2, of(tracks, "screen")].sum() >= 8
    assert not tracks.visible[:2, of(tracks, "screen")].any(), "the ground hides it"


def test_its_own_body_hides_the_far_side(renderer: Renderer) -> None:
    """Of a cube that stands before the camera, points on at most three sides are ever seen."""
    pose = np.float32([[[0.1, 0.0, TABLE_TOP + 0.03, *TURN]]])
    seen = track_surfaces([Recording(PIPER, stand_at_home(PIPER, 1), (CUBE,), pose)], [("cube",)], renderer)[0]
    kept = of(seen, "cube")
    assert seen.visible[0, kept].all(), "a point that no frame shows is not kept"
    box_of_all, _ = project(HEAD_CAMERA, np.array([0.1, 0.0, TABLE_TOP + 0.005]))
    assert (seen.pixels[0, kept, 1] < box_of_all[1] + 12).all()


def test_robots_have_points_on_what_moves(tracks: SurfaceTracks) -> None:
    bases = {f"{side}/{robot_link}" for side in ("left", "right") for _, robot_link in body_names(PIPER)[:1]}
    names = {name for name, is_robot in zip(tracks.names, tracks.is_robot, strict=True) if is_robot}
    assert names and not names & bases and all(name.startswith(("left/", "right/")) for name in names)
    assert tracks.visible[:, tracks.is_robot[tracks.body]].sum(axis=1).min() >= 8


def test_looking_up_is_what_rendering_says(renderer: Renderer) -> None:
    points = np.array([[[0.0, 0.0, 0.82], [0.3, 0.2, TABLE_TOP], [5.0, 0.0, 0.8]]])
    world = World([CUBE], np.float32([[[0.0, 0.0, 0.78, *TURN]]]), points)
    frames = renderer.render_batch([world])[0]
    (found,) = renderer.probe_batch([world])
    np.testing.assert_array_equal(found.point_body, frames.point_body)
    np.testing.assert_array_equal(found.point_depth, frames.point_depth)
    np.testing.assert_array_equal(found.robot_mask, frames.robot_mask)
    assert found.rgb.size == 0 and found.body.shape == found.depth.shape == frames.robot_mask.shape
    x, y = nearest_pixel(HEAD_CAMERA, points[0, :2]).T
    np.testing.assert_array_equal(found.body[0, y, x], found.point_body[0, :2])
    np.testing.assert_array_equal(found.depth[0, y, x], found.point_depth[0, :2])
    assert renderer.probe_batch([]) == []
    with pytest.raises(ValueError, match="no points"):
        renderer.probe_batch([World([CUBE], world.pose)])


def test_few_points_are_chosen_that_show_in_every_frame() -> None:
    visible = np.array([[1, 1, 0, 0], [1, 0, 1, 0], [0, 0, 0, 0], [1, 1, 1, 0]], bool)
    assert choose_points(visible, 1).tolist() == [0]
    assert choose_points(visible, 2).tolist() == [0, 1, 2]
    assert choose_points(visible[2:3], 3).tolist() == []
    assert choose_points(visible, np.array([0, 2, 5, 0])).tolist() == [0, 2], "as many as each frame wants"


@pytest.mark.usefixtures("candidates_alone")
def test_where_candidates_suffice_nothing_is_added(recording: Recording, tracks: SurfaceTracks, renderer: Renderer) -> None:
    """In the last frame the cube is wholly hidden, which no number of points would change."""
    assert_same(track_surfaces([recording], [("cube", "screen")], renderer)[0], tracks)


def test_a_body_of_which_few_candidates_are_free_gets_points(
    edge_on: Recording, renderer: Renderer, request: pytest.FixtureRequest
) -> None:
    filled = track_surfaces([edge_on], [("plate",)], renderer)[0]
    request.getfixturevalue("candidates_alone")
    plain = track_surfaces([edge_on], [("plate",)], renderer)[0]
    assert count(plain, of(plain, "plate")).max() < AIM_OF_THING <= count(filled, of(filled, "plate")).min()
    kept = len(plain.body)
    assert (filled.body[kept:] == filled.names.index("plate")).all() and len(filled.body) < kept + 2 * AIM_OF_THING
    cut = {"pixels": filled.pixels[:, :kept], "visible": filled.visible[:, :kept], "body": filled.body[:kept]}
    cut |= {"local": filled.local[:kept]}
    assert_same(replace(filled, **cut), plain)
    x, y = np.round(filled.pixels[filled.visible]).astype(int).T
    frame, point = np.nonzero(filled.visible)
    np.testing.assert_array_equal(filled.shown[frame, y, x], filled.body[point], err_msg="added points are seen, too")


def test_what_rests_or_hardly_shows_is_not_filled(
    edge_on: Recording, renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Points on what never moves are in no score; on a sliver most that lies round a point is something else."""
    assert edge_on.thing_pose is not None
    at_rest = replace(edge_on, thing_pose=np.repeat(edge_on.thing_pose[:1], FRAMES, axis=0))
    found = track_surfaces([at_rest], [("plate",)], renderer)[0]
    assert count(found, of(found, "plate")).max() < AIM_OF_THING
    monkeypatch.setattr(surfaces, "LEAST_SHOWN", np.sum(found.shown == found.names.index("plate"), axis=(1, 2)).max() + 20)
    hardly = track_surfaces([edge_on], [("plate",)], renderer)[0]
    assert count(hardly, of(hardly, "plate")).max() < AIM_OF_THING


def test_a_robot_at_the_image_border_has_points(renderer: Renderer, request: pytest.FixtureRequest) -> None:
    """The camera is turned away so far that it sees little more than a hand."""
    intrinsics = HEAD_CAMERA.intrinsics.copy()
    intrinsics[0, 2] += BESIDE
    camera = Camera(intrinsics, HEAD_CAMERA.extrinsics)
    alone = Recording(PIPER, stand_at_home(PIPER, 1))
    filled = track_surfaces([alone], [()], renderer, camera)[0]
    request.getfixturevalue("candidates_alone")
    plain = track_surfaces([alone], [()], renderer, camera)[0]
    assert 0 < plain.visible.sum() < AIM_OF_ROBOT == filled.visible.sum()


def test_tracks_do_not_depend_on_the_batch(
    recording: Recording, tracks: SurfaceTracks, edge_on: Recording, renderer: Renderer
) -> None:
    """Nor on what was tracked before."""
    names = [("plate",), ("cube", "screen")]
    together = track_surfaces([edge_on, recording], names, renderer)
    assert_same(together[0], track_surfaces([edge_on], names[:1], renderer)[0])
    assert_same(together[1], tracks)
