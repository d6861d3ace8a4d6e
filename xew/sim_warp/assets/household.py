"""Everyday objects that several tasks share: appearance, collision shapes and grasps from above.

Each function of `THINGS` draws one variant (form, size, color) and returns a `Thing` in the object's frame: z up, origin at the
center of the bottom face, longer side along y, grasped across x. Kinds and sizes follow RoboTwin 2.0, reduced for a gripper of
80 mm (graspable widths at most 65 mm). The visible mesh has few flat pieces; one to three convex hulls collide.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from xew.sim_warp import objects
from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.meshes import Color, Mesh
from xew.sim_warp.objects import Shape
from xew.sim_warp.scene import Grasp, Point, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP

LOWEST_GRASP = 0.019
"""Least height of the tool above the table for a leaning hand [m]: pads reach 15 mm beyond the tool."""
PALM = 0.020
"""Largest height of a long object above the tool [m], limited by the palm of the hand with the shortest fingers."""
HALF_TURN, QUARTER_TURN = np.pi, np.pi / 2
SKIN = 0.0006
"""Height of a printed or glued part above its face [m]."""

DARK: Color = (45, 46, 50)
STEEL: Color = (168, 172, 178)
CREAM: Color = (238, 228, 205)
COLORS: dict[str, Color] = objects.PALETTE | {"black": (52, 53, 58), "gray": (135, 138, 145)}


MATS: dict[str, Color] = {name: COLORS[name] for name in ("red", "green", "blue", "yellow", "black", "gray")} | {
    "cyan": (70, 190, 205),
    "magenta": (190, 60, 150),
}
"""RoboTwin's eight colors of mats."""
MAT_THICKNESS = 0.001


def mat_color(rng: np.random.Generator, words: str) -> str:
    """A color of `MATS` that is not in `words`, the name of the object for the mat."""
    return str(rng.choice([name for name in sorted(MATS) if name not in words.split()]))


def mat(size: tuple[float, float], color: Color) -> Shape:
    """A thin mat of full edge lengths `size` x y [m]."""
    return objects.block((*size, MAT_THICKNESS), color)


@dataclass(frozen=True)
class Thing:
    """One variant of an everyday object."""

    words: str
    """Name in an instruction, without an article: "red toy car"."""
    shape: Shape
    mass: float
    """Mass [kg]."""
    grasp_height: float
    """Height of the tool above the object's bottom, on the object's own z axis [m]."""
    width: float
    """Width between the fingers [m]."""
    symmetry: float
    """Turn of the hand about z to an equally good grasp [rad]: pi for long objects, less for square or round ones."""

    def place_at(self, name: str, xy: Point, yaw: float) -> SceneObject:
        """The object upright on the table at `xy` [2] m, turned by `yaw` [rad]."""
        grasp = Grasp(self.grasp_height, self.width, self.symmetry)
        return SceneObject(name, self.shape, upright(xy, TABLE_TOP, yaw), self.mass, grasp=grasp)

    @property
    def height(self) -> float:
        """Height of the top above the bottom [m]."""
        return float(max(hull[:, 2].max() for hull in self.shape.hulls))

    @property
    def radius(self) -> float:
        """Radius of the footprint's circle about the origin [m]."""
        return footprint_radius(self.shape)


def footprint_radius(shape: Shape) -> float:
    """Radius of the circle about the z axis around a shape's collision hulls [m]."""
    return float(max(np.hypot(hull[:, 0], hull[:, 1]).max() for hull in shape.hulls))


def draw_thing(rng: np.random.Generator, kinds: Sequence[str]) -> Thing:
    """A random variant of a random kind out of `kinds`."""
    return THINGS[str(rng.choice(kinds))](rng)


# --- Pieces.


def _color(rng: np.random.Generator, names: Sequence[str]) -> tuple[str, Color]:
    name = str(rng.choice(names))
    return name, COLORS[name]


def _holding_height(height: float) -> float:
    """Height of the tool above the bottom of a long object of this height [m], as low as the palm allows."""
    return max(LOWEST_GRASP, height - PALM)


def slab(size: Sequence[float], cut: float, color: Color, z: float = 0.0) -> Mesh:
    """A box of full edge lengths `size` [m] with its edges cut off by `cut` [m]; its bottom is at `z`."""
    half = np.asarray(size, float) / 2
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    points = np.concatenate([signs * (half - cut * (np.arange(3) != axis)) for axis in range(3)])
    return meshes.hull(points + [0, 0, half[2] + z], color)


def part(size: Sequence[float], at: Sequence[float], color: Color) -> Mesh:
    """A decoration: a box of full edge lengths `size` [m] about the center `at`."""
    return meshes.box(size, color).transformed(at)


def print_on(length: Sequence[float], at: Sequence[float], color: Color) -> Mesh:
    """A printed rectangle of `length` x y [m] on a horizontal face, centered at `at`."""
    return part((*length, 2 * SKIN), at, color)


def profile(points: Sequence[tuple[float, float]], width: float, color: Color) -> Mesh:
    """The convex hull of an outline (y, z) [m], extruded over `width` along x."""
    outline = np.asarray(points, float)
    return meshes.hull(
        np.concatenate([np.column_stack([np.full(len(outline), x), outline]) for x in (-width / 2, width / 2)]), color
    )


def _loft(stations: Sequence[tuple[float, float, float]], flat: float, color: Color) -> Mesh:
    """The convex hull of arches, one at each station (y, half width, height) [m].

    Each arch rises straight up to the share `flat` of its height, where a pad can lie on it, and is round above.
    """
    arch = np.array([[1, 0], [1, flat], [0.93, flat + 0.45 * (1 - flat)], [0.66, flat + 0.83 * (1 - flat)], [0, 1]])
    arch = np.concatenate([arch, arch[:-1] * [-1, 1]])
    rings = [np.column_stack([half * arch[:, 0], np.full(len(arch), y), height * arch[:, 1]]) for y, half, height in stations]
    return meshes.hull(np.concatenate(rings), color)


def _solid(*colliding: Mesh, seen: Sequence[Mesh] = (), unseen: Sequence[Mesh] = ()) -> Shape:
    """A shape of convex meshes that are visible and collide, visible decorations, and invisible collision hulls."""
    return Shape(meshes.merge([*colliding, *seen]), tuple(mesh.vertices for mesh in (*colliding, *unseen)))


# --- Objects.


def mouse(rng: np.random.Generator) -> Thing:
    """A computer mouse: an arched body, two keys, a wheel."""
    name, color = _color(rng, ("black", "gray", "red", "blue", "pink", "teal"))
    width, length, height = rng.uniform([0.044, 0.078, 0.027], [0.052, 0.092, 0.032])
    half, back = width / 2, length / 2
    arches = np.array([(-1, 0.55, 0.45), (-0.8, 0.88, 0.8), (-0.35, 1, 1), (0.35, 1, 0.9), (0.75, 0.92, 0.68), (1, 0.66, 0.42)])
    stations = [tuple(row) for row in arches * [back, half, height]]
    body = _loft(stations, 0.5, color)
    trim: Color = (112, 114, 120) if name == "black" else DARK
    ridge = [(y * back, h * height + SKIN) for y, _, h in arches[3:]]
    seam = profile([(0.35 * back, height / 2), *ridge, (back, height / 4)], 0.0014, trim)
    crossing = [(y * back, half + SKIN, 0.9 * height + SKIN) for y in (0.33, 0.37)]
    band = _loft(crossing, 0.5, trim)
    wheel = meshes.cylinder(0.006, 0.006, STEEL, sections=12).transformed(
        (0, 0.6 * back, 0.75 * height - 0.003), (0, np.pi / 2, 0)
    )
    keys = [seam, band]
    return Thing(f"{name} mouse", _solid(body, seen=[wheel, *keys]), 0.06, LOWEST_GRASP, width, HALF_TURN)


@dataclass(frozen=True)
class StaplerParts:
    """A desk stapler in two rigid pieces, hinged at the back (-y)."""

    words: str
    base: Shape
    arm: Shape
    """Upper arm in its open position; the gap below it is widest at the front."""
    hinge: tuple[float, float, float]
    """Point of the axis, which runs along x [m]."""
    width: float
    height: float
    """Total height [m]."""
    opening: float
    """Angle of the arm from open to closed [rad]."""


def stapler_parts(rng: np.random.Generator) -> StaplerParts:
    """A stapler's base and upper arm."""
    name, color = _color(rng, ("black", "red", "blue", "green", "orange", "purple", "gray"))
    width, length, height = rng.uniform([0.026, 0.088, 0.044], [0.034, 0.100, 0.050])
    back, foot, gap = -length / 2, 0.010, 0.016
    base = slab((width, length, foot), 0.0015, DARK)
    anvil = print_on((width * 0.5, 0.014), (0, length * 0.36, foot), STEEL)
    post = part((width * 0.7, 0.016, 0.012), (0, back + 0.012, foot + 0.006), STEEL)
    top = height + np.array([-0.007, 0, -0.002, -0.014])
    ways = length * np.array([-0.5, -0.38, 0.30, 0.49])
    under = [(back, foot + 0.003), (0.49 * length, foot + gap)]
    arm = profile([*under, *zip(ways, top, strict=True)], width, color)
    magazine = profile(
        [(back + 0.012, foot + 0.002), (0.46 * length, foot + gap - 0.004), (0.46 * length, foot + gap + 0.002)],
        width * 0.5,
        STEEL,
    )
    rest = part((width * 0.62, 0.34 * length, 0.002), (0, 0.08 * length, height - 0.0012), objects.darken(color, 0.6))
    nose = part((width * 0.55, 0.006, 0.012), (0, 0.49 * length, height - 0.022), STEEL)
    return StaplerParts(
        words=f"{name} stapler",
        base=_solid(base, seen=[anvil, post]),
        arm=_solid(arm, seen=[magazine, rest, nose]),
        hinge=(0.0, back + 0.008, foot + 0.005),
        width=width,
        height=height,
        opening=float(np.arctan2(gap - 0.006, length * 0.9)),
    )


def stapler(rng: np.random.Generator) -> Thing:
    """A desk stapler as one rigid piece."""
    parts = stapler_parts(rng)
    return Thing(
        parts.words,
        objects.merge(parts.base, parts.arm),
        0.09,
        _holding_height(parts.height),
        parts.width,
        HALF_TURN,
    )


def bell(rng: np.random.Generator) -> Thing:
    """A reception bell: a graspable foot, a dome and a button."""
    name = str(rng.choice(["brass", "silver", "copper"]))
    metal: Color = {"brass": (212, 170, 70), "silver": (176, 181, 190), "copper": (190, 110, 75)}[name]
    radius, height = rng.uniform([0.027, 0.046], [0.031, 0.054])
    foot = 0.018
    ring = objects.disc(radius, foot, DARK, sides=12).mesh.transformed(rpy=(0, 0, np.pi / 12))
    stretch = radius / np.cos(np.pi / 12) * 0.97
    rise = np.linspace(0, np.pi / 2, 5)
    arch = [(stretch * np.cos(a), foot + (height - 0.008 - foot) * np.sin(a)) for a in rise[:-1]]
    dome = meshes.revolve([(0, foot), *arch, (0, height - 0.008)], metal, sections=24)
    button = meshes.cylinder(0.005, 0.009, STEEL, sections=12).transformed((0, 0, height - 0.0045))
    collide = meshes.revolve([(0, foot), *arch[::2], (0, height)], metal, sections=12)
    shape = _solid(ring, seen=[dome, button], unseen=[collide])
    return Thing(f"{name} bell", shape, 0.10, LOWEST_GRASP, 2 * radius, np.pi / 6)


def toy_car(rng: np.random.Generator) -> Thing:
    """A toy car on fixed wheels: saloon, van or pickup."""
    name, color = _color(rng, ("red", "blue", "green", "yellow", "orange", "teal", "purple"))
    form = str(rng.choice(["car", "van", "pickup"]))
    width, length, deck = rng.uniform([0.040, 0.084, 0.021], [0.048, 0.096, 0.025])
    low, high, roof = {"car": (-0.36, 0.24, 0.017), "van": (-0.48, 0.30, 0.021), "pickup": (-0.08, 0.26, 0.018)}[form]
    body = slab((width, length, deck - 0.006), 0.003, color, z=0.006)
    under = slab((width, length, deck), 0.003, color)
    front = high - 0.14
    cabin = profile(
        [
            (low * length, deck - 0.001),
            (high * length, deck - 0.001),
            (front * length, deck + roof),
            ((low + 0.06) * length, deck + roof),
        ],
        width * 0.88,
        color,
    )
    glass: Color = (70, 90, 115)
    middle = (low + front) / 2 * length
    windows = part((width * 0.88 + 2 * SKIN, (front - low) * length * 0.72, roof * 0.5), (0, middle, deck + roof * 0.5), glass)
    panes = [
        meshes.box((width * 0.74, 0.7 * np.hypot(roof, run), 2 * SKIN), glass).transformed(
            (0, y, deck + roof * 0.5), (-sign * np.arctan2(roof, run), 0, 0)
        )
        for sign, run, y in (
            (1, (high - front) * length, (front + high) / 2 * length),
            (-1, 0.06 * length, (low + 0.03) * length),
        )
    ]
    wheels = [
        meshes.cylinder(0.009, 0.007, DARK, sections=14).transformed(
            (side * (width / 2 - 0.002), way * length, 0.009), (0, np.pi / 2, 0)
        )
        for side in (-1, 1)
        for way in (-0.3, 0.3)
    ]
    lamps = [
        part((0.008, 2 * SKIN, 0.005), (side * width * 0.32, way * length / 2, deck - 0.008), light)
        for side in (-1, 1)
        for way, light in ((1, CREAM), (-1, COLORS["red"]))
    ]
    bed = [print_on((width * 0.8, 0.32 * length), (0, -0.29 * length, deck), DARK)] if form == "pickup" else []
    shape = Shape(meshes.merge([body, cabin, windows, *panes, *wheels, *lamps, *bed]), (under.vertices, cabin.vertices))
    words = {"car": "toy car", "van": "toy van", "pickup": "toy pickup"}[form]
    return Thing(f"{name} {words}", shape, 0.07, _holding_height(deck + roof), width, HALF_TURN)


CUBE_FACES: tuple[Color, ...] = ((200, 45, 40), (225, 120, 45), (240, 240, 235), (225, 195, 55), (50, 90, 190), (60, 150, 70))


def rubik_cube(rng: np.random.Generator) -> Thing:
    """A magic cube, scrambled (every sticker of a random color) or solved."""
    edge = rng.uniform(0.048, 0.057)
    scrambled = rng.random() < 0.7
    colors = rng.permutation(54) // 9 if scrambled else np.repeat(np.arange(6), 9)
    body = slab((edge,) * 3, 0.0012, (28, 28, 30))
    stickers = []
    for face in range(6):
        axis, sign = face // 2, 2 * (face % 2) - 1
        for cell in range(9):
            at, size = np.zeros(3), np.full(3, edge / 3 * 0.84)
            at[axis], size[axis] = sign * edge / 2, 2 * SKIN
            at[(axis + 1) % 3], at[(axis + 2) % 3] = (cell % 3 - 1) * edge * 0.323, (cell // 3 - 1) * edge * 0.323
            stickers.append(part(size.tolist(), (at + [0, 0, edge / 2]).tolist(), CUBE_FACES[colors[9 * face + cell]]))
    words = "scrambled magic cube" if scrambled else "solved magic cube"
    return Thing(words, _solid(body, seen=stickers), 0.08, edge / 2, edge, QUARTER_TURN)


def bread(rng: np.random.Generator) -> Thing:
    """A piece of bread: a round bun, an oblong roll, a small tin loaf or a short baguette."""
    form = str(rng.choice(["bun", "roll", "loaf", "baguette"]))
    crust: Color = ((196, 132, 66), (182, 112, 52), (208, 150, 84))[rng.integers(3)]
    low, high = {
        "bun": ((0.054, 0.056, 0.036), (0.060, 0.062, 0.044)),
        "roll": ((0.048, 0.080, 0.034), (0.056, 0.094, 0.042)),
        "loaf": ((0.046, 0.088, 0.042), (0.054, 0.100, 0.048)),
        "baguette": ((0.042, 0.105, 0.034), (0.048, 0.120, 0.040)),
    }[form]
    width, length, height = rng.uniform(low, high)
    half, end = width / 2, length / 2
    if form == "loaf":
        arches = [(-1, 0.94, 0.9), (-0.93, 1, 0.97), (-0.4, 1, 1), (0.4, 1, 1), (0.93, 1, 0.97), (1, 0.94, 0.9)]
    else:
        arches = [(-1, 0.42, 0.5), (-0.8, 0.82, 0.83), (-0.4, 1, 1), (0.4, 1, 1), (0.8, 0.82, 0.83), (1, 0.42, 0.5)]
    body = _loft([(y * end, w * half, h * height) for y, w, h in arches], 0.5, crust)
    pale: Color = (236, 206, 150)
    cuts = {"bun": (-0.22, 0.22), "roll": (-0.36, 0.0, 0.36), "loaf": (0.0,), "baguette": (-0.36, -0.12, 0.12, 0.36)}[form]
    if form == "loaf":
        scores = [part((0.008, length * 0.72, 0.004), (0, 0, height - 0.0012), pale)]
    else:
        scores = [
            meshes.box((0.62 * width, 0.006, 0.004), pale).transformed((0, y * end, height - 0.0028), (0, 0, 0.5)) for y in cuts
        ]
    words = {"bun": "bread bun", "roll": "bread roll", "loaf": "loaf of bread", "baguette": "baguette"}[form]
    return Thing(words, _solid(body, seen=scores), 0.06, _holding_height(height), width, HALF_TURN)


def phone(rng: np.random.Generator) -> Thing:
    """A smartphone on its back, its screen up, the ear piece at +y."""
    name, color = _color(rng, ("black", "gray", "blue", "red", "purple", "green"))
    width, length, thickness = rng.uniform([0.058, 0.120, 0.012], [0.064, 0.136, 0.015])
    body = slab((width, length, thickness), 0.0022, color)
    glass = print_on((width - 0.006, length - 0.010), (0, 0, thickness), (24, 28, 38))
    tint: Color = ((60, 110, 190), (40, 150, 140), (150, 80, 160))[rng.integers(3)]
    picture = print_on((width - 0.012, length - 0.026), (0, 0, thickness + SKIN / 2), tint)
    icons = [
        print_on((0.008, 0.008), ((column - 1.5) * 0.012, -length * 0.32 + row * 0.014, thickness + SKIN), icon)
        for row in range(2)
        for column, icon in enumerate([(240, 240, 240), (230, 180, 60), (110, 200, 120), (225, 95, 85)])
    ]
    ear = print_on((0.014, 0.0025), (0, length / 2 - 0.009, thickness + SKIN), (95, 98, 105))
    shape = _solid(body, seen=[glass, picture, *icons, ear])
    return Thing(f"{name} phone", shape, 0.10, LOWEST_GRASP, width, HALF_TURN)


def playing_cards(rng: np.random.Generator) -> Thing:
    """A pack of playing cards, flat."""
    name, color = _color(rng, ("red", "blue", "green", "black"))
    width, length, height = rng.uniform([0.057, 0.086, 0.019], [0.063, 0.094, 0.024])
    body = slab((width, length, height), 0.0008, CREAM)
    back = print_on((width - 0.008, length - 0.008), (0, 0, height), color)
    frame = print_on((width - 0.018, length - 0.018), (0, 0, height + SKIN / 2), CREAM)
    field = print_on((width - 0.021, length - 0.021), (0, 0, height + SKIN), color)
    diamond = meshes.box((0.02, 0.02, 2 * SKIN), CREAM).transformed((0, 0, height + 1.5 * SKIN), (0, 0, np.pi / 4))
    edges = [part((width + SKIN, length + SKIN, 0.0012), (0, 0, height * share), (200, 196, 186)) for share in (0.35, 0.65)]
    shape = _solid(body, seen=[back, frame, field, diamond, *edges])
    return Thing(f"pack of {name} playing cards", shape, 0.09, LOWEST_GRASP, width, HALF_TURN)


def wooden_block(rng: np.random.Generator) -> Thing:
    """A block of wood with its grain on top."""
    wood: Color = ((206, 164, 110), (176, 124, 74), (142, 92, 54))[rng.integers(3)]
    grain = objects.darken(wood, 0.78)
    width, length, height = rng.uniform([0.040, 0.068, 0.030], [0.056, 0.098, 0.048])
    body = slab((width, length, height), 0.002, wood)
    lines = rng.uniform(-0.42, 0.42, 5) * width
    seen = [print_on((0.0022, length * 0.95), (x, 0, height - SKIN / 2), grain) for x in lines]
    seen += [part((0.0022, length + 2 * SKIN - 0.001, height * 0.9), (x, 0, height / 2), grain) for x in lines[:2]]
    return Thing("wooden block", _solid(body, seen=seen), 0.10, _holding_height(height), width, HALF_TURN)


def tea_box(rng: np.random.Generator) -> Thing:
    """A carton of tea: a colored box with a pale label and a leaf on it."""
    name, color = _color(rng, ("green", "teal", "red", "purple", "yellow"))
    width, length, height = rng.uniform([0.048, 0.070, 0.042], [0.060, 0.092, 0.060])
    leaf = meshes.cylinder(0.013, 2 * SKIN, (70, 125, 60), sections=16)
    leaf = _squeeze(leaf, 0.5).transformed((0, 0, height + SKIN), (0, 0, 0.7))
    rib = meshes.box((0.001, 0.026, 2 * SKIN), (190, 215, 160)).transformed((0, 0, height + 1.5 * SKIN), (0, 0, 0.7))
    return Thing(
        f"{name} tea box",
        _carton((width, length, height), color, CREAM, [leaf, rib]),
        0.08,
        _holding_height(height),
        width,
        HALF_TURN,
    )


def coffee_box(rng: np.random.Generator) -> Thing:
    """A carton of coffee: a dark box with a colored label and a bean on it."""
    box: Color = ((84, 54, 38), (58, 44, 40), (120, 72, 44))[rng.integers(3)]
    name, label = _color(rng, ("orange", "yellow", "red", "gray"))
    width, length, height = rng.uniform([0.050, 0.066, 0.044], [0.062, 0.084, 0.062])
    bean = _squeeze(meshes.cylinder(0.013, 2 * SKIN, (70, 42, 28), sections=16), 0.66).transformed((0, 0, height + SKIN))
    cleft = meshes.box((0.002, 0.022, 2 * SKIN), (190, 150, 110)).transformed((0, 0, height + 1.5 * SKIN), (0, 0, 0.2))
    return Thing(
        f"coffee box with a {name} label",
        _carton((width, length, height), box, label, [bean, cleft]),
        0.08,
        _holding_height(height),
        width,
        HALF_TURN,
    )


def _carton(size: Sequence[float], color: Color, label: Color, top: Sequence[Mesh]) -> Shape:
    """A box with a label round it along y and over its top, and prints on that."""
    width, length, height = size
    body = slab(size, 0.0008, color)
    band = part((width + 2 * SKIN, length * 0.5, height * 0.55), (0, 0, height * 0.5), label)
    ends = part((width * 0.6, length + 2 * SKIN, height * 0.55), (0, 0, height * 0.5), label)
    lid = print_on((width * 0.72, length * 0.6), (0, 0, height), label)
    return _solid(body, seen=[band, ends, lid, *top])


def _squeeze(mesh: Mesh, share: float) -> Mesh:
    """A flat mesh made narrower along x; its normals, up or along the rim, stay good enough."""
    return Mesh((mesh.vertices * [share, 1, 1]).astype(np.float32), mesh.triangles, mesh.colors, mesh.normals)


SOAPS: dict[str, Color] = {
    "pink": (232, 168, 178),
    "green": (158, 204, 164),
    "yellow": (236, 214, 140),
    "blue": (150, 190, 224),
    "lilac": (190, 170, 216),
}


def soap(rng: np.random.Generator) -> Thing:
    """A bar of soap with a sunken oval."""
    name = str(rng.choice(sorted(SOAPS)))
    width, length, height = rng.uniform([0.046, 0.076, 0.025], [0.058, 0.094, 0.033])
    half, end, color = width / 2, length / 2, SOAPS[name]
    corners = [(-1, 0.6, 0.82), (-0.76, 1, 1), (0.76, 1, 1), (1, 0.6, 0.82)]
    body = _loft([(y * end, w * half, h * height) for y, w, h in corners], 0.7, color)
    deep = objects.darken(color, 0.86)
    oval = _squeeze(meshes.cylinder(length * 0.28, 0.003, deep, sections=20), 0.5).transformed((0, 0, height - 0.0008))
    inner = _squeeze(meshes.cylinder(length * 0.22, 0.003, color, sections=20), 0.45).transformed((0, 0, height - 0.0003))
    return Thing(f"{name} soap", _solid(body, seen=[oval, inner]), 0.08, LOWEST_GRASP, width, HALF_TURN)


def remote(rng: np.random.Generator) -> Thing:
    """A remote control with its keys up."""
    name, color = _color(rng, ("black", "gray", "blue"))
    width, length, height = rng.uniform([0.040, 0.120, 0.020], [0.048, 0.150, 0.024])
    body = slab((width, length, height), 0.003, color)
    keys = [
        part((0.007, 0.007, 0.002), ((column - 1) * 0.0115, -0.30 * length + row * 0.0125, height), (215, 215, 210))
        for row in range(4)
        for column in range(3)
    ]
    power = meshes.cylinder(0.005, 0.003, (200, 45, 40), sections=12).transformed((-0.011, length * 0.41, height))
    ring = meshes.cylinder(0.013, 0.002, STEEL, sections=20).transformed((0, length * 0.2, height))
    middle = meshes.cylinder(0.006, 0.003, DARK, sections=16).transformed((0, length * 0.2, height))
    shape = _solid(body, seen=[*keys, power, ring, middle])
    return Thing(f"{name} remote control", shape, 0.09, LOWEST_GRASP, width, HALF_TURN)


THINGS: dict[str, Callable[[np.random.Generator], Thing]] = {
    "bell": bell,
    "bread": bread,
    "coffee_box": coffee_box,
    "mouse": mouse,
    "phone": phone,
    "playing_cards": playing_cards,
    "remote": remote,
    "rubik_cube": rubik_cube,
    "soap": soap,
    "stapler": stapler,
    "tea_box": tea_box,
    "toy_car": toy_car,
    "wooden_block": wooden_block,
}
