"""Meshes that users bring: units, axes and colors that a file states; sizes that cannot be; and files that declare too much."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image, ImageCms

from tests.faults.reading import at_most_seconds
from tests.sim_warp.robots.tiny_urdf import BOX, MESH, color, joint, link, material, sizes, write
from xew.config import ConfigError
from xew.sim_warp.embodiment import mesh_files, prepared, urdf
from xew.sim_warp.embodiment.mesh_claims import MeshError
from xew.sim_warp.embodiment.mesh_files import read_mesh, rgb_pixels
from xew.sim_warp.robots import ROBOTS, keep_robot, load_urdf, recorded_robot
from xew.sim_warp.robots.procedural.bodies import keep_files
from xew.sim_warp.robots.procedural.design import design_body

# --- Units, axes and colors that a file states.


def collada(unit: str, size: np.ndarray, up: str = "Z_UP", scene: str = "", library: str = "", polygons: str = "") -> str:
    box = trimesh.creation.box(size)
    points, faces = (" ".join(map(str, values.ravel().tolist())) for values in (box.vertices, box.faces))
    params = "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
    vertex = '<input semantic="VERTEX" source="#v" offset="0"/>'
    return f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="u" meter="{unit}"/><up_axis>{up}</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="pa" count="24">{points}</float_array>
<technique_common><accessor source="#pa" count="8" stride="3">{params}</accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
{polygons or f'<triangles count="12">{vertex}<p>{faces}</p></triangles>'}</mesh></geometry></library_geometries>{library}
<library_visual_scenes><visual_scene id="s">{scene or '<node id="n"><instance_geometry url="#g"/></node>'}</visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


FINGER = np.array([0.04, 0.01, 0.02])


def write_collada(folder: Path, text: str) -> Path:
    (folder / "m.dae").write_text(text)
    return write(folder, link("a", MESH.format("m.dae"), MESH.format("m.dae")))


@pytest.mark.parametrize("unit", [1, 0.1, 0.01, 0.0254, 0.001])
def test_the_unit_of_collada_counts(unit: float, tmp_path: Path) -> None:
    path = write_collada(tmp_path, collada(str(unit), FINGER / unit))
    assert sizes(path) == (FINGER.tolist(), FINGER.tolist()) and load_urdf(path).notes == ()


@pytest.mark.parametrize("unit", ["0", "-1", "nan", "inf", "big"])
def test_a_unit_that_is_none_is_refused(unit: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"m\.dae (states a unit of|cannot be read as a mesh)"):
        load_urdf(write_collada(tmp_path, collada(unit, FINGER)))


def test_an_axis_that_is_not_followed_is_told(tmp_path: Path) -> None:
    path = write_collada(tmp_path, collada("1", FINGER, "Y_UP"))
    assert sizes(path)[0] == FINGER.tolist()
    assert load_urdf(path).notes == ("m.dae states that its Y axis points up: its axes are used as they are, as in RViz",)


def linear_to_srgb(value: float) -> int:
    return round(255 * (1.055 * value ** (1 / 2.4) - 0.055))


def test_the_factors_of_gltf_are_linear(tmp_path: Path) -> None:
    """Half of the light is 188 in sRGB. A texture is sRGB already, and its factor is for the light."""
    shape = trimesh.creation.box((0.1, 0.1, 0.1))
    texture = Image.fromarray(np.full((4, 4, 3), (188, 100, 0), np.uint8))
    materials = (
        ({"baseColorFactor": [0.5, 1.0, 0.0, 1.0]}, [(188, 255, 0)]),
        ({"baseColorTexture": texture}, [(188, 100, 0)]),
        ({"baseColorTexture": texture, "baseColorFactor": [0.5, 1.0, 1.0, 1.0]}, [(linear_to_srgb(0.25), 100, 0)]),
    )
    for number, (given, expected) in enumerate(materials):
        coordinates = np.zeros((len(shape.vertices), 2))
        pbr = trimesh.visual.material.PBRMaterial(**given)
        shape.visual = trimesh.visual.TextureVisuals(uv=coordinates, material=pbr)
        shape.export(tmp_path / f"m{number}.glb")
        path = write(tmp_path, link("a", MESH.format(f"m{number}.glb"), BOX), name=f"r{number}.urdf")
        assert np.abs(np.subtract(color(path), expected)).max() <= 1, given


def test_colors_of_vertices_are_linear_in_gltf_alone(tmp_path: Path) -> None:
    shape = trimesh.creation.box((0.1, 0.1, 0.1))
    shape.visual.vertex_colors = np.tile(np.uint8([128, 255, 0, 255]), (8, 1))
    for kind, expected in (("glb", (linear_to_srgb(128 / 255), 255, 0)), ("ply", (128, 255, 0))):
        shape.export(tmp_path / f"m.{kind}")
        colors = read_mesh(tmp_path / f"m.{kind}").parts[0].colors
        assert colors is not None and {tuple(row) for row in colors.tolist()} == {expected}


def swapped_profile() -> bytes:
    """A color profile whose red is sRGB's blue."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    return profile.replace(b"rXYZ", b"none").replace(b"bXYZ", b"rXYZ").replace(b"none", b"bXYZ")


def test_an_image_is_read_as_it_says(tmp_path: Path) -> None:
    """Color profiles count, and 16 bit gray is not cut off at 255."""
    Image.new("RGB", (2, 2), (200, 100, 0)).save(tmp_path / "p.png", icc_profile=swapped_profile())
    Image.fromarray(np.full((2, 2), 128 * 257, np.uint16)).save(tmp_path / "g.png")
    Image.new("P", (2, 2), 0).save(tmp_path / "x.png", icc_profile=b"no profile")
    for name, expected in (("p", (0, 100, 200)), ("g", (128, 128, 128)), ("x", (0, 0, 0))):
        with Image.open(tmp_path / f"{name}.png") as picture:
            assert np.abs(rgb_pixels(picture)[0, 0].astype(int) - expected).max() <= 1, name


def test_what_a_mesh_names_and_does_not_exist_is_told(tmp_path: Path) -> None:
    corners = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0.1\nvt 0 0\n"
    (tmp_path / "a.obj").write_text(f"mtllib none.mtl\n{corners}usemtl red\nf 1/1 2/1 3/1\n")
    (tmp_path / "b.obj").write_text(f"mtllib b.mtl\n{corners}usemtl rde\nf 1/1 2/1 3/1\n")
    (tmp_path / "b.mtl").write_text("newmtl red\nKd 1 0 0\n")
    (tmp_path / "c.obj").write_text(f"mtllib c.mtl\n{corners}usemtl red\nf 1/1 2/1 3/1\n")
    (tmp_path / "c.mtl").write_text("newmtl red\nKd 1 0 0\nmap_Kd none.png\n")
    (tmp_path / "d.obj").write_text(f"mtllib b.mtl\n{corners}usemtl red\nf 1/1 2/1 3/1\n")
    assert [read_mesh(tmp_path / f"{name}.obj").notes for name in "abcd"] == [
        ("a.obj names none.mtl, which does not exist: its colors are missing",),
        ("b.obj uses materials that are defined nowhere: rde",),
        ("c.obj names none.png, which does not exist: its colors are missing",),
        (),
    ]


@pytest.mark.parametrize(
    ("size", "other", "note"),
    [
        ("4 1 2", "4 1 2", "link a is 4 m large: its mesh in centimeters needs a scale of 0.01, in inches 0.0254, in mill"),
        ("4e-5 1e-5 2e-5", "4e-5 1e-5 2e-5", "link a is 4e-05 m large: a factor of 0.001 is probably applied twice"),
        ("1 0.1 0.1", "0.01 0.001 0.001", "link a is seen 100 times as large as it collides: check the units of its meshes"),
        ("0.04 0.01 0.02", "0.05 0.02 0.02", ""),
    ],
)
def test_sizes_that_cannot_be_are_told(size: str, other: str, note: str, tmp_path: Path) -> None:
    visual, collision = (f'<geometry><box size="{text}"/></geometry>' for text in (size, other))
    notes = load_urdf(write(tmp_path, link("a", visual, collision))).notes
    assert len(notes) == bool(note) and "".join(notes).startswith(note)


def test_degrees_are_told_and_quaternions_read(tmp_path: Path) -> None:
    bent = '<origin xyz="0 0 0" rpy="0 0 90"/><limit lower="-170" upper="170" effort="1" velocity="1"/>'
    turned = '<origin quat_xyzw="0 0 0.7071068 0.7071068"/>'
    path = write(
        tmp_path, *(link(name, BOX, BOX) for name in "abc"), joint("j", "b", bent, "revolute"), joint("k", "c", turned)
    )
    read = load_urdf(path)
    assert read.notes == (
        'joint j has rpy="0 0 90" in radians; degrees need a factor of 0.01745',
        'joint j has lower="-170" upper="170" in radians; degrees need a factor of 0.01745',
    )
    assert np.allclose(read.joints["k"].origin[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-6)


# --- Bombs.


def gltf(accessor: dict[str, int], **more: object) -> str:
    header = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}}]}]
    return json.dumps(header | {"accessors": [accessor | {"componentType": 5126, "type": "VEC3"}], "meshes": meshes} | more)


def ply(count: int) -> str:
    lists = "element face 1\nproperty list uchar int vertex_indices"
    return f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\nproperty float x\n{lists}\nend_header\n"


VERTEX = '<input semantic="VERTEX" source="#v" offset="0"/>'
DOUBLING = "".join(
    f'<node id="l{n}"><instance_node url="#l{n + 1}"/><instance_node url="#l{n + 1}"/></node>' for n in range(40)
)
LIBRARY = f'<library_nodes>{DOUBLING}<node id="l40"><instance_geometry url="#g"/></node></library_nodes>'
LOOP = '<library_nodes><node id="l0"><instance_node url="#l0"/></node></library_nodes>'
START = '<node id="n"><instance_node url="#l0"/></node>'
BOMBS: dict[str, tuple[str, Callable[[], str | bytes], str]] = {
    "zeros": ("a.gltf", lambda: gltf({"count": 10**9}), "declares arrays of 1000000000 rows"),
    "a scene that doubles": ("a.dae", lambda: collada("1", FINGER, scene=START, library=LIBRARY), "repeats parts of its scene"),
    "a scene in itself": ("a.dae", lambda: collada("1", FINGER, scene=START, library=LOOP), "node l0 contains itself"),
    "a polygon": (
        "a.dae",
        lambda: collada(
            "1", FINGER, polygons=f'<polylist count="1">{VERTEX}<vcount>1000000000</vcount><p>0 1 2</p></polylist>'
        ),
        "declares polygons of 1000000000 corners",
    ),
    "vertices": ("a.ply", lambda: ply(4 * 10**9), "cannot be read as a mesh"),
    "triangles": ("a.stl", lambda: b"\0" * 80 + struct.pack("<I", 2**31 - 1) + b"\0" * 50, "holds no triangle"),
    "an archive": ("a.3mf", lambda: b"PK", "is no mesh of a known format; expected one of .stl"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_what_a_mesh_declares_is_bounded_first(name: str, tmp_path: Path) -> None:
    file, content, told = BOMBS[name]
    text = content()
    (tmp_path / file).write_bytes(text if isinstance(text, bytes) else text.encode())
    with at_most_seconds(20), pytest.raises(MeshError, match=told):
        read_mesh(tmp_path / file)


def test_repeated_meshes_and_large_textures_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, link("a", "", "").replace("</link>", f"<visual>{BOX}</visual>" * 20 + "</link>"))
    monkeypatch.setattr(urdf, "MOST_TRIANGLES", 200)
    with pytest.raises(ConfigError, match="more than 200 triangles"):
        load_urdf(path)
    path = write(tmp_path, link("a", BOX + material("m", '<texture filename="t.png"/>')), name="t.urdf")
    Image.new("RGB", (10, 10)).save(tmp_path / "t.png")
    monkeypatch.setattr(mesh_files, "MOST_PIXELS", 99)
    with pytest.raises(ConfigError, match=r"t\.png has 0 million pixels in its textures, at most 0; reduce them"):
        load_urdf(path)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 10)
    with pytest.raises(ConfigError, match=r"t\.png cannot be read as a picture"):
        load_urdf(path)


# --- Prepared shapes.


def test_prepared_shapes_next_to_a_robot_are_not_read(tmp_path: Path) -> None:
    """Anybody could have written them; the robot is what its URDF says."""
    keep_robot(ROBOTS["piper"], tmp_path)
    (tmp_path / "robots/piper").rename(tmp_path / "robots/arm")
    folder = tmp_path / "robots/arm"
    path = folder / yaml.safe_load((folder / "robot.yaml").read_text())["urdf"]
    (folder / prepared.PREPARED).write_bytes(b"garbage")
    assert load_urdf(recorded_robot("arm", tmp_path).urdf).links.keys() == load_urdf(ROBOTS["piper"].urdf).links.keys()
    assert prepared.read_prepared(path) is None


@pytest.mark.parametrize("damage", [b"", b"garbage", b"PK\3\4", None], ids=["empty", "garbage", "cut", "flipped"])
def test_damaged_shapes_in_the_cache_are_read_from_meshes(
    damage: bytes | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = keep_files(design_body(3))
    expected = load_urdf(path)
    urdf._load.cache_clear()
    file = path.with_name(prepared.PREPARED)
    content = bytearray(file.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 40] = b"\xff" * 40
    file.write_bytes(bytes(content) if damage is None else damage)
    assert prepared.read_prepared(path) is None
    for name, read in load_urdf(path).links.items():
        visual, other = read.visual, expected.links[name].visual
        assert visual is not None and other is not None and (visual.vertices == other.vertices).all()
