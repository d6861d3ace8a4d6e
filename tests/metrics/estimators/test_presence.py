"""A place that was found is the body's only if it has the body's color and is nothing else that stands there."""

import numpy as np

from xew.metrics.estimators.presence import confirm_tracks

rng = np.random.default_rng(8)
GROUND = np.repeat(np.repeat(rng.integers(120, 200, (12, 16, 3), dtype=np.uint8), 5, axis=0), 5, axis=1)
RED, DARK = (200, 30, 30), (40, 40, 40)


def draw(red: tuple[int, int] | None, dark: tuple[int, int] = (5, 5)) -> np.ndarray:
    """[60 80 3] a red body of 9 x 5 pixels and a dark one beside it, by the columns and rows of their middles."""
    image = GROUND.copy()
    for place, color in ((dark, DARK), (red, RED)):
        if place is not None:
            image[place[1] - 2 : place[1] + 3, place[0] - 4 : place[0] + 5] = color
    return image


def draw_bodies(red: tuple[int, int], dark: tuple[int, int] = (5, 5)) -> np.ndarray:
    """[60 80] int16, 0 the red body, 1 the dark one, -1 the ground."""
    whose = np.full(GROUND.shape[:2], -1, np.int16)
    for number, place in ((1, dark), (0, red)):
        whose[place[1] - 2 : place[1] + 3, place[0] - 4 : place[0] + 5] = number
    return whose


def keeps(prediction: np.ndarray, found: tuple[float, float], true: tuple[int, int] = (40, 30)) -> bool:
    """Is a place that a tracker found for the red body in a frame kept?"""
    points = np.float32([[true]])
    places = np.float32([[found]])
    seen, whose = np.ones((1, 1), bool), draw_bodies(true)[None]
    confirmed = confirm_tracks(places, prediction[None], draw(true)[None], points, seen, whose, np.zeros(1, np.int32))
    assert np.isnan(confirmed).all() or (confirmed == places).all()
    return bool(np.isfinite(confirmed).all())


def test_the_body_is_confirmed_where_it_is() -> None:
    assert keeps(draw((40, 30)), (40, 30)) and keeps(draw((55, 20)), (55, 20)) and keeps(draw((40, 30)), (41.5, 30.5))
    noisy = np.clip(draw((55, 20)) + rng.normal(0, 8, GROUND.shape), 0, 255).astype(np.uint8)
    assert keeps(noisy, (55, 20))


def test_where_it_is_gone_it_is_not_found_by_what_is_round_it() -> None:
    assert not keeps(draw(None), (40, 30)) and not keeps(draw((55, 20)), (40, 30))


def test_another_body_is_not_it() -> None:
    assert not keeps(draw(None, dark=(40, 30)), (40, 30)), "of another color"
    truth = draw((40, 30), dark=(60, 45))
    truth[43:48, 56:65] = RED  # of the same color, and it stands there in the truth too
    prediction = np.where((np.arange(80) < 50)[None, :, None], GROUND, truth)
    whose = draw_bodies((40, 30), dark=(60, 45))[None]
    arguments = prediction[None], truth[None], np.float32([[[40, 30]]]), np.ones((1, 1), bool), whose, np.zeros(1, np.int32)
    assert np.isnan(confirm_tracks(np.float32([[[60, 45]]]), *arguments)).all()


def test_what_was_lost_stays_lost_and_hidden_points_are_left_alone() -> None:
    found = np.float32([[[np.nan, np.nan], [3, 3]]])
    points, seen = np.float32([[[40, 30], [40, 30]]]), np.array([[True, False]])
    frame = draw((40, 30))[None]
    confirmed = confirm_tracks(found, frame, frame, points, seen, draw_bodies((40, 30))[None], np.zeros(2, np.int32))
    np.testing.assert_array_equal(confirmed, found)
