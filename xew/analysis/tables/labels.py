"""Titles and labels in tables and charts: metrics of the paper, robots, conditions, systems, remedies.

They come from the registries; a name that no registry has is shown as it is.
"""

from xew.analysis.paper import PAPER_TITLES
from xew.analysis.statistics.grades import REFERENCE, SEEN
from xew.model.conditions import ACTIONS as REPRESENTATIONS
from xew.model.conditions import CONDITIONS
from xew.protocol import HELD_OUT_ROBOTS, PARTS, SEEN_ROBOTS
from xew.sim_warp.robots import ROBOTS

PAPER_METRICS = tuple(PAPER_TITLES)
ROBOT_TITLES = {key: robot.title for key, robot in ROBOTS.items()}
SHORT_ROBOTS = {key: robot.label for key, robot in ROBOTS.items()}
SEEN_TITLE = "Seen robots, pooled: {}, {} and {}".format(*(ROBOT_TITLES[robot] for robot in SEEN_ROBOTS))
"""Title of means over the robots that the fixed split trains on."""
HELD_OUT_TITLES = {robot: f"Held-out {ROBOTS[robot].title}" for robot in HELD_OUT_ROBOTS}
GROUP_TITLES = {SEEN: SEEN_TITLE, **HELD_OUT_TITLES}
"""Titles of the groups of robots in tables of the fixed split, by their names in addresses."""


def robot_title(robot: str) -> str:
    """Title of a robot; the key of an unregistered one."""
    return ROBOT_TITLES.get(robot, robot)


def action_title(key: str) -> str:
    """Title of an action representation."""
    return REPRESENTATIONS[key].title if key in REPRESENTATIONS else spell_key(key)


def condition_label(key: str) -> str:
    """Label of a condition on the robot's appearance, as a step of the ladder."""
    return CONDITIONS[key].label if key in CONDITIONS else spell_key(key)


def spell_key(key: str) -> str:
    """A key as words."""
    return key.replace("_", " ")


ACTIONS = {variant.action: action_title(variant.action) for variant in PARTS["actions"]}
LADDER = {variant.embodiment: condition_label(variant.embodiment) for variant in PARTS["ladder"]}
"""Label of each condition of the ladder by its key, from no condition to a render of every frame."""
SYSTEMS = {
    variant.system: "reference model" if variant.system == REFERENCE else action_title(variant.action)
    for variant in PARTS["baselines"]
}
SYSTEM_ACTIONS = tuple(
    REPRESENTATIONS[variant.action].label if variant.action in REPRESENTATIONS else spell_key(variant.action)
    for variant in PARTS["baselines"]
)
TRUE = "true video, graded"
"""Label of the row of the true video."""
REMEDIES = {"replay": "with replay", "lora": "with LoRA"}
