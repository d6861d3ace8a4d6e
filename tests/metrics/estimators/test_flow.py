"""Optical flow of others: DIS against the renderer's exact motion vectors, RAFT against torchvision's own call."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.torch_ops import make_torchvision_importable
from xew.config import ConfigError
from xew.metrics.backends import open_flow
from xew.metrics.estimators.flow import dis_flow, open_raft

STEP = 0.01
"""Motion of every joint of the arms from frame to frame [rad]: 3 pixels on average, 5 at most."""


@pytest.fixture(scope="module")
def moving_robot() -> tuple[np.ndarray, np.ndarray]:
    """Four renders [4 240 320 3] of a robot in steady motion, and its exact motion vectors [3 240 320 2]."""
    from xew.protocol import ARMS
    from xew.sim_warp.rendering.streams import command_streams, home_action
    from xew.sim_warp.robots import get_robot

    robot = get_robot("piper")
    action = np.tile(home_action(robot), (4, 1))
    for sign, (joints, _) in zip((1, -1), ARMS, strict=True):
        action[:, joints.start : joints.start + robot.arm_joint_count] += sign * STEP * np.arange(4)[:, None]
    streams = command_streams(robot, action)
    return streams.render, streams.optical_flow[:-1]


def test_dis_agrees_with_the_exact_motion_vectors(moving_robot: tuple[np.ndarray, np.ndarray]) -> None:
    """On moving pixels its mean end-point error is under 1 pixel, a quarter of that of no motion; a swap of the images, or of
    x and y, doubles it at least."""
    video, exact = moving_robot
    flow = dis_flow(video[:-1], video[1:])
    moving = np.linalg.norm(exact, axis=-1) > 0.5
    error = np.linalg.norm(flow - exact, axis=-1)[moving].mean()
    length = np.linalg.norm(exact, axis=-1)[moving].mean()
    assert moving.sum() > 20_000 and length > 2.5
    assert error < 1.0 and error < 0.3 * length
    for wrong in (dis_flow(video[1:], video[:-1]), flow[..., ::-1]):
        assert np.linalg.norm(wrong - exact, axis=-1)[moving].mean() > 2 * error


def test_dis_carries_texture_by_whole_pixels() -> None:
    image = cv2.resize(np.random.default_rng(0).integers(0, 255, (14, 18, 3), dtype=np.uint8), (90, 70))
    flow = dis_flow(image[None, 10:60, 10:80], image[None, 8:58, 7:77])  # its content moves right by 3 and down by 2
    assert flow.shape == (1, 50, 70, 2) and flow.dtype == np.float32
    np.testing.assert_allclose(np.median(flow, axis=(0, 1, 2)), (3, 2), atol=0.05)


def test_flow_of_no_pairs_is_no_flow() -> None:
    assert dis_flow(np.zeros((0, 20, 30, 3), np.uint8), np.zeros((0, 20, 30, 3), np.uint8)).shape == (0, 20, 30, 2)


@pytest.mark.parametrize(
    "wrong", [np.zeros((1, 20, 30), np.uint8), np.zeros((1, 20, 30, 3)), np.zeros((2, 20, 30, 3), np.uint8)]
)
def test_flow_says_what_it_takes(wrong: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"expected two uint8 \[n h w 3\]"):
        dis_flow(wrong, np.zeros((1, 20, 30, 3), np.uint8))


def test_dis_says_that_frames_are_too_small() -> None:
    with pytest.raises(ValueError, match="at least 12"):
        dis_flow(*np.zeros((2, 1, 8, 30, 3), np.uint8))


@pytest.fixture(scope="module")
def raft_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random raft_small as torchvision publishes its own: a plain state dict."""
    make_torchvision_importable()
    import torch
    from torchvision.models.optical_flow import raft_small

    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("raft") / "raft_small.pth"
    torch.save(raft_small(weights=None).state_dict(), path)
    return path


@pytest.mark.lab
def test_raft_is_torchvisions_network_on_our_frames(raft_file: Path) -> None:
    """One call of the network on images in [-1, 1] gives the same; several pairs do not touch each other."""
    import torch
    from torchvision.models.optical_flow import raft_small

    pairs = np.random.default_rng(0).integers(0, 255, (2, 3, 128, 136, 3), dtype=np.uint8)
    flow = open_flow("raft", raft_file)(*pairs)
    assert flow.shape == (3, 128, 136, 2) and flow.dtype == np.float32
    network = raft_small(weights=None).eval()
    network.load_state_dict(torch.load(raft_file, weights_only=True))
    start, end = (torch.from_numpy(images[1:2].transpose(0, 3, 1, 2) / 255.0 * 2 - 1).float() for images in pairs)
    with torch.no_grad():
        expected = network(start, end)[-1].permute(0, 2, 3, 1).numpy()
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(flow[1:2], expected, atol=1e-3)


@pytest.mark.lab
def test_raft_takes_frames_of_any_size(raft_file: Path) -> None:
    pair = np.random.default_rng(1).integers(0, 255, (2, 1, 61, 75, 3), dtype=np.uint8)
    flow = open_raft(raft_file)(*pair)
    assert flow.shape == (1, 61, 75, 2) and np.isfinite(flow).all()


@pytest.mark.lab
def test_raft_tells_its_large_network_by_its_tensors(tmp_path: Path) -> None:
    make_torchvision_importable()
    import torch
    from torchvision.models.optical_flow import raft_large

    path = tmp_path / "any_name.pth"
    torch.save(raft_large(weights=None).state_dict(), path)
    assert open_raft(path)(*np.zeros((2, 1, 16, 16, 3), np.uint8)).shape == (1, 16, 16, 2)


@pytest.mark.lab
def test_raft_refuses_another_checkpoint(raft_file: Path, tmp_path: Path) -> None:
    import torch

    state = torch.load(raft_file, weights_only=True)
    other, cut, broken = (tmp_path / name for name in ("other.pth", "cut.pth", "broken.pth"))
    torch.save({"weight": torch.zeros(3)}, other)
    torch.save({key: value for key, value in state.items() if not key.startswith("context_encoder")}, cut)
    broken.write_bytes(raft_file.read_bytes()[:1000])
    for path, reason in ((other, "no checkpoint of torchvision's"), (cut, "Missing key"), (broken, "download it again")):
        with pytest.raises(ConfigError, match=reason) as caught:
            open_raft(path)
        assert path.name in str(caught.value)
