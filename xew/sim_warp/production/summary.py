"""The table of a data set: cells tried and succeeded by task and robot, and why the others failed."""

from collections import Counter, defaultdict
from collections.abc import Sequence

from xew.dataset import count_motions
from xew.episode import Record


def yield_table(records: Sequence[Record]) -> str:
    """A line per task and robot: cells tried, succeeded, why not, and frames; a line per task of accepted seeds; the motion."""
    cells: dict[tuple[str, str], list[Record]] = defaultdict(list)
    seeds: dict[str, dict[int, bool]] = defaultdict(dict)
    for record in records:
        cells[record.task, record.robot].append(record)
        seeds[record.task][record.seed] = seeds[record.task].get(record.seed, True) and record.success
    wide, room = max(map(len, ("task", *seeds))), max(len(robot) for robot in ("robot", *(robot for _, robot in cells)))
    lines = [f"{'task':<{wide}} {'robot':<{room}} {'tried':>6}{'succeeded':>11}{'frames':>8}  reasons"]
    for (task, robot), tried in sorted(cells.items()):
        good = [record for record in tried if record.success]
        frames = sum(record.frame_count for record in good) // max(1, len(good))
        reasons = Counter(record.failure for record in tried if not record.success)
        listed = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
        share = f"{len(good)} ({100 * len(good) / len(tried):.0f} %)"
        lines.append(f"{task:<{wide}} {robot:<{room}} {len(tried):>6}{share:>11}{frames:>8}  {listed}")
    for task, accepted in sorted(seeds.items()):
        lines.append(f"{task:<{wide}} all robots together: {sum(accepted.values())} of {len(accepted)} seeds accepted")
    lines.append("motion: " + ", ".join(f"{motion} {count}" for motion, count in count_motions(records).items()))
    return "\n".join(lines)
