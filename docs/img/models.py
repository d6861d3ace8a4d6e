"""Draws the pictures of docs/model.md (the network, its streams and mechanisms) and docs/performance.md (time of a step).

`python docs/img/models.py` writes network.png and step_time.png next to this file. The times are those of docs/performance.md.
"""

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

FOLDER = Path(__file__).parent
RGB, CONDITION, MECHANISM, NETWORK, TEXT = "#9ecae1", "#c7e9c0", "#fdd0a2", "#e8e8ee", "#dadaeb"
STREAMS = (
    ("rgb", "noisy latents;\nframe 0 is given", RGB),
    ("history", "earlier frames", CONDITION),
    ("action", "motion as\npictures", CONDITION),
    ("joints", "16 numbers\na latent frame", CONDITION),
    ("embodiment", "appearance as\npictures", CONDITION),
)
"""Name, content and color of each stream, in the order of the tokens."""
MECHANISMS = (
    ("time", "a vector for each\nlatent frame", 5.38),
    ("context", "tokens that\nall tokens read", 4.22),
    ("frame", "tokens for their\nframe alone", 3.06),
)
"""Place, content and height of each mechanism but `channels`."""
TIMES = {
    "training step, two samples\n(remat: attention), 1,278 ms": (683, 312, 1278 - 683 - 312),
    "denoising step, one sample,\n152 ms": (87, 41, 152 - 87 - 41),
}
"""Milliseconds of matrix products, of attention and of the rest, on one H200 (docs/performance.md)."""


def box(axes: Axes, x: float, y: float, width: float, height: float, text: str, color: str, size: float = 9.5) -> None:
    """Draw a box with its lower left corner at (x, y)."""
    style = "round,pad=0,rounding_size=0.08"
    axes.add_patch(FancyBboxPatch((x, y), width, height, boxstyle=style, facecolor=color, edgecolor="#444444", linewidth=0.9))
    axes.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=size)


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Draw an arrow between two points."""
    style = {"arrowstyle": "-|>", "mutation_scale": 11, "color": "#444444", "linewidth": 1.1, "shrinkA": 0, "shrinkB": 0}
    axes.add_patch(FancyArrowPatch(start, end, **style))


def draw_network(path: Path) -> None:
    """Draw the streams below, the blocks above them, and what enters by mechanisms at the sides."""
    figure, axes = plt.subplots(figsize=(12.6, 7), layout="constrained")
    axes.set(xlim=(0, 14.1), ylim=(0, 7.9))
    axes.axis("off")
    for number, (name, content, color) in enumerate(STREAMS):
        x = 1.9 + 1.46 * number
        box(axes, x, 0.1, 1.36, 1.0, f"$\\bf{{{name}}}$\n{content}", color)
        arrow(axes, (x + 0.68, 1.1), (x + 0.68, 1.4))
        box(axes, x, 1.4, 1.36, 0.4, "embedding", NETWORK)
        arrow(axes, (x + 0.68, 1.8), (x + 0.68, 2.1))
        box(axes, x, 2.1, 1.36, 0.4, "tokens", color)
    axes.text(1.75, 2.3, "one sequence", ha="right", va="center", style="italic", fontsize=9)
    box(axes, 1.9, 2.8, 7.2, 3.75, "", "#f7f7fa")
    arrow(axes, (5.5, 2.5), (5.5, 3.15))
    axes.text(2.05, 2.96, "block", style="italic", va="center", fontsize=9)
    for y, text in zip(
        (3.15, 4.3, 5.45),
        (
            "norm, self-attention\nall tokens see all tokens",
            "norm, cross-attention\nevery token reads the context",
            "norm, feed-forward",
        ),
        strict=True,
    ):
        box(axes, 3.3, y, 4.4, 0.8, text, NETWORK)
        arrow(axes, (5.5, y + 0.8), (5.5, y + (1.3 if y > 5 else 1.15)))
    axes.text(8.95, 6.36, "repeated for every layer", style="italic", ha="right", va="center", fontsize=9)
    box(axes, 3.3, 6.75, 4.4, 0.45, "norm, head (of RGB's tokens only)", NETWORK)
    arrow(axes, (5.5, 7.2), (5.5, 7.45))
    axes.text(5.5, 7.62, "velocity of RGB's latents", ha="center", va="center", fontweight="bold")

    box(axes, 9.6, 5.45, 1.9, 0.8, "time embedding\nof the noise level", TEXT)
    arrow(axes, (9.6, 5.85), (7.7, 5.85))
    arrow(axes, (9.75, 5.45), (7.7, 3.55))
    arrow(axes, (10.0, 6.25), (7.7, 6.97))
    box(axes, 9.6, 4.1, 1.9, 0.8, "context:\ntext", TEXT)
    arrow(axes, (9.6, 4.6), (7.7, 4.7))
    for (name, content, y), target in zip(MECHANISMS, (5.85, 4.7, 4.3), strict=True):
        box(axes, 12.0, y, 2.0, 0.95, f"$\\bf{{{name}}}$\n{content}", MECHANISM)
        arrow(axes, (12.0, y + 0.47), (11.5, target))
    box(axes, 0.1, 1.1, 1.5, 1.0, "$\\bf{channels}$\npictures with\nRGB's latents", MECHANISM)
    arrow(axes, (1.6, 1.6), (1.9, 1.6))
    for label, color in {"RGB": RGB, "condition streams": CONDITION, "mechanisms": MECHANISM, "every model": TEXT}.items():
        axes.scatter([], [], marker="s", s=90, color=color, edgecolor="#444444", label=label)
    axes.legend(loc="lower right", frameon=False, fontsize=9)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_times(path: Path) -> None:
    """Draw one bar for each kind of step, in shares of its time."""
    figure, axes = plt.subplots(figsize=(9, 2.3), layout="constrained")
    for name, times in list(TIMES.items())[::-1]:
        left = 0.0
        for time, color in zip(times, (RGB, CONDITION, NETWORK), strict=True):
            share = 100 * time / sum(times)
            axes.barh(name, share, left=left, color=color, edgecolor="#444444", linewidth=0.8, height=0.62)
            axes.text(left + share / 2, name, f"{time} ms\n{share:.0f} %", ha="center", va="center", fontsize=9)
            left += share
    labels = ("matrix products", "attention", "everything elementwise, in training the optimizer")
    for label, color in zip(labels, (RGB, CONDITION, NETWORK), strict=True):
        axes.barh([0], [0], color=color, edgecolor="#444444", label=label)
    axes.set(xlim=(0, 100), xlabel="share of the step [%]")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="lower center", bbox_to_anchor=(0.42, 1.0), ncols=3, frameon=False, fontsize=9)
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    draw_network(FOLDER / "network.png")
    draw_times(FOLDER / "step_time.png")
