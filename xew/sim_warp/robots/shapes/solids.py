"""The few solids that robot shapes are built from. Metres; frames are those of the link that carries the shape."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

Vector = tuple[float, float, float]
Part = tuple[str, trimesh.Trimesh]
"""Name of a material, and a solid in the frame of its link."""

PAD_BACK, PAD_FRONT, PAD_HALF_WIDTH, PAD_THICKNESS = 0.020, 0.015, 0.011, 0.008
"""A gripping face reaches this far behind and before the tool centre point, to either side, and outwards [m]."""


@dataclass(frozen=True)
class Box:
    """A collision box between two corners, in a frame turned by fixed-axis roll, pitch, yaw [rad]."""

    low: Vector
    high: Vector
    rpy: Vector = (0, 0, 0)
    name: str = ""

    @property
    def size(self) -> np.ndarray:
        return np.subtract(self.high, self.low)

    @property
    def center(self) -> np.ndarray:
        """[3] in the link frame."""
        return Rotation.from_euler("xyz", self.rpy).apply(np.add(self.low, self.high) / 2)


def transform(xyz: Sequence[float] = (0, 0, 0), rpy: Sequence[float] = (0, 0, 0)) -> np.ndarray:
    """[4 4], URDF's order: turn by roll, pitch, yaw, then move."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
    matrix[:3, 3] = xyz
    return matrix


def box_solid(box: Box) -> trimesh.Trimesh:
    return trimesh.creation.box(box.size, transform(box.center, box.rpy))
