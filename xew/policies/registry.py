"""Policies by name, as --policy takes them.

To add one, write a function in `policy.py` and one line in POLICIES; users name theirs as module:NAME.
"""

from pathlib import Path

from xew.config import pick
from xew.policies.lerobot import LeRobotPolicy
from xew.policies.policy import Policy, expert, noisy_expert

LEROBOT = "lerobot"
"""Name before the folder of a policy that LeRobot trained."""
POLICIES: dict[str, Policy] = {"expert": expert, "noisy_expert": noisy_expert}
"""Policies of --policy."""


def open_policy(name: str) -> Policy:
    """The policy of a name in POLICIES, of module:NAME, or of lerobot:FOLDER. Raises ConfigError if there is none."""
    kind, _, folder = name.partition(":")
    if kind != LEROBOT or not folder:
        return pick(POLICIES, name, "policy")
    return LeRobotPolicy(Path(folder))


def short_name(name: str) -> str:
    """The last part of a policy's name, for names of models."""
    return Path(name.rpartition(":")[2]).name
