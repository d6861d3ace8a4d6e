"""Policies that LeRobot trained on an export of `xew.exchange.lerobot`, as functions of frames and a state.

LeRobot and PyTorch are imported at first use. Policies see one frame of one camera and predict a chunk of commands, as ACT.
"""

from pathlib import Path
from typing import Any

import numpy as np

from xew.config import ConfigError
from xew.policies.policy import State

LAST = Path("checkpoints", "last", "pretrained_model")
"""Folder of the policy in the output folder of lerobot-train."""


class LeRobotPolicy:
    """A policy of LeRobot.

    Args:
        folder: that lerobot-train wrote, or one of its checkpoints' folders pretrained_model.

    Raises:
        ConfigError: LeRobot is not installed, the folder holds no policy, or the policy needs other inputs.
    """

    def __init__(self, folder: Path) -> None:
        folder = folder / LAST if (folder / LAST).is_dir() else folder
        if not (folder / "config.json").is_file():
            raise ConfigError(f"{folder} holds no policy of LeRobot; expected the output folder of lerobot-train.")
        try:
            from lerobot.configs.policies import PreTrainedConfig
            from lerobot.policies.factory import get_policy_class, make_pre_post_processors
        except (ImportError, AttributeError) as error:  # PyAV lacks an attribute if LeRobot's data sets are installed, too
            raise ConfigError(
                f"cannot import LeRobot ({error}); in Python 3.12 or later: python -m pip install lerobot. Its extras need an "
                "older PyAV than xew; if they are installed: python -m pip uninstall datasets."
            ) from error
        config = PreTrainedConfig.from_pretrained(str(folder))
        if config.n_obs_steps != 1 or len(config.image_features) != 1:
            raise ConfigError(
                f"{folder} sees {config.n_obs_steps} frames of {', '.join(config.image_features) or 'no camera'}; expected one "
                "frame of one camera, as of ACT on an export with one view."
            )
        (self.image,) = config.image_features
        self.policy: Any = get_policy_class(config.type).from_pretrained(str(folder))
        device = {"device_processor": {"device": str(config.device)}}
        self.before, self.after = make_pre_post_processors(config, str(folder), preprocessor_overrides=device)

    def __call__(self, frames: np.ndarray, state: State) -> np.ndarray:
        """The next commands [n t 16] float32 from the last of frames [n t h w 3] uint8, joints and instruction.

        A policy's first command is the one of the frame that it sees. Raises ConfigError if it predicts too few.
        """
        import torch

        picture = torch.from_numpy(np.ascontiguousarray(frames[:, -1])).permute(0, 3, 1, 2) / 255
        instructions = [record.instruction for record in state.records]
        seen = {self.image: picture, "observation.state": torch.from_numpy(state.joint_pos), "task": instructions}
        commands = self.after(self.policy.predict_action_chunk(self.before(seen))).cpu().numpy()
        if commands.shape[1] <= frames.shape[1]:
            raise ConfigError(
                f"the policy predicts {commands.shape[1]} commands, expected at least {frames.shape[1] + 1}; train it with a "
                "larger --policy.chunk_size."
            )
        return commands[:, 1 : frames.shape[1] + 1]
