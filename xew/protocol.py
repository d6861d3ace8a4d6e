"""Who is held out of what: robots' roles, splits, seed families and the canonical 16-number joint layout.

Plain data after the paper's protocol (section 3 and its appendix); every room may read it, it imports nothing.
"""

from dataclasses import dataclass

ROBOT_NAMES = ("aloha_agilex", "arx_x5", "ur5_wsg", "franka_panda", "piper")
SEEN_ROBOTS = ("aloha_agilex", "arx_x5", "ur5_wsg")
HELD_OUT_ROBOTS = ("franka_panda", "piper")
"""The fixed split: three robots train, two are held out and reported apart, never averaged."""

ACTION_DIM = 16
"""Left arm 7 joints [rad], left gripper, right arm 7 joints [rad], right gripper; grippers 0 closed to 1 open.
Arms of six joints leave their seventh at zero."""
LEFT_ARM, LEFT_GRIPPER, RIGHT_ARM, RIGHT_GRIPPER = slice(0, 7), 7, slice(8, 15), 15
ARMS = ((LEFT_ARM, LEFT_GRIPPER), (RIGHT_ARM, RIGHT_GRIPPER))

FRAME_RATE = 1000 / 60
"""Stored frames a second: one every 15 physics steps of 4 ms."""
TRAIN_SEEDS_PER_TASK = 50
TEST_SEEDS_PER_TASK = 20

TEST_SEED_START = 1_000_000
"""Training seeds count up from 0, test seeds from here, so that no number of either ever meets the other."""


@dataclass(frozen=True)
class Split:
    """Robots that a model trains on and robots that it is asked to render unseen."""

    train_robots: tuple[str, ...]
    held_out_robots: tuple[str, ...]


FIXED = Split(SEEN_ROBOTS, HELD_OUT_ROBOTS)
LOEO = {held_out: Split(tuple(r for r in ROBOT_NAMES if r != held_out), (held_out,)) for held_out in ROBOT_NAMES}
"""Leave-one-embodiment-out: five folds, each named by the robot that it holds out."""
SPLITS = {"fixed": FIXED} | {f"loeo_{robot}": split for robot, split in LOEO.items()}


def seed_split(seed: int) -> str:
    """'train' or 'test', the family that a scene seed belongs to."""
    return "test" if seed >= TEST_SEED_START else "train"
