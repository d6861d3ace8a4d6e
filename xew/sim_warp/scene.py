"""Scenes: the objects on the table for a (task, seed), from a counter-based random stream; the same for every robot."""

import difflib
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from xew.config import ConfigError
from xew.episode import array_hash
from xew.sim_warp.geometry.poses import Pose
from xew.sim_warp.objects import Shape

Point = Sequence[float] | np.ndarray
"""Coordinates x y or x y z [m]."""


@dataclass(frozen=True)
class Hinge:
    """A lid on a revolute joint of a fixed object."""

    lid: Shape
    """Shape of the lid in the object's frame at angle 0."""
    mass: float
    """Mass of the lid [kg]."""
    anchor: tuple[float, float, float]
    """Point of the axis in the object's frame [m]."""
    axis: tuple[float, float, float]
    lower: float
    """Least angle [rad]."""
    upper: float
    start: float
    """Initial angle [rad]."""
    friction: float
    """Dry friction [N m]; holds the lid in place."""
    damping: float
    """Viscous damping [N m s/rad]."""
    stiffness: float = 0.0
    """Stiffness of a spring [N m/rad]."""
    rest: float = 0.0
    """Rest angle of the spring, inside the range or outside [rad]."""

    def fraction(self, angle: float) -> float:
        """Opening, 0 to 1."""
        return (angle - self.lower) / (self.upper - self.lower)


@dataclass(frozen=True)
class Grasp:
    """Grasp of an object from above: across the object's x axis, the tool over its origin."""

    height: float
    """Height of the tool above the object's origin [m]."""
    width: float
    """Width of the object between the fingers [m]."""
    symmetry: float
    """Turn of the hand about the object's z to an equally good grasp [rad]."""


@dataclass(frozen=True)
class SceneObject:
    """One object of a scene."""

    name: str
    shape: Shape
    pose: Pose
    mass: float = 0.0
    """Mass [kg]; 0 means fixed to the table."""
    hinge: Hinge | None = None
    friction: float = 0.6
    """Sliding friction coefficient; a contact uses the larger of two."""
    grasp: Grasp | None = None
    """Grasp from above, if any."""

    @property
    def is_fixed(self) -> bool:
        return self.mass == 0.0

    @property
    def yaw(self) -> float:
        """Turn of an upright object about the world's z [rad]."""
        return float(2 * np.arctan2(self.pose[5], self.pose[6]))


@dataclass(frozen=True)
class Scene:
    """The initial objects on the table, at rest."""

    task: str
    seed: int
    objects: tuple[SceneObject, ...]
    words: dict[str, str] = field(default_factory=dict)
    """Words of this scene (colors, sizes) for the slots of the instruction."""
    targets: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Target places without objects, such as of a row of blocks: x y [m]."""
    clutter: tuple[SceneObject, ...] = ()
    """Fixed objects that no robot and no object touches: they are rendered, not simulated."""
    raised: float = 0.0
    """Height of the table's top, and of all objects, over the standard one [m]."""

    def index(self, name: str) -> int:
        """The number of an object. Raises ConfigError if the scene has none of that name."""
        if name not in self.names:
            near = difflib.get_close_matches(name, self.names, 1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise ConfigError(
                f"the scene of {self.task} has no object {name!r}; {hint}It has {', '.join(self.names) or 'none'}."
            )
        return self.names.index(name)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(o.name for o in self.objects)

    def object(self, name: str) -> SceneObject:
        return self.objects[self.index(name)]


def scene_rng(task: str, seed: int) -> np.random.Generator:
    """The random stream of one scene, a function of (task, seed)."""
    key = int.from_bytes(hashlib.sha256(task.encode()).digest()[:8], "little")
    return np.random.Generator(np.random.Philox(key=np.array([key, seed], np.uint64)))


def scene_hash(scene: Scene) -> str:
    """SHA-256 over the content of a scene."""
    digest = hashlib.sha256(repr((scene.task, scene.seed, sorted(scene.words.items()), sorted(scene.targets.items()))).encode())
    if scene.raised:
        digest.update(repr(scene.raised).encode())
    for thing in (*scene.objects, *scene.clutter):
        digest.update(repr(_plain_numbers(thing)).encode())
        for shape in (thing.shape, *((thing.hinge.lid,) if thing.hinge else ())):
            mesh = shape.mesh
            digest.update(array_hash(mesh.vertices, mesh.triangles, mesh.colors, mesh.normals, *shape.hulls).encode())
    return digest.hexdigest()


def _plain_numbers(thing: SceneObject) -> tuple[object, ...]:
    """Numbers of an object without its shapes, as `scene_hash` reads them."""
    hinge = thing.hinge
    numbers = {f.name: None if f.name == "lid" else getattr(hinge, f.name) for f in fields(hinge)} if hinge else None
    return (thing.name, thing.pose, thing.mass, thing.friction, thing.grasp, numbers)


def upright(xy: Point, z: float, yaw: float = 0.0) -> Pose:
    """A pose at `xy` [2] and height `z` [m], turned by `yaw` [rad] about the world's z."""
    x, y = xy
    return (float(x), float(y), float(z), 0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))


def draw(
    rng: np.random.Generator, low: Sequence[float], high: Sequence[float], accept: Callable[[np.ndarray], bool]
) -> np.ndarray:
    """A uniform point [d] of the box from `low` [d] to `high` [d] that `accept` accepts, by rejection sampling."""
    for _ in range(10_000):
        point = rng.uniform(low, high)
        if accept(point):
            return point
    raise RuntimeError(
        f"none of 10,000 points of the box {low} to {high} was accepted: the ranges of the task contradict each other"
    )
