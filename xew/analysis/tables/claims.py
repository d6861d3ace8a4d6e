"""The paper's claims, as inequalities and equivalences that any study's numbers can be tested against.

A bound is the number in the paper's text. Where the text has only a word ("several times"), the bound is ours and the test
says so. To add a claim: a function of a `Reader` and one entry in CLAIMS.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from xew.analysis.correlation import leave_one_out
from xew.analysis.statistics.grades import REFERENCE
from xew.analysis.tables.comparisons import Claim, Comparison, NotMeasuredError, Reader
from xew.analysis.tables.labels import PAPER_METRICS, SHORT_ROBOTS, SYSTEMS, spell_key
from xew.protocol import FORGETTING_ROBOT, HELD_OUT_ROBOTS, ROBOT_NAMES, SHOTS
from xew.statistics import combine, fixed_mean, pearson

FRANKA, PIPER = HELD_OUT_ROBOTS
PIXELS = ("ray_map", "mask", "optical_flow")
Comparisons = Callable[[Reader], Iterator[Comparison]]


def _gap(reader: Reader) -> Iterator[Comparison]:
    for robot in HELD_OUT_ROBOTS:
        yield reader.unseen_gap(robot, "lpips")


def _gains(part: str, pairs: Sequence[tuple[str, str, str]], metrics: Sequence[str], above: float = 0) -> Comparisons:
    """Gains of rows over others of a part, on both held-out robots.

    `pairs` are row, row before it, and beginning of the label; `{robot}` stands for the robot's key.
    """

    def compare(reader: Reader) -> Iterator[Comparison]:
        for metric, robot, (after, before, label) in product(metrics, HELD_OUT_ROBOTS, pairs):
            gain = reader.gain(part, after.format(robot=robot), before.format(robot=robot), robot, metric, above)
            yield _relabel(gain, f"{label}, {gain.label}" if label else gain.label)

    return compare


def _against_others(winner: str, metrics: Sequence[str]) -> Comparisons:
    others = (other for other in ("joints", *PIXELS) if other != winner)
    return _gains("actions", [(winner, other, f"over {spell_key(other)}") for other in others], metrics)


def _ray_map_share(reader: Reader) -> Iterator[Comparison]:
    for robot in HELD_OUT_ROBOTS:
        joints, rays, flow = (reader.mean("actions", row, robot, "lpips") for row in ("joints", "ray_map", "optical_flow"))
        share, doubt = reader.share(joints, rays, flow, "lpips")
        subject = ("actions", "ray_map", robot, "lpips")
        yield Comparison(f"{SHORT_ROBOTS[robot]} LPIPS", share, above=1 / 3, doubt=doubt, subject=subject)


def _more_views(reader: Reader) -> Iterator[Comparison]:
    for metric, bound in (("lpips", 0.01), ("mask_iou", 0.02)):
        for robot in HELD_OUT_ROBOTS:
            yield reader.gain("ladder", "nine_views", "reference_image", robot, metric, -bound, bound)


def _render_several_times(reader: Reader) -> Iterator[Comparison]:
    for metric in ("region_lpips", "mask_iou"):
        for robot in HELD_OUT_ROBOTS:
            render = reader.gain("ladder", "robot_render", "none", robot, metric, above=0)
            views = reader.gain("ladder", "nine_views", "none", robot, metric)
            # Three times a loss is no bound: where the views do not help, the render has to.
            yield _relabel(render, f"{render.label}: render")
            left = combine(lambda gain, small: gain - 3 * small, render.number, views.number)
            yield Comparison(f"{render.label}: render − 3 × views", left, above=0, doubt=render.doubt)


def _render_closes(reader: Reader) -> Iterator[Comparison]:
    for robot in HELD_OUT_ROBOTS:
        for row, title, above, below in (("robot_render", "render", 0.5, np.inf), ("nine_views", "nine views", -np.inf, 0.25)):
            share, doubt = reader.closed_share("ladder", row, "none", robot, "region_lpips", ("ladder", "none"))
            subject = ("ladder", row, robot, "region_lpips")
            yield Comparison(f"{title}, {SHORT_ROBOTS[robot]}", share, above, below, doubt=doubt, subject=subject)


def _most_at_once(reader: Reader) -> Iterator[Comparison]:
    for robot in HELD_OUT_ROBOTS:
        none, one, three = (reader.mean("few_shot", f"{robot}-{shots}", robot, "lpips") for shots in (0, 1, 3))
        share, doubt = reader.share(none, one, three, "lpips")
        yield Comparison(f"{SHORT_ROBOTS[robot]} LPIPS", share, above=0.5, doubt=doubt)


def _frame_flatters(reader: Reader) -> Iterator[Comparison]:
    for robot in HELD_OUT_ROBOTS:
        (frame, doubt), (region, region_doubt) = (
            reader.closed_share("few_shot", f"{robot}-3", f"{robot}-0", robot, metric, ("few_shot", REFERENCE))
            for metric in ("lpips", "region_lpips")
        )
        yield Comparison(
            f"{SHORT_ROBOTS[robot]}: frame − region", combine(np.subtract, frame, region), above=0, doubt=doubt or region_doubt
        )


def _forgets(reader: Reader) -> Iterator[Comparison]:
    for robot in HELD_OUT_ROBOTS:
        for shots in SHOTS:
            gain = reader.gain("forgetting", "none", f"{robot}-{shots}", FORGETTING_ROBOT, "lpips", above=0)
            yield _relabel(gain, f"M = {shots}, after {SHORT_ROBOTS[robot]}")


def _catastrophe(reader: Reader) -> Iterator[Comparison]:
    gain = reader.gain("forgetting", f"{FRANKA}-1", "none", FORGETTING_ROBOT, "lpips", above=0)
    yield Comparison("UR5 LPIPS grows by", combine(np.negative, gain.number), above=0.5, doubt=gain.doubt)


def _remedies(reader: Reader) -> Iterator[Comparison]:
    for remedy, robot, shots in product(("replay", "lora"), HELD_OUT_ROBOTS, SHOTS):
        row = f"{robot}-{shots}"
        gain = reader.gain("forgetting", f"{row}-{remedy}", row, FORGETTING_ROBOT, "lpips", above=0)
        yield _relabel(gain, f"{remedy}, M = {shots}, {SHORT_ROBOTS[robot]}")


def _smallest_r(distances: np.ndarray, scores: np.ndarray) -> np.ndarray:
    return leave_one_out(distances, scores)[0]


def _appearance_predicts(metrics: Sequence[str], above: float = 0) -> Comparisons:
    def compare(reader: Reader) -> Iterator[Comparison]:
        for metric in metrics:
            yield reader.correlation(f"r, {reader.title(metric)}", metric, pearson, ("appearance",), above)

    return compare


def _appearance_stable(reader: Reader) -> Iterator[Comparison]:
    # The exact p is of all five robots; among the pairings of four, none is rare enough.
    whole = reader.correlation("r", "lpips", pearson, ("appearance",))
    smallest = reader.correlation("smallest r without one robot", "lpips", _smallest_r, ("appearance",))
    yield replace(smallest, doubt=whole.doubt, exact=whole.exact)


def _kinematic_unstable(reader: Reader) -> Iterator[Comparison]:
    # Five robots can show that there is a relation, not that there is none.
    whole = reader.correlation("r", "lpips", pearson, ("kinematic",))
    smallest = reader.correlation("smallest r without one robot", "lpips", _smallest_r, ("kinematic",))
    yield replace(smallest, above=-np.inf, below=0, doubt=whole.doubt, exact=(1.0, whole.exact[0]))


def _r_ahead(appearance: np.ndarray, kinematic: np.ndarray, scores: np.ndarray) -> np.ndarray:
    return pearson(appearance, scores) - pearson(kinematic, scores)


def _appearance_first(reader: Reader) -> Iterator[Comparison]:
    yield reader.correlation("r of appearance − r of kinematics", "lpips", _r_ahead, ("appearance", "kinematic"))


def _appearance_first_always(reader: Reader) -> Iterator[Comparison]:
    (whole,) = _appearance_first(reader)
    for i, robot in enumerate(ROBOT_NAMES):
        rest = [j for j in range(len(ROBOT_NAMES)) if j != i]

        def without(*values: np.ndarray, rest: list[int] = rest) -> np.ndarray:
            return _r_ahead(*(value[..., rest] for value in values))

        difference = reader.correlation(f"without {SHORT_ROBOTS[robot]}", "lpips", without, ("appearance", "kinematic"))
        yield replace(difference, doubt=whole.doubt, exact=whole.exact)


def _pair_differs_in_appearance(reader: Reader) -> Iterator[Comparison]:
    if not reader.grades.own_distances:
        raise NotMeasuredError("distances between robots (--distances)")
    for axis, above, below in (("appearance", 1.5, np.inf), ("kinematic", 1 / 1.25, 1.25)):
        values = reader.grades.axis(axis)
        ratio = values[..., ROBOT_NAMES.index(FRANKA)] / values[..., ROBOT_NAMES.index(PIPER)]
        number = fixed_mean(np.resize(ratio, max(2, ratio.size)), 0, None)
        yield Comparison(f"{axis}, Franka / Piper", number, above, below, percent=False)


def _systems_degrade(metrics: Sequence[str], robots: Sequence[str], above: float = 0) -> Comparisons:
    def compare(reader: Reader) -> Iterator[Comparison]:
        for system, metric, robot in product(SYSTEMS, metrics, robots):
            loss = reader.worse_than_seen("baselines", system, robot, metric, above)
            yield _relabel(loss, f"{SYSTEMS[system]}, {loss.label}")

    return compare


def _pixel_systems(metrics: Sequence[str]) -> Comparisons:
    pairs = product((REFERENCE, "enerverse_ac"), ("irasim", "ctrl_world"))
    labeled = [(pixel, numeric, f"{SYSTEMS[pixel]} over {SYSTEMS[numeric]}") for pixel, numeric in pairs]
    return _gains("baselines", labeled, metrics)


def _relabel(comparison: Comparison, label: str) -> Comparison:
    return replace(comparison, label=label)


OVER_JOINTS = [(action, "joints", spell_key(action)) for action in PIXELS]
GAP, ACTION, LOOKS, SHOT = "Experiments", "Action representation", "Robot descriptions", "Few-shot adaptation"
DISTANCE, MODELS, OURS = "Embodiment distance", "World models", "ours"
CLAIMS = (
    Claim("gap", GAP, "Robots that were never seen are rendered worse than seen ones.",
          "LPIPS of the fold without Franka (Piper) is above that of the folds with it, on the same episodes", _gap),
    Claim("pixels beat joints", ACTION, "Image-space actions transfer to unseen robots better than joint angles.",
          "LPIPS of ray map, mask and flow is below that of joint pose, for both robots",
          _gains("actions", OVER_JOINTS, ("lpips",))),
    Claim("pixels keep shape", ACTION, "Image-space actions keep an unseen robot's shape better than joint angles.",
          "mask IoU of ray map, mask and flow is above that of joint pose, for both robots",
          _gains("actions", OVER_JOINTS, ("mask_iou",))),
    Claim("flow gains much", ACTION, "Optical flow is much better than joint pose.",
          "LPIPS and mask IoU better by more than 20 % (the paper: 29, 57, 25, 116 %; the bound is ours)",
          _gains("actions", [("optical_flow", "joints", "")], ("lpips", "mask_iou"), above=0.2)),
    Claim("rays recover", ACTION, "A sparse ray map closes much of the distance from joint pose to optical flow.",
          "in LPIPS, ray map closes more than 1/3 of the distance from joint pose to flow (the bound is ours)", _ray_map_share),
    Claim("mask keeps outlines", ACTION, "A mask keeps the robot's outline best.",
          "mask IoU and boundary F1 of mask are above all others, for both robots",
          _against_others("mask", ("mask_iou", "boundary_f1"))),
    Claim("flow looks best", ACTION, "Optical flow gives the best image quality.",
          "LPIPS of flow is below all others, for both robots", _against_others("optical_flow", ("lpips",))),
    Claim("one image helps", LOOKS, "A first reference image helps a little.",
          "region LPIPS with a reference image is below that of flow only, for both robots",
          _gains("ladder", [("reference_image", "none", "")], ("region_lpips",))),
    Claim("views saturate", LOOKS, "Nine views are no better than one image.",
          "equivalence: LPIPS changes by less than 1 %, mask IoU by less than 2 % either way, for both robots", _more_views),
    Claim("clip is no better", LOOKS, "An articulation clip is worse than nine views.",
          "LPIPS with the clip is above that with nine views, for both robots",
          _gains("ladder", [("nine_views", "articulation_clip", "nine views over the clip")], ("lpips",))),
    Claim("render gains most", LOOKS, "A render aligned with every frame gains several times what nine views gain.",
          "its gain over flow only is above 0 and more than 3 times theirs, region LPIPS and mask IoU (the bound is ours)",
          _render_several_times),
    Claim("only alignment closes the gap", LOOKS, "Without alignment in time and space, most of the gap remains.",
          "the render closes more than 1/2 of the gap in region LPIPS to folds that saw the robot, nine views less than 1/4 "
          "(bounds are ours)",
          _render_closes),
    Claim("adaptation pays", SHOT, "One demonstration of each task brings a large gain.",
          "LPIPS on the target falls by more than 25 % at M = 1 (the paper: 30 and 32 %; the bound is ours)",
          _gains("few_shot", [("{robot}-1", "{robot}-0", "")], ("lpips",), above=0.25)),
    Claim("returns diminish", SHOT, "The first demonstration brings most of the gain.",
          "the gain in LPIPS at M = 1 is more than half of the gain at M = 3", _most_at_once),
    Claim("the frame flatters", SHOT, "Full-frame scores recover more than scores of the robot's region.",
          "at M = 3 LPIPS closes a larger share of the gap to folds that saw the robot than region LPIPS", _frame_flatters),
    Claim("forgetting", SHOT, "Adapting to a new robot makes a seen one worse.",
          "LPIPS on UR5 is lower before adaptation than after each (as a share of LPIPS after it)", _forgets),
    Claim("catastrophic forgetting", SHOT, "One Franka demonstration of each task makes UR5 much worse.",
          "LPIPS on UR5 grows by more than 50 % (the paper: 69 %; the bound is ours)", _catastrophe),
    Claim("far in looks only", "Protocol", "Franka and Piper are equally distant in kinematics, but not in appearance.",
          "Franka / Piper: appearance distance above 1.5; kinematic distance from 1/1.25 to 1.25 (bounds are ours)",
          _pair_differs_in_appearance),
    Claim("looks predict", DISTANCE, "Appearance distance predicts the difficulty of a robot.",
          "r of appearance distance with LPIPS is above 0.7 (the paper: 0.812; the bound is ours), exact p at most 0.05",
          _appearance_predicts(("lpips",), above=0.7)),
    Claim("looks are stable", DISTANCE, "Appearance distance predicts difficulty when any one robot is left out.",
          "every r without one robot is above 0, exact p of all five at most 0.05", _appearance_stable),
    Claim("kinematics are unstable", DISTANCE, "Kinematic distance predicts difficulty weakly and not stably.",
          "fails if the exact p is at most 0.05 and every r without one robot is above 0; five robots cannot show more",
          _kinematic_unstable),
    Claim("looks before kinematics", DISTANCE, "Appearance predicts difficulty better than kinematics.",
          "in LPIPS, r of appearance distance is above r of kinematic distance, exact p at most 0.05", _appearance_first),
    Claim("all systems degrade", MODELS, "Every world model is worse on unseen robots.",
          "LPIPS and mask IoU on Franka and Piper are worse than on seen robots, scaled by each robot's difficulty for the "
          "folds that saw it, for all four", _systems_degrade(("lpips", "mask_iou"), HELD_OUT_ROBOTS)),
    Claim("systems degrade much", MODELS, "Every world model is worse on Franka by 38 % or more in LPIPS.",
          "LPIPS on Franka is more than 30 % above the scaled LPIPS on seen robots, for all four (the bound is ours)",
          _systems_degrade(("lpips",), (FRANKA,), above=0.3)),
    Claim("pixel systems lead", MODELS, "World models with image-space actions are better on unseen robots.",
          "LPIPS of the reference model and EnerVerse-AC is below that of IRASim and Ctrl-World", _pixel_systems(("lpips",))),
    Claim("pixel systems lead in all", OURS, "World models with image-space actions are better in all four dimensions.",
          "the same comparisons in mask IoU, PCK and object error", _pixel_systems(("mask_iou", "pck", "trajectory_error"))),
    Claim("looks are significant", OURS, "Appearance distance predicts difficulty beyond chance.",
          "r of appearance distance with LPIPS is above 0, exact p at most 0.05",
          _appearance_predicts(("lpips",))),
    Claim("looks before kinematics, always", OURS, "Appearance predicts better than kinematics without any one robot.",
          "in LPIPS, r of appearance is above r of kinematics without any one robot, exact p of all five at most 0.05",
          _appearance_first_always),
    Claim("looks predict everything", OURS, "Appearance distance predicts every metric, not image quality alone.",
          "r of appearance distance is above 0 for all ten metrics, each with exact p at most 0.05",
          _appearance_predicts(PAPER_METRICS)),
    Claim("remedies", OURS, "Replay and LoRA forget less than training all weights.",
          "LPIPS on UR5 is below LPIPS after plain adaptation, for every target and M", _remedies),
)  # fmt: skip
"""Claims in the order of the paper's sections; `ours` are stricter than the paper's."""
