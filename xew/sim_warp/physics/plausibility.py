"""Is a motion one that could have happened? What soft contacts of a physics engine let pass, this refuses.

Reads  what was recorded of an episode (poses, penetration), the scene, and when a hand should be holding what
Writes the first thing that is implausible, in words, or nothing

To use another limit, change the constants; `python -m xew.sim_warp.inspect --verify` holds accepted episodes to them.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from xew.sim_warp.plan import Hold
from xew.sim_warp.scene import Scene
from xew.sim_warp.stage import TABLE_SIZE, TABLE_TOP

DEEPEST = 0.005
"""How deep an object and anything else may be in each other [m]."""
DEEP_FRAMES = 3
"""For how many frames in a row it may be deeper: a blow passes, a wall that has sunk into a finger stays."""
FARTHEST_CREEP = 0.010
"""How far a held object may slip along the fingers between their closing and their opening [m]."""
BELOW_TABLE = 0.03
"""How far an object's origin may be under the table's top before it has fallen [m]."""


def implausible(
    scene: Scene,
    holds: Sequence[Hold],
    object_pose: np.ndarray,
    penetration: np.ndarray,
    tool_pose: np.ndarray,
    frame_rate: float,
) -> str | None:
    """The first thing that could not have happened, in words; None if all is well.

    Args:
        holds: when a hand should have been holding which object [s].
        object_pose: [t o 7], world.
        penetration: [t o] m.
        tool_pose: [t 2 7] measured, world.
        frame_rate: Hz.
    """
    return _sunk(scene, penetration) or _fallen(scene, object_pose) or _crept(scene, holds, object_pose, tool_pose, frame_rate)


def _sunk(scene: Scene, penetration: np.ndarray) -> str | None:
    windows = np.lib.stride_tricks.sliding_window_view(penetration, min(DEEP_FRAMES + 1, len(penetration)), axis=0)
    lasting = windows.min(-1).max(0)  # the depth that is exceeded for so many frames in a row
    worst = int(np.argmax(lasting))
    if lasting[worst] > DEEPEST:
        return f"the {scene.names[worst]} sank {1000 * lasting[worst]:.0f} mm into something"
    return None


def _fallen(scene: Scene, object_pose: np.ndarray) -> str | None:
    half = np.array(TABLE_SIZE[:2]) / 2
    outside = (np.abs(object_pose[..., :2]) > half).any(-1) | (object_pose[..., 2] < TABLE_TOP - BELOW_TABLE)
    for name, left in zip(scene.names, outside.any(0), strict=True):
        if left:
            return f"the {name} left the table"
    return None


def _crept(
    scene: Scene, holds: Sequence[Hold], object_pose: np.ndarray, tool_pose: np.ndarray, frame_rate: float
) -> str | None:
    for hold in holds:
        index = scene.index(hold.name)
        if scene.objects[index].is_fixed:
            continue
        frames = slice(int(np.ceil(hold.start * frame_rate)), int(hold.end * frame_rate) + 1)
        creep = slip(tool_pose[frames, hold.arm], object_pose[frames, index])
        if creep > FARTHEST_CREEP:
            return f"the {hold.name} crept {1000 * creep:.0f} mm in the {('left', 'right')[hold.arm]} hand"
    return None


def slip(tool_pose: np.ndarray, object_pose: np.ndarray) -> float:
    """How far the point of an object that was between the fingers at first has moved in the hand at most [m].

    Args:
        tool_pose, object_pose: [t 7], world.
    """
    hand, thing = Rotation.from_quat(tool_pose[:, 3:]), Rotation.from_quat(object_pose[:, 3:])
    grasped = thing[0].inv().apply(tool_pose[0, :3] - object_pose[0, :3])
    at = object_pose[:, :3] + thing.apply(grasped)
    in_hand = hand.inv().apply(at - tool_pose[:, :3])
    return float(np.linalg.norm(in_hand - in_hand[0], axis=-1).max())
