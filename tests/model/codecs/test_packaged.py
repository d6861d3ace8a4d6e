"""The codec that comes with the package: the file that the docs describe, and what it leaves of a drawn scene."""

from pathlib import Path

import cv2
import numpy as np

from xew.files import file_digest
from xew.metrics import psnr
from xew.model.codecs.autoencoders import PACKAGED_WEIGHTS, ConvAutoencoderCodec
from xew.model.codecs.ceiling import reconstruct
from xew.model.codecs.contract import CodecSettings

DOCS = Path(__file__).parents[3] / "docs" / "codec.md"
MOST_BYTES = 20e6


def draw_scene(frames: int) -> np.ndarray:
    """A white table below a wall, a green box and a dark arm that moves right: [t 240 320 3] uint8."""
    video = np.full((frames, 240, 320, 3), 232, np.uint8)
    video[:, :20] = (178, 158, 157)
    for time, frame in enumerate(video):
        cv2.rectangle(frame, (240, 70), (270, 100), (40, 140, 50), -1)
        arm = np.array([(30, 239), (100 + 2 * time, 120), (130 + 2 * time, 130), (80, 239)])
        cv2.fillPoly(frame, [arm], (45, 45, 48), cv2.LINE_AA)
    return video


def test_the_file_is_the_one_that_the_docs_describe() -> None:
    assert file_digest(PACKAGED_WEIGHTS) in DOCS.read_text()
    assert PACKAGED_WEIGHTS.stat().st_size < MOST_BYTES


def test_a_config_that_names_no_weights_gets_it_and_it_renders_a_scene() -> None:
    codec = ConvAutoencoderCodec.open(CodecSettings())
    video = draw_scene(5)
    decoded = reconstruct(codec, video, 5, 256, 320)
    frozen = np.repeat(video[:1], 5, axis=0)
    found = float(np.mean(np.asarray(psnr(decoded, video))))
    assert found > 30 and found > float(np.mean(np.asarray(psnr(frozen, video))[1:])) + 5, found
