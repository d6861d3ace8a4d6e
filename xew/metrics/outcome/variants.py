"""Command variants of a scene, a counterfactual set: what objects do and look like under each, for retrieval.

All are of one scene and robot and begin with the same frame. A process reads each variant once and keeps it for the others,
whose videos `evaluate` grades after one another.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from xew.episode import Record, data_folder, episode_folder, read_pixels, read_record, read_states
from xew.metrics.estimators.images import soften
from xew.metrics.estimators.presence import OTHER_COLOR, SOFTNESS
from xew.metrics.perceptual import lpips_embedding
from xew.protocol import split_fault

INSTANTS = 8
"""Number of frames in which videos are compared by LPIPS. Each of k videos is compared with k others, and 8 frames cost about a
twentieth of a whole video. An object that is dropped or missed stays where it is, so a few instants show it."""
LEAST_SEEN = 16
"""Number of pixels from which on an object is seen."""
MOST = 0.75
"""Share of an object's pixels with its color from which on a video shows it."""
KEPT_SETS = 6
"""Number of sets that a process keeps, as many as threads grade at a time; the features of nine variants take about 40 MB."""


@dataclass(frozen=True, eq=False)
class Variant:
    """One variant as it happened in the simulator."""

    object_pose: np.ndarray
    """[t o 7] as in `States`."""
    object_joint: np.ndarray
    """[t o] rad."""
    given: np.ndarray
    """[h w 3] uint8, the first frame."""
    rgb: np.ndarray
    """[n h w 3] uint8, at the instants."""
    shown: np.ndarray
    """[n h w] int, the body that each pixel shows, -1 for any other."""
    moved: np.ndarray
    """[b] bool, the objects and lids among these bodies that move."""
    robot: np.ndarray
    """[n h w] bool, the robot's mask."""


@dataclass(frozen=True, eq=False)
class CommandVariants:
    """All variants of the commands in one scene, with one robot."""

    folders: tuple[Path, ...]
    frames: int
    """Number of frames that are compared."""
    surfaces: Path | None
    """Folder of points on surfaces, as of `read_truth`."""

    def __len__(self) -> int:
        return len(self.folders)

    @cached_property
    def variants(self) -> tuple[Variant, ...]:
        """What is known of each. Raises EpisodeError if one is damaged."""
        return tuple(_read_variant(folder, self.frames, self.surfaces) for folder in self.folders)

    @cached_property
    def moving(self) -> np.ndarray:
        """[n h w] bool, pixels that show an object under any variant that moves under any, and the robot under none.

        One region for the whole set, so distances from different truths compare. The robot follows the commands whatever they
        cause: a render of it alone would be retrieved where it hides objects.
        """
        moved = np.append(np.any([variant.moved for variant in self.variants], axis=0), False)
        shown = np.any([moved[variant.shown] for variant in self.variants], axis=0)
        return shown & ~np.any([variant.robot for variant in self.variants], axis=0)

    def find_shown(self, video: np.ndarray) -> Variant | None:
        """The variant whose objects end where a video [t h w 3] uint8 shows them; None if it shows them at no variant's places.

        It is the one with the most similar last frame, by squared differences of color in moving regions. Each object that
        moves under any variant must be seen where this one has it: most of these pixels must have the same color in the video.
        """
        region, end = self.moving[-1], _soften(video[self.frames - 1])
        differences = [end - _soften(variant.rgb[-1]) for variant in self.variants]
        nearest = int(np.argmin([np.square(difference[region]).sum() for difference in differences]))
        variant, same = self.variants[nearest], np.abs(differences[nearest]).max(axis=-1) <= OTHER_COLOR
        moved = np.any([other.moved for other in self.variants], axis=0)
        places = [region & (variant.shown[-1] == body) for body in np.flatnonzero(moved)]
        is_shown = all(place.sum() >= LEAST_SEEN and same[place].mean() >= MOST for place in places)
        return variant if region.any() and is_shown else None

    def perceptual_distances(self, video: np.ndarray) -> np.ndarray:
        """LPIPS [v] float32 of a video [t h w 3] uint8 from the truth of each variant, in the moving regions.

        Mean over INSTANTS frames. A truth that ends earlier stands still. Outside of the regions all show the first frame,
        because LPIPS looks far beyond a region, where the robot's motion would say which commands these are.
        """
        truths, described = self._truths
        own = self._describe(video[instants(self.frames)])
        near, beyond = np.square(truths - own[described]), np.square(own[~described])
        total = near.sum(axis=1, dtype=np.float64) + beyond.sum(dtype=np.float64)  # of millions of numbers
        return (total / max(1, self.moving.any(axis=(1, 2)).sum())).astype(np.float32)

    @cached_property
    def _truths(self) -> tuple[np.ndarray, np.ndarray]:
        """Features of all truths, and where [n d] bool they are: elsewhere, as outside of the region, all truths have 0."""
        features = np.stack([self._describe(variant.rgb) for variant in self.variants])
        described = np.any(features != 0, axis=0)
        return features[:, described], described

    def _describe(self, frames: np.ndarray) -> np.ndarray:
        """Features [n d] float32 of the regions of frames [n h w 3] uint8."""
        regions = np.where(self.moving[..., None], frames, self.variants[0].given)
        return np.asarray(lpips_embedding(regions, self.moving))


def find_variants(folder: Path, record: Record, frames: int, surfaces: Path | None) -> tuple[CommandVariants | None, int]:
    """The set that an episode belongs to, and its number in it; None and 0 if its scene has no other commands.

    Args:
        folder, record: of the episode.
        frames, surfaces: as of `CommandVariants`.
    """
    data, (_, base) = data_folder(folder), split_fault(record.seed)
    seeds = sorted(int(path.name) for path in folder.parents[1].iterdir() if path.name.isdigit())
    folders = [episode_folder(data, record.task, seed, record.robot) for seed in seeds if split_fault(seed)[1] == base]
    records = {path: read_record(path) for path in folders if (path / "episode.json").exists()}
    recorded = {path: str(record.hashes) for path, record in records.items() if record.is_recorded}
    if len(recorded) < 2:
        return None, 0
    own = next(number for number, path in enumerate(recorded) if path.samefile(folder))
    return _open_variants(tuple(recorded), tuple(recorded.values()), frames, surfaces), own


def _soften(frame: np.ndarray) -> np.ndarray:
    """A frame [h w 3] uint8 as float32, softened as trackers see it."""
    return soften(frame.astype(np.float32), SOFTNESS)


def instants(frames: int, count: int = INSTANTS) -> np.ndarray:
    """Numbers [count] of frames of a video of so many, equally far apart, the last one among them."""
    return np.round(np.arange(1, count + 1) / count * (frames - 1)).astype(int)


@lru_cache(maxsize=KEPT_SETS)
def _open_variants(folders: tuple[Path, ...], hashes: tuple[str, ...], frames: int, surfaces: Path | None) -> CommandVariants:
    """The set of these folders, whose episodes have these hashes."""
    return CommandVariants(folders, frames, surfaces)


def _read_variant(folder: Path, frames: int, surfaces: Path | None) -> Variant:
    from xew.sim_warp.production.surfaces import read_surfaces  # only here: the metrics load without Warp
    from xew.sim_warp.rendering.surfaces import MOVED

    record = read_record(folder)
    states = read_states(folder, record)
    tracks = read_surfaces(folder, surfaces, states)
    assert tracks is not None, "the shapes of one episode of the scene are known"
    shown = np.minimum(instants(frames), record.frame_count - 1)
    moved = (tracks.displacement[:frames].max(axis=0) > MOVED) & ~tracks.is_robot
    rgb = read_pixels(folder, "rgb", record=record)
    return Variant(
        states.object_pose, states.object_joint, rgb[0], rgb[shown], tracks.shown[shown], moved, states.robot_mask[shown]
    )
