"""The codec of a latent cache: fitted on training episodes and kept, read from weights, or that of the run to adapt."""

import sys
from collections.abc import Sequence

import numpy as np
from tqdm import tqdm

from xew.config import ConfigError
from xew.dataset import Episode
from xew.episode import complete_folder
from xew.model.cache.clips import clip_starts, take_frames
from xew.model.cache.keys import codec_path
from xew.model.codecs.codec import RUN_REMEDY, load_kept_codec
from xew.model.codecs.contract import Codec
from xew.model.settings.parts import Encoding
from xew.model.video.frames import to_model_size
from xew.model.video.pixels import PixelSource, stored_pixels


def load_codec(encoding: Encoding, episodes: Sequence[Episode]) -> Codec:
    """The codec of these episodes: fitted on them, read from the weights that the config names, or that of the run to adapt.

    Raises:
        ConfigError: `latents` has not been run for them, the weights are missing or do not fit, or the codec is damaged.
    """
    if encoding.start_from is None and not encoding.kind.fitted:
        return encoding.kind.prepare(encoding.codec, list)
    path, remedy = codec_path(encoding, episodes), RUN_REMEDY
    if encoding.start_from is None:
        if not path.exists():
            raise ConfigError(f"no codec fitted on {encoding.data} as it is now under {path.parent}; {encoding.remedy}.")
        remedy = f"delete it and {encoding.remedy}"
    return load_kept_codec(encoding.kind, path, remedy)


def prepare_codec(encoding: Encoding, episodes: Sequence[Episode], source: PixelSource = stored_pixels) -> Codec:
    """The codec of these episodes, which is fitted on them and kept where that has not been done."""
    fits = encoding.start_from is None and encoding.kind.fitted
    if not fits or codec_path(encoding, episodes).exists():
        return load_codec(encoding, episodes)
    codec = encoding.kind.prepare(encoding.codec, lambda: _clips_to_fit(encoding, episodes, source))
    with complete_folder(codec_path(encoding, episodes)) as unfinished:
        codec.save(unfinished)
    return codec


def _clips_to_fit(encoding: Encoding, episodes: Sequence[Episode], source: PixelSource) -> list[np.ndarray]:
    """Evenly chosen clips, scene and robot-only, [t h w 3] uint8 at the model's size."""
    clip, count = encoding.inputs.clip, min(len(episodes), encoding.codec.fit_clips // 2)
    chosen = [episodes[i] for i in np.linspace(0, len(episodes) - 1, count).astype(int)]
    clips = []
    for number, (folder, record) in enumerate(tqdm(chosen, desc="fit codec", disable=not sys.stderr.isatty())):
        starts = clip_starts(record.frame_count, clip.frames)
        start = starts[number % len(starts)]
        pixels = source(folder, record, ("rgb", "robot"))
        cut = (take_frames(pixels[name], start, clip.frames) for name in ("rgb", "robot"))
        clips += [to_model_size(video, clip.height, clip.width) for video in cut]
    return clips
