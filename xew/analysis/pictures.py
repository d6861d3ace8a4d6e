"""Stage 11 of 11: pictures of the report. Strips and sheets are uint8 RGB arrays, curves a matplotlib figure."""

import base64
import io
from collections.abc import Mapping, Sequence

import cv2
import matplotlib
import numpy as np
from matplotlib import patheffects
from matplotlib.figure import Figure

GAP = 4
"""White pixels between the pictures of a sheet."""
DIFFERENCE_FULL = 96
"""Levels of 255 at which the difference picture is darkest."""
FRAME = (208, 215, 222)
COLOURS = ("#1f6feb", "#c2410c", "#15803d", "#7e22ce", "#a16207", "#0e7490")
"""Of models, in order; baselines are grey."""


def difference_picture(predicted: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Largest channel difference of two uint8 frames [h w 3] as colour: white is none, black DIFFERENCE_FULL or more."""
    difference = cv2.absdiff(predicted, observed).max(axis=-1) / DIFFERENCE_FULL
    picture = (matplotlib.colormaps["gist_heat_r"](np.minimum(difference, 1))[..., :3] * 255).astype(np.uint8)
    height, width = picture.shape[:2]
    return cv2.rectangle(picture, (0, 0), (width - 1, height - 1), FRAME, 1)  # else white on white has no edge


def strip_times(frame_count: int, count: int = 5) -> list[int]:
    """Frames shown of a video: the given one, the last, and some between."""
    return np.unique(np.linspace(0, frame_count - 1, count).round().astype(int)).tolist()


def strip(observed: np.ndarray, predicted: np.ndarray, times: Sequence[int]) -> np.ndarray:
    """Three rows observed, predicted, difference; one column for each time. Videos [t h w 3] uint8 of the same length."""
    rows = [
        [observed[t] for t in times],
        [predicted[t] for t in times],
        [difference_picture(predicted[t], observed[t]) for t in times],
    ]
    return sheet(rows)


def sheet(rows: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """Pictures [h w 3] of one size as a grid on white."""
    height, width = rows[0][0].shape[:2]
    columns = max(len(row) for row in rows)
    page = np.full((len(rows) * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, np.uint8)
    for i, row in enumerate(rows):
        for j, picture in enumerate(row):
            top, left = i * (height + GAP), j * (width + GAP)
            page[top : top + height, left : left + width] = picture
    return page


def png(image: np.ndarray) -> bytes:
    """An RGB image [h w 3] uint8 as PNG."""
    done, encoded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not done:
        raise OSError("OpenCV cannot encode a PNG")
    return encoded.tobytes()


def data_uri(image: bytes) -> str:
    """PNG bytes for the src of an <img> that must open without a network."""
    return "data:image/png;base64," + base64.b64encode(image).decode()


def figure_png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=200)
    return buffer.getvalue()


def distance_scatter(axes: Mapping[str, np.ndarray], score: np.ndarray, title: str, robots: Sequence[str]) -> Figure:
    """Score by distance, a panel for each axis: five points, the line through all, and thin ones without one of them."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    panels = figure.subplots(1, len(axes), sharey=True, squeeze=False)[0]
    for panel, (name, distance) in zip(panels, axes.items(), strict=True):
        ends = np.array([distance.min(), distance.max()])
        for left_out in range(len(robots)):
            rest = np.delete(np.arange(len(robots)), left_out)
            panel.plot(ends, np.polyval(np.polyfit(distance[rest], score[rest], 1), ends), color="#8c959f", linewidth=0.8)
        panel.plot(ends, np.polyval(np.polyfit(distance, score, 1), ends), color=COLOURS[0], linewidth=2)
        panel.scatter(distance, score, color="#1f2328", s=24, zorder=3)
        for x, y, robot in zip(distance, score, robots, strict=True):
            # Words stand towards the middle, so that none leaves the panel.
            side, shift = ("right", -7) if x > ends.mean() else ("left", 7)
            text = panel.annotate(
                robot, (x, y), xytext=(shift, 0), textcoords="offset points", ha=side, va="center", fontsize=9
            )
            text.set_path_effects([patheffects.withStroke(linewidth=3, foreground="white")])
        panel.set_xlabel(name, fontsize=9)
        _dress(panel)
    panels[0].set_ylabel(title, fontsize=9)
    return figure


def _dress(panel: matplotlib.axes.Axes) -> None:
    panel.spines[["top", "right"]].set_visible(False)
    panel.spines[["left", "bottom"]].set_color("#8c959f")
    panel.tick_params(labelsize=8, color="#8c959f")
    panel.grid(axis="y", color="#d0d7de", linewidth=0.6)
