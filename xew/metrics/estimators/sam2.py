"""SAM 2 as a masker: the true mask of the frame where the robot is largest, propagated both ways (the paper's protocol).

Each direction starts from a fresh state, because a backward pass would read the memories of a forward pass. A .pt of the
authors needs the package `sam2`, a folder of Hugging Face needs `transformers`.
"""

import contextlib
import itertools
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from xew.config import ConfigError
from xew.metrics.estimators.adapters import import_package, import_torch, load_state_dict, read_state_dict, torch_device
from xew.metrics.networks.pickles import first_line

MEAN, DEVIATION = np.array([(0.485, 0.456, 0.406), (0.229, 0.224, 0.225)], np.float32)
"""Mean and standard deviation of ImageNet's colors in [0, 1], by which SAM 2 normalizes."""
SIZES = {(96, 12): "t", (96, 16): "s", (112, 24): "b+", (144, 48): "l"}
"""Names of the authors' configs, by the width of the trunk's first layer and the number of its blocks."""
ROBOT = 1
REPLACING = threading.Lock()

Propagate = Callable[["Frames", int, np.ndarray, bool], dict[int, np.ndarray]]
"""(frames, prompted frame, its mask, backwards) -> mask [h w] bool of each frame on the way, by its number."""


def open_sam2(checkpoint: Path, side: int | None = None) -> "Sam2":
    """SAM 2 or 2.1 from a local checkpoint, on a GPU or else the CPU.

    Args:
        checkpoint: a .pt of the authors (needs the package `sam2`), or a folder with config.json and model.safetensors of
            Hugging Face's `facebook/sam2.1-hiera-*` (needs `transformers`).
        side: of the square that the authors' network sees [pixels]; by default 1024, for which it was trained.

    Raises:
        ConfigError: a package is absent, or the checkpoint is damaged or of another network.
    """
    if checkpoint.is_dir():
        if side is not None:
            raise ConfigError(f"{checkpoint} says its size in config.json; `side` is for the authors' .pt files.")
        return _open_folder(checkpoint)
    return _open_authors(checkpoint, 1024 if side is None else side)


class Sam2:
    """The masker: see `xew.metrics.backends.Masker`. A frame's mask depends on all frames between it and the prompt."""

    def __init__(self, propagate: Propagate, side: int) -> None:
        self._propagate, self._side = propagate, side

    def __call__(self, prediction: np.ndarray, target: np.ndarray, target_mask: np.ndarray) -> np.ndarray:
        """Masks [t h w] bool of the robot in a prediction.

        Args:
            prediction: [t h w 3] uint8, the predicted video.
            target: [t h w 3] uint8, the true video; not looked at.
            target_mask: [t h w] bool, the true masks; the largest is the prompt, and the answer of its own frame.
        """
        if prediction.ndim != 4 or prediction.shape[-1] != 3 or prediction.dtype != np.uint8:
            raise ValueError(f"the video is {prediction.dtype} {prediction.shape}, expected uint8 [t h w 3].")
        if target_mask.shape != prediction.shape[:3] or target_mask.dtype != bool:
            raise ValueError(f"the masks are {target_mask.dtype} {target_mask.shape}, expected bool {prediction.shape[:3]}.")
        masks = np.zeros_like(target_mask)
        if not target_mask.any():
            return masks  # nothing to be prompted with, and nothing to be found
        start = int(target_mask.sum(axis=(1, 2)).argmax())
        frames = Frames(prediction, self._side)
        for backwards, ahead in ((False, start < len(masks) - 1), (True, start > 0)):
            found_masks = self._propagate(frames, start, target_mask[start], backwards) if ahead else {}
            for frame, mask in found_masks.items():
                masks[frame] = mask
        masks[start] = target_mask[start]  # SAM 2 takes a mask that it is given as the answer
        return masks


class Frames:
    """A video as SAM 2 reads it, frame by frame: float32 [3 side side] tensors. All at once would be 12.6 MB a frame."""

    def __init__(self, video: np.ndarray, side: int) -> None:
        self.video, self.side = video, side
        self._torch = import_torch("SAM 2")

    def __len__(self) -> int:
        return len(self.video)

    def __getitem__(self, frame: int) -> Any:
        image = Image.fromarray(self.video[frame]).resize((self.side, self.side))
        pixels = (np.asarray(image, np.float32) / 255 - MEAN) / DEVIATION
        return self._torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))


# The authors' implementation.


def _open_authors(checkpoint: Path, side: int) -> Sam2:
    state = read_state_dict(checkpoint, "SAM 2")
    config = _config_name(state, checkpoint)
    install = "pip install sam2 hydra-core iopath, or the sources of github.com/facebookresearch/sam2"
    build = import_package("sam2.build_sam", "SAM 2 from a .pt", install)
    module = import_package("sam2.sam2_video_predictor", "SAM 2 from a .pt", install)
    predictor = build.build_sam2_video_predictor(
        config, None, device=torch_device(), hydra_overrides_extra=[f"++model.image_size={side}"]
    )
    load_state_dict(predictor, state, checkpoint, "SAM 2")
    predictor.fill_hole_area = 0  # small holes are filled only where a CUDA extension was compiled; so they never are

    def propagate(frames: Frames, start: int, mask: np.ndarray, backwards: bool) -> dict[int, np.ndarray]:
        # It reads nothing but mp4 and JPEG, so our frames go in where its reader's would. Its progress bar stays quiet.
        ours = {"load_video_frames": lambda **_: (frames, *mask.shape), "tqdm": lambda order, **_: order}
        with _autocast():
            with _replace_names(module, ours):
                session = predictor.init_state(video_path="")
                predictor.add_new_mask(session, frame_idx=start, obj_id=ROBOT, mask=mask)
                order = predictor.propagate_in_video(session, start_frame_idx=start, reverse=backwards)
                first = next(order)  # by now it has its progress bar; the rest needs no turn
            outputs = itertools.chain([first], order)
            return {frame: (logits[0, 0] > 0).cpu().numpy() for frame, _, logits in outputs}

    return Sam2(propagate, side)


def _config_name(state: Mapping[str, Any], checkpoint: Path) -> str:
    """Which of the authors' configs a state dict belongs to, by its tensors and not by the file's name."""
    first = state.get("image_encoder.trunk.patch_embed.proj.weight")
    blocks = {key.split(".")[3] for key in state if key.startswith("image_encoder.trunk.blocks.")}
    size = SIZES.get((0 if first is None else len(first), len(blocks)))
    if size is None:
        raise ConfigError(
            f"{checkpoint} is no checkpoint of SAM 2; expected one of sam2.1_hiera_{{tiny,small,base_plus,large}}.pt."
        )
    version = "2.1" if "no_obj_embed_spatial" in state else "2"
    return f"configs/sam{version}/sam{version}_hiera_{size}.yaml"


@contextlib.contextmanager
def _replace_names(module: Any, names: Mapping[str, Any]) -> Iterator[None]:
    """The module's names hold other things for a while, for one thread at a time."""
    with REPLACING:
        before = {name: getattr(module, name) for name in names}
        vars(module).update(names)
        try:
            yield
        finally:
            vars(module).update(before)


# Hugging Face's implementation.


def _open_folder(folder: Path) -> Sam2:
    torch = import_torch("SAM 2")
    install = "pip install transformers; if torchvision is installed, its build must match torch"
    transformers = import_package("transformers.models.sam2_video.modeling_sam2_video", "SAM 2 from a folder", install)
    network = _read_folder(transformers, folder).eval().to(torch_device())
    side = int(network.config.image_size)

    def propagate(frames: Frames, start: int, mask: np.ndarray, backwards: bool) -> dict[int, np.ndarray]:
        masks = {}
        with torch.inference_mode(), _autocast():
            session = transformers.Sam2VideoInferenceSession(
                video_height=mask.shape[0], video_width=mask.shape[1], inference_device=network.device,
                inference_state_device=network.device, dtype=torch.float32,
            )  # fmt: skip
            session.processed_frames = frames
            session.add_mask_inputs(session.obj_id_to_idx(ROBOT), start, _prompt(mask, side))
            session.obj_with_new_inputs = [ROBOT]
            network(inference_session=session, frame_idx=start)
            for output in network.propagate_in_video_iterator(session, start_frame_idx=start, reverse=backwards):
                logits = torch.nn.functional.interpolate(output.pred_masks.float(), mask.shape, mode="bilinear")
                masks[output.frame_idx] = (logits[0, 0] > 0).cpu().numpy()
                # Kept for every frame and read by none: 4 MB each.
                session.output_dict_per_obj[0]["non_cond_frame_outputs"].get(output.frame_idx, {}).pop("high_res_masks", None)
        return masks

    return Sam2(propagate, side)


def _read_folder(transformers: Any, folder: Path) -> Any:
    try:
        network, report = transformers.Sam2VideoModel.from_pretrained(
            str(folder), local_files_only=True, output_loading_info=True
        )
    except Exception as error:  # each library below it raises its own
        raise ConfigError(
            f"{folder} cannot be read as a SAM 2 of Hugging Face ({first_line(error)}); "
            "expected config.json and model.safetensors."
        ) from error
    lacking = sorted({*report["missing_keys"], *(key for key, *_ in report["mismatched_keys"])})
    if lacking:
        raise ConfigError(f"{folder} lacks {len(lacking)} tensors of SAM 2, as {lacking[0]}; download it again.")
    return network


def _prompt(mask: np.ndarray, side: int) -> Any:
    """A mask [h w] as the network takes it: float [1 1 side side], resized as the authors do."""
    torch = import_torch("SAM 2")
    prompt = torch.from_numpy(mask)[None, None].float()
    resized = torch.nn.functional.interpolate(prompt, (side, side), mode="bilinear", antialias=True)
    return (resized >= 0.5).float()


def _autocast() -> Any:
    """bfloat16 on a GPU, as in the authors' examples; float32 on the CPU."""
    torch = import_torch("SAM 2")
    return torch.autocast("cuda", torch.bfloat16, enabled=torch_device() == "cuda")
