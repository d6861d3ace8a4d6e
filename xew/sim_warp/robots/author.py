"""Write the shapes of `robots.shapes` into the five URDFs: `python -m xew.sim_warp.robots.author`.

The URDFs hold each robot's tree (joints, limits, inertials) and are edited by hand for that. Their materials, visuals
and collisions, and the meshes beside them, are output of this command; a test holds that they are up to date.
"""

import importlib
import io
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import trimesh

from xew.sim_warp.geometry.meshes import Color
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.robots.shapes.solids import Box, Part


def authored_files(key: str) -> dict[Path, bytes]:
    """The URDF of a robot and its meshes as they should be, by path."""
    shapes = importlib.import_module(f"xew.sim_warp.robots.shapes.{key}")
    path = ROBOTS[key].urdf
    root = _read_tree(path)
    for old in root.findall("material"):
        root.remove(old)
    for index, (name, color) in enumerate(shapes.MATERIALS.items()):
        root.insert(1 + index, _material(name, color))
    meshes: dict[Path, bytes] = {}
    for link in root.findall("link"):
        for old in link.findall("visual") + link.findall("collision"):
            link.remove(old)
        name = link.attrib["name"]
        for file, solid, material in _link_meshes(shapes.MESH_NAMES.get(name, name), shapes.PARTS.get(name, ())):
            meshes[path.parent / "meshes" / key / file] = solid.export(file_type="stl")
            link.append(_visual(f"meshes/{key}/{file}", material))
        for box in shapes.COLLISIONS.get(name, ()):
            link.append(_collision(box))
    return {path: _serialize(root)} | meshes


def _read_tree(path: Path) -> ElementTree.Element:
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    return ElementTree.parse(path, parser).getroot()


def _serialize(root: ElementTree.Element) -> bytes:
    ElementTree.indent(root)
    buffer = io.BytesIO()
    ElementTree.ElementTree(root).write(buffer, encoding="utf-8", xml_declaration=True)
    return buffer.getvalue() + b"\n"


def _link_meshes(name: str, parts: list[Part]) -> list[tuple[str, trimesh.Trimesh, str]]:
    """One mesh a material: file name, solid, material."""
    solids = defaultdict(list)
    for material, solid in parts:
        solids[material].append(solid)
    return [(f"{name}_{material}.stl", trimesh.util.concatenate(found), material) for material, found in solids.items()]


def _material(name: str, color: Color) -> ElementTree.Element:
    material = ElementTree.Element("material", name=name)
    ElementTree.SubElement(material, "color", rgba=_format_numbers([value / 255 for value in color] + [1]))
    return material


def _visual(file: str, material: str) -> ElementTree.Element:
    visual = ElementTree.Element("visual")
    ElementTree.SubElement(ElementTree.SubElement(visual, "geometry"), "mesh", filename=file)
    ElementTree.SubElement(visual, "material", name=material)
    return visual


def _collision(box: Box) -> ElementTree.Element:
    collision = ElementTree.Element("collision", {"name": box.name} if box.name else {})
    ElementTree.SubElement(collision, "origin", xyz=_format_numbers(box.center), rpy=_format_numbers(box.rpy))
    ElementTree.SubElement(ElementTree.SubElement(collision, "geometry"), "box", size=_format_numbers(box.size))
    return collision


def _format_numbers(values: Iterable[float]) -> str:
    return " ".join(f"{round(float(value), 6) + 0.0:g}" for value in values)


def main() -> None:
    for key in ROBOTS:
        files = authored_files(key)
        folder = ROBOTS[key].urdf.parent / "meshes" / key
        for old in set(folder.glob("*.stl")) - set(files):
            old.unlink()
        folder.mkdir(parents=True, exist_ok=True)
        for path, content in files.items():
            path.write_bytes(content)
        print(f"{key}: {len(files) - 1} meshes, {sum(map(len, files.values())) / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
