"""The codec that comes with the package: the file that the docs describe, and what it leaves of a drawn scene."""

from pathlib import Path

import cv2
import numpy as np

from xew.files import file_digest
from xew.metrics import psnr
from xew.model.codecs.autoencoders import PACKAGED_WEIGHTS, ConvAutoencoderCodec
from xew.model.codecs.ceiling import reconstruct
from xew.model.codecs.contract import CodecSettings
from xew.model.codecs.conv_autoencoder import HEAD_FILE

DOCS = Path(__file__).parents[3] / "docs" / "codec.md"
MOST_BYTES = 22e6


def draw_scene(frames: int, arm: bool = True) -> np.ndarray:
    """A white table below a wall, a green box and, with `arm`, a dark arm that moves right: [t 240 320 3] uint8."""
    video = np.full((frames, 240, 320, 3), 232, np.uint8)
    video[:, :20] = (178, 158, 157)
    for time, frame in enumerate(video):
        cv2.rectangle(frame, (240, 70), (270, 100), (40, 140, 50), -1)
        corners = np.array([(30, 239), (100 + 2 * time, 120), (130 + 2 * time, 130), (80, 239)])
        cv2.fillPoly(frame, [corners] * arm, (45, 45, 48), cv2.LINE_AA)
    return video


def test_the_files_are_those_that_the_docs_describe() -> None:
    files = (PACKAGED_WEIGHTS, PACKAGED_WEIGHTS.with_name(HEAD_FILE))
    assert all(file_digest(file) in DOCS.read_text(encoding="utf-8") for file in files)
    assert sum(file.stat().st_size for file in files) < MOST_BYTES


def test_a_config_that_names_no_weights_gets_it_and_it_renders_a_scene() -> None:
    codec = ConvAutoencoderCodec.open(CodecSettings())
    video = draw_scene(5)
    decoded = reconstruct(codec, video, 5, 256, 320)
    frozen = np.repeat(video[:1], 5, axis=0)
    found = float(np.mean(np.asarray(psnr(decoded, video))))
    assert found > 30 and found > float(np.mean(np.asarray(psnr(frozen, video))[1:])) + 5, found


def test_its_head_draws_the_robot_of_the_render() -> None:
    """The arm of the drawn scene, on white, is the render; the codec alone leaves its edges blurred."""
    codec = ConvAutoencoderCodec.open(CodecSettings())
    video, empty = draw_scene(5), draw_scene(5, arm=False)
    arm = (video != empty).any(axis=-1)
    render = np.where(arm[..., None], video, 255).astype(np.uint8)
    errors = [np.square(reconstruct(codec, video, 5, 256, 320, given).astype(int) - video) for given in (None, render)]
    of_arm, elsewhere = ([10 * np.log10(255**2 / error[where].mean()) for error in errors] for where in (arm, ~arm))
    assert of_arm[1] > of_arm[0] + 3, of_arm
    assert elsewhere[1] > elsewhere[0], elsewhere
