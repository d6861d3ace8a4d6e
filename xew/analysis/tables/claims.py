"""The paper's claims, as inequalities and equivalences that can be asked of any study's numbers.

Where the paper's text has a number, the bound is that number. Where it has a word only ("substantial", "several times"), the
bound is ours and the claim says so in its test. To add a claim: a function of a `Reader` and one entry in CLAIMS.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from xew.analysis.correlation import leave_one_out, pearson
from xew.analysis.statistics.grades import REFERENCE
from xew.analysis.tables.comparisons import Claim, Comparison, NotMeasuredError, Reader
from xew.analysis.tables.labels import PAPER_METRICS, SHORT_ROBOTS, SYSTEMS
from xew.protocol import FORGETTING_ROBOT, HELD_OUT_ROBOTS, ROBOT_NAMES, SHOTS
from xew.statistics import Mean, combine

FRANKA, PIPER = HELD_OUT_ROBOTS


def _gap(reader: Reader) -> Iterator[Comparison]:
    for robot in HELD_OUT_ROBOTS:
        yield reader.unseen_gap(robot, "lpips")


def _pixels_beat_joints(metric: str) -> Callable[[Reader], Iterator[Comparison]]:
    def compare(reader: Reader) -> Iterator[Comparison]:
        for action in ("ray_map", "mask", "optical_flow"):
            for robot in HELD_OUT_ROBOTS:
                made = reader.gain("actions", action, "joints", robot, metric, above=0)
                yield _relabel(made, f"{action.replace('_', ' ')}, {made.label}")

    return compare


def _flow_gain(reader: Reader) -> Iterator[Comparison]:
    for metric in ("lpips", "mask_iou"):
        for robot in HELD_OUT_ROBOTS:
            yield reader.gain("actions", "optical_flow", "joints", robot, metric, above=0.2)


def _ray_map_share(reader: Reader) -> Iterator[Comparison]:
    for robot in HELD_OUT_ROBOTS:
        joints, rays, flow = (reader.mean("actions", row, robot, "lpips") for row in ("joints", "ray_map", "optical_flow"))
        share, doubt = reader.share(joints, rays, flow, "lpips")
        subject = ("actions", "ray_map", robot, "lpips")
        yield Comparison(f"{SHORT_ROBOTS[robot]} LPIPS", share, above=1 / 3, doubt=doubt, subject=subject)


def _against_others(winner: str, metrics: Sequence[str]) -> Callable[[Reader], Iterator[Comparison]]:
    def compare(reader: Reader) -> Iterator[Comparison]:
        for metric in metrics:
            for robot in HELD_OUT_ROBOTS:
                for other in ("joints", "ray_map", "mask", "optical_flow"):
                    if other != winner:
                        made = reader.gain("actions", winner, other, robot, metric, above=0)
                        yield _relabel(made, f"over {other.replace('_', ' ')}, {made.label}")

    return compare


def _first_image(reader: Reader) -> Iterator[Comparison]:
    for robot in HELD_OUT_ROBOTS:
        yield reader.gain("ladder", "reference_image", "none", robot, "region_lpips", above=0)


def _more_views(reader: Reader) -> Iterator[Comparison]:
    for metric, bound in (("lpips", 0.01), ("mask_iou", 0.02)):
        for robot in HELD_OUT_ROBOTS:
            yield reader.gain("ladder", "nine_views", "reference_image", robot, metric, -bound, bound)


def _clip(reader: Reader) -> Iterator[Comparison]:
    for robot in HELD_OUT_ROBOTS:
        made = reader.gain("ladder", "nine_views", "articulation_clip", robot, "lpips", above=0)
        yield _relabel(made, f"nine views over the clip, {made.label}")


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


def _first_round(reader: Reader) -> Iterator[Comparison]:
    for robot in HELD_OUT_ROBOTS:
        yield reader.gain("few_shot", f"{robot}-1", f"{robot}-0", robot, "lpips", above=0.25)


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
            made = reader.gain("forgetting", "none", f"{robot}-{shots}", FORGETTING_ROBOT, "lpips", above=0)
            yield _relabel(made, f"M = {shots}, after {SHORT_ROBOTS[robot]}")


def _catastrophe(reader: Reader) -> Iterator[Comparison]:
    made = reader.gain("forgetting", f"{FRANKA}-1", "none", FORGETTING_ROBOT, "lpips", above=0)
    yield Comparison("UR5 LPIPS grows by", combine(np.negative, made.number), above=0.5, doubt=made.doubt)


def _remedies(reader: Reader) -> Iterator[Comparison]:
    for remedy in ("replay", "lora"):
        for robot in HELD_OUT_ROBOTS:
            for shots in SHOTS:
                row = f"{robot}-{shots}"
                made = reader.gain("forgetting", f"{row}-{remedy}", row, FORGETTING_ROBOT, "lpips", above=0)
                yield _relabel(made, f"{remedy}, M = {shots}, {SHORT_ROBOTS[robot]}")


def _smallest_r(distances: np.ndarray, scores: np.ndarray) -> np.ndarray:
    return leave_one_out(distances, scores)[0]


def _appearance_strong(reader: Reader) -> Iterator[Comparison]:
    yield reader.correlation("r", "lpips", pearson, ("appearance",), above=0.7)


def _appearance_stable(reader: Reader) -> Iterator[Comparison]:
    # How far r is from chance is asked of all five robots; of four, no pairing is rare enough.
    whole = reader.correlation("r", "lpips", pearson, ("appearance",))
    made = reader.correlation("smallest r without one robot", "lpips", _smallest_r, ("appearance",))
    yield replace(made, doubt=whole.doubt, exact=whole.exact)


def _kinematic_unstable(reader: Reader) -> Iterator[Comparison]:
    # That there is no relation cannot be shown by five robots, only that there is one.
    whole = reader.correlation("r", "lpips", pearson, ("kinematic",))
    made = reader.correlation("smallest r without one robot", "lpips", _smallest_r, ("kinematic",))
    yield replace(made, above=-np.inf, below=0, doubt=whole.doubt, exact=(1.0, whole.exact[0]))


def _r_ahead(looks: np.ndarray, reach: np.ndarray, scores: np.ndarray) -> np.ndarray:
    return pearson(looks, scores) - pearson(reach, scores)


def _appearance_first(reader: Reader) -> Iterator[Comparison]:
    yield reader.correlation("r of appearance − r of kinematics", "lpips", _r_ahead, ("appearance", "kinematic"))


def _appearance_first_always(reader: Reader) -> Iterator[Comparison]:
    whole = reader.correlation("r of appearance − r of kinematics", "lpips", _r_ahead, ("appearance", "kinematic"))
    for i, robot in enumerate(ROBOT_NAMES):
        rest = [j for j in range(len(ROBOT_NAMES)) if j != i]

        def without(*values: np.ndarray, rest: list[int] = rest) -> np.ndarray:
            return _r_ahead(*(value[..., rest] for value in values))

        made = reader.correlation(f"without {SHORT_ROBOTS[robot]}", "lpips", without, ("appearance", "kinematic"))
        yield replace(made, doubt=whole.doubt, exact=whole.exact)


def _appearance_everywhere(reader: Reader) -> Iterator[Comparison]:
    for metric in PAPER_METRICS:
        yield reader.correlation(reader.title(metric), metric, pearson, ("appearance",))


def _appearance_significant(reader: Reader) -> Iterator[Comparison]:
    yield reader.correlation("r", "lpips", pearson, ("appearance",))


def _pair_differs_in_looks(reader: Reader) -> Iterator[Comparison]:
    if not reader.grades.own_distances:
        raise NotMeasuredError("distances between robots (--distances)")
    for axis, above, below in (("appearance", 1.5, np.inf), ("kinematic", 1 / 1.25, 1.25)):
        values = reader.grades.axis(axis)
        ratio = values[..., ROBOT_NAMES.index(FRANKA)] / values[..., ROBOT_NAMES.index(PIPER)]
        number = Mean(np.resize(ratio, max(2, ratio.size)), 0, None)
        yield Comparison(f"{axis}, Franka / Piper", number, above, below, percent=False)


def _systems_degrade(reader: Reader) -> Iterator[Comparison]:
    for system, title in SYSTEMS.items():
        for metric in ("lpips", "mask_iou"):
            for robot in HELD_OUT_ROBOTS:
                made = reader.worse_than_seen("baselines", system, robot, metric)
                yield _relabel(made, f"{title}, {made.label}")


def _systems_degrade_much(reader: Reader) -> Iterator[Comparison]:
    for system, title in SYSTEMS.items():
        made = reader.worse_than_seen("baselines", system, FRANKA, "lpips", above=0.3)
        yield _relabel(made, title)


def _pixel_systems(metrics: Sequence[str]) -> Callable[[Reader], Iterator[Comparison]]:
    def compare(reader: Reader) -> Iterator[Comparison]:
        for metric in metrics:
            for robot in HELD_OUT_ROBOTS:
                for told in (REFERENCE, "enerverse_ac"):
                    for numeric in ("irasim", "ctrl_world"):
                        made = reader.gain("baselines", told, numeric, robot, metric, above=0)
                        yield _relabel(made, f"{SYSTEMS[told]} over {SYSTEMS[numeric]}, {made.label}")

    return compare


def _relabel(comparison: Comparison, label: str) -> Comparison:
    return replace(comparison, label=label)


GAP, ACTION, LOOKS, SHOT = "Experiments", "Action representation", "Robot descriptions", "Few-shot adaptation"
DISTANCE, MODELS, OURS = "Embodiment distance", "World models", "ours"
CLAIMS = (
    Claim("gap", GAP, "Robots that were never seen are rendered worse than seen ones.",
          "LPIPS of the fold without Franka (Piper) is above that of the folds with it, on the same episodes", _gap),
    Claim("pixels beat joints", ACTION, "Actions shown in the image carry over to unseen robots better than joint numbers.",
          "LPIPS of ray map, mask and flow is below that of joint pose, for both robots", _pixels_beat_joints("lpips")),
    Claim("pixels keep shape", ACTION, "… and keep the robot's shape better.",
          "mask IoU of ray map, mask and flow is above that of joint pose, for both robots", _pixels_beat_joints("mask_iou")),
    Claim("flow gains much", ACTION, "Optical flow in place of joint pose is a large step.",
          "LPIPS and mask IoU better by more than 20 % (the paper: 29, 57, 25, 116 %; the bound is ours)", _flow_gain),
    Claim("rays recover", ACTION, "Even a sparse ray map recovers much of what joint pose loses.",
          "ray map goes more than 1/3 of the way in LPIPS from joint pose to flow (the bound is ours)", _ray_map_share),
    Claim("mask keeps outlines", ACTION, "A mask keeps the robot's outline best.",
          "mask IoU and boundary F1 of mask are above all others, for both robots",
          _against_others("mask", ("mask_iou", "boundary_f1"))),
    Claim("flow looks best", ACTION, "Optical flow gives the best picture.",
          "LPIPS of flow is below all others, for both robots", _against_others("optical_flow", ("lpips",))),
    Claim("one image helps", LOOKS, "A first reference image helps a little.",
          "region LPIPS with a reference image is below that of flow only, for both robots", _first_image),
    Claim("views saturate", LOOKS, "Nine views add next to nothing to one image.",
          "equivalence: LPIPS changes by less than 1 %, mask IoU by less than 2 % either way, for both robots", _more_views),
    Claim("clip is no better", LOOKS, "An articulation clip takes back some of the gain of nine views.",
          "LPIPS with the clip is above that with nine views, for both robots", _clip),
    Claim("render gains most", LOOKS, "A render aligned with every frame gains several times what nine views gain.",
          "its gain over flow only is above 0 and more than 3 times theirs, region LPIPS and mask IoU (the bound is ours)",
          _render_several_times),
    Claim("only alignment closes the gap", LOOKS, "Without alignment in time and space most of the gap to seen robots stays.",
          "of the gap in region LPIPS to folds that saw the robot the render closes more than 1/2, nine views less than 1/4 "
          "(bounds are ours)",
          _render_closes),
    Claim("adaptation pays", SHOT, "One demonstration of each task already helps much.",
          "LPIPS on the target falls by more than 25 % at M = 1 (the paper: 30 and 32 %; the bound is ours)", _first_round),
    Claim("returns diminish", SHOT, "The first demonstration brings most of the gain.",
          "M = 1 has more than half of the gain in LPIPS that M = 3 has", _most_at_once),
    Claim("the frame flatters", SHOT, "Full-frame scores recover more than the robot itself does.",
          "at M = 3 LPIPS closes a larger share of the gap to folds that saw the robot than region LPIPS", _frame_flatters),
    Claim("forgetting", SHOT, "Adapting to a new robot makes a seen one worse.",
          "LPIPS on UR5 before adaptation is below that after each (by which share of it)", _forgets),
    Claim("catastrophic forgetting", SHOT, "… by much: one Franka demonstration of each task is enough.",
          "LPIPS on UR5 grows by more than 50 % (the paper: 69 %; the bound is ours)", _catastrophe),
    Claim("far in looks only", "Protocol", "Franka and Piper are as far in kinematics, but not in looks.",
          "appearance distance above 1.5 times; kinematic alike, from 1/1.25 to 1.25 times (bounds are ours)",
          _pair_differs_in_looks),
    Claim("looks predict", DISTANCE, "Distance in looks predicts how hard a robot is.",
          "r of appearance distance with LPIPS is above 0.7 (the paper: 0.812; the bound is ours), exact p at most 0.05",
          _appearance_strong),
    Claim("looks are stable", DISTANCE, "… whichever robot is left out.",
          "all r without one robot are above 0, exact p of all five at most 0.05", _appearance_stable),
    Claim("kinematics are unstable", DISTANCE, "Kinematic distance predicts it weakly and not stably.",
          "fails where the exact p is at most 0.05 and all r without one robot are above 0; five robots cannot show more",
          _kinematic_unstable),
    Claim("looks before kinematics", DISTANCE, "Looks, and not kinematics, decide.",
          "r of appearance distance is above that of kinematic distance, in LPIPS, exact p at most 0.05", _appearance_first),
    Claim("all systems degrade", MODELS, "Every world model does worse on unseen robots.",
          "LPIPS and mask IoU on Franka and Piper are worse than on seen robots, times how much harder each is for the folds "
          "that saw it, for all four", _systems_degrade),
    Claim("systems degrade much", MODELS, "… on Franka by 38 % or more in LPIPS.",
          "LPIPS on Franka is more than 30 % above that, for all four (the bound is ours)",
          _systems_degrade_much),
    Claim("pixel systems lead", MODELS, "World models told actions in the image do better on unseen robots.",
          "LPIPS of the reference model and EnerVerse-AC is below that of IRASim and Ctrl-World", _pixel_systems(("lpips",))),
    Claim("pixel systems lead in all", OURS, "… in all four dimensions.",
          "the same with mask IoU, PCK and object error", _pixel_systems(("mask_iou", "pck", "trajectory_error"))),
    Claim("looks are significant", OURS, "Looks predict difficulty beyond chance.",
          "r of appearance distance with LPIPS is above 0, exact p at most 0.05", _appearance_significant),
    Claim("looks before kinematics, always", OURS, "Looks decide whichever robot is left out.",
          "r of appearance is above r of kinematics without any one robot, in LPIPS, exact p of all five at most 0.05",
          _appearance_first_always),
    Claim("looks predict everything", OURS, "Looks predict every dimension, not the picture alone.",
          "r of appearance distance is above 0 for all ten metrics, each exact p at most 0.05", _appearance_everywhere),
    Claim("remedies", OURS, "Replay and LoRA forget less than training all weights.",
          "LPIPS on UR5 is below that after plain adaptation, for every target and M", _remedies),
)  # fmt: skip
"""In the order of the paper's sections; `ours` asks more than it claims."""
