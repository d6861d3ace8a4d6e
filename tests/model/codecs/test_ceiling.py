"""The codec's ceiling is what the study's metrics say of its reconstruction."""

import numpy as np
import pytest

from tests.networks import TINY_CODEC
from xew.metrics import psnr
from xew.model.codecs.autoencoders import ConvAutoencoderCodec
from xew.model.codecs.ceiling import choose_evenly, measure_ceiling
from xew.model.codecs.contract import CodecSettings
from xew.model.video.frames import to_camera_size, to_model_size


def picture(seed: int) -> np.ndarray:
    """A smooth picture uint8 [1 240 320 3]."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:240, :320]
    waves = [np.sin(rng.uniform(-0.1, 0.1) * x + rng.uniform(-0.1, 0.1) * y) for _ in range(3)]
    return (127 + 100 * np.stack(waves, -1)).astype(np.uint8)[None]


def test_ceiling() -> None:
    videos = [np.repeat(picture(seed), frames, 0) for seed, frames in ((0, 3), (1, 9))]
    codec = ConvAutoencoderCodec.open(CodecSettings(weights=TINY_CODEC))
    ceiling = measure_ceiling(codec, ((video, None, None) for video in videos), 5, 48, 64)
    decoded = [to_camera_size(codec.decode(codec.encode(to_model_size(video[[0] * 5], 48, 64)))) for video in videos]
    expected = [np.mean(psnr(made[:n], video[:n])) for made, video, n in zip(decoded, videos, (3, 5), strict=True)]
    assert ceiling.clips == 2
    assert ceiling.psnr == pytest.approx(np.mean(expected), abs=1e-3)
    assert 0 < ceiling.lpips < 1


def test_spread_takes_evenly() -> None:
    assert choose_evenly(range(10), 4) == [0, 3, 6, 9]
    assert choose_evenly("abc", 8) == ["a", "b", "c"]
