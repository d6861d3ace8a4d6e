"""Write the shapes of `lab.robots.shapes` into the five URDFs: `python -m lab.robots.author`.

The URDFs hold each robot's tree (joints, limits, inertials) and are edited by hand for that. Their materials, visuals
and collisions, and their meshes, are output of this command; a test holds that they are up to date.
"""

import importlib
import io
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from pathlib import Path

import trimesh

from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.robots.procedural.solids import Part
from xew.sim_warp.robots.procedural.urdf_files import collision_element, material_element, visual_element


def authored_files(key: str) -> dict[Path, bytes]:
    """The URDF of a robot and its meshes as they should be, by path."""
    shapes = importlib.import_module(f"lab.robots.shapes.{key}")
    path = ROBOTS[key].urdf
    root = _read_tree(path)
    for old in root.findall("material"):
        root.remove(old)
    for index, (name, color) in enumerate(shapes.MATERIALS.items()):
        root.insert(1 + index, material_element(name, color))
    meshes: dict[Path, bytes] = {}
    for link in root.findall("link"):
        for old in link.findall("visual") + link.findall("collision"):
            link.remove(old)
        name = link.attrib["name"]
        for file, solid, material in _link_meshes(shapes.MESH_NAMES.get(name, name), shapes.PARTS.get(name, ())):
            meshes[path.parent / "meshes" / key / file] = solid.export(file_type="stl")
            link.append(visual_element(f"meshes/{key}/{file}", material))
        link.extend(collision_element(box) for box in shapes.COLLISIONS.get(name, ()))
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
    return [(f"{name}_{material}.stl", trimesh.util.concatenate(pieces), material) for material, pieces in solids.items()]


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
