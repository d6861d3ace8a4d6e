"""Small URDFs: pieces of text, and what is read from them."""

from pathlib import Path

import numpy as np

from xew.sim_warp.robots import load_urdf

BOX = '<geometry><box size="0.1 0.1 0.1"/></geometry>'
MESH = '<geometry><mesh filename="{}"/></geometry>'


def link(name: str, visual: str = "", collision: str = "") -> str:
    parts = (f"<visual>{visual}</visual>" if visual else "") + (f"<collision>{collision}</collision>" if collision else "")
    return f'<link name="{name}">{parts}</link>'


def joint(name: str, child: str, inner: str = "", kind: str = "fixed") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="a"/><child link="{child}"/>{inner}</joint>'


def write(folder: Path, *parts: str, name: str = "r.urdf") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(f'<robot name="r">{"".join(parts)}</robot>', encoding="utf-8")
    return folder / name


def sizes(path: Path, name: str = "a") -> tuple[list[float], list[float]]:
    """Extents of a link's visual and first collision shape [m]."""
    read = load_urdf(path).links[name]
    assert read.visual is not None
    clouds = (read.visual.vertices, read.collisions[0].points)
    first, second = (np.ptp(cloud, axis=0).astype(float).round(5).tolist() for cloud in clouds)
    return first, second


def color(path: Path, name: str = "a") -> list[tuple[int, ...]]:
    """Colors of a link's triangles."""
    visual = load_urdf(path).links[name].visual
    assert visual is not None
    return sorted({tuple(row) for row in visual.colors.tolist()})


def material(name: str, inner: str = "") -> str:
    return f'<material name="{name}">{inner}</material>'
