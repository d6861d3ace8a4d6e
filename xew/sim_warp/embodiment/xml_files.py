"""Reading the XML of URDFs, in the encoding that a file declares. All names and numbers are checked before they are used."""

import codecs
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

from scipy.spatial.transform import Rotation

from xew.config import ConfigError
from xew.files import demand_regular

LARGEST_XML = 20e6
"""Largest size of a URDF [bytes]; larger files are not read."""
MOST_LINKS = 1000
"""Largest number of links; xew's robots have some tens."""
MOST_LEVELS = 100
"""Largest depth of elements in elements; a URDF has six levels."""
NO_ENCODINGS = ("idna", "punycode")
"""Codecs for names of hosts; their time grows with the square of the size."""
SOLIDS = ("box", "cylinder", "sphere")
SHAPES = (*SOLIDS, "mesh")
INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
ONE, THREE = (1,), (3,)
NUMBERS: dict[str, dict[str, tuple[int, ...]]] = {
    "origin": {"xyz": THREE, "rpy": THREE, "quat_xyzw": (4,)},
    "axis": {"xyz": THREE},
    "box": {"size": THREE},
    "cylinder": {"radius": ONE, "length": ONE},
    "sphere": {"radius": ONE},
    "mesh": {"scale": (0, 1, 3)},
    "color": {"rgba": (3, 4)},
    "limit": dict.fromkeys(("lower", "upper", "velocity", "effort"), ONE),
    "mimic": {"multiplier": ONE, "offset": ONE},
    "mass": {"value": ONE},
    "inertia": dict.fromkeys(INERTIA, ONE),
    "calibration": {"rising": ONE, "falling": ONE},
    "safety_controller": dict.fromkeys(("soft_lower_limit", "soft_upper_limit", "k_position", "k_velocity"), ONE),
}
"""Elements with numbers: how many an attribute may hold."""
REQUIRED = {
    "robot": ("name",),
    "link": ("name",),
    "joint": ("name", "type"),
    "parent": ("link",),
    "child": ("link",),
    "mimic": ("joint",),
    "mesh": ("filename",),
    "box": ("size",),
    "cylinder": ("radius", "length"),
    "sphere": ("radius",),
}
"""Attributes that an element needs."""
CHILDREN = {"joint": ("parent", "child"), "visual": ("geometry",), "collision": ("geometry",)}
"""Elements that an element needs."""
READ = {*NUMBERS, *REQUIRED, *CHILDREN, "inertial", "geometry", "material", "texture"}
"""Elements that are read; others, as those of simulators, are ignored with their content."""
XACRO = re.compile(r"\{http://(www\.)?ros\.org/(wiki/)?xacro\}")


class UrdfError(ConfigError):
    """A URDF or one of its meshes cannot be used; the message says what to do."""


def read_xml(path: Path) -> ElementTree.Element:
    """The root of an XML file. Raises UrdfError if it is too large or cannot be read."""
    try:
        size = demand_regular(path).stat().st_size
        if size > LARGEST_XML:
            raise UrdfError(f"{path} has {size / 1e6:.0f} MB; a URDF has at most {LARGEST_XML / 1e6:.0f}.")
        return parse_xml(path.read_bytes())
    except OSError as error:
        raise UrdfError(f"{path} cannot be read ({error.strerror}); expected a URDF file.") from error
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        reason = f"{path} is not a URDF that can be read ({error})"
        raise UrdfError(f"{reason}; fix its XML, or the encoding that its first line declares.") from error


def parse_xml(content: bytes) -> ElementTree.Element:
    """The root of an XML document. Raises ParseError, ValueError or LookupError if it cannot be read."""
    return ElementTree.fromstring(decode_xml(content))


def decode_xml(content: bytes) -> str:
    """The text of an XML document, by its byte order mark or the encoding that its first line declares; else UTF-8.

    Python decodes it, because expat has no encodings of several bytes.
    """
    for mark, encoding in ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16")):
        if content.startswith(mark):
            return content.decode(encoding)
    declared = re.match(rb"<\?xml[^>]*?encoding=[\"']([\w.-]+)", content)
    encoding = declared[1].decode() if declared else "utf-8"
    if codecs.lookup(encoding).name in NO_ENCODINGS:
        raise LookupError(f"{encoding} is no encoding of XML")
    return content.decode(encoding)


def check_elements(root: ElementTree.Element, path: Path) -> ElementTree.Element:
    """The root of the URDF at `path`, with all names and numbers in place and angles as roll, pitch, yaw.

    Raises:
        UrdfError: an element is not as it should be; all problems are in the message.
    """
    if root.tag != "robot" or any(XACRO.match(element.tag) for element in root.iter()):
        found = f"begins with <{root.tag}>, expected <robot>" if root.tag != "robot" else "holds xacro macros"
        raise UrdfError(f"{path} {found}; a xacro is named .xacro and expanded by python -m xew.sim_warp.robots.adopt.")
    if _depth(root) > MOST_LEVELS:
        raise UrdfError(f"{path} is not a URDF that can be read (elements of more than {MOST_LEVELS} levels); fix its XML.")
    most = max(len(root.findall(kind)) for kind in ("link", "joint"))
    if most > MOST_LINKS:
        raise UrdfError(f"{path} has {most} links or joints; expected at most {MOST_LINKS} of each.")
    problems = list(_problems(root))
    entries = [entry for entry in root if entry.tag in ("link", "joint", "material")]
    for entry in entries:
        owner = f"{entry.tag} {entry.get('name', 'without a name')}"
        problems += [f"{owner}: {problem}" for element in own_elements(entry) for problem in _problems(element)]
    if problems:
        raise UrdfError(*problem_lines(path, problems))
    for element in [element for entry in entries for element in own_elements(entry) if element.tag == "origin"]:
        _set_angles(element)
    return root


def _depth(root: ElementTree.Element) -> int:
    level, depth = [root], 0
    while level:
        level, depth = [child for element in level for child in element], depth + 1
    return depth


def problem_lines(path: Path, problems: list[str]) -> list[str]:
    """The lines of a message on all problems of a file."""
    few = [problem.removeprefix(f"{path}: ") for problem in problems]
    return [f"{path} has {len(few)} problems:", *(f"  {line}" for line in few)] if len(few) > 1 else [f"{path}: {few[0]}"]


def own_elements(entry: ElementTree.Element) -> Iterator[ElementTree.Element]:
    """A link, joint or material and all elements in it that are read."""
    yield entry
    for child in entry:
        if child.tag in READ:
            yield from own_elements(child)


def file_entries(root: ElementTree.Element) -> Iterator[tuple[str, ElementTree.Element]]:
    """The elements of a URDF that name files to read, each with the beginning of a sentence on it."""
    for entry in root:
        if entry.tag in ("link", "material"):
            for element in own_elements(entry):
                if element.tag in ("mesh", "texture") and element.get("filename"):
                    yield f"{entry.tag} {entry.get('name')} names the {element.tag}", element


def angle_notes(root: ElementTree.Element) -> list[str]:
    """Sentences on angles that are probably in degrees."""
    notes = []
    for entry in [entry for entry in root if entry.tag in ("link", "joint")]:
        for element in own_elements(entry):
            turns = entry.get("type") in ("revolute", "continuous")
            names = {"origin": ("rpy",), "limit": ("lower", "upper") if turns else ()}.get(element.tag, ())
            texts = {name: element.get(name, "") for name in names}
            angles = [abs(float(word)) for text in texts.values() for word in text.split()]
            if any(2.02 * math.pi < angle <= 720 for angle in angles):
                said = " ".join(f'{name}="{text}"' for name, text in texts.items())
                notes.append(f"{entry.tag} {entry.get('name')} has {said} in radians; degrees need a factor of 0.01745")
    return notes


def _problems(element: ElementTree.Element) -> Iterator[str]:
    """What an element lacks or holds wrongly."""
    needed = REQUIRED.get(element.tag, ())
    yield from (f"<{element.tag}> has no {name}; name it" for name in needed if not element.get(name))
    inner = CHILDREN.get(element.tag, ())
    yield from (f"<{element.tag}> has no <{name}>; add it" for name in inner if element.find(name) is None)
    if element.tag == "geometry" and (len(element) == 0 or element[0].tag not in SHAPES):
        yield f"its geometry holds {element[0].tag if len(element) else 'nothing'}; expected box, cylinder, sphere or mesh"
    for name, counts in NUMBERS.get(element.tag, {}).items():
        if name in element.attrib and (element.get(name) or name not in needed):
            yield from _number_problems(element, name, counts)


def _number_problems(element: ElementTree.Element, name: str, counts: tuple[int, ...]) -> Iterator[str]:
    """What is wrong with the numbers of an attribute; commas between them become spaces."""
    text = element.get(name, "").replace(",", " ")
    element.set(name, text)
    said = f'<{element.tag} {name}="{text[:40]}">'
    if not _fits(text, counts, least=0.0 if element.tag in SOLIDS else -math.inf):
        more = ", each finite and 0 or more" if element.tag in SOLIDS else ""
        yield f"{said}; expected {' or '.join(str(count) for count in counts if count)} numbers{more}"
    elif name == "quat_xyzw" and (element.get("rpy") or not any(float(word) for word in text.split())):
        yield f"{said}; expected a rotation, and no rpy next to it"


def _fits(text: str, counts: tuple[int, ...], least: float) -> bool:
    """Whether a text holds as many numbers, none below `least`."""
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return False
    return len(numbers) in counts and (least == -math.inf or all(least <= number < math.inf for number in numbers))


def _set_angles(origin: ElementTree.Element) -> None:
    """Replace a quaternion (URDF 1.2) by URDF's older roll, pitch and yaw [rad]."""
    if quaternion := origin.attrib.pop("quat_xyzw", ""):
        angles = Rotation.from_quat([float(value) for value in quaternion.split()]).as_euler("xyz")
        origin.set("rpy", " ".join(map(repr, angles.tolist())))
