"""Mesh files, with their materials and textures, to colored triangles in meters by trimesh and Pillow.

The renderer shades one color per triangle: a texture is sampled at seven points of each triangle and averaged. Patterns finer
than the triangles are lost. What a file states on its unit and colors is followed (`mesh_claims`).
"""

import io
import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image, ImageCms
from trimesh.resolvers import Resolver
from trimesh.visual import TextureVisuals

from xew.files import demand_regular
from xew.sim_warp.embodiment.mesh_claims import LARGEST_FILE, MOST_TRIANGLES, Claims, MeshError, read_claims

logging.getLogger("trimesh").setLevel(logging.ERROR)  # its warnings have tracebacks
FORMATS = (".stl", ".obj", ".dae", ".gltf", ".glb", ".ply", ".off")
"""Formats that are read. Archives are not: their size is known only when they are unpacked."""
MOST_PIXELS = 2**26
"""Largest number of pixels of all textures of a mesh file, and of a texture in a URDF."""
TEXTURES = ("image", "baseColorTexture", "emissiveTexture", "normalTexture", "occlusionTexture", "metallicRoughnessTexture")
"""Attributes of trimesh's materials that hold images, which are decoded when they are used."""
SAMPLES = np.array([(4, 1, 1), (1, 4, 1), (1, 1, 4), (2, 2, 2), (3, 3, 0), (0, 3, 3), (3, 0, 3)]) / 6
"""Barycentric coordinates at which a texture is read."""


@dataclass(frozen=True)
class Part:
    """A piece of a mesh file."""

    shape: trimesh.Trimesh
    """Mesh in the file's frame, m."""
    colors: np.ndarray | None
    """[f 3] uint8, sRGB, or None if the file has none."""


@dataclass(frozen=True)
class MeshFile:
    """The content of a mesh file."""

    parts: tuple[Part, ...]
    files: tuple[Path, ...]
    """The file and the files that it names: materials, textures, buffers."""
    notes: tuple[str, ...] = ()
    """Sentences on what could not be followed."""


def read_mesh(path: Path) -> MeshFile:
    """Read a mesh of one of the `FORMATS`.

    Raises:
        MeshError: it is too large, unreadable or has no finite triangle.
    """
    if path.suffix.lower() not in FORMATS:
        raise MeshError(f"is no mesh of a known format; expected one of {', '.join(FORMATS)}")
    try:
        demand_regular(path)
    except OSError as error:
        raise MeshError(f"cannot be read ({error.strerror})") from error
    if path.stat().st_size > LARGEST_FILE:
        raise MeshError(f"has {path.stat().st_size / 1e6:.0f} MB, at most {LARGEST_FILE / 1e6:.0f}; simplify it")
    companions = _Companions(path.parent)
    try:
        claims = read_claims(path)
        pieces = _read_pieces(path, companions)
        for piece in pieces if claims.unit != 1 else ():
            piece.apply_scale(claims.unit)
        parts = tuple(Part(piece, face_colors(piece, claims.linear_colors)) for piece in pieces)
        return MeshFile(parts, (path, *companions.files), _notes(path, claims, companions))
    except MeshError:
        raise
    except Exception as error:  # one kind of error per file format
        raise MeshError(f"cannot be read as a mesh ({_join_lines(error)})") from error


def _read_pieces(path: Path, companions: "_Companions") -> list[trimesh.Trimesh]:
    """The meshes of a file's scene. Raises MeshError if they are too large, or errors of the file's format."""
    with path.open("rb") as file:
        scene = trimesh.load_scene(file, file_type=path.suffix[1:].lower(), resolver=companions)
    placed = [scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry]
    count = sum(len(getattr(shape, "faces", ())) for shape in placed)
    if count > MOST_TRIANGLES:
        raise MeshError(f"has {count} triangles, at most {MOST_TRIANGLES}; simplify it")
    _check_pixels([picture for shape in scene.geometry.values() for picture in _pictures(shape)])
    pieces = [piece for piece in scene.dump() if isinstance(piece, trimesh.Trimesh) and len(piece.faces)]
    if not pieces:
        raise MeshError("holds no triangle")
    return pieces


def _notes(path: Path, claims: Claims, companions: "_Companions") -> tuple[str, ...]:
    """Sentences on what a mesh file names and does not exist, and on statements that are not followed."""
    notes = [f"{path.name} names {name}, which does not exist: its colors are missing" for name in companions.missing]
    if path.suffix.lower() == ".obj" and not companions.missing:
        libraries = [file.read_bytes() for file in companions.files if file.suffix.lower() == ".mtl"]
        defined = {name for text in libraries for name in re.findall(rb"^\s*newmtl\s+(\S.*?)\s*$", text, re.M)}
        used = set(re.findall(rb"^usemtl[ \t]+(\S.*?)\s*$", path.read_bytes(), re.M))
        if names := sorted(name.decode(errors="replace") for name in used - defined):
            notes.append(f"{path.name} uses materials that are defined nowhere: {', '.join(names[:5])}")
    return (*claims.notes, *notes)


def read_picture(path: Path) -> Image.Image:
    """An image of any format that Pillow reads. Raises MeshError if it cannot be read."""
    try:
        with Image.open(demand_regular(path)) as picture:
            return Image.fromarray(rgb_pixels(picture))
    except MeshError:
        raise
    except Exception as error:  # one kind of error per file format
        raise MeshError(f"cannot be read as a picture ({_join_lines(error)})") from error


def rgb_pixels(picture: Any) -> np.ndarray:
    """[h w 3] uint8 sRGB of a Pillow image, by its color profile if it has one. Raises MeshError if it is too large."""
    _check_pixels([picture])
    if picture.mode.startswith("I"):  # 16 bit gray, which Pillow would clip at 255
        picture = Image.fromarray((np.asarray(picture) // 257).astype(np.uint8))
    profile = picture.info.get("icc_profile")
    if profile and picture.mode in ("RGB", "CMYK"):
        try:
            source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
            picture = ImageCms.profileToProfile(picture, source, ImageCms.createProfile("sRGB"), outputMode="RGB")
        except (ImageCms.PyCMSError, OSError):  # a profile that cannot be read
            pass
    return np.asarray(picture.convert("RGB"))


def _check_pixels(pictures: Sequence[Any]) -> None:
    """Raise MeshError if images are too large together; their sizes are known before they are decoded."""
    count = sum(picture.width * picture.height for picture in pictures)
    if count > MOST_PIXELS:
        raise MeshError(f"has {count / 1e6:.0f} million pixels in its textures, at most {MOST_PIXELS / 1e6:.0f}; reduce them")


def _pictures(shape: Any) -> list[Any]:
    """The images of a mesh's material."""
    material = getattr(getattr(shape, "visual", None), "material", None)
    return [picture for name in TEXTURES if (picture := getattr(material, name, None)) is not None]


def picture_colors(shape: trimesh.Trimesh, picture: Image.Image) -> np.ndarray:
    """[f 3] uint8 colors of the triangles under an image; its mean color if the mesh has no texture coordinates."""
    uv = getattr(shape.visual, "uv", None)
    if uv is None:
        mean = np.asarray(picture, float).reshape(-1, 3).mean(0)
        return np.tile(np.round(mean).astype(np.uint8), (len(shape.faces), 1))
    return sample_texture(picture, np.asarray(uv), shape.faces, np.ones(3))


def face_colors(shape: trimesh.Trimesh, linear: bool = False) -> np.ndarray | None:
    """[f 3] uint8 sRGB colors of the triangles by the mesh's texture, material or vertex colors; None without any.

    `linear` says that colors of materials and vertices are linear; those of textures are sRGB.
    """
    visual = shape.visual
    if isinstance(visual, TextureVisuals):
        return _texture_colors(shape, visual, linear)
    if visual.defined:
        return _to_bytes(np.asarray(visual.face_colors)[:, :3] / 255, linear)
    return None


def sample_texture(image: Any, uv: np.ndarray, faces: np.ndarray, factor: np.ndarray, linear: bool = False) -> np.ndarray:
    """Mean colors of triangles under a texture.

    Args:
        image: a Pillow image.
        uv: [v 2] texture coordinates of the vertices, (0, 0) lower left; the texture repeats outside 0 to 1.
        faces: [f 3] vertex indices.
        factor: [3] factor of the material, 0 to 1.
        linear: whether the factor is for linear colors.

    Returns:
        [f 3] uint8, sRGB.
    """
    texture = rgb_pixels(image)
    height, width = texture.shape[:2]
    at = np.einsum("sc,fcd->sfd", SAMPLES, uv[faces]) % 1.0
    column = np.minimum((at[..., 0] * width).astype(int), width - 1)
    row = np.minimum(((1 - at[..., 1]) * height).astype(int), height - 1)
    colors = texture[row, column].mean(0)
    return _to_bytes(_decode_srgb(colors / 255) * factor, linear) if linear else np.round(colors * factor).astype(np.uint8)


def _texture_colors(shape: trimesh.Trimesh, visual: TextureVisuals, linear: bool) -> np.ndarray | None:
    material = visual.material
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None or visual.uv is None:
        main = _to_bytes(np.asarray(material.main_color)[:3] / 255, linear)
        return np.tile(main, (len(shape.faces), 1))
    factor = getattr(material, "baseColorFactor", None)
    share = np.ones(3) if factor is None else _unit_color(np.asarray(factor)[:3])
    return sample_texture(image, np.asarray(visual.uv), shape.faces, share, linear)


def _unit_color(color: np.ndarray) -> np.ndarray:
    """The color in 0 to 1; uint8 colors are in 0 to 255."""
    return color / 255 if color.dtype == np.uint8 else color.astype(float)


def _to_bytes(colors: np.ndarray, linear: bool) -> np.ndarray:
    """Colors in 0 to 1 as uint8 sRGB."""
    if linear:
        colors = np.where(colors <= 0.0031308, 12.92 * colors, 1.055 * np.maximum(colors, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(255 * colors).astype(np.uint8)


def _decode_srgb(colors: np.ndarray) -> np.ndarray:
    """Linear colors of sRGB colors, both 0 to 1."""
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def _join_lines(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


class _Companions(Resolver):
    """Reads the files that a mesh file names, relative to its folder, and lists them and those that do not exist."""

    def __init__(self, folder: Path, above: "_Companions | None" = None) -> None:
        self.folder = folder
        self.files: list[Path] = above.files if above else []
        self.missing: list[str] = above.missing if above else []

    def get(self, name: str) -> bytes:
        path = self.folder / name.strip().replace("\\", "/")
        if not path.exists() and name not in self.missing:
            self.missing.append(name)
        content = demand_regular(path).read_bytes()
        if path not in self.files:
            self.files.append(path)
        return content

    def namespaced(self, namespace: str) -> "_Companions":
        return _Companions(self.folder / namespace, self)

    def keys(self) -> list[str]:
        return [str(path.relative_to(self.folder)) for path in self.folder.rglob("*") if path.is_file()]

    def write(self, name: str, data: bytes) -> None:
        raise NotImplementedError("meshes are only read")
