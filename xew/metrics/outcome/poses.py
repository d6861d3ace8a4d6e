"""Poses of objects in a predicted video, from tracked points on their surfaces.

A recursive least-squares fit: in each frame an object is expected where it was, or where a hand that holds it carries it, and
the tracked points correct that. Pixels say little of depth, so it comes from the hand's known path. An object by itself can
slide, and fall once a hand has let it go; a lid can only turn about its hinge. An object that is hidden stays as it was, or
in its hand. One that should be seen but is not found stays as it was: no hand takes it away.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Bool, Float

from xew.metrics.metric import AnyArray

PIXEL = 1.5
"""Standard deviation of tracked points [pixels]; their errors on one object are alike, so it is more than a single point's."""
OUTLIER = 2.0
"""Number of standard deviations from which on a point's distance counts linearly (Huber)."""
SLIDE, SLIP, RISE = 0.005, 0.005, 0.0005
"""Standard deviations of an object's motion in a frame [m]: by itself, in the hand that holds it, and by itself upward where no
hand has taken it."""
SETTLE, FALL = 0.002, 0.5
"""Standard deviation of the vertical motion in a frame of an object that a hand has let go [m], and what each meter over its
first place adds."""
TURN = 0.05
"""Standard deviation of an object's turn in a frame [rad]."""
SWING = 0.1
"""Standard deviation of the turn of a lid in a frame [rad]."""
REACH = 0.2
"""Largest distance [m] between a hand's tool and the origin of an object that it holds."""
FEWEST_FOUND = 0.5
"""Least share of an object's visible points that are found where it is seen at all: few places that happen to look like it are
none."""
CHANGE = 0.5
"""Cost of a change, when an object is taken by a hand or let go, in squared standard deviations."""
NEAREST = 0.05
"""Least depth of a point [m]."""
ITERATIONS = 6
"""Number of Gauss-Newton steps in a frame."""


class Body(NamedTuple):
    """An object or a lid whose pose is estimated."""

    start: Float[AnyArray, "4 4"]
    """Its pose in the first frame, world."""
    hinged: Bool[AnyArray, ""]
    """Whether it is a lid."""
    anchor: Float[AnyArray, "3"]
    """A point of a lid's axis, world [m]."""
    axis: Float[AnyArray, "3"]
    """Direction of a lid's axis, world."""


class Hands(NamedTuple):
    """Both hands, whose paths follow from the commands."""

    pose: Float[AnyArray, "t 2 4 4"]
    """Poses of their tools, world."""
    closing: Bool[AnyArray, "t 2"]
    """Whether each is commanded to be less than open."""


class Lens(NamedTuple):
    """The camera that the video is of."""

    intrinsics: Float[AnyArray, "3 3"]
    extrinsics: Float[AnyArray, "t 4 4"]
    """World to camera [m]."""


class _Seen(NamedTuple):
    """Tracked points in one frame, and the camera that sees them."""

    track: jax.Array
    """[k 2] pixels."""
    local: jax.Array
    """[k 3] m, in the frame of the body."""
    intrinsics: jax.Array
    extrinsics: jax.Array


@jax.jit
def follow_body(
    tracks: Float[AnyArray, "t k 2"],
    visible: Bool[AnyArray, "t k"],
    local: Float[AnyArray, "k 3"],
    body: Body,
    hands: Hands,
    lens: Lens,
) -> Float[jax.Array, "t 4 4"]:
    """Poses of a body in every frame, world.

    Args:
        tracks: tracked points on it [pixels], NaN where lost.
        visible: where each should be seen.
        local: their places in the body's frame [m].
        body, hands, lens: what is known.

    Returns:
        [t 4 4] float32.
    """
    body, hands, lens = jax.tree.map(_in_float32, (body, hands, lens))
    points = _in_float32(local)

    def step(carry: Any, now: Any) -> tuple[Any, jax.Array]:
        pose, mover, before = carry
        track, seen, hand, closing, extrinsics = now
        found = seen & jnp.isfinite(track).all(axis=-1)
        missed = jnp.sum(found, dtype=jnp.float32) < FEWEST_FOUND * jnp.sum(seen, dtype=jnp.float32)
        moved = hand @ jnp.linalg.inv(before)
        seen_points = _Seen(jnp.nan_to_num(track), points, jnp.asarray(lens.intrinsics), extrinsics)
        pose, mover = _follow(seen_points, (moved, before, closing), found & ~missed, missed, pose, mover, body)
        return (pose, mover, hand), pose

    start = body.start, jnp.zeros((), int), hands.pose[0]
    frames = _in_float32(tracks), jnp.asarray(visible), hands.pose, hands.closing, lens.extrinsics
    poses: jax.Array = lax.scan(step, start, frames)[1]
    return poses


def _in_float32(array: AnyArray) -> jax.Array:
    """The same numbers in float32; flags as they are."""
    array = jnp.asarray(array)
    return array if array.dtype == jnp.bool_ else array.astype(jnp.float32)


def _follow(
    points: _Seen,
    hands: tuple[jax.Array, jax.Array, jax.Array],
    found: jax.Array,
    missed: jax.Array,
    pose: jax.Array,
    mover: jax.Array,
    body: Body,
) -> tuple[jax.Array, jax.Array]:
    """The pose of a body in a frame and who moves it, from both in the frame before.

    It is moved by nobody yet (0), the left (1) or the right hand (2), or nobody any more (3).
    """
    moved, hand, closing = hands
    height = jnp.maximum(pose[2, 3] - body.start[2, 3], 0)
    alone = _spread(SLIDE, jnp.where(mover == 0, RISE, SETTLE + FALL * height))
    lid = jnp.zeros((6, 6)).at[:3, 0].set(SWING * body.axis)
    spread = jnp.stack([jnp.where(body.hinged, lid, alone), *[_spread(SLIP, SLIP)] * 2])
    anchor = jnp.where(body.hinged, body.anchor, jnp.nan)
    fit = functools.partial(_fit, points, found, anchor)
    poses, costs = jax.vmap(fit)(jnp.stack([pose, moved[0] @ pose, moved[1] @ pose]), spread)
    near = jnp.linalg.norm(hand[:, :3, 3] - pose[None, :3, 3], axis=-1) < REACH
    possible = jnp.concatenate([jnp.ones(1, bool), closing & near & ~(body.hinged | missed)])
    costs = jnp.where(possible, costs + jnp.where(jnp.arange(3) == mover % 3, 0, CHANGE), jnp.inf)
    best = jnp.argmin(costs)
    return poses[best], jnp.where((best == 0) & (mover > 0), 3, best)


def _spread(sideways: float | jax.Array, upward: float | jax.Array) -> jax.Array:
    """Standard deviations [6 6] of the turn [rad] and motion [m] of a free body in a frame, world, of independent numbers."""
    return jnp.diag(jnp.stack([*[jnp.float32(TURN)] * 3, *[jnp.float32(sideways)] * 2, jnp.float32(upward)]))


def _fit(points: _Seen, found: jax.Array, anchor: jax.Array, pose: jax.Array, spread: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The pose near an expected one that fits the found points best, and its cost in squared standard deviations.

    Args:
        points: on the body.
        found: [k] bool, which of them count.
        anchor: [3] the point that the body turns about; NaN for its origin.
        pose: [4 4] where it is expected.
        spread: [6 6] as of `_spread`.
    """

    def step(state: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], None]:
        pose, deviation = state
        left = _off(points, pose)
        weight = jnp.where(found, 1 / jnp.maximum(jnp.linalg.norm(left, axis=-1) / OUTLIER, 1), 0)
        slope = jnp.einsum("kpi,ij->kpj", _slope(points, pose, anchor), spread) / PIXEL
        weighted = weight[:, None, None] * slope
        normal = jnp.einsum("kpi,kpj->ij", weighted, slope) + jnp.eye(6)
        change = jnp.linalg.solve(normal, jnp.einsum("kpi,kp->i", weighted, left) - deviation)
        return (_move(pose, anchor, spread @ change), deviation + change), None

    (pose, deviation), _ = lax.scan(step, (pose, jnp.zeros(6)), None, ITERATIONS)
    far = jnp.linalg.norm(_off(points, pose), axis=-1)
    huber = jnp.where(far < OUTLIER, far**2, OUTLIER * (2 * far - OUTLIER))
    return pose, jnp.sum(jnp.where(found, huber, 0)) + jnp.sum(deviation**2)


def _off(points: _Seen, pose: jax.Array) -> jax.Array:
    """[k 2] how far the points are from where a pose [4 4] has them, in standard deviations."""
    seen = _place(points.extrinsics @ pose, points.local)
    return (points.track - _project(points, seen)) / PIXEL


def _slope(points: _Seen, pose: jax.Array, anchor: jax.Array) -> jax.Array:
    """Derivatives [k 2 6] of the pixels of points on a body with respect to a twist (`_move`) where it is zero."""
    world = _place(pose, points.local)
    arm = world - _pivot(pose, anchor)[None]
    turned = jnp.cross(jnp.eye(3)[None], arm[:, None])
    moved = jnp.concatenate([turned, jnp.broadcast_to(jnp.eye(3)[None], turned.shape)], axis=1)
    seen = _place(points.extrinsics, world)
    nearing = jnp.where(seen[:, 2:] > NEAREST, _project(points, seen), 0)
    shown = points.intrinsics[None, :2] - nearing[..., None] * points.intrinsics[None, 2:]
    return jnp.einsum("kpc,cw,kiw->kpi", shown / _depth(seen)[..., None], points.extrinsics[:3, :3], moved)


def _place(pose: jax.Array, local: jax.Array) -> jax.Array:
    """Places [k 3] of points in the frame that a pose [4 4] is of."""
    return local @ pose[:3, :3].T + pose[None, :3, 3]


def _project(points: _Seen, seen: jax.Array) -> jax.Array:
    """Pixels [k 2] of places [k 3] m in the camera's frame."""
    return seen @ points.intrinsics[:2].T / _depth(seen)


def _depth(seen: jax.Array) -> jax.Array:
    return jnp.maximum(seen[:, 2:], NEAREST)


def _move(pose: jax.Array, anchor: jax.Array, twist: jax.Array) -> jax.Array:
    """A pose [4 4] turned about an anchor [3], or its origin if that is NaN, and moved: by a twist [6], rad and m, world."""
    pivot = _pivot(pose, anchor)
    turn = Rotation.from_quat(jnp.append(twist[:3] / 2, 1)).as_matrix()  # of small turns, and smooth at none
    place = pivot + turn @ (pose[:3, 3] - pivot) + twist[3:]
    return jnp.eye(4).at[:3, :3].set(turn @ pose[:3, :3]).at[:3, 3].set(place)


def _pivot(pose: jax.Array, anchor: jax.Array) -> jax.Array:
    """The point [3] that a body turns about."""
    return jnp.where(jnp.isnan(anchor), pose[:3, 3], anchor)
