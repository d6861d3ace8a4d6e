"""Predictors made on purpose: videos that are wrong in a way that every metric should see, or is known to be blind to.

Reads  the true video of an episode, the same seed's with another robot, and the scene rendered with its objects or grippers
       otherwise
Writes predicted videos [t h w 3] uint8; frame 0 is the given frame and stays the truth's
To add one: a function and one line in PREDICTORS.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path

import av
import cv2
import numpy as np

from lab.calibration.perturbations import render_perturbation
from xew.episode import States, read_states, take_pixels
from xew.metrics.grading.grade_episodes import SOFTNESS
from xew.metrics.truth import MOVED
from xew.protocol import ARMS

QUALITY = 34
"""Quantizer (CRF) of the H.264 video that stands for a codec; 23 is x264's default, more is worse. At 28 a video is nearer to
the truth than the softened truth is."""
LATE = (2, 8)
"""Numbers of frames by which the late predictors lag."""
NOISE_SEED = 0
BRIGHTER = 12.0
"""Offset [levels] of what is brighter."""
DARKER = 0.8
CONTRAST = 1.2
TINT = (1.0, 0.9, 0.8)
RECOLORED = (0.4, 0.5, 0.9)
"""Gains of what is darker, of more contrast, tinted, and recolored."""
MIDDLE = 128
"""Level that more contrast leaves as it is."""
GRAIN = 4.0
BLANK_STEP = 5
ASIDE = 60
"""Distance [pixels] of a ghost from what it copies."""
FAILING = 0.2
"""Share of the frames, at the end, in which a task that fails has failed."""
BELOW = -10.0
"""Height [m] to which what is erased is taken, under the ground and out of sight."""


@dataclass(frozen=True)
class Material:
    """What predictors are made of."""

    truth: np.ndarray
    """[t h w 3] uint8, the true video."""
    other_robot: np.ndarray | None = None
    """[t h w 3] uint8, the same seed's true video of another robot; None where there is none."""
    still: np.ndarray | None = None
    """[t h w 3] uint8, the true motion of the robot while all objects stand where they began; None where nothing moves."""
    erased: np.ndarray | None = None
    """[t h w 3] uint8, the same without the objects that move, from the frame on in which they do."""
    failed: np.ndarray | None = None
    """[t h w 3] uint8, the true video whose objects are back where they began in the last fifth of the frames."""
    open_hands: np.ndarray | None = None
    """[t h w 3] uint8, the true video with all grippers open."""
    robot: np.ndarray | None = None
    """[t h w] bool, the robot's true mask."""
    objects: np.ndarray | None = None
    """[t h w] bool, the true mask of all objects."""


def soften(video: np.ndarray, sigma: float = SOFTNESS) -> np.ndarray:
    """A video [t h w 3] uint8 under a Gaussian blur of this standard deviation [pixels]."""
    return np.stack([cv2.GaussianBlur(frame, (0, 0), sigma) for frame in video])


def through_h264(video: np.ndarray, quality: int = QUALITY) -> np.ndarray:
    """What H.264 in YUV 4:2:0 at this quantizer (CRF) leaves of a video [t h w 3] uint8 with even sides."""
    height, width = video.shape[1:3]
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.framerate = width, height, "yuv420p", 17
    # Its macroblock tree is left out, which gives other bytes each time (x264 with assembly, seen on one processor).
    encoder.options = {"crf": str(quality), "preset": "medium", "x264-params": "mbtree=0"}
    encoder.thread_count = 1
    packets = [p for frame in video for p in encoder.encode(av.VideoFrame.from_ndarray(frame, format="rgb24"))]
    packets += encoder.encode()
    decoder = av.CodecContext.create("h264", "r")
    decoder.thread_count = 1
    frames = [frame for packet in [*packets, None] for frame in decoder.decode(packet)]
    return np.stack([take_pixels(frame) for frame in frames])


def delay(video: np.ndarray, frames: int) -> np.ndarray:
    """A video [t h w 3] in which everything happens some frames too late."""
    return video[np.maximum(np.arange(len(video)) - frames, 0)]


def hurry(video: np.ndarray, frames: int) -> np.ndarray:
    """A video [t h w 3] in which everything happens some frames too early."""
    return video[np.minimum(np.arange(len(video)) + frames, len(video) - 1)]


def expose(video: np.ndarray, gain: float | tuple[float, ...] = 1.0, offset: float = 0.0) -> np.ndarray:
    """A video [t h w 3] uint8 with its channels times a gain, or one of each, and an offset [levels]."""
    return np.clip(np.rint(np.asarray(gain, np.float32) * video + np.float32(offset)), 0, 255).astype(np.uint8)


def recolor(video: np.ndarray, mask: np.ndarray | None) -> np.ndarray | None:
    """A video [t h w 3] uint8 whose pixels in a mask [t h w] are bluish; None without a mask."""
    return None if mask is None else np.where(mask[..., None], expose(video, RECOLORED, 20), video)


def flicker(video: np.ndarray) -> np.ndarray:
    """A video [t h w 3] uint8 whose every second frame is brighter."""
    return np.where((np.arange(len(video)) % 2 == 1)[:, None, None, None], expose(video, offset=BRIGHTER), video)


def jitter(video: np.ndarray) -> np.ndarray:
    """A video [t h w 3] whose frames are by turns a pixel to the right and to the left."""
    return np.stack([np.roll(frame, 1 - 2 * (t % 2), axis=1) for t, frame in enumerate(video)])


def haunt(video: np.ndarray, mask: np.ndarray | None) -> np.ndarray | None:
    """A video [t h w 3] with half-transparent copies of what a mask [t h w] shows, to its side; None without a mask."""
    if mask is None:
        return None
    there, copy = np.roll(mask, ASIDE, axis=2), np.roll(video, ASIDE, axis=2)
    return np.where((there & ~mask)[..., None], (video.astype(np.uint16) + copy) // 2, video).astype(np.uint8)


def blank(video: np.ndarray) -> np.ndarray:
    """A video [t h w 3] uint8 whose every fifth frame is gray."""
    return np.where((np.arange(len(video)) % BLANK_STEP == 0)[:, None, None, None], np.uint8(128), video)


def add_grain(video: np.ndarray) -> np.ndarray:
    """A video [t h w 3] uint8 with Gaussian noise of GRAIN levels, the same every time."""
    rng = np.random.Generator(np.random.Philox(key=NOISE_SEED))
    return np.clip(np.rint(video + rng.normal(0, GRAIN, video.shape)), 0, 255).astype(np.uint8)


def shuffle(video: np.ndarray) -> np.ndarray:
    """The frames of a video [t h w 3] after the first in another order, the same every time."""
    order = np.random.Generator(np.random.Philox(key=NOISE_SEED)).permutation(np.arange(1, len(video)))
    return video[np.concatenate([[0], order])]


def paint(video: np.ndarray, level: int) -> np.ndarray:
    """A gray video of the shape of another [t h w 3] uint8; 0 is black."""
    return np.full_like(video, level)


def scatter(video: np.ndarray) -> np.ndarray:
    """Uniform noise of the shape of a video [t h w 3] uint8."""
    rng = np.random.Generator(np.random.Philox(key=NOISE_SEED))
    return rng.integers(0, 256, video.shape, dtype=np.uint8)


PREDICTORS: dict[str, Callable[[Material], np.ndarray | None]] = {
    "truth": lambda m: soften(m.truth),
    "codec": lambda m: through_h264(m.truth),
    "blur": lambda m: soften(m.truth, 2 * SOFTNESS),
    "grain": lambda m: add_grain(m.truth),
    "brighter": lambda m: expose(m.truth, offset=BRIGHTER),
    "darker": lambda m: expose(m.truth, DARKER),
    "contrast": lambda m: expose(m.truth, CONTRAST, MIDDLE * (1 - CONTRAST)),
    "tinted": lambda m: expose(m.truth, TINT),
    "robot recolored": lambda m: recolor(m.truth, m.robot),
    "object recolored": lambda m: recolor(m.truth, m.objects),
    "flicker": lambda m: flicker(m.truth),
    "jitter": lambda m: jitter(m.truth),
    "ghost": lambda m: haunt(m.truth, m.robot),
    "every 5th blank": lambda m: blank(m.truth),
    "grippers open": lambda m: m.open_hands,
    "fails at the end": lambda m: m.failed,
    "2 frames late": lambda m: delay(m.truth, LATE[0]),
    "8 frames late": lambda m: delay(m.truth, LATE[1]),
    "8 frames early": lambda m: hurry(m.truth, LATE[1]),
    "object at rest": lambda m: m.still,
    "object erased": lambda m: m.erased,
    "other robot": lambda m: m.other_robot,
    "frozen": lambda m: delay(m.truth, len(m.truth)),
    "shuffled": lambda m: shuffle(m.truth),
    "mirrored": lambda m: m.truth[:, :, ::-1],
    "noise": lambda m: scatter(m.truth),
    "black": lambda m: paint(m.truth, 0),
    "gray": lambda m: paint(m.truth, 128),
}
"""Predictors by name, about in the order of how wrong they are; None where an episode has nothing to make one of. The truth is
softened as `evaluate` shows it to its estimators, since no prediction is ever the very video that it is compared with."""


APPEARANCES = ("blur", "grain", "brighter", "darker", "contrast", "tinted", "robot recolored", "object recolored")
"""Names of predictors with the true motion and another appearance."""


def predict(name: str, material: Material) -> np.ndarray | None:
    """The video [t h w 3] uint8 of a predictor, its frame 0 the true one; None where there is none."""
    video = PREDICTORS[name](material)
    return None if video is None else np.concatenate([material.truth[:1], video[1:]])


def hold_objects(states: States) -> States:
    """States in which the objects stay where they began while the robot moves as it did."""
    pose, hinge = (np.repeat(values[:1], len(values), axis=0) for values in (states.object_pose, states.object_joint))
    return replace(states, object_pose=pose, object_joint=hinge)


def erase_objects(states: States) -> States:
    """States in which each object that moves is gone from the frame on in which it has begun to; its lid goes with it."""
    pose = states.object_pose.copy()
    far = np.linalg.norm(pose[..., :3] - pose[:1, :, :3], axis=-1) > MOVED
    turned = np.abs(states.object_joint - states.object_joint[:1]) > MOVED
    begun = np.logical_or.accumulate(far | turned, axis=0)
    pose[..., 2] = np.where(begun, BELOW, pose[..., 2])
    return replace(states, object_pose=pose)


def fail_at_end(states: States) -> States:
    """States whose objects are back where they began in the last FAILING of the frames."""
    pose, hinge = states.object_pose.copy(), states.object_joint.copy()
    last = round(len(pose) * (1 - FAILING))
    pose[last:], hinge[last:] = pose[0], hinge[0]
    return replace(states, object_pose=pose, object_joint=hinge)


def open_grippers(states: States) -> States:
    """States whose grippers are open from frame 1 on."""
    joints = states.joint_pos.copy()
    joints[1:, [gripper for _, gripper in ARMS]] = 1
    return replace(states, joint_pos=joints)


STATES_OF = {
    "still": ("object at rest", hold_objects),
    "erased": ("object erased", erase_objects),
    "failed": ("fails at the end", fail_at_end),
    "open_hands": ("grippers open", open_grippers),
}
"""Videos of `Material` that are rendered from changed states: the predictor that needs each, and the change."""


def render_material(folder: Path, cases: Collection[str]) -> dict[str, np.ndarray]:
    """The videos [t h w 3] of `Material` that are rendered for these predictors.

    Raises:
        EpisodeError: the states of the episode are unknown.
    """
    changes = {name: change for name, (case, change) in STATES_OF.items() if case in cases}
    states = read_states(folder) if changes else None
    return {name: render_perturbation(folder, change(states)).rgb for name, change in changes.items() if states is not None}
