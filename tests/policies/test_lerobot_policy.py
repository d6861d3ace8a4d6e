"""Policies of LeRobot: what they are given and what is taken of their commands; LeRobot's own ACT where it is installed."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from xew.config import ConfigError
from xew.policies.policy import State
from xew.policies.registry import open_policy, short_name

HEAD = "observation.images.head"
AHEAD = 6
"""Number of commands that the policy predicts."""


def make_state(count: int, frames: int) -> State:
    records: Any = tuple(SimpleNamespace(instruction=f"scene {number}") for number in range(count))
    joints = np.arange(count * 16, dtype=np.float32).reshape(count, 16)
    return State(records, 0, 0 * joints, joints, np.zeros((count, frames, 16), np.float32))


class Counting:
    """A policy whose command k is the joints, the red of the picture and k."""

    @classmethod
    def from_pretrained(cls, folder: str) -> "Counting":
        return cls()

    def predict_action_chunk(self, batch: dict[str, Any]) -> Any:
        import torch

        assert batch["task"] == ["scene 0", "scene 1"]
        red = batch[HEAD][:, 0].mean(dim=(1, 2))
        return torch.stack([batch["observation.state"] + red[:, None] + k for k in range(AHEAD)], dim=1)


@pytest.fixture
def checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The output of a training, with a LeRobot that has only this policy."""
    folder = tmp_path / "act" / "checkpoints" / "last" / "pretrained_model"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text("{}")
    config = SimpleNamespace(type="act", n_obs_steps=1, image_features={HEAD: None}, device="cpu")
    parts: dict[str, dict[str, Any]] = {
        "lerobot": {},
        "lerobot.configs": {},
        "lerobot.configs.policies": {"PreTrainedConfig": SimpleNamespace(from_pretrained=lambda folder: config)},
        "lerobot.policies": {},
        "lerobot.policies.factory": {
            "get_policy_class": {"act": Counting}.__getitem__,
            "make_pre_post_processors": lambda *_, **__: (lambda batch: batch, lambda actions: actions),
        },
    }
    for name, content in parts.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return tmp_path / "act"


@pytest.mark.needs("torch")
def test_a_policy_sees_the_last_frame_and_its_first_command_is_in_force(checkpoint: Path) -> None:
    policy, state = open_policy(f"lerobot:{checkpoint}"), make_state(2, 4)
    frames = np.zeros((2, 4, 8, 8, 3), np.uint8)
    frames[1, -1, ..., 0], frames[0, 0] = 255, 77
    commands = policy(frames, state)
    expected = state.joint_pos[:, None] + np.array([0, 1])[:, None, None] + np.arange(1, 5)[:, None]
    np.testing.assert_array_equal(commands, expected)
    with pytest.raises(ConfigError, match="predicts 6 commands, expected at least 7"):
        policy(np.zeros((2, AHEAD, 8, 8, 3), np.uint8), state)
    assert short_name(f"lerobot:{checkpoint}") == "act"


def test_what_is_missing_is_said(checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="holds no policy of LeRobot"):
        open_policy(f"lerobot:{tmp_path}")
    config: Any = sys.modules["lerobot.configs.policies"].PreTrainedConfig.from_pretrained("")
    config.image_features = {HEAD: None, "observation.images.cam_left_wrist": None}
    with pytest.raises(ConfigError, match="cam_left_wrist; expected one frame of one camera"):
        open_policy(f"lerobot:{checkpoint}")
    monkeypatch.setitem(sys.modules, "lerobot.configs.policies", None)
    with pytest.raises(ConfigError, match="pip install lerobot"):
        open_policy(f"lerobot:{checkpoint}")


@pytest.mark.needs("lerobot")
def test_act_of_lerobot_acts(tmp_path: Path) -> None:
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    numbers, picture = ((16,), FeatureType.STATE), ((3, 64, 96), FeatureType.VISUAL)
    inputs = {"observation.state": numbers, "observation.tool_pose": ((14,), FeatureType.STATE), HEAD: picture}
    config = ACTConfig(
        input_features={name: PolicyFeature(kind, shape) for name, (shape, kind) in inputs.items()},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (16,))},
        **{"device": "cpu", "pretrained_backbone_weights": None, "chunk_size": 8, "n_action_steps": 8, "dim_model": 64},
        **{"n_heads": 2, "dim_feedforward": 64, "n_encoder_layers": 1, "n_vae_encoder_layers": 1},
    )
    constant = {
        name: np.full((3, 1, 1) if "images" in name else (16,), value) for name, value in ((HEAD, 0.5), ("action", 3.0))
    }
    statistics = {name: {"mean": value, "std": 0 * value} for name, value in constant.items()}
    ACTPolicy(config).save_pretrained(tmp_path)
    for processor in make_pre_post_processors(config, dataset_stats=statistics):
        processor.save_pretrained(tmp_path)
    commands = open_policy(f"lerobot:{tmp_path}")(np.zeros((2, 4, 64, 96, 3), np.uint8), make_state(2, 4))
    np.testing.assert_allclose(commands, np.full((2, 4, 16), 3.0), atol=1e-6)
