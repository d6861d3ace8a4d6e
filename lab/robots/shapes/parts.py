"""Parts that several robots' shapes share, beyond the solids of `xew.sim_warp.robots.procedural.solids`."""

from xew.sim_warp.robots.procedural.solids import Part, Vector, rounded_box


def point_between(start: Vector, end: Vector, share: float) -> Vector:
    """The point that lies `share` of the way from start to end."""
    x, y, z = (a + share * (b - a) for a, b in zip(start, end, strict=True))
    return x, y, z


def camera(low: Vector, high: Vector, bracket: tuple[Vector, Vector]) -> list[Part]:
    """A camera of the D435's size, a light bar with a dark face that looks along x, and the bracket that holds it."""
    face = (high[0] - 0.002, low[1] + 0.006, low[2] + 0.004), (high[0] + 0.001, high[1] - 0.006, high[2] - 0.004)
    return [
        ("lens", rounded_box(*face, 0.001)),
        ("case", rounded_box(low, high, 0.004)),
        ("case", rounded_box(*bracket, 0.001)),
    ]
