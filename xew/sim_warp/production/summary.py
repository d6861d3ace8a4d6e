"""The table of a data set: tried and successful cells by task and robot, and reasons of failure."""

from collections import Counter, defaultdict
from collections.abc import Sequence

from xew.dataset import count_motions
from xew.episode import Record
from xew.names import plain_line


def yield_table(records: Sequence[Record]) -> str:
    """Table of tried and successful cells, frames and failures by task and robot, then accepted seeds by task, and motions."""
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
    lines.append("motion: " + ", ".join(f"{motion} {count}" for motion, count in count_motions(records).items()))
    if changes := Counter(record.change for record in records if record.change):
        lines.append("changes: " + ", ".join(f"{change} {count}" for change, count in sorted(changes.items())))
    return "\n".join(lines)
