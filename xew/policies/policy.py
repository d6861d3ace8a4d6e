"""Policies: functions of the last frames and a state that return the next commands.

Those by name are in `registry.py`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from xew.dataset import name_number
from xew.episode import Record
from xew.protocol import ARMS

NOISE = 0.02
"""Standard deviation of the noisy expert's joints [rad]."""


@dataclass(frozen=True)
class State:
    """What a policy is given besides frames; also the `info` of an environment, by name."""

    records: tuple[Record, ...]
    """Headers of the episodes, with robot and instruction."""
    frame: int
    """Number of the last frame."""
    command: np.ndarray
    """[n 16] float32, the command in force at it, in the canonical layout (`xew.protocol`)."""
    joint_pos: np.ndarray
    """[n 16] float32, the joints at it as the simulator measures them; in a world model the command."""
    recorded: np.ndarray
    """[n t 16] float32, the expert's commands of the next chunk, for baselines; the last one is repeated."""


Policy = Callable[[np.ndarray, State], np.ndarray]
"""Function of the last chunk of frames, uint8 [n t h w 3], and the state, that returns the next chunk's commands [n t 16]."""


def expert(frames: np.ndarray, state: State) -> np.ndarray:
    """The recorded commands [n t 16], whatever the frames [n t h w 3] show."""
    return state.recorded


def noisy_expert(frames: np.ndarray, state: State) -> np.ndarray:
    """The recorded commands [n t 16] with normal noise on the joints, which depends on the episode and the frame alone.

    `frames` [n t h w 3] are ignored; joints that a robot does not have stay 0.
    """
    keys = [[name_number(record), state.frame] for record in state.records]
    noise = np.stack([np.random.default_rng(key).normal(0, NOISE, state.recorded.shape[1:]) for key in keys])
    noise[..., [gripper for _, gripper in ARMS]] = 0
    return state.recorded + np.where(state.recorded == 0, 0, noise)
