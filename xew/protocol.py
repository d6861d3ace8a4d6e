"""The protocol of a study as plain data: roles of robots, splits, seeds, counts, commands and cameras.

It follows the paper's section 3 and its appendix. Every package may import this file, which imports nothing of xew.
"""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

ROBOT_NAMES = ("aloha_agilex", "arx_x5", "ur5_wsg", "franka_panda", "piper")
"""Keys of the five robots of the paper, in its order."""
SEEN_ROBOTS = ("aloha_agilex", "arx_x5", "ur5_wsg")
HELD_OUT_ROBOTS = ("franka_panda", "piper")
"""Roles in the fixed split: three training robots, and two held-out robots, reported separately and never averaged."""

BODY_NAME = re.compile(r"body[:_](\d+)")
BODY_RANGE = re.compile(r"body:(\d+)-(\d+)")
"""Forms of the names of one procedural body and of several in a row, as users write them."""

ACTION_DIM = 16
"""Length of a command: left arm 7 joints [rad], left gripper, right arm 7 joints [rad], right gripper. Grippers go from 0,
closed, to 1, open. Arms of six joints leave their seventh at zero."""
LEFT_ARM, LEFT_GRIPPER, RIGHT_ARM, RIGHT_GRIPPER = slice(0, 7), 7, slice(8, 15), 15
ARMS = ((LEFT_ARM, LEFT_GRIPPER), (RIGHT_ARM, RIGHT_GRIPPER))
"""Columns of each arm's joints and gripper in a command."""

OUTCOME = "outcome"
"""The dimension of what commands cause. Its judge leaves out tasks itself (`xew.metrics.outcome.judge.UNJUDGED`)."""
DIMENSION_TITLES = {
    "visual": "Visual quality",
    "morphology": "Robot morphology",
    "kinematics": "Robot kinematics",
    "objects": "Object dynamics",
    OUTCOME: "Task outcome",
}
"""Titles of the dimensions, the groups of metrics, which are never combined into one number."""

CAMERA_SIZE = (320, 240)
"""Width and height of the head camera's picture [pixels]."""
LARGEST_SIDE = 4096
"""Largest width and height of a camera's picture [pixels]."""
HEAD = "head"
"""Name of the camera, and of its view, that every data set has."""


@dataclass(frozen=True)
class CameraSpec:
    """A camera as data: what it is fixed to, where it looks, and its picture. The default is the head camera."""

    name: str = HEAD
    fixed_to: str = "world"
    """world, left_tool or right_tool (the tool's frame, x out of the hand), or a link of the robot, such as left/link6."""
    position: tuple[float, float, float] = (-0.032, -0.45, 1.35)
    """Center of projection [m], in the frame of what it is fixed to."""
    target: tuple[float, float, float] = (-0.032, 0.15, 0.55)
    """Point in the middle of the picture [m], in the same frame."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction that points up in the picture, in the same frame."""
    vertical_fov: float = 37.0
    """Full vertical angle of view [deg]."""
    size: tuple[int, int] = CAMERA_SIZE
    """Width and height of the picture [pixels]."""

    @property
    def view(self) -> str:
        """Name of the camera's view in a data set: the camera's name, with the size if that is not 320x240."""
        width, height = self.size
        return self.name if self.parts or self.size == CAMERA_SIZE else f"{self.name}_{width}x{height}"

    @property
    def parts(self) -> tuple[str, ...]:
        """The views that this one tiles into one picture, from top to bottom, named head+wrist_left; usually none."""
        return tuple(self.name.split("+")) if "+" in self.name else ()

    @property
    def moves(self) -> bool:
        """Whether the camera moves with the robot."""
        return self.fixed_to != "world"

    @property
    def problem(self) -> str:
        """Reason why the numbers make no picture; empty if they do."""
        line = [to - start for start, to in zip(self.position, self.target, strict=True)]
        (a, b, c), (x, y, z) = line, self.up
        sideways = math.hypot(b * z - c * y, c * x - a * z, a * y - b * x)
        if not all(map(math.isfinite, (sideways, self.vertical_fov))) or not 1 <= self.vertical_fov <= 170:
            return f"the camera has a field of view of {self.vertical_fov:g} degrees; expected 1 to 170, and finite numbers"
        if sideways < 1e-6:
            return (
                f"the camera at {self.position} looks at {self.target} with {self.up} upward; choose a target away from its "
                "position, and an up across the line of sight"
            )
        if not 1 <= min(self.size) <= max(self.size) <= LARGEST_SIDE:
            return f"the camera has a picture of {self.size} pixels, expected sides of 1 to {LARGEST_SIDE}"
        return ""


HEAD_SPEC = CameraSpec()

SHARED_MOTION, OWN_MOTION = "shared", "own"
MOTIONS = (SHARED_MOTION, OWN_MOTION)
"""Kinds of motion. Shared: all robots of a scene follow one tool path on one clock; only the body differs. Own: each robot
moves between the task's waypoints on its own path, in its own time and from its own rest posture."""

FACTORS = ("light", "background", "table", "clutter", "height", "camera")
"""Factors of a scene, of which a change concerns one; everything else stays the same."""
STRENGTHS = 3
"""Number of strengths of a change, each stronger than the previous one."""
MOST_LEVEL = 99
"""Largest level of a change. Levels 1 to 3 grow in strength and are for grading. Each further three are another draw of these
strengths. `RANDOM_CHANGE` draws from level 4 on, so training never shows a graded level."""
RANDOM_CHANGE = "random"
"""Name of the change that is drawn for each scene, as a function of task and seed."""

FRAME_RATE = 1000 / 60
"""Number of stored frames per second [Hz]: one every 15 physics steps of 4 ms."""
TASK_COUNT = 25
"""Number of tasks."""
TRAIN_SEEDS_PER_TASK = 50
"""Number of accepted training seeds of each task."""
TEST_SEEDS_PER_TASK = 20
"""Number of accepted test seeds of each task."""

TEST_SEED_START = 1_000_000
"""First test seed. Training seeds count up from 0 and never reach it."""
VALIDATION_SEED_START = 800_000
"""First validation seed. Validation seeds are for samples during training, calibration and tuning, not for training. Test seeds
are for results only."""
FINAL_SEED_START = 2_100_000
"""First seed of the block that is reserved for the final study. Nobody has looked at its scenes, and no command makes or reads
them unless it is asked for the family `final`: the scenes of `test` were looked at while recipes were made."""
SEED_STARTS = {"train": 0, "validation": VALIDATION_SEED_START, "test": TEST_SEED_START, "final": FINAL_SEED_START}
"""First seed of each family."""
TASK_GROUPS = {
    "place an object": (
        "place_a2b_left",
        "place_a2b_right",
        "place_container_plate",
        "place_empty_cup",
        "place_mouse_pad",
        "place_object_scale",
        "place_object_stand",
        "place_phone_stand",
        "move_can_pot",
        "move_pillbottle_pad",
        "move_stapler_pad",
    ),
    "place several objects": (
        "blocks_ranking_rgb",
        "blocks_ranking_size",
        "place_bread_basket",
        "place_burger_fries",
        "place_dual_shoes",
        "stack_bowls_two",
    ),
    "both hands at one object": ("grab_roller", "lift_pot"),
    "use a tool or a mechanism": ("beat_block_hammer", "open_laptop", "press_stapler", "stamp_seal"),
    "move without placing": ("shake_bottle", "shake_bottle_horizontally"),
}
"""Tasks by what hands do in them (docs/tasks.md)."""
FAULT_STRIDE = 10_000_000
"""Distance between the seed of an expert's episode and those of its faults 1, 2, ..., all of which have its scene."""
FAULT_SEVERITIES: dict[str, tuple[float, ...]] = {
    "grasp_offset": (5, 10, 20, 30, 40),
    "close_late": (0.3, 0.45, 0.6),
    "stay_open": (1,),
    "open_early": (10, 30, 60),
    "miss_target": (12, 16, 25, 40, 60),
    "swap_objects": (1,),
    "low_lift": (50, 80, 95),
    "stop": (5, 10, 30, 60),
    "push": (40, 60, 80),
    "jitter": (10, 20, 40),
}
"""Severities of each kind of fault (docs/tasks.md), of which each is worse than the one before. Seeds number the faults in this
order: add kinds at the end, and severities as another line there."""
FAULT_GRADES = (0.0, *(place / len(own) for own in FAULT_SEVERITIES.values() for place in range(1, len(own) + 1)))
"""Grade of each fault by its number: its place among the severities of its kind, 1 for the worst; 0 for the expert."""


def body_key(number: int) -> str:
    """The key of a procedural body in folders, headers and score tables, without a colon, which Windows forbids in paths."""
    return f"body_{number}"


def expand_robots(names: Iterable[str]) -> tuple[str, ...]:
    """Keys of robots: `body:17` becomes `body_17`, `body:0-63` becomes `body_0` to `body_63`; other names are unchanged."""
    keys: list[str] = []
    for name in names:
        if several := BODY_RANGE.fullmatch(name):
            first, last = int(several[1]), int(several[2])
            keys += [body_key(number) for number in range(first, last + 1)] or [name]
        elif one := BODY_NAME.fullmatch(name):
            keys.append(body_key(int(one[1])))
        else:
            keys.append(name)
    return tuple(keys)


@dataclass(frozen=True)
class Split:
    """Training robots and held-out robots of a model."""

    train_robots: tuple[str, ...]
    held_out_robots: tuple[str, ...]
    motion: str = SHARED_MOTION
    """Kind of motion of its episodes: one of MOTIONS."""


FIXED = Split(SEEN_ROBOTS, HELD_OUT_ROBOTS)
"""Split of most tables: three robots train, two are held out."""
LOEO = {held_out: Split(tuple(r for r in ROBOT_NAMES if r != held_out), (held_out,)) for held_out in ROBOT_NAMES}
"""Leave-one-embodiment-out (LOEO): five folds, by their held-out robot."""

TRAINING_BODIES = expand_robots(["body:0-63"])
"""Procedural bodies for training, in the order of the scaling protocol."""
UNSEEN_BODIES = expand_robots(["body:64-95"])
"""Bodies without training episodes; their test episodes are graded."""
VALIDATION_BODIES = expand_robots(["body:96-103"])
"""Bodies for model selection, separate from held-out robots and test bodies."""
DISTANCE_BODIES = expand_robots(["body:104-167"])
"""Bodies of the wide family of designs, whose kinematic distances span and exceed those among the five robots."""
BODY_SCALES = (4, 16, 64)
"""Numbers of bodies (K) that the scaling protocol trains on."""
_TESTED = (*HELD_OUT_ROBOTS, *UNSEEN_BODIES)
SCALING = {
    "scaling_seen": Split(SEEN_ROBOTS, (*_TESTED, *DISTANCE_BODIES)),
    **{f"scaling_bodies_{count}": Split(TRAINING_BODIES[:count], _TESTED) for count in BODY_SCALES},
    **{f"scaling_seen_bodies_{count}": Split((*SEEN_ROBOTS, *TRAINING_BODIES[:count]), _TESTED) for count in BODY_SCALES},
}
"""The scaling protocol: training on the three robots, K bodies, or both, with tests on Franka, Piper and 32 unseen bodies. The
model of the three robots is tested on 64 bodies of the wide family, too, for error against distance."""
CROSSED_BODIES = (*TRAINING_BODIES, *DISTANCE_BODIES)
"""Bodies of both families for two models, each trained on one half and graded on both. 128 of them tell looks from kinematics
with a probability of 0.96, 64 with 0.73 (`xew.analysis.studies.power`)."""
HALVES = {
    "halves_even": Split(CROSSED_BODIES[0::2], CROSSED_BODIES[1::2]),
    "halves_odd": Split(CROSSED_BODIES[1::2], CROSSED_BODIES[0::2]),
}
"""The protocol of halves: every body is rendered by a model that trained on it and by one that did not, as in LOEO, with 128
bodies instead of five robots. Keys name the training half by the bodies' numbers."""
VALIDATION = Split(SEEN_ROBOTS, VALIDATION_BODIES)
"""The fixed split's training robots, with the validation bodies instead of the held-out robots."""


def validation_split(split: Split) -> Split:
    """Robots for model selection in a split: its training robots, and the validation bodies as held-out robots."""
    return replace(split, held_out_robots=VALIDATION_BODIES)


@dataclass(frozen=True)
class Change:
    """One factor of a scene at a level; level 0 leaves the scene unchanged."""

    factor: str
    level: int

    @property
    def strength(self) -> int:
        """1, 2 or 3."""
        return (self.level - 1) % STRENGTHS + 1

    @property
    def draw(self) -> int:
        """The number of the draw that determines direction, color or pattern, the same for three strengths."""
        return (self.level - 1) // STRENGTHS

    def __str__(self) -> str:
        return f"{self.factor}:{self.level}"


SHIFTS = tuple(str(Change(factor, level)) for factor in FACTORS for level in range(1, STRENGTHS + 1))
"""Changes of the protocol of shifts: each factor at the three graded levels."""


def parse_change(text: str) -> Change | None:
    """The change that a text such as `light:2` names; None for no change: an empty text or level 0.

    Raises:
        ValueError: it names no factor, or a level out of range.
    """
    if not text:
        return None
    factor, _, level = text.partition(":")
    if factor not in FACTORS or not re.fullmatch("[0-9]{1,9}", level) or int(level) > MOST_LEVEL:
        factors = f"{', '.join(FACTORS[:-1])} or {FACTORS[-1]}"
        raise ValueError(f"{text!r} is no change, expected {factors} with a level from 0 to {MOST_LEVEL}, such as light:2")
    return Change(factor, int(level)) if int(level) else None


def split_key(split: str, motion: str, change: str = "") -> str:
    """The key of a split or data set in a kind of motion, with a change: fixed, fixed_own, data_light_2."""
    own, changed = motion if motion != SHARED_MOTION else "", change.replace(":", "_")
    return "_".join(part for part in (split, own, changed) if part)


_SHARED_SPLITS = (
    {"fixed": FIXED} | {f"loeo_{robot}": split for robot, split in LOEO.items()} | SCALING | HALVES | {"validation": VALIDATION}
)
SPLITS = {split_key(key, motion): replace(split, motion=motion) for motion in MOTIONS for key, split in _SHARED_SPLITS.items()}
"""All splits by key; keys of splits in own motion end in `_own`."""

SHOTS = (1, 2, 3)
"""Numbers of training episodes per task for few-shot adaptation (M), from the first accepted seeds."""
FORGETTING_ROBOT = "ur5_wsg"
"""Robot whose test episodes measure forgetting, the same for every adapted model."""
GRADING_PROTOCOL = 7
"""Version of the grading. It increases with every change of scores; scores of another version are graded again."""
COPY_FIRST_FRAME, PASTED_RENDER, OTHER_ROBOT = "copy_first_frame", "pasted_render", "other_robot"
CODEC_TRUTH, GROUND_TRUTH = "codec_truth", "ground_truth"
BASELINES = {
    COPY_FIRST_FRAME: "frozen first frame",
    PASTED_RENDER: "pasted render",
    OTHER_ROBOT: "another robot's episode",
    CODEC_TRUTH: "truth through the codec",
    GROUND_TRUTH: "ground truth",
}
"""Titles of the baselines by name; they have the empty variant in a score table. The pasted render, the first frame with the
robot's render, is the no-learning baseline. The condition of the truth through the codec names the codec. The scores of the
last two show the estimators' error."""


@dataclass(frozen=True)
class Variant:
    """One trained or adapted model of a study."""

    name: str
    """Unique name, also the folder's name."""
    system: str = "reference"
    """Key of the world model: reference, irasim, ctrl_world, enerverse_ac, bwm, or an outside model's name."""
    split: str = "fixed"
    """Key of SPLITS."""
    action: str = "optical_flow"
    """Key of the model's ACTIONS: the condition on the commanded motion."""
    embodiment: str = "none"
    """Key of the model's CONDITIONS: the condition on the robot's appearance."""
    target: str | None = None
    """Target robot of the adaptation, if any."""
    shots: int = 0
    """Number of episodes per task in the adaptation (M)."""
    remedy: str = "full"
    """Kind of adaptation: full (all weights, as in the paper), replay (of training robots' episodes) or lora."""
    change: str = ""
    """Change of its training scenes: empty, or RANDOM_CHANGE."""

    @property
    def graded_robots(self) -> tuple[str, ...]:
        """Robots whose test episodes it predicts: the split's robots, training bodies of the halves, held-out bodies.

        For an adaptation they are FORGETTING_ROBOT and the target.
        """
        if self.target is not None:
            return FORGETTING_ROBOT, self.target
        split = SPLITS[self.split]
        of_paper = tuple(robot for robot in ROBOT_NAMES if robot in (*split.train_robots, *split.held_out_robots))
        known = split.train_robots if self.split in HALVES else ()
        return (*of_paper, *known, *(robot for robot in split.held_out_robots if robot not in ROBOT_NAMES))

    @property
    def seen_robots(self) -> tuple[str, ...]:
        """Graded robots of the training before any adaptation."""
        return tuple(robot for robot in self.graded_robots if robot in SPLITS[self.split].train_robots)

    @property
    def held_out_robots(self) -> tuple[str, ...]:
        """Graded robots held out from the training before any adaptation; reported separately, never averaged."""
        return tuple(robot for robot in self.graded_robots if robot in SPLITS[self.split].held_out_robots)

    @property
    def start(self) -> "Variant | None":
        """The variant from which an adaptation starts."""
        return None if self.target is None else reference(self.split, self.action, self.embodiment)


def reference(split: str = "fixed", action: str = "optical_flow", embodiment: str = "none") -> Variant:
    """The reference model of the paper, trained on a split with an action representation and a conditioning."""
    return Variant(f"{split}-{action}-{embodiment}", "reference", split, action, embodiment)


def system(name: str) -> Variant:
    """Another project's action conditioning, in xew's network and on the fixed split."""
    return Variant(f"fixed-{name}", name, "fixed", name)


def adaptation(target: str, shots: int, remedy: str = "full") -> Variant:
    """The nine-view model of the fixed split after training on `shots` episodes of each task of an unseen robot."""
    ending = "" if remedy == "full" else f"-{remedy}"
    return Variant(f"few_shot-{target}-{shots}{ending}", "reference", "fixed", *MULTI_VIEW, target, shots, remedy)


MULTI_VIEW = ("optical_flow", "nine_views")
"""Action and appearance conditions of the model from which adaptations start (the paper's appendix on few-shot adaptation)."""
RECOMMENDED = ("mask_and_flow_channels", "carried_render_and_shadows")
"""Conditions of the recommended recipe, configs/fixed.yaml."""
_FEW_SHOT = tuple(adaptation(target, shots) for target in HELD_OUT_ROBOTS for shots in SHOTS)
_RENDERED = reference(embodiment="robot_render")
_RECOMMENDED = reference("fixed", *RECOMMENDED)

PARTS: dict[str, tuple[Variant, ...]] = {
    "fixed": (reference(),),
    "actions": tuple(reference(action=name) for name in ("joints", "ray_map", "mask", "optical_flow")),
    "ladder": tuple(
        reference(embodiment=name) for name in ("none", "reference_image", "nine_views", "articulation_clip", "robot_render")
    ),
    # The paper does not state the folds' conditions; their Franka and Piper scores agree with the nine-view model's.
    "loeo": tuple(reference(f"loeo_{robot}", *MULTI_VIEW) for robot in ROBOT_NAMES),
    "few_shot": (reference("fixed", *MULTI_VIEW), *_FEW_SHOT, _RENDERED),
    "forgetting": (reference("fixed", *MULTI_VIEW), *_FEW_SHOT),
    "baselines": (*(system(name) for name in ("irasim", "ctrl_world", "enerverse_ac")), reference()),
    # Not in the paper.
    "remedies": tuple(
        adaptation(target, shots, remedy) for remedy in ("replay", "lora") for target in HELD_OUT_ROBOTS for shots in SHOTS
    ),
    "more_systems": (system("bwm"),),
    # Not in the paper: procedural bodies, conditioned on the robot's render at every frame.
    "scaling": tuple(reference(split, embodiment="robot_render") for split in SCALING),
    "bodies": (reference("scaling_seen", embodiment="robot_render"),),
    # With the recommended recipe's conditions.
    "halves": tuple(reference(split, *RECOMMENDED) for split in HALVES),
    # The recommended model, trained in unchanged and in randomly changed scenes; both are graded on changed scenes as well.
    "shifts": (_RECOMMENDED, replace(_RECOMMENDED, name=f"{_RECOMMENDED.name}-{RANDOM_CHANGE}", change=RANDOM_CHANGE)),
}
"""Variants that each table compares, in the order of its rows. A variant may be in several parts."""
PAPER_PARTS = ("fixed", "actions", "ladder", "loeo", "few_shot", "forgetting", "baselines")
"""Parts that the paper has, in its order."""
VARIANTS = {variant.name: variant for variants in PARTS.values() for variant in variants}
"""All variants by name."""


def expected_counts(
    variant: Variant,
    tasks: int = TASK_COUNT,
    test_seeds: int = TEST_SEEDS_PER_TASK,
    robots: tuple[str, ...] = ROBOT_NAMES,
) -> dict[str, int]:
    """Number of scored episodes of each robot in a complete table: 500 in the paper, fewer in a smaller study."""
    return {robot: tasks * test_seeds for robot in variant.graded_robots if robot in robots}


def training_counts(
    variant: Variant,
    tasks: int = TASK_COUNT,
    train_seeds: int = TRAIN_SEEDS_PER_TASK,
    robots: tuple[str, ...] = ROBOT_NAMES,
) -> dict[str, int]:
    """Number of training episodes of each robot; for an adaptation, of the target without replay."""
    if variant.target is not None:
        return {variant.target: tasks * variant.shots} if variant.target in robots else {}
    return {robot: tasks * train_seeds for robot in SPLITS[variant.split].train_robots if robot in robots}


def seed_split(seed: int) -> str:
    """The family that a seed belongs to, a key of SEED_STARTS; a faulty episode belongs to that of its scene."""
    _, base = split_fault(seed)
    return next(family for family, start in reversed(SEED_STARTS.items()) if base >= start)


def split_fault(seed: int) -> tuple[int, int]:
    """The number of the fault of a seed, 0 for the expert, and the base seed, that of its scene."""
    return divmod(seed, FAULT_STRIDE)


def join_fault(number: int, base: int) -> int:
    """The seed of the fault `number` in the scene of the seed `base`: the inverse of `split_fault`."""
    return number * FAULT_STRIDE + base
