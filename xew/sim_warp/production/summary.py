"""The tables of a data set: tried and successful cells by task and robot, reasons of failure, and outcomes by fault."""

from collections import Counter, defaultdict
from collections.abc import Sequence

from xew.dataset import count_motions
from xew.episode import Record
from xew.names import plain_line
from xew.protocol import split_fault


def yield_table(records: Sequence[Record]) -> str:
    """Tables of an expert's cells, of accepted seeds by task, of motions, and of faults if there are any."""
    experts, faulty = ([record for record in records if bool(record.fault) == has_fault] for has_fault in (False, True))
    tables = [_expert_table(experts)] if experts or not faulty else []
    return "\n".join([*tables, *_list_kinds(records), *([fault_table(faulty)] if faulty else [])])


def _expert_table(records: Sequence[Record]) -> str:
    """Table of tried and successful cells, frames and failures by task and robot, then accepted seeds by task."""
    cells: dict[tuple[str, str], list[Record]] = defaultdict(list)
    seeds: dict[str, dict[int, bool]] = defaultdict(dict)
    for record in records:
        cells[record.task, record.robot].append(record)
        seeds[record.task][record.seed] = seeds[record.task].get(record.seed, True) and record.success
    task_width = max(map(len, ("task", *seeds)))
    robot_width = max(len(robot) for robot in ("robot", *(robot for _, robot in cells)))
    lines = [f"{'task':<{task_width}} {'robot':<{robot_width}} {'tried':>6}{'succeeded':>11}{'frames':>8}  reasons"]
    for (task, robot), tried in sorted(cells.items()):
        good = [record for record in tried if record.success]
        frames = sum(record.frame_count for record in good) // max(1, len(good))
        reasons = Counter(plain_line(str(record.failure)) for record in tried if not record.success)
        listed = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
        share = f"{len(good)} ({100 * len(good) / len(tried):.0f} %)"
        lines.append(f"{task:<{task_width}} {robot:<{robot_width}} {len(tried):>6}{share:>11}{frames:>8}  {listed}")
    for task, accepted in sorted(seeds.items()):
        lines.append(f"{task:<{task_width}} all robots together: {sum(accepted.values())} of {len(accepted)} seeds accepted")
    return "\n".join(lines)


def _list_kinds(records: Sequence[Record]) -> list[str]:
    """Lines with the numbers of episodes by motion and by change."""
    lines = ["motion: " + ", ".join(f"{motion} {count}" for motion, count in count_motions(records).items())]
    if changes := Counter(record.change for record in records if record.change):
        lines.append("changes: " + ", ".join(f"{change} {count}" for change, count in sorted(changes.items())))
    return lines


def fault_table(records: Sequence[Record]) -> str:
    """Table of scenes, refused scenes, episodes, successes and mean progress by fault, and reasons of refusal by cell.

    The last line counts scenes by the number of their commands, with the expert's.
    """
    width = max(len("fault"), *(len(record.fault) for record in records))
    accepted: set[tuple[str, int]] = set()
    lines = [f"{'fault':<{width}} {'scenes':>6}{'refused':>8}{'episodes':>9}{'success':>8}{'progress':>9}  reasons"]
    for fault in sorted({record.fault for record in records}, key=sort_faults):
        tried = [record for record in records if record.fault == fault]
        refused = {(record.task, record.seed) for record in tried if not record.is_kept}
        kept = [record for record in tried if (record.task, record.seed) not in refused]
        scenes = len({(record.task, record.seed) for record in tried})
        success, progress = (_mean([getattr(record, name) for record in kept]) for name in ("success", "progress"))
        reasons = Counter(plain_line(str(record.failure)) for record in tried if not record.is_kept)
        listed = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
        lines.append(
            f"{fault:<{width}} {scenes:>6}{len(refused):>8}{len(kept):>9}{success:>8.0%}{progress:>9.2f}  {listed}".rstrip()
        )
        accepted |= {(record.task, record.seed) for record in kept}
    sets = Counter((task, split_fault(seed)[1]) for task, seed in accepted)
    sizes = ", ".join(f"{size + 1} in {count}" for size, count in sorted(Counter(sets.values()).items()))
    return "\n".join([*lines, f"commands by scene: {sizes or 'none'}"])


def sort_faults(fault: str) -> tuple[str, float]:
    """The key that sorts faults by name and then by severity."""
    name, _, severity = fault.partition(":")
    return name, float(severity or 0)


def _mean(values: Sequence[float]) -> float:
    return sum(values) / max(1, len(values))
