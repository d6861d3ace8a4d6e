"""Reading URDFs: `load_urdf(path)` gives links, joints, coloured meshes and convex collision shapes.

yourdfpy parses the XML, trimesh the mesh files; what comes out is a small tree of our own, so that the rest of the
room knows neither. Units are metres, kilograms and radians; every shape is in the frame of its link.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import trimesh
import yourdfpy

from xew.sim_warp.geometry import Color, Mesh, from_trimesh, merge

DEFAULT_COLOR: Color = (190, 190, 190)
"""Of a visual that names no material."""


class UrdfError(Exception):
    """A URDF, or a mesh that it names, cannot be used; the message says what to do."""


@dataclass(frozen=True)
class Inertial:
    """Mass properties of a link."""

    mass: float
    """kg."""
    center: np.ndarray
    """[3] centre of mass in the link frame, m."""
    inertia: np.ndarray
    """[3 3] about the centre of mass, along the axes of the link frame, kg m2."""


@dataclass(frozen=True)
class Collision:
    """A convex shape that a link collides with."""

    name: str
    """As in the URDF; "pad" is the gripping face of a finger. Empty where the URDF names none."""
    points: np.ndarray
    """[k 3] float32, corners of its convex hull in the link frame, m."""


@dataclass(frozen=True)
class Link:
    name: str
    visual: Mesh | None
    """All visuals of the link as one mesh."""
    collisions: tuple[Collision, ...]
    inertial: Inertial | None


@dataclass(frozen=True)
class Joint:
    name: str
    kind: str
    """fixed, revolute, continuous or prismatic."""
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


@dataclass(frozen=True)
class Urdf:
    """A robot description: a tree of links and the joints between them, both in file order."""

    name: str
    path: Path
    root: str
    links: dict[str, Link]
    joints: dict[str, Joint]

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """The joints that move, in file order: what a `joint_pos [n j]` lists. Mimic tags are not followed."""
        return tuple(name for name, joint in self.joints.items() if joint.kind != "fixed")

    @cached_property
    def tree(self) -> tuple[Joint, ...]:
        """All joints, parents before children."""
        below: dict[str, list[Joint]] = {}
        for joint in self.joints.values():
            below.setdefault(joint.parent, []).append(joint)
        ordered, links = [], [self.root]
        while links:
            found = below.get(links.pop(), [])
            ordered += found
            links += [joint.child for joint in found]
        return tuple(ordered)

    def chain(self, link: str) -> tuple[Joint, ...]:
        """The joints from the root to a link, fixed ones included."""
        above = {joint.child: joint for joint in self.joints.values()}
        path = []
        while link in above:
            path.append(above[link])
            link = above[link].parent
        return tuple(reversed(path))


def load_urdf(path: Path | str) -> Urdf:
    """Read a URDF with its meshes; a file that has not changed is read once.

    Args:
        path: the file. Mesh names may be relative to it, absolute or `package://`, which is looked for in the folders above.

    Raises:
        UrdfError: the file or a mesh is missing or cannot be understood, or it is not one tree; says which and what to do.
    """
    path = Path(path).resolve()
    if not path.is_file():
        raise UrdfError(f"{path} does not exist; expected a URDF file.")
    return _load(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=32)
def _load(path: Path, modified: int) -> Urdf:
    try:
        robot = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # lxml and yourdfpy each have their own
        raise UrdfError(f"{path} is not a URDF that can be read ({error}); mend its XML.") from error
    colors = {material.name: material.color for material in robot.materials if material.color is not None}
    links = {link.name: _link(link, path, colors) for link in robot.links}
    joints = {joint.name: _joint(joint, path) for joint in robot.joints}
    children = {joint.child for joint in joints.values()}
    root = next((name for name in links if name not in children), "")
    if not root:
        raise UrdfError(f"{path}: there is no link without a parent; links must form one tree.")
    urdf = Urdf(robot.name, path, root, links, joints)
    _check_tree(urdf)
    return urdf


def _check_tree(urdf: Urdf) -> None:
    """All links hang together from one root, each by one joint."""
    path, links, joints = urdf.path, set(urdf.links), urdf.joints.values()
    if unknown := sorted({name for joint in joints for name in (joint.parent, joint.child)} - links):
        raise UrdfError(f"{path}: joints name links that do not exist: {', '.join(unknown)}; add or rename them.")
    children = [joint.child for joint in joints]
    if twice := sorted({name for name in children if children.count(name) > 1}):
        raise UrdfError(f"{path}: links must form one tree; more than one joint leads to {', '.join(twice)}.")
    if loose := sorted(links - {urdf.root, *(joint.child for joint in urdf.tree)}):
        raise UrdfError(f"{path}: links must form one tree; no way leads from {urdf.root} to {', '.join(loose)}.")


def _joint(joint: yourdfpy.Joint, path: Path) -> Joint:
    if joint.type not in ("fixed", "revolute", "continuous", "prismatic"):
        raise UrdfError(f"{path}: joint {joint.name} is {joint.type}; expected fixed, revolute, continuous or prismatic.")
    axis = np.array([1.0, 0.0, 0.0]) if joint.axis is None else np.asarray(joint.axis, float)
    if not np.any(axis):
        raise UrdfError(f"{path}: joint {joint.name} has the axis 0 0 0; give it a direction.")
    limit = joint.limit
    bounded = joint.type in ("revolute", "prismatic") and limit is not None
    return Joint(
        joint.name,
        joint.type,
        joint.parent,
        joint.child,
        np.eye(4) if joint.origin is None else np.asarray(joint.origin, float),
        axis / np.linalg.norm(axis),
        _number(limit.lower, 0.0) if bounded else -math.inf,
        _number(limit.upper, 0.0) if bounded else math.inf,
        _number(limit and limit.velocity, math.inf),
        _number(limit and limit.effort, math.inf),
    )


def _number(value: float | None, default: float) -> float:
    return default if value is None else float(value)


def _link(link: yourdfpy.Link, path: Path, colors: dict[str, yourdfpy.Color]) -> Link:
    visuals = [_visual(visual, link.name, path, colors) for visual in link.visuals]
    collisions = tuple(_collision(collision, link.name, path) for collision in link.collisions)
    return Link(link.name, merge(visuals) if visuals else None, collisions, _inertial(link.inertial))


def _inertial(inertial: yourdfpy.Inertial | None) -> Inertial | None:
    if inertial is None or not inertial.mass:
        return None
    origin = np.eye(4) if inertial.origin is None else np.asarray(inertial.origin, float)
    inertia = np.zeros((3, 3)) if inertial.inertia is None else np.asarray(inertial.inertia, float)
    return Inertial(float(inertial.mass), origin[:3, 3], origin[:3, :3] @ inertia @ origin[:3, :3].T)


def _visual(visual: yourdfpy.Visual, link: str, path: Path, colors: dict[str, yourdfpy.Color]) -> Mesh:
    shape = _shape(visual.geometry, link, path)
    if visual.origin is not None:
        shape.apply_transform(visual.origin)
    return from_trimesh(shape, _color(visual, shape, colors))


def _color(visual: yourdfpy.Visual, shape: trimesh.Trimesh, colors: dict[str, yourdfpy.Color]) -> Color:
    """The visual's own colour, that of the material it names, or that of its mesh file."""
    material = visual.material
    color = material and (material.color or colors.get(material.name))
    if color:
        red, green, blue = (round(255 * float(value)) for value in color.rgba[:3])
        return red, green, blue
    if shape.visual.defined:
        red, green, blue = (int(value) for value in shape.visual.main_color[:3])
        return red, green, blue
    return DEFAULT_COLOR


def _collision(collision: yourdfpy.Collision, link: str, path: Path) -> Collision:
    shape = _shape(collision.geometry, link, path)
    if collision.origin is not None:
        shape.apply_transform(collision.origin)
    return Collision(collision.name or "", np.asarray(shape.convex_hull.vertices, np.float32))


def _shape(geometry: yourdfpy.Geometry, link: str, path: Path) -> trimesh.Trimesh:
    """The triangles of one geometry element, before its origin is applied."""
    if geometry.box is not None:
        return trimesh.creation.box(geometry.box.size)
    if geometry.cylinder is not None:
        return trimesh.creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length, sections=24)
    if geometry.sphere is not None:
        return trimesh.creation.icosphere(2, geometry.sphere.radius)
    if geometry.mesh is not None:
        return _mesh_file(geometry.mesh, link, path)
    raise UrdfError(f"{path}: link {link} has an empty geometry; expected box, cylinder, sphere or mesh.")


def _mesh_file(mesh: yourdfpy.Mesh, link: str, path: Path) -> trimesh.Trimesh:
    found = Path(yourdfpy.urdf.filename_handler_magic(mesh.filename, dir=str(path.parent)))
    if not found.is_file():
        raise UrdfError(
            f"{path}: link {link} names the mesh {mesh.filename}, which does not exist; put it there or mend the name."
        )
    try:
        shape = trimesh.load(found, force="mesh")
    except Exception as error:  # one kind of error per file format
        raise UrdfError(f"{path}: link {link}: {found} cannot be read as a mesh ({error}).") from error
    if shape.is_empty:
        raise UrdfError(f"{path}: link {link}: {found} holds no triangle.")
    shape.apply_scale(np.broadcast_to(np.asarray(1.0 if mesh.scale is None else mesh.scale, float), 3))
    return shape
