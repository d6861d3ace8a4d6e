"""Who is held out of what, what a study trains and what it grades: robots' roles, splits, seeds, variants, counts.

Plain data after the paper's protocol (section 3 and its appendix); every room may read it, it imports nothing of ours. Also
the canonical 16-number joint layout.
"""

from dataclasses import dataclass

ROBOT_NAMES = ("aloha_agilex", "arx_x5", "ur5_wsg", "franka_panda", "piper")
SEEN_ROBOTS = ("aloha_agilex", "arx_x5", "ur5_wsg")
HELD_OUT_ROBOTS = ("franka_panda", "piper")
"""The fixed split: three robots train, two are held out and reported apart, never averaged."""

ACTION_DIM = 16
"""Left arm 7 joints [rad], left gripper, right arm 7 joints [rad], right gripper; grippers 0 closed to 1 open.
Arms of six joints leave their seventh at zero."""
LEFT_ARM, LEFT_GRIPPER, RIGHT_ARM, RIGHT_GRIPPER = slice(0, 7), 7, slice(8, 15), 15
ARMS = ((LEFT_ARM, LEFT_GRIPPER), (RIGHT_ARM, RIGHT_GRIPPER))

DIMENSION_TITLES = {
    "visual": "Visual quality",
    "morphology": "Robot morphology",
    "kinematics": "Robot kinematics",
    "objects": "Object dynamics",
}
"""What a group of metrics speaks of; dimensions are reported side by side, never as one number."""

FRAME_RATE = 1000 / 60
"""Stored frames a second: one every 15 physics steps of 4 ms."""
TASK_COUNT = 25
TRAIN_SEEDS_PER_TASK = 50
TEST_SEEDS_PER_TASK = 20

TEST_SEED_START = 1_000_000
"""Training seeds count up from 0, test seeds from here, so that no number of either ever meets the other."""


@dataclass(frozen=True)
class Split:
    """Robots that a model trains on and robots that it is asked to render unseen."""

    train_robots: tuple[str, ...]
    held_out_robots: tuple[str, ...]


FIXED = Split(SEEN_ROBOTS, HELD_OUT_ROBOTS)
LOEO = {held_out: Split(tuple(r for r in ROBOT_NAMES if r != held_out), (held_out,)) for held_out in ROBOT_NAMES}
"""Leave-one-embodiment-out: five folds, each named by the robot that it holds out."""
SPLITS = {"fixed": FIXED} | {f"loeo_{robot}": split for robot, split in LOEO.items()}

SHOTS = (1, 2, 3)
"""M: training episodes of each task that a model is adapted with; the first accepted seeds."""
FORGETTING_ROBOT = "ur5_wsg"
"""On its test episodes, the same for every adapted model, forgetting is measured."""
BASELINES = COPY_FIRST_FRAME, GROUND_TRUTH = ("copy_first_frame", "ground_truth")
"""Rows of a score table that no model made, with the empty variant: a score of nothing, and the estimators' own error."""


@dataclass(frozen=True)
class Variant:
    """One trained or adapted model of a study."""

    name: str
    """Unique, and fit to be a folder's name."""
    system: str = "reference"
    """reference, irasim, ctrl_world, enerverse_ac, bwm, or an outside model's name."""
    split: str = "fixed"
    """A key of SPLITS."""
    action: str = "optical_flow"
    """A key of the model's ACTIONS: how the commanded motion is shown."""
    embodiment: str = "none"
    """A key of the model's CONDITIONS: how the robot's looks are shown."""
    target: str | None = None
    """Robot that it was adapted to."""
    shots: int = 0
    """M, episodes of each task in the adaptation."""
    remedy: str = "full"
    """How it was adapted: full (all weights, as in the paper), replay (of training robots' episodes) or lora."""

    @property
    def graded_robots(self) -> tuple[str, ...]:
        """Whose test episodes it predicts: all robots', after an adaptation the target's and those that show forgetting."""
        return ROBOT_NAMES if self.target is None else (FORGETTING_ROBOT, self.target)

    @property
    def seen_robots(self) -> tuple[str, ...]:
        """Graded robots that its (first) training had."""
        return tuple(robot for robot in self.graded_robots if robot in SPLITS[self.split].train_robots)

    @property
    def held_out_robots(self) -> tuple[str, ...]:
        """Graded robots that its (first) training had not: reported apart, never averaged."""
        return tuple(robot for robot in self.graded_robots if robot in SPLITS[self.split].held_out_robots)

    @property
    def start(self) -> "Variant | None":
        """The variant that an adapted one starts from."""
        return None if self.target is None else reference(self.split, self.action, self.embodiment)


def reference(split: str = "fixed", action: str = "optical_flow", embodiment: str = "none") -> Variant:
    """The reference model of the paper, trained on a split with an action representation and a conditioning."""
    return Variant(f"{split}-{action}-{embodiment}", "reference", split, action, embodiment)


def system(name: str) -> Variant:
    """Another project's way to be told actions, on the fixed split."""
    return Variant(f"fixed-{name}", name, "fixed", name)


def adapted(target: str, shots: int, remedy: str = "full") -> Variant:
    """The nine-view model of the fixed split after training on `shots` episodes of each task of an unseen robot."""
    ending = "" if remedy == "full" else f"-{remedy}"
    return Variant(f"few_shot-{target}-{shots}{ending}", "reference", "fixed", *MULTI_VIEW, target, shots, remedy)


MULTI_VIEW = ("optical_flow", "nine_views")
"""Action and embodiment of the model that adaptations start from (the paper's appendix on few-shot adaptation)."""
_FEW_SHOT = tuple(adapted(target, shots) for target in HELD_OUT_ROBOTS for shots in SHOTS)
_RENDERED = reference(embodiment="robot_render")

PARTS: dict[str, tuple[Variant, ...]] = {
    "fixed": (reference(),),
    "actions": tuple(reference(action=name) for name in ("joints", "ray_map", "mask", "optical_flow")),
    "ladder": tuple(
        reference(embodiment=name) for name in ("none", "reference_image", "nine_views", "articulation_clip", "robot_render")
    ),
    # The paper does not say what its folds are told; their Franka and Piper scores lie at those of nine views.
    "loeo": tuple(reference(f"loeo_{robot}", *MULTI_VIEW) for robot in ROBOT_NAMES),
    "few_shot": (reference("fixed", *MULTI_VIEW), *_FEW_SHOT, _RENDERED),
    "forgetting": (reference("fixed", *MULTI_VIEW), *_FEW_SHOT),
    "baselines": (*(system(name) for name in ("irasim", "ctrl_world", "enerverse_ac")), reference()),
    # Ours; the paper leaves them open.
    "remedies": tuple(
        adapted(target, shots, remedy) for remedy in ("replay", "lora") for target in HELD_OUT_ROBOTS for shots in SHOTS
    ),
    "more_systems": (system("bwm"),),
}
"""Which variants each table compares, in the order of its rows. A variant may be in several."""
PAPER_PARTS = ("fixed", "actions", "ladder", "loeo", "few_shot", "forgetting", "baselines")
VARIANTS = {variant.name: variant for variants in PARTS.values() for variant in variants}


def expected_counts(
    variant: Variant,
    tasks: int = TASK_COUNT,
    test_seeds: int = TEST_SEEDS_PER_TASK,
    robots: tuple[str, ...] = ROBOT_NAMES,
) -> dict[str, int]:
    """Scored episodes of each robot in a complete table: 500 in the paper, or as many as a smaller study has.

    Args:
        tasks, test_seeds, robots: of the study; the paper's where left out.
    """
    return {robot: tasks * test_seeds for robot in variant.graded_robots if robot in robots}


def training_counts(
    variant: Variant,
    tasks: int = TASK_COUNT,
    train_seeds: int = TRAIN_SEEDS_PER_TASK,
    robots: tuple[str, ...] = ROBOT_NAMES,
) -> dict[str, int]:
    """Episodes of each robot that a variant learns from; after an adaptation, those of the adaptation (replay not counted)."""
    if variant.target is not None:
        return {variant.target: tasks * variant.shots} if variant.target in robots else {}
    return {robot: tasks * train_seeds for robot in SPLITS[variant.split].train_robots if robot in robots}


def seed_split(seed: int) -> str:
    """'train' or 'test', the family that a scene seed belongs to."""
    return "test" if seed >= TEST_SEED_START else "train"
