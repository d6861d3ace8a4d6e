"""Reading URDFs: `load_urdf(path)` gives links, joints, colored meshes and convex collision shapes.

yourdfpy parses the XML, trimesh the mesh files. Units are meters, kilograms and radians; shapes are in the frame of their link.
"""

import io
import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import trimesh
import yourdfpy

from xew.config import suggestion
from xew.sim_warp.embodiment.mesh_claims import MeshError
from xew.sim_warp.embodiment.mesh_files import MeshFile, Part, picture_colors, read_mesh, read_picture
from xew.sim_warp.embodiment.named_files import find_file, missing_file
from xew.sim_warp.embodiment.prepared import Prepared, read_prepared, write_prepared
from xew.sim_warp.embodiment.xml_files import UrdfError, angle_notes, check_elements, problem_lines, read_xml
from xew.sim_warp.geometry.meshes import Color, Mesh, from_trimesh, merge

Entry = TypeVar("Entry", bound=Any)
Result = TypeVar("Result")
DEFAULT_COLOR: Color = (190, 190, 190)
"""Color of a visual without a material."""
HULL_POINTS = 64
"""Largest number of corners of a collision hull; finer hulls keep the outermost corner in each of as many directions."""
LARGEST_LINK = 10.0
"""Largest extent of a link [m]; larger meshes are probably in millimeters."""
USUAL_LINK = (0.001, 2.0)
"""Extents of links between which nothing is noted [m]."""
UNLIKE = 8.0
"""Ratio of the extents of a link's visual and collision shapes from which their units probably differ."""
MOST_TRIANGLES = 5_000_000
"""Largest number of triangles of a robot."""


@dataclass(frozen=True)
class Inertial:
    """Mass properties of a link."""

    mass: float
    """Mass [kg]."""
    center: np.ndarray
    """[3] center of mass in the link frame, m."""
    inertia: np.ndarray
    """[3 3] about the center of mass, along the axes of the link frame, kg m2."""


@dataclass(frozen=True)
class Collision:
    """A convex collision shape of a link."""

    name: str
    """Name in the URDF, "pad" for the gripping face of a finger; empty if it has none."""
    points: np.ndarray
    """[k 3] float32, corners of its convex hull in the link frame, m."""


@dataclass(frozen=True)
class Link:
    name: str
    visual: Mesh | None
    """Merged mesh of the link's visuals; None if it has none."""
    collisions: tuple[Collision, ...]
    inertial: Inertial | None


@dataclass(frozen=True)
class Joint:
    name: str
    kind: str
    """One of fixed, revolute, continuous or prismatic."""
    parent: str
    child: str
    origin: np.ndarray
    """[4 4] child frame in the parent frame at joint position 0."""
    axis: np.ndarray
    """[3] unit vector in the child frame."""
    lower: float
    """Position limit [rad or m], -inf where there is none."""
    upper: float
    velocity: float
    """Speed limit [rad/s or m/s], inf where there is none."""
    effort: float
    """Effort limit [N m or N], inf where there is none."""
    mimic: tuple[str, float, float] | None = None
    """Joint that this one mimics, with factor and offset; None if it moves independently. The joint exists, and following such
    joints ends."""


@dataclass(frozen=True)
class Urdf:
    """A robot description: a tree of links and the joints between them, both in file order."""

    name: str
    path: Path
    root: str
    links: dict[str, Link]
    joints: dict[str, Joint]
    meshes: dict[str, Path]
    """File of each mesh by its name in the URDF."""
    files: tuple[Path, ...]
    """Files that were read: the URDF, meshes, their materials and textures."""
    notes: tuple[str, ...] = ()
    """Sentences on deviations from the file's content, and on what is probably wrong in it."""
    ignored_mimics: tuple[str, ...] = ()
    """Sentences on mimic tags that lead nowhere; they are also among the notes."""

    @property
    def mimic_hint(self) -> str:
        """Sentences on ignored mimic tags, for errors on hands."""
        return "".join(f" Note: {sentence}." for sentence in self.ignored_mimics)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """The moving joints in file order, the columns of `joint_pos [n j]`. Mimic tags are not followed."""
        return tuple(name for name, joint in self.joints.items() if joint.kind != "fixed")

    @cached_property
    def tree(self) -> tuple[Joint, ...]:
        """All joints, parents before children."""
        below: dict[str, list[Joint]] = {}
        for joint in self.joints.values():
            below.setdefault(joint.parent, []).append(joint)
        ordered, links = [], [self.root]
        while links:
            joints = below.get(links.pop(), [])
            ordered += joints
            links += [joint.child for joint in joints]
        return tuple(ordered)

    def chain(self, link: str) -> tuple[Joint, ...]:
        """The joints from the root to a link, fixed ones included."""
        above = {joint.child: joint for joint in self.joints.values()}
        path = []
        while link in above:
            path.append(above[link])
            link = above[link].parent
        return tuple(reversed(path))

    def moved_links(self, joint: str) -> list[Link]:
        """The links that a joint moves."""
        return [link for link in self.links.values() if joint in [above.name for above in self.chain(link.name)]]


def load_urdf(path: Path | str) -> Urdf:
    """Read a URDF with its meshes; a file that has not changed is read once.

    Args:
        path: the file. Mesh names may be relative to it, absolute or `package://`, which is searched in the folders above.

    Raises:
        UrdfError: the file or a mesh is missing or invalid, or the links do not form one tree.
    """
    path = Path(path).resolve()
    if not path.is_file():
        raise UrdfError(f"{path} does not exist; expected a URDF file.")
    return _load(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=256)
def _load(path: Path, modified: int) -> Urdf:
    root = check_elements(read_xml(path), path)
    robot = _parse(root, path)
    source = _Source(path, read_prepared(path), notes=angle_notes(root))
    source.materials = _define_materials(robot, source.notes)
    problems: list[str] = []
    links = _read_all(robot.links, lambda link: _link(link, source), problems)
    read_joints = _read_all(robot.joints, lambda joint: _joint(joint, path), problems)
    if problems:
        raise UrdfError(*problem_lines(path, problems))
    joints, ignored = _drop_broken_mimics(read_joints)
    source.notes += [*ignored, *_size_notes(links)]
    links = _with_hulls(links, source.notes)
    notes = tuple(dict.fromkeys(source.notes))
    urdf = Urdf(robot.name, path, _root(links, joints, path), links, joints, source.meshes, source.files, notes, ignored)
    _check_tree(urdf)
    return urdf


def _parse(root: ElementTree.Element, path: Path) -> yourdfpy.Robot:
    """The robot by yourdfpy, with unique names."""
    try:
        content = io.BytesIO(ElementTree.tostring(root, encoding="utf-8"))
        robot = yourdfpy.URDF.load(content, build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # lxml and yourdfpy each have their own
        raise UrdfError(f"{path} is not a URDF that can be read ({error}); fix its XML.") from error
    for kind, entries in (("link", robot.links), ("joint", robot.joints)):
        if twice := sorted(name for name, count in Counter(entry.name for entry in entries).items() if count > 1):
            raise UrdfError(f"{path}: more than one {kind} is called {', '.join(twice)}; names must be unique.")
    return robot


def _root(links: Iterable[str], joints: Mapping[str, Joint], path: Path) -> str:
    """The first link without a parent."""
    children = {joint.child for joint in joints.values()}
    if (root := next((name for name in links if name not in children), None)) is None:
        raise UrdfError(f"{path}: there is no link without a parent; links must form one tree.")
    return root


def _define_materials(robot: yourdfpy.Robot, notes: list[str]) -> dict[str, yourdfpy.Material]:
    """The materials with a color or texture by their name, those of the robot before those in links."""
    inner = [visual.material for link in robot.links for visual in link.visuals if visual.material is not None]
    defined: dict[str, yourdfpy.Material] = {}
    for material in [*robot.materials, *inner]:
        if material.name and _has_content(material):
            first = defined.setdefault(material.name, material)
            if material.color is not None and first.color is not None and material.color != first.color:
                notes.append(f"the material {material.name} has several colors: each link keeps its own")
    notes += [
        f"link {link.name} names the material {visual.material.name}, which is defined nowhere"
        for link in robot.links
        for visual in link.visuals
        if visual.material is not None and visual.material.name and visual.material.name not in defined
    ]
    return defined


def _has_content(material: yourdfpy.Material) -> bool:
    return material.color is not None or bool(material.texture is not None and material.texture.filename)


def _drop_broken_mimics(joints: Mapping[str, Joint]) -> tuple[dict[str, Joint], tuple[str, ...]]:
    """The joints without mimic tags that name no joint or lead back to themselves, and a sentence on each of these."""
    sentences = {}
    for joint in joints.values():
        if joint.mimic is None:
            continue
        other = joint.mimic[0]
        if other not in joints:
            reason = f"which does not exist;{suggestion(other, joints) or ' correct the name.'}"
        elif _mimics_itself(joint, joints):
            reason = "which is itself." if other == joint.name else "which mimics it in turn."
        else:
            continue
        sentences[joint.name] = f"joint {joint.name} mimics {other}, {reason} It is read as independent"
    kept = {name: replace(joint, mimic=None) if name in sentences else joint for name, joint in joints.items()}
    return kept, tuple(sentences.values())


def _mimics_itself(joint: Joint, joints: Mapping[str, Joint]) -> bool:
    """Whether following the mimic tags from a joint leads back to it."""
    seen, name = set(), joint.name
    while name in joints and name not in seen and (mimic := joints[name].mimic) is not None:
        seen.add(name)
        name = mimic[0]
    return name == joint.name and name in seen


def _size_notes(links: Mapping[str, Link]) -> list[str]:
    """Sentences on links whose units are probably wrong."""
    notes = []
    for link in links.values():
        if link.visual is None:
            continue
        size = _extent(link.visual.vertices)
        if not USUAL_LINK[0] <= size <= USUAL_LINK[1]:
            factors = "its mesh in centimeters needs a scale of 0.01, in inches 0.0254, in millimeters 0.001"
            fault = factors if size > 1 else "a factor of 0.001 is probably applied twice"
            notes.append(f"link {link.name} is {size:.3g} m large: {fault}")
        collided = [shape.points for shape in link.collisions]
        ratio = size / _extent(np.concatenate(collided)) if collided else 1.0
        if not 1 / UNLIKE < ratio < UNLIKE:
            notes.append(f"link {link.name} is seen {ratio:.3g} times as large as it collides: check the units of its meshes")
    return notes


def _extent(points: np.ndarray) -> float:
    """Largest extent of points [k 3] along an axis [m], at least 1 nm."""
    return max(float(np.ptp(points, axis=0).max()), 1e-9)


def _read_all(entries: Iterable[Entry], read: Callable[[Entry], Result], problems: list[str]) -> dict[str, Result]:
    """Result of `read` for each entry, by its name; all errors are collected in `problems`."""
    results: dict[str, Result] = {}
    for entry in entries:
        try:
            results[entry.name] = read(entry)
        except UrdfError as error:
            problems.append(str(error))
    return results


def _with_hulls(links: dict[str, Link], notes: list[str]) -> dict[str, Link]:
    """The links, with convex hulls of their visuals as collision shapes if no link has any."""
    if any(link.collisions for link in links.values()):
        return links
    notes.append("it has no collision shapes: the convex hulls of its visuals collide instead")
    return {name: _with_hull(link) for name, link in links.items()}


def _with_hull(link: Link) -> Link:
    """The link with the convex hull of its visual as collision shape, if the hull has a volume."""
    if link.visual is None:
        return link
    try:
        corners = trimesh.convex.convex_hull(link.visual.vertices).vertices
    except Exception:  # qhull's own: all points in a plane
        return link
    return replace(link, collisions=(Collision("", outermost_points(np.asarray(corners, np.float32), HULL_POINTS)),))


@dataclass
class _Source:
    """State of reading a URDF."""

    path: Path
    prepared: Prepared | None
    """Stored shapes of the URDF, if any."""
    materials: dict[str, yourdfpy.Material] = field(default_factory=dict)
    read: dict[Path, MeshFile] = field(default_factory=dict)
    """Mesh files read so far."""
    named: dict[str, Path] = field(default_factory=dict)
    """Mesh files and texture images by their name in the URDF."""
    triangles: int = 0
    """Number of triangles so far."""
    notes: list[str] = field(default_factory=list)

    @property
    def meshes(self) -> dict[str, Path]:
        """Meshes and textures by their name in the URDF."""
        return (dict(self.prepared.meshes) if self.prepared else {}) | self.named

    @property
    def files(self) -> tuple[Path, ...]:
        """All files read: the URDF, meshes with their materials, textures."""
        prepared = self.prepared.meshes.values() if self.prepared else ()
        meshes = [file for mesh in self.read.values() for file in mesh.files]
        return tuple(dict.fromkeys([self.path, *prepared, *meshes, *self.named.values()]))

    def find(self, name: str, who: str) -> Path:
        """The file of a name in the URDF; `who` begins the error's sentence. Raises UrdfError if it is nowhere."""
        found = find_file(name, self.path.parent)
        if found is None:
            raise UrdfError(missing_file(self.path, who, name))
        self.named[name], note = found
        self.notes += [note] if note else []
        return found[0]


def prepare(path: Path) -> None:
    """Store the shapes of a URDF next to it as arrays, from which `load_urdf` reads it five times as fast.

    For folders that never change: the arrays are valid as long as the URDF has the same bytes, even if its meshes change.
    """
    urdf = _load.__wrapped__(path, 0)
    shapes = {name: (link.visual, tuple((c.name, c.points) for c in link.collisions)) for name, link in urdf.links.items()}
    write_prepared(path, Prepared(shapes, urdf.meshes))


def _finite_array(values: object, path: Path, what: str) -> np.ndarray:
    """The values as float64. Raises UrdfError if one is not a finite number."""
    array = np.asarray(values, float)
    if not np.isfinite(array).all():
        raise UrdfError(f"{path}: {what} has a number that is not finite; expected finite numbers.")
    return array


def _check_tree(urdf: Urdf) -> None:
    """Raise UrdfError unless all links form one tree."""
    path, links, joints = urdf.path, set(urdf.links), urdf.joints.values()
    if unknown := sorted({name for joint in joints for name in (joint.parent, joint.child)} - links):
        raise UrdfError(f"{path}: joints name links that do not exist: {', '.join(unknown)}; add or rename them.")
    children = Counter(joint.child for joint in joints)
    if twice := sorted(name for name, count in children.items() if count > 1):
        raise UrdfError(f"{path}: links must form one tree; more than one joint leads to {', '.join(twice)}.")
    if loose := sorted(links - {urdf.root, *(joint.child for joint in urdf.tree)}):
        raise UrdfError(f"{path}: links must form one tree; no way leads from {urdf.root} to {', '.join(loose)}.")


def _joint(joint: yourdfpy.Joint, path: Path) -> Joint:
    if joint.type not in ("fixed", "revolute", "continuous", "prismatic"):
        raise UrdfError(f"{path}: joint {joint.name} is {joint.type}; expected fixed, revolute, continuous or prismatic.")
    axis = (
        np.array([1.0, 0.0, 0.0]) if joint.axis is None else _finite_array(joint.axis, path, f"the axis of joint {joint.name}")
    )
    if not np.any(axis) and joint.type == "fixed":  # URDF ignores it, and many files have 0 0 0
        axis = np.array([1.0, 0.0, 0.0])
    if not np.any(axis):
        raise UrdfError(f"{path}: joint {joint.name} has the axis 0 0 0; give it a direction.")
    limit = joint.limit
    bounded = joint.type in ("revolute", "prismatic") and limit is not None
    return Joint(
        joint.name,
        joint.type,
        joint.parent,
        joint.child,
        _origin(joint.origin, path, f"the origin of joint {joint.name}"),
        axis / np.linalg.norm(axis),
        _number(limit.lower, 0.0, path, joint.name) if bounded else -math.inf,
        _number(limit.upper, 0.0, path, joint.name) if bounded else math.inf,
        _number(limit and limit.velocity, math.inf, path, joint.name),
        _number(limit and limit.effort, math.inf, path, joint.name),
        _mimic(joint, path),
    )


def _mimic(joint: yourdfpy.Joint, path: Path) -> tuple[str, float, float] | None:
    mimic = joint.mimic
    if mimic is None:
        return None
    numbers = (1.0 if mimic.multiplier is None else mimic.multiplier, 0.0 if mimic.offset is None else mimic.offset)
    factor, offset = _finite_array(numbers, path, f"the mimic of joint {joint.name}").tolist()
    return mimic.joint, factor, offset


def _number(value: float | None, default: float, path: Path, joint: str) -> float:
    return default if value is None else float(_finite_array(value, path, f"the limit of joint {joint}"))


def _origin(origin: np.ndarray | None, path: Path, what: str) -> np.ndarray:
    return np.eye(4) if origin is None else _finite_array(origin, path, what)


def _link(link: yourdfpy.Link, source: _Source) -> Link:
    if source.prepared is not None:
        ready, hulls = source.prepared.shapes[link.name]
        return Link(link.name, ready, tuple(Collision(name, points) for name, points in hulls), _inertial(link, source.path))
    visuals = [mesh for visual in link.visuals for mesh in _visual(visual, link.name, source)]
    visual = merge(visuals) if visuals else None
    if visual is not None and np.ptp(visual.vertices, axis=0).max() > LARGEST_LINK:
        size = np.ptp(visual.vertices, axis=0).max()
        raise UrdfError(
            f"{source.path}: link {link.name} is {size:.0f} m large; is its mesh in millimeters? Then give it "
            f'scale="0.001 0.001 0.001".'
        )
    collisions = tuple(_collision(collision, link.name, source) for collision in link.collisions)
    return Link(link.name, visual, collisions, _inertial(link, source.path))


def _inertial(link: yourdfpy.Link, path: Path) -> Inertial | None:
    inertial = link.inertial
    if inertial is None or not inertial.mass:
        return None
    what = f"the inertial of link {link.name}"
    mass = float(_finite_array(inertial.mass, path, what))
    if mass < 0:
        raise UrdfError(f"{path}: {what} has a mass of {mass:g} kg; expected more than 0.")
    origin = _origin(inertial.origin, path, what)
    inertia = np.zeros((3, 3)) if inertial.inertia is None else _finite_array(inertial.inertia, path, what)
    return Inertial(mass, origin[:3, 3], origin[:3, :3] @ inertia @ origin[:3, :3].T)


def _visual(visual: yourdfpy.Visual, link: str, source: _Source) -> Iterable[Mesh]:
    """One mesh per part, colored by the visual's material or else by the mesh file."""
    origin = _origin(visual.origin, source.path, f"a visual of link {link}")
    material = _material(visual, source)
    color, picture = _material_color(material), _material_texture(material, link, source)
    for part in _shape(visual.geometry, link, source):
        shape = part.shape
        if visual.origin is not None:
            shape.apply_transform(origin)
        colors = part.colors if picture is None else picture_colors(shape, picture)
        mesh = from_trimesh(shape, color or DEFAULT_COLOR)
        yield mesh if colors is None or (color and picture is None) else replace(mesh, colors=colors)


def _material(visual: yourdfpy.Visual, source: _Source) -> yourdfpy.Material | None:
    """The material of a visual: its own, or else the one that is defined elsewhere under its name."""
    material = visual.material
    return material if material is None or _has_content(material) else source.materials.get(material.name)


def _material_color(material: yourdfpy.Material | None) -> Color | None:
    """The color of a material; None if it has none."""
    if material is None or material.color is None:
        return None
    red, green, blue = (round(255 * min(max(float(value), 0.0), 1.0)) for value in material.color.rgba[:3])
    return red, green, blue


def _material_texture(material: yourdfpy.Material | None, link: str, source: _Source) -> Any | None:
    """The texture image of a material; None if it has none."""
    if material is None or material.texture is None or not material.texture.filename:
        return None
    path = source.find(material.texture.filename, f"link {link} names the texture")
    try:
        return read_picture(path)
    except MeshError as error:
        raise UrdfError(f"{source.path}: link {link}: {path} {error}.") from error


def _collision(collision: yourdfpy.Collision, link: str, source: _Source) -> Collision:
    parts = [part.shape for part in _shape(collision.geometry, link, source)]
    shape = parts[0] if len(parts) == 1 else trimesh.util.concatenate(parts)
    if collision.origin is not None:
        shape.apply_transform(_origin(collision.origin, source.path, f"a collision of link {link}"))
    try:
        corners = np.asarray(shape.convex_hull.vertices, np.float32)
    except Exception as error:  # qhull's own: all points in a plane
        raise UrdfError(f"{source.path}: link {link} has a collision without volume; give it a box.") from error
    return Collision(collision.name or "", outermost_points(corners, HULL_POINTS))


def outermost_points(points: np.ndarray, most: int) -> np.ndarray:
    """The points among [k 3] that are outermost in `most` evenly spread directions; all if k <= most."""
    if len(points) <= most:
        return points
    step = np.arange(most) + 0.5
    polar, azimuth = np.arccos(1 - 2 * step / most), np.pi * (1 + 5**0.5) * step
    directions = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
    return points[np.unique(np.argmax(directions @ points.T, axis=1))]


def _shape(geometry: yourdfpy.Geometry, link: str, source: _Source) -> list[Part]:
    """The triangles of one geometry element, before its origin is applied; the caller may move them."""
    parts = _mesh_parts(geometry.mesh, link, source) if geometry.mesh is not None else [Part(_solid(geometry), None)]
    source.triangles += sum(len(part.shape.faces) for part in parts)
    if source.triangles > MOST_TRIANGLES:
        raise UrdfError(f"{source.path}: its shapes have more than {MOST_TRIANGLES} triangles; simplify the meshes.")
    return parts


def _solid(geometry: yourdfpy.Geometry) -> trimesh.Trimesh:
    if geometry.box is not None:
        return trimesh.creation.box(geometry.box.size)
    if geometry.cylinder is not None:
        return trimesh.creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length, sections=24)
    return trimesh.creation.icosphere(2, geometry.sphere.radius)


def _mesh_parts(mesh: yourdfpy.Mesh, link: str, source: _Source) -> list[Part]:
    path = source.named.get(mesh.filename) or source.find(mesh.filename, f"link {link} names the mesh")
    if path not in source.read:
        try:
            source.read[path] = read_mesh(path)
        except MeshError as error:
            raise UrdfError(f"{source.path}: link {link}: {path} {error}.") from error
        source.notes += source.read[path].notes
    scale = np.broadcast_to(np.asarray(1.0 if mesh.scale is None else mesh.scale, float), 3)
    parts = [Part(part.shape.copy(), part.colors) for part in source.read[path].parts]
    for part in parts:
        part.shape.apply_scale(_finite_array(scale, source.path, f"the scale of a mesh of link {link}"))
    return parts
