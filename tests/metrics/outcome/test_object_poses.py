"""Poses of bodies from tracked points: motions whose truth is known, seen by a camera that looks down at 45 degrees."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xew.episode import project
from xew.metrics.outcome import poses
from xew.metrics.outcome.poses import Body, Hands, Lens, follow_body

T = 24
INTRINSICS = np.array([[360.0, 0, 159.5], [0, 360.0, 119.5], [0, 0, 1]])
DOWN = Rotation.from_euler("x", 135, degrees=True).as_matrix()
EXTRINSICS = np.eye(4)
EXTRINSICS[:3, :3], EXTRINSICS[:3, 3] = DOWN, DOWN @ [0, 0.7, -0.7]
LOCAL = np.random.default_rng(0).uniform(-0.03, 0.03, (12, 3))
Motion = Callable[[int], np.ndarray]


def pose(x: float = 0, y: float = 0, z: float = 0, turn: tuple[float, ...] = (0, 0, 0)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), (x, y, z)
    return matrix


def rest(t: int) -> np.ndarray:
    return pose()


def slide(t: int) -> np.ndarray:
    return pose(0.004 * t, 0.002 * t, turn=(0, 0, 0.02 * t))


def lift(t: int) -> np.ndarray:
    return pose(z=0.006 * max(t - 4, 0), turn=(0.01 * max(t - 4, 0), 0, 0))


def drop(t: int) -> np.ndarray:
    return lift(t) if t < 16 else pose(z=max(0.0, 0.066 - 0.022 * (t - 15)), turn=(0.11, 0, 0))


def swing(t: int) -> np.ndarray:
    """A lid that turns about an axis along -x at y 0.05."""
    return pose(y=0.05) @ pose(turn=(-0.06 * t, 0, 0)) @ pose(y=-0.05)


def follow(
    motion: Motion, hand: Motion = rest, closed: int = T, lost: slice | None = None, hidden: bool = False, lid: bool = False
) -> np.ndarray:
    """Poses [t 4 4] found of a body; its hand is closed from a frame on, and points are lost from frame 10 on."""
    true = np.stack([motion(t) for t in range(T)])
    world = np.einsum("tij,kj->tki", true[:, :3, :3], LOCAL) + true[:, None, :3, 3]
    tracks = project(world, INTRINSICS, EXTRINSICS)[0] + np.random.default_rng(1).normal(0, 0.5, (T, len(LOCAL), 2))
    if lost is not None:
        tracks[10:, lost] = np.nan
    visible = np.isfinite(tracks).all(axis=-1) if hidden else np.ones(tracks.shape[:2], bool)
    body = Body(true[0], np.array(lid), np.array([0, 0.05, 0]), np.array([-1.0, 0, 0]))
    away = np.stack([pose(9, 9, 9)] * T)
    hands = Hands(np.stack([[hand(t) for t in range(T)], away], axis=1), np.arange(T)[:, None] >= [closed, T])
    lens = Lens(INTRINSICS, np.broadcast_to(EXTRINSICS, (T, 4, 4)))
    return np.asarray(follow_body(tracks, visible, LOCAL, body, hands, lens))


@pytest.mark.parametrize(
    ("case", "given", "millimeters", "degrees"),
    [
        (rest, {}, 1, 1),
        (slide, {}, 4, 3),
        (lift, {"hand": lift, "closed": 3}, 4, 2),
        (lift, {"hand": lift, "closed": 3, "lost": slice(None), "hidden": True}, 4, 2),  # the hand's path is known
        (lift, {"hand": lift, "closed": 3, "lost": slice(6)}, 8, 4),
        (drop, {"hand": lift, "closed": 3}, 12, 4),
        (swing, {"lid": True}, 1, 1),
        (swing, {"lid": True, "lost": slice(6)}, 2, 2),
    ],
)
def test_poses_are_found(case: Motion, given: dict, millimeters: float, degrees: float) -> None:
    found, true = follow(case, **given)[-1], case(T - 1)
    assert 1000 * np.linalg.norm(found[:3, 3] - true[:3, 3]) < millimeters
    turn = Rotation.from_matrix(found[:3, :3].T @ true[:3, :3]).magnitude()
    assert np.degrees(turn) < degrees


def test_a_body_that_is_not_found_stays_while_a_hand_leaves() -> None:
    for closed, hidden in ((T, True), (T, False), (0, False)):
        found = follow(rest, hand=lift, closed=closed, lost=slice(None), hidden=hidden)
        np.testing.assert_allclose(found[-1], np.eye(4), atol=0.02)


def test_few_places_that_look_like_a_body_do_not_move_it() -> None:
    found = follow(slide, lost=slice(7))
    assert np.linalg.norm(found[-1, :3, 3] - found[9, :3, 3]) < 1e-3


def test_a_lid_keeps_its_axis() -> None:
    found = follow(swing, lid=True)
    on_axis = found[:, :3, :3] @ [0.2, 0.05, 0] + found[:, :3, 3]
    np.testing.assert_allclose(on_axis, np.tile([0.2, 0.05, 0], (T, 1)), atol=1e-5)


@pytest.mark.parametrize("anchor", [(np.nan,) * 3, (0.0, 0.05, 0.0)])
@pytest.mark.parametrize("near", [False, True])
def test_derivatives_are_those_of_projected_motions(anchor: tuple[float, ...], near: bool) -> None:
    to_camera = EXTRINSICS.copy()
    to_camera[2, 3] -= 0.95 if near else 0  # then some points are nearer than NEAREST
    seen = poses._Seen(*(jnp.asarray(array, jnp.float32) for array in (np.zeros((12, 2)), LOCAL, INTRINSICS, to_camera)))
    start, pivot = jnp.asarray(slide(3), jnp.float32), jnp.asarray(anchor, jnp.float32)

    def pixels(twist: jax.Array) -> jax.Array:
        moved = poses._move(start, pivot, twist)
        return poses._project(seen, poses._place(seen.extrinsics @ moved, seen.local))

    expected = jax.jacfwd(pixels)(jnp.zeros(6))
    np.testing.assert_allclose(
        poses._slope(seen, start, pivot), expected, rtol=1e-4, atol=1e-5 * float(jnp.abs(expected).max())
    )
