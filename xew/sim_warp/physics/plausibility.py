"""Plausibility check of a motion: soft contacts of a physics engine let objects sink, fall and creep.

`python -m xew.sim_warp.inspect --verify` applies these limits to accepted episodes.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from xew.sim_warp.plan import Hold
from xew.sim_warp.scene import Scene
from xew.sim_warp.stage import TABLE_SIZE, TABLE_TOP

DEEPEST = 0.005
"""Largest penetration of an object [m]."""
DEEP_FRAMES = 3
"""Number of consecutive frames in which it may be deeper, as in a blow."""
FARTHEST_CREEP = 0.010
"""Largest slip of a held object along the fingers [m]."""
BELOW_TABLE = 0.03
"""Depth of an object's origin below the table's top at which it has fallen [m]."""


def find_implausible(
    scene: Scene,
    holds: Sequence[Hold],
    object_pose: np.ndarray,
    penetration: np.ndarray,
    contact: np.ndarray,
    tool_pose: np.ndarray,
    frame_rate: float,
) -> str | None:
    """The first implausible event in words, or None.

    Args:
        object_pose: [t o 7] xyz [m] and quaternion xyzw, world.
        penetration: [t o] m.
        contact: [t 2 o] bool, contacts of hands and objects.
        tool_pose: [t 2 7] measured, xyz [m] and quaternion xyzw, world.
        frame_rate: Hz.
    """
    return (
        _find_sunk(scene, penetration, contact, frame_rate)
        or _find_fallen(scene, object_pose, frame_rate)
        or _find_crept(scene, holds, object_pose, tool_pose, frame_rate)
    )


def _find_sunk(scene: Scene, penetration: np.ndarray, contact: np.ndarray, frame_rate: float) -> str | None:
    windows = np.lib.stride_tricks.sliding_window_view(penetration, min(DEEP_FRAMES + 1, len(penetration)), axis=0)
    lasting = windows.min(-1).max(0)  # depth exceeded in all frames of a window
    worst = int(np.argmax(lasting))
    if lasting[worst] > DEEPEST:
        frame = int(np.argmax(windows.min(-1)[:, worst]))
        into = _name_partner(scene, worst, penetration[frame], contact[frame])
        return f"the {scene.names[worst]} sank {1000 * lasting[worst]:.0f} mm into {into} at {frame / frame_rate:.1f} s"
    return None


def _name_partner(scene: Scene, index: int, penetration: np.ndarray, contact: np.ndarray) -> str:
    """The object or hand that an object has sunk into, from one frame's penetration [o] m and contact [2 o].

    Depths are recorded per object, not per pair: an object with an equal depth is the partner, else a hand or the table.
    """
    equally = [n for n, depth in enumerate(penetration) if n != index and abs(depth - penetration[index]) < 1e-6]
    if equally:
        return f"the {scene.names[equally[0]]}"
    hands = [f"the {side} hand" for side, touches in zip(("left", "right"), contact[:, index], strict=True) if touches]
    return " or ".join([*hands, "the table"] if hands else ["the table", "an arm"])


def _find_fallen(scene: Scene, object_pose: np.ndarray, frame_rate: float) -> str | None:
    half = np.array(TABLE_SIZE[:2]) / 2
    outside = (np.abs(object_pose[..., :2]) > half).any(-1) | (object_pose[..., 2] < TABLE_TOP + scene.raised - BELOW_TABLE)
    for name, left in zip(scene.names, outside.T, strict=True):
        if left.any():
            return f"the {name} left the table at {np.argmax(left) / frame_rate:.1f} s"
    return None


def _find_crept(
    scene: Scene, holds: Sequence[Hold], object_pose: np.ndarray, tool_pose: np.ndarray, frame_rate: float
) -> str | None:
    for hold in holds:
        index = scene.index(hold.name)
        if scene.objects[index].is_fixed:
            continue
        frames = slice(int(np.ceil(hold.start * frame_rate)), int(hold.end * frame_rate) + 1)
        creep = measure_slip(tool_pose[frames, hold.arm], object_pose[frames, index])
        if creep > FARTHEST_CREEP:
            hand = f"the {('left', 'right')[hold.arm]} hand"
            return f"the {hold.name} crept {1000 * creep:.0f} mm in {hand} from {hold.start:.1f} to {hold.end:.1f} s"
    return None


def measure_slip(tool_pose: np.ndarray, object_pose: np.ndarray) -> float:
    """Largest displacement [m] in the hand of the initially held point, for poses [t 7] xyz [m], quaternion xyzw, world."""
    hand, thing = Rotation.from_quat(tool_pose[:, 3:]), Rotation.from_quat(object_pose[:, 3:])
    grasped = thing[0].inv().apply(tool_pose[0, :3] - object_pose[0, :3])
    at = object_pose[:, :3] + thing.apply(grasped)
    in_hand = hand.inv().apply(at - tool_pose[:, :3])
    return float(np.linalg.norm(in_hand - in_hand[0], axis=-1).max())
