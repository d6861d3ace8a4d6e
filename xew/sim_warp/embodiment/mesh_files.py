"""Mesh files, with their materials and textures, to colored triangles by trimesh and Pillow.

The renderer shades one color per triangle: a texture is sampled at seven points of each triangle and averaged. Patterns finer
than the triangles are lost.
"""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.resolvers import Resolver
from trimesh.visual import TextureVisuals

from xew.files import demand_regular

logging.getLogger("trimesh").setLevel(logging.ERROR)  # its warnings have tracebacks
LARGEST_FILE = 200e6
"""Largest size of a mesh file [bytes]; larger files are not read."""
MOST_TRIANGLES = 1_000_000
"""Largest number of triangles of a mesh file; a link of xew's robots has some hundreds."""
SAMPLES = np.array([(4, 1, 1), (1, 4, 1), (1, 1, 4), (2, 2, 2), (3, 3, 0), (0, 3, 3), (3, 0, 3)]) / 6
"""Barycentric coordinates at which a texture is read."""


class MeshError(Exception):
    """A mesh file cannot be used; the message completes a sentence that begins with its name."""


@dataclass(frozen=True)
class Part:
    """A piece of a mesh file."""

    shape: trimesh.Trimesh
    """Mesh in the file's units and frame."""
    colors: np.ndarray | None
    """[f 3] uint8, sRGB, or None if the file has none."""


@dataclass(frozen=True)
class MeshFile:
    """The content of a mesh file."""

    parts: tuple[Part, ...]
    files: tuple[Path, ...]
    """The file and the files that it names: materials, textures, buffers."""


def read_mesh(path: Path) -> MeshFile:
    """Read a mesh of any format that trimesh knows.

    Raises:
        MeshError: it is too large, unreadable or has no finite triangle.
    """
    try:
        demand_regular(path)
    except OSError as error:
        raise MeshError(f"cannot be read ({error.strerror})") from error
    if path.stat().st_size > LARGEST_FILE:
        raise MeshError(f"has {path.stat().st_size / 1e6:.0f} MB, at most {LARGEST_FILE / 1e6:.0f}; simplify it")
    companions = _Companions(path.parent)
    try:
        with path.open("rb") as file:
            scene = trimesh.load_scene(file, file_type=path.suffix[1:].lower(), resolver=companions)
        pieces = [piece for piece in scene.dump() if isinstance(piece, trimesh.Trimesh) and len(piece.faces)]
    except Exception as error:  # one kind of error per file format
        raise MeshError(f"cannot be read as a mesh ({_join_lines(error)})") from error
    if not pieces:
        raise MeshError("holds no triangle")
    count = sum(len(piece.faces) for piece in pieces)
    if count > MOST_TRIANGLES:
        raise MeshError(f"has {count} triangles, at most {MOST_TRIANGLES}; simplify it")
    return MeshFile(tuple(Part(piece, face_colors(piece)) for piece in pieces), (path, *companions.files))


def read_picture(path: Path) -> Image.Image:
    """An image of any format that Pillow reads. Raises MeshError if it cannot be read."""
    try:
        with Image.open(demand_regular(path)) as picture:
            return picture.convert("RGB")
    except (OSError, ValueError) as error:
        raise MeshError(f"cannot be read as a picture ({_join_lines(error)})") from error


def picture_colors(shape: trimesh.Trimesh, picture: Image.Image) -> np.ndarray:
    """[f 3] uint8 colors of the triangles under an image; its mean color if the mesh has no texture coordinates."""
    uv = getattr(shape.visual, "uv", None)
    if uv is None:
        mean = np.asarray(picture, float).reshape(-1, 3).mean(0)
        return np.tile(np.round(mean).astype(np.uint8), (len(shape.faces), 1))
    return sample_texture(picture, np.asarray(uv), shape.faces, np.ones(3))


def face_colors(shape: trimesh.Trimesh) -> np.ndarray | None:
    """[f 3] uint8 colors of the triangles by the mesh's texture, material or vertex colors; None without any."""
    visual = shape.visual
    if isinstance(visual, TextureVisuals):
        return _texture_colors(shape, visual)
    if visual.defined:
        return np.asarray(visual.face_colors)[:, :3].astype(np.uint8)
    return None


def sample_texture(image: Any, uv: np.ndarray, faces: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Mean colors of triangles under a texture.

    Args:
        image: a Pillow image, sRGB.
        uv: [v 2] texture coordinates of the vertices, (0, 0) lower left; the texture repeats outside 0 to 1.
        faces: [f 3] vertex indices.
        factor: [3] factor of the material, 0 to 1.

    Returns:
        [f 3] uint8.
    """
    texture = np.asarray(image.convert("RGB"), float)
    height, width = texture.shape[:2]
    at = np.einsum("sc,fcd->sfd", SAMPLES, uv[faces]) % 1.0
    column = np.minimum((at[..., 0] * width).astype(int), width - 1)
    row = np.minimum(((1 - at[..., 1]) * height).astype(int), height - 1)
    return np.round(texture[row, column].mean(0) * factor).astype(np.uint8)


def _texture_colors(shape: trimesh.Trimesh, visual: TextureVisuals) -> np.ndarray | None:
    material = visual.material
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None or visual.uv is None:
        main = np.asarray(material.main_color)[:3].astype(np.uint8)
        return np.tile(main, (len(shape.faces), 1))
    factor = getattr(material, "baseColorFactor", None)
    share = np.ones(3) if factor is None else _unit_color(np.asarray(factor)[:3])
    return sample_texture(image, np.asarray(visual.uv), shape.faces, share)


def _unit_color(color: np.ndarray) -> np.ndarray:
    """The color in 0 to 1; uint8 colors are in 0 to 255."""
    return color / 255 if color.dtype == np.uint8 else color.astype(float)


def _join_lines(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


class _Companions(Resolver):
    """Reads the files that a mesh file names, relative to its folder, and lists them."""

    def __init__(self, folder: Path, files: list[Path] | None = None) -> None:
        self.folder = folder
        self.files: list[Path] = [] if files is None else files

    def get(self, name: str) -> bytes:
        path = self.folder / name.strip().replace("\\", "/")
        content = demand_regular(path).read_bytes()
        if path not in self.files:
            self.files.append(path)
        return content

    def namespaced(self, namespace: str) -> "_Companions":
        return _Companions(self.folder / namespace, self.files)

    def keys(self) -> list[str]:
        return [str(path.relative_to(self.folder)) for path in self.folder.rglob("*") if path.is_file()]

    def write(self, name: str, data: bytes) -> None:
        raise NotImplementedError("meshes are only read")
