"""SAM 2 as a masker, in both public implementations, on random weights in the formats in which its authors publish."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.synthetic import write_synthetic_data
from tests.torch_ops import make_torchvision_importable
from xew.config import ConfigError
from xew.episode import episode_folder, read_states, read_video
from xew.metrics import mask_iou
from xew.metrics.backends import Masker, identity, open_masker
from xew.metrics.estimators.sam2 import Frames, open_sam2
from xew.metrics.evaluate import Args, main
from xew.rollout import write_rollout

SIDE = 128
PROMPTED = 1
"""The frame with the largest true mask, of three."""

operators = make_torchvision_importable()
torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")
pytestmark = pytest.mark.lab


def tiny_network() -> Any:
    """Hugging Face's SAM 2 at its smallest: 1.5 million random numbers, an object always in sight."""
    backbone = {
        "model_type": "sam2_hiera_det_model", "hidden_size": 16, "blocks_per_stage": [1, 1, 2, 1],
        "embed_dim_per_stage": [16, 32, 64, 128], "global_attention_blocks": [3], "image_size": [SIDE, SIDE],
    }  # fmt: skip
    vision = {
        "model_type": "sam2_vision_model", "backbone_config": backbone, "backbone_channel_list": [128, 64, 32, 16],
        "backbone_feature_sizes": [[SIDE // scale] * 2 for scale in (4, 8, 16)], "fpn_hidden_size": 128,
    }  # fmt: skip
    config = transformers.Sam2VideoConfig(
        image_size=SIDE, vision_config=vision, prompt_encoder_config={"image_size": SIDE, "hidden_size": 128},
        mask_decoder_config={"hidden_size": 128, "mlp_dim": 32, "iou_head_hidden_dim": 32, "num_attention_heads": 2},
        memory_attention_hidden_size=128, memory_attention_num_layers=1, memory_attention_feed_forward_hidden_size=32,
        memory_attention_rope_feat_sizes=[SIDE // 16] * 2, memory_encoder_hidden_size=128, mask_downsampler_embed_dim=128,
        memory_fuser_embed_dim=128, memory_fuser_intermediate_dim=32,
    )  # fmt: skip
    torch.manual_seed(0)
    network = transformers.Sam2VideoModel(config)
    return liven(network, network.mask_decoder.pred_obj_score_head.proj_out.bias)


def liven(network: Any, score_bias: Any) -> Any:
    """Random weights with something to see: the object never counts as gone, and what is remembered weighs in."""
    with torch.no_grad():
        for name, weight in network.named_parameters():
            if "memory_attention" in name or "mask_decoder" in name:
                weight.mul_(3.0) if weight.ndim > 1 else weight
        score_bias.fill_(10.0)
    return network


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.json and model.safetensors."""
    path = tmp_path_factory.mktemp("sam2") / "sam2.1-hiera-tiny"
    tiny_network().save_pretrained(path)
    return path


@pytest.fixture(scope="module")
def video() -> tuple[np.ndarray, np.ndarray]:
    """Three frames of noise and a mask that is largest in the middle."""
    frames = np.random.default_rng(0).integers(0, 255, (3, 48, 64, 3), dtype=np.uint8)
    mask = np.zeros(frames.shape[:3], bool)
    mask[:, 10:20, 10:30] = True
    mask[PROMPTED, 5:25, 5:40] = True
    return frames, mask


@pytest.fixture(scope="module")
def authors_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A .pt of the authors' SAM 2.1 tiny (39 million numbers): their config, random weights."""
    for package in ("hydra", "iopath", "sam2"):
        pytest.importorskip(package, reason="needs the package sam2 with hydra-core and iopath")
    from sam2.build_sam import build_sam2_video_predictor

    torch.manual_seed(0)
    predictor = build_sam2_video_predictor("configs/sam2.1/sam2.1_hiera_t.yaml", None, device="cpu")
    liven(predictor, predictor.sam_mask_decoder.pred_obj_score_head.layers[-1].bias)
    path = tmp_path_factory.mktemp("authors") / "any_name.pt"
    torch.save({"model": predictor.state_dict()}, path)
    return path


@pytest.fixture(scope="module")
def masks(masker: Masker, video: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The masks that a masker gives."""
    frames, mask = video
    return masker(frames, frames, mask)


@pytest.fixture(scope="module", params=["folder", "authors_file"])
def masker(request: pytest.FixtureRequest) -> Masker:
    """Both implementations, the authors' on a smaller image than it was made for: 1 s a video instead of 40 s."""
    path = request.getfixturevalue(request.param)
    return open_masker("sam2", path) if path.is_dir() else open_sam2(path, side=SIDE)


def test_masks_spread_from_the_largest_true_mask(masks: np.ndarray, video: tuple[np.ndarray, np.ndarray]) -> None:
    _, mask = video
    assert masks.shape == mask.shape and masks.dtype == bool
    np.testing.assert_array_equal(masks[PROMPTED], mask[PROMPTED])
    others = np.delete(masks, PROMPTED, axis=0)
    assert others.any() and not others.all(), "random weights ought to find something, and not everything"


def test_both_directions_start_afresh(masker: Masker, masks: np.ndarray, video: tuple[np.ndarray, np.ndarray]) -> None:
    """What comes before the prompted frame changes nothing after it, and the other way round."""
    frames, mask = video
    first, last = frames.copy(), frames.copy()
    first[:PROMPTED], last[PROMPTED + 1 :] = 255 - first[:PROMPTED], 255 - last[PROMPTED + 1 :]
    for changed, same, other in ((first, slice(PROMPTED, None), 0), (last, slice(PROMPTED + 1), -1)):
        again = masker(changed, frames, mask)
        np.testing.assert_array_equal(again[same], masks[same])
        assert (again[other] != masks[other]).any()


def test_without_a_robot_there_is_nothing_to_follow(masker: Masker, video: tuple[np.ndarray, np.ndarray]) -> None:
    frames, mask = video
    assert not masker(frames, frames, np.zeros_like(mask)).any()


def test_a_video_of_one_frame_is_its_prompt(masker: Masker, video: tuple[np.ndarray, np.ndarray]) -> None:
    frames, mask = video
    np.testing.assert_array_equal(masker(frames[:1], frames[:1], mask[:1]), mask[:1])


def test_it_says_what_it_takes(masker: Masker, video: tuple[np.ndarray, np.ndarray]) -> None:
    frames, mask = video
    with pytest.raises(ValueError, match="expected bool"):
        masker(frames, frames, mask[:2])
    with pytest.raises(ValueError, match=r"expected uint8 \[t h w 3\]"):
        masker(frames / 255, frames, mask)


def test_frames_go_in_one_by_one_and_give_what_all_at_once_gives(folder: Path, video: tuple[np.ndarray, np.ndarray]) -> None:
    """Hugging Face's own way with the whole video in memory, for the second half."""
    frames, mask = video
    network = transformers.Sam2VideoModel.from_pretrained(folder).eval()
    session = transformers.models.sam2_video.modeling_sam2_video.Sam2VideoInferenceSession(
        video=torch.stack([Frames(frames, SIDE)[frame] for frame in range(3)]), video_height=48, video_width=64,
        dtype=torch.float32,
    )  # fmt: skip
    prompt = torch.nn.functional.interpolate(
        torch.from_numpy(mask[PROMPTED])[None, None].float(), (SIDE, SIDE), mode="bilinear", antialias=True
    )
    session.add_mask_inputs(session.obj_id_to_idx(1), PROMPTED, (prompt >= 0.5).float())
    session.obj_with_new_inputs = [1]
    with torch.no_grad():
        network(inference_session=session, frame_idx=PROMPTED)
        outputs = list(network.propagate_in_video_iterator(session, start_frame_idx=PROMPTED))
    found = open_masker("sam2", folder)(frames, frames, mask)
    for output in outputs[1:]:
        logits = torch.nn.functional.interpolate(output.pred_masks, (48, 64), mode="bilinear")
        np.testing.assert_array_equal(found[output.frame_idx], (logits[0, 0] > 0).numpy())
    assert [output.frame_idx for output in outputs] == [1, 2]


def test_frames_are_normalized_as_the_authors_do() -> None:
    frame = np.full((1, 6, 8, 3), (255, 0, 128), np.uint8)
    tensor = Frames(frame, 4)[0].numpy()
    assert tensor.shape == (3, 4, 4)
    expected = (np.array([1, 0, 128 / 255]) - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
    np.testing.assert_allclose(tensor, np.broadcast_to(expected[:, None, None], (3, 4, 4)), atol=1e-5)


def test_a_folder_that_lacks_tensors_is_refused(folder: Path, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    cut = tmp_path / "cut"
    cut.mkdir()
    (cut / "config.json").write_bytes((folder / "config.json").read_bytes())
    tensors = load_file(folder / "model.safetensors")
    tensors.pop("memory_encoder.projection.weight")
    save_file(tensors, cut / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(ConfigError, match=r"cut lacks 1 tensors of SAM 2, as memory_encoder\.projection\.weight"):
        open_sam2(cut)


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"expected config\.json and model\.safetensors"):
        open_sam2(tmp_path)


def test_another_checkpoint_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "sam2.1_hiera_tiny.pt"
    torch.save({"model": {"weight": torch.zeros(3)}}, path)
    with pytest.raises(ConfigError, match="is no checkpoint of SAM 2; expected"):
        open_sam2(path)


def test_a_file_that_would_run_code_is_refused(tmp_path: Path) -> None:
    path, ran = tmp_path / "sam2.1_hiera_tiny.pt", tmp_path / "ran"
    torch.save({"model": Malice(ran)}, path)
    with pytest.raises(ConfigError, match=r"sam2\.1_hiera_tiny\.pt is no whole checkpoint of SAM 2"):
        open_sam2(path)
    assert not ran.exists()


class Malice:
    """Makes a file where it is unpickled freely."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return (open, (str(self.path), "w"))


def test_the_command_grades_with_it(folder: Path, tmp_path: Path) -> None:
    """From a checkpoint on disk to a score, and the table says which checkpoint it was."""
    write_synthetic_data(tmp_path / "data", seeds=(1_000_000,), robots=("piper",), frames=4)
    episode = episode_folder(tmp_path / "data", "place_empty_cup", 1_000_000, "piper")
    video, states = read_video(episode / "rgb.mkv"), read_states(episode)
    write_rollout(tmp_path / "mine", "place_empty_cup", 1_000_000, "piper", video[::-1], {"model": "backwards"})
    out = tmp_path / "scores.parquet"
    main(Args((tmp_path / "mine",), tmp_path / "data", out, metrics=("mask_iou",), masks="sam2", masks_checkpoint=folder))
    table = pd.read_parquet(out)
    found = open_sam2(folder)(video[::-1], video, states.robot_mask)
    expected = float(mask_iou(found[1:], states.robot_mask[1:]).mean())
    assert table.loc[table["model"] == "backwards", "value"].tolist() == [pytest.approx(expected, rel=1e-6)]
    assert table.attrs["estimators"]["masks"] == identity("sam2", folder)
