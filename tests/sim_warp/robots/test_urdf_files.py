"""Files that users bring: what a URDF and its meshes name and state is followed as RViz does it, or told; nothing hangs."""

import codecs
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from tests.faults.reading import at_most_seconds
from tests.sim_warp.robots.own_robot import write_urdf
from tests.sim_warp.robots.tiny_urdf import BOX, MESH, color, joint, link, material, write
from xew.config import ConfigError
from xew.sim_warp.robots import ROBOTS, adopt, adopt_robots, keep_robot, load_urdf, recorded_robot
from xew.sim_warp.robots.user.draft import find_description
from xew.sim_warp.robots.user.hands import find_linkages
from xew.sim_warp.robots.user.plain import read_description

# --- Encodings.


@pytest.mark.parametrize(
    ("encoding", "word", "mark"),
    [
        ("utf-8", "größe", b""),
        ("utf-8", "größe", codecs.BOM_UTF8),
        ("ISO-8859-1", "größe", b""),
        ("windows-1252", "“arm”", b""),
        ("utf-16", "größe", b""),
        ("gb2312", "机械臂", b""),
        ("shift_jis", "腕", b""),
    ],
)
def test_a_file_is_read_in_the_encoding_that_it_declares(encoding: str, word: str, mark: bytes, tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    text = f'<?xml version="1.0" encoding="{encoding}"?><robot name="r">{link(word, BOX, BOX)}</robot>'
    path.write_bytes(mark + text.encode(encoding))
    assert list(load_urdf(path).links) == [word]
    assert [entry.get("name") for entry in read_description(path, {}, {}).iter("link")] == [word]


@pytest.mark.parametrize("encoding", ["utf-8", "nothing", "punycode", "base64", "utf-16"])
def test_other_bytes_than_declared_are_refused(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    path.write_bytes(f'<?xml version="1.0" encoding="{encoding}"?><robot name="größe!"/>'.encode("latin-1"))
    for read in (load_urdf, lambda path: read_description(path, {}, {})):
        with pytest.raises(ConfigError, match=r"r\.urdf is not a URDF that can be read .*first line declares"):
            read(path)


# --- Materials.


ORANGE, BLUE = '<color rgba="1 0.5 0 1"/>', '<color rgba="0 0 1 1"/>'
MATERIALS = [
    ("of another link", (link("a", BOX + material("m")), link("b", BOX + material("m", ORANGE))), [(255, 128, 0)], ""),
    ("of the robot", (link("a", BOX + material("m")), link("b"), material("m", ORANGE)), [(255, 128, 0)], ""),
    ("its own", (link("a", BOX + material("", ORANGE)), link("b", BOX + material("", BLUE))), [(255, 128, 0)], ""),
    (
        "two colors",
        (link("a", BOX + material("m", ORANGE)), link("b"), material("m", BLUE)),
        [(255, 128, 0)],
        "the material m has several colors: each link keeps its own",
    ),
    (
        "nowhere",
        (link("a", BOX + material("ornage")), link("b", BOX + material("orange", ORANGE))),
        [(190, 190, 190)],
        "link a names the material ornage, which is defined nowhere",
    ),
]


@pytest.mark.parametrize(("parts", "expected", "note"), [case[1:] for case in MATERIALS], ids=[case[0] for case in MATERIALS])
def test_a_material_is_found_where_it_is_defined(
    parts: tuple[str, ...], expected: list[tuple[int, ...]], note: str, tmp_path: Path
) -> None:
    path = write(tmp_path, *parts, joint("j", "b"))
    assert color(path) == expected
    assert [text for text in load_urdf(path).notes if "material" in text] == ([note] if note else [])


def test_a_texture_of_another_link_is_found(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        link("a", BOX + material("m")),
        link("b", BOX + material("m", '<texture filename="t.png"/>')),
        joint("j", "b"),
    )
    Image.fromarray(np.full((4, 4, 3), (9, 80, 200), np.uint8)).save(tmp_path / "t.png")
    assert color(path) == [(9, 80, 200)] and tmp_path / "t.png" in load_urdf(path).files


# --- Packages and names of files.


def ball(path: Path, radius: float = 0.01) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.icosphere(1, radius).export(path)
    return path


def declare(folder: Path, name: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "package.xml").write_text(f"<package><name>{name}</name></package>")


NAMES = [
    ("package://arm/meshes/x.stl", "arm/meshes/x.stl", ""),
    ("package://fork/meshes/x.stl", "arm/meshes/x.stl", ""),  # arm/package.xml says that it is fork
    ("package://hand/meshes/x.stl", "hand/meshes/x.stl", ""),  # not the arm's own meshes/x.stl
    ("model://hand/meshes/x.stl", "hand/meshes/x.stl", ""),
    ("package://ros2/meshes/x.stl", "ament/share/ros2/meshes/x.stl", ""),
    ("package://ros1/meshes/x.stl", "catkin/ros1/meshes/x.stl", ""),
    ("package://gone/meshes/x.stl", "arm/meshes/x.stl", "there is no package gone: its files are read from"),
    ("file://{}/hand/meshes/x.stl", "hand/meshes/x.stl", ""),
    ("../meshes/my%20x.stl", "arm/meshes/my x.stl", ""),
    ("..\\meshes\\x.stl", "arm/meshes/x.stl", ""),
    ("C:\\work\\meshes\\x.stl", "arm/meshes/x.stl", "is not on this machine"),
    ("meshes/x.stl", "arm/meshes/x.stl", ""),
]


@pytest.mark.parametrize(("name", "expected", "note"), NAMES, ids=[name for name, _, _ in NAMES])
def test_all_commands_find_the_same_file(
    name: str, expected: str, note: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for place in sorted({path for _, path, _ in NAMES}):
        ball(tmp_path / place)
    declare(tmp_path / "arm", "fork")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "ament"))
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "catkin"))
    name = name.format(tmp_path)
    path = write(tmp_path / "arm" / "urdf", link("a", MESH.format(name), BOX))
    read = load_urdf(path)
    assert read.meshes[name].resolve() == tmp_path / expected and len(read.notes) == bool(note) and note in "".join(read.notes)
    notes: list[str] = []
    tree = read_description(path, {}, {}, notes)
    assert [mesh.get("filename") for mesh in tree.iter("mesh")] == [str(tmp_path / expected)] and notes == list(read.notes)


@pytest.mark.parametrize(
    "name", ["none.stl", "package://none/x.stl", "package://arm/none.stl", f"{'a' * 5000}.stl", "/none.stl"]
)
def test_a_file_that_is_nowhere_is_told_alike(name: str, tmp_path: Path) -> None:
    path = write(tmp_path / "arm", link("a", MESH.format(name)))
    messages = []
    for read in (load_urdf, lambda path: read_description(path, {}, {})):
        with pytest.raises(ConfigError, match=r"link a names the mesh .* does not exist") as error:
            read(path)
        messages.append(str(error.value))
    assert messages[0] == messages[1]


def test_a_given_package_is_the_only_one(tmp_path: Path) -> None:
    path = write(tmp_path / "arm", link("a", MESH.format("package://arm/x.stl")))
    ball(tmp_path / "arm" / "x.stl")
    (tmp_path / "other").mkdir()
    with pytest.raises(ConfigError, match="--package arm=DIR"):
        read_description(path, {"arm": tmp_path / "other"}, {})


def test_files_of_simulators_do_not_matter(tmp_path: Path) -> None:
    """A robot with a plugin and a simulator's mesh by absolute paths is kept, and read again from the data set."""
    plugin = '<gazebo><plugin name="c" filename="/opt/ros/lib/c.so"/><visual><mesh filename="/opt/m.dae"/></visual></gazebo>'
    own = keep_robot(ROBOTS["piper"], tmp_path / "lab").urdf
    own.write_text(own.read_text().replace("</robot>", f"{plugin}</robot>"))
    (tmp_path / "lab/robots/piper").rename(tmp_path / "lab/robots/arm")
    keep_robot(recorded_robot("arm", tmp_path / "lab"), tmp_path / "data")
    robot = recorded_robot("arm", tmp_path / "data")
    assert robot.arms == ROBOTS["piper"].arms and "/opt/ros/lib/c.so" in robot.urdf.read_text()


def test_generate_tells_what_it_could_not_follow(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = keep_robot(ROBOTS["piper"], tmp_path / "lab").urdf
    path.write_text(re.sub(r'<material name="\w+" ?/>', '<material name="lost"/>', path.read_text(), count=1))
    (tmp_path / "lab/robots/piper").rename(tmp_path / "lab/robots/arm")
    assert adopt_robots([str(tmp_path / "lab/robots/arm")], tmp_path / "data") == ("arm",)
    assert re.search(r"note: link \w+ names the material lost, which is defined nowhere", capsys.readouterr().out)


def test_upper_case_and_hidden_files(tmp_path: Path) -> None:
    path = write_urdf(tmp_path).rename(tmp_path / "SMALL.URDF")
    (tmp_path / "._small.urdf").write_bytes(b"\0\5\26\7")
    assert find_description(tmp_path) == path


# --- References that lead nowhere or in a circle.


def fingers(*mimics: str) -> list[str]:
    """Joints ga, gb, gc with these names of joints that they mimic."""
    limit = '<limit lower="0" upper="1" effort="1" velocity="1"/>'
    tags = [f'<mimic joint="{name}" multiplier="-2"/>' if name else "" for name in mimics]
    return [
        link("a"),
        *(link(name, BOX, BOX) for name in ("fa", "fb", "fc")),
        *(joint(f"g{name}", f"f{name}", limit + tag, "revolute") for name, tag in zip("abc", tags, strict=True)),
    ]


@pytest.mark.parametrize(
    ("mimics", "driven", "notes"),
    [
        (("", "ga", "gb"), {"ga": ["ga", "gb", "gc"]}, []),
        (("", "gaa", ""), {}, ["joint gb mimics gaa, which does not exist; did you mean 'ga'? It is read as independent"]),
        (
            ("", "GB", "gb"),
            {"gb": ["gb", "gc"]},
            ["joint gb mimics GB, which does not exist; correct the name. It is read as "],
        ),
        (("", "gb", "gb"), {"gb": ["gb", "gc"]}, ["joint gb mimics gb, which is itself. It is read as independent"]),
        (
            ("gb", "ga", "ga"),
            {"ga": ["ga", "gc"]},
            ["joint ga mimics gb, which mimics it in turn.", "joint gb mimics ga, which mimics it in turn."],
        ),
        (("gb", "gc", "ga"), {}, [f"joint g{name} mimics" for name in "abc"]),
    ],
    ids=["a chain", "a typo", "upper case", "itself", "each other", "three"],
)
def test_mimic_tags_are_followed_to_an_end(
    mimics: tuple[str, ...], driven: dict[str, list[str]], notes: list[str], tmp_path: Path
) -> None:
    with at_most_seconds(20):
        read = load_urdf(write(tmp_path, *fingers(*mimics)))
        linkages = find_linkages(read)
    assert {linkage.driver.name: list(linkage.factors) for linkage in linkages} == driven
    assert len(read.ignored_mimics) == len(notes) and all(map(str.startswith, read.ignored_mimics, notes))
    assert set(read.ignored_mimics) <= set(read.notes)


def test_a_chain_of_mimics_multiplies(tmp_path: Path) -> None:
    (linkage,) = find_linkages(load_urdf(write(tmp_path, *fingers("", "ga", "gb"))))
    assert linkage.positions(0.5) == {"ga": 0.5, "gb": -1.0, "gc": 2.0}


XACRO = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">{}</robot>'
ARGUMENT = '<xacro:arg name="prefix" default=""/><link name="$(arg prefix)base"/>'


def write_xacro(folder: Path, inner: str, name: str = "arm.urdf.xacro") -> Path:
    pytest.importorskip("xacrodoc")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(XACRO.format(inner))
    return folder / name


def test_an_argument_that_a_xacro_does_not_have_is_told(tmp_path: Path) -> None:
    path = write_xacro(tmp_path, ARGUMENT)
    with pytest.raises(ConfigError, match=r"--argument prefx: arm.urdf.xacro has no .*did you mean 'prefix'\? It has prefix\."):
        read_description(path, {}, {"prefx": "left_"})
    assert [entry.get("name") for entry in read_description(path, {}, {"prefix": "ü_"})] == ["ü_base"]


def test_an_argument_of_an_included_file_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file is named relative to the xacro, not to the folder in which the command runs."""
    path = write_xacro(tmp_path / "arm", '<xacro:include filename="parts/base.xacro"/>')
    write_xacro(tmp_path / "arm" / "parts", ARGUMENT, "base.xacro")
    monkeypatch.chdir(tmp_path)
    tree = read_description(path.relative_to(tmp_path), {}, {"prefix": "left_"})
    assert [entry.get("name") for entry in tree] == ["left_base"]


def test_packages_of_a_xacro_are_those_of_its_meshes(tmp_path: Path) -> None:
    """A package next to the file's own is found, and the package of another file's call is forgotten."""
    include = '<xacro:include filename="$(find hand)/hand.xacro"/>'
    for place in ("one", "two"):
        write_xacro(tmp_path / place / "hand", link(place), "hand.xacro")
        path = write_xacro(tmp_path / place / "arm", include)
        assert [entry.get("name") for entry in read_description(path, {}, {})] == [place]
    given = read_description(path, {"hand": tmp_path / "one" / "hand"}, {})
    assert [entry.get("name") for entry in given] == ["one"]


@pytest.mark.parametrize(
    ("inner", "told"),
    [
        ('<xacro:include filename="arm.urdf.xacro"/>', "includes itself; remove the circle|includes itself\\)"),
        ('<xacro:macro name="m"><xacro:m/></xacro:macro><xacro:m/>', "includes itself"),
        ('<xacro:property name="p" value="${p}"/><link name="${p}"/>', "cannot be expanded"),
        ('<xacro:include filename="$(find nothing)/a.xacro"/>', "nothing.*check --package NAME=DIR"),
    ],
    ids=["a file", "a macro", "a property", "no package"],
)
def test_a_xacro_that_does_not_end_is_told(inner: str, told: str, tmp_path: Path) -> None:
    path = write_xacro(tmp_path, inner)
    with at_most_seconds(60), pytest.raises(ConfigError, match=told):
        read_description(path, {}, {})


def test_a_xacro_is_read_in_its_encoding(tmp_path: Path) -> None:
    path = write_xacro(tmp_path, "")
    text = '<?xml version="1.0" encoding="ISO-8859-1"?>' + XACRO.format('<link name="größe"/>')
    path.write_bytes(text.encode("latin-1"))
    assert [entry.get("name") for entry in read_description(path, {}, {})] == ["größe"]
    with pytest.raises(ConfigError, match=r"holds xacro macros; a xacro is named \.xacro"):
        load_urdf(write_xacro(tmp_path, ARGUMENT, "plain.urdf"))


# --- Broken and hostile files end in one line.


BROKEN = [
    (link("a", '<geometry><box size="1"/></geometry>'), 'link a: <box size="1">; expected 3 numbers'),
    (link("a", '<geometry><box size=""/></geometry>'), "link a: <box> has no size; name it"),
    (link("a", '<geometry><box size="1 1 -1"/></geometry>'), "expected 3 numbers, each finite and 0 or more"),
    (link("a", '<geometry><cylinder radius="1"/></geometry>'), "link a: <cylinder> has no length"),
    (link("a", '<geometry><sphere radius="nan"/></geometry>'), 'link a: <sphere radius="nan">; expected 1 numbers'),
    (link("a", "<geometry><mesh/></geometry>"), "link a: <mesh> has no filename; name it"),
    (link("a", '<geometry><mesh filename="x" scale="1 1"/></geometry>'), 'scale="1 1">; expected 1 or 3 numbers'),
    (link("a", "<geometry/>"), "its geometry holds nothing; expected box, cylinder, sphere or mesh"),
    (link("a", "<geometry><capsule/></geometry>"), "its geometry holds capsule"),
    (link("a", "<origin/>"), "link a: <visual> has no <geometry>; add it"),
    (link("a", f'<origin xyz="0 0"/>{BOX}'), 'link a: <origin xyz="0 0">; expected 3 numbers'),
    (link("a", f'<origin rpy="a b c"/>{BOX}'), "expected 3 numbers"),
    (link("a", f'<origin quat_xyzw="0 0 0 0"/>{BOX}'), "expected a rotation"),
    (link("a", f'<origin quat_xyzw="x"/>{BOX}'), "expected 4 numbers"),
    (link("a", BOX + material("m", '<color rgba="red"/>')), 'rgba="red">; expected 3 or 4 numbers'),
    ("<link/>", "link without a name: <link> has no name"),
    (link("a") + '<joint name="j" type="fixed"/>', "joint j: <joint> has no <parent>"),
    (link("a") + '<joint name="j"><parent link="a"/><child/></joint>', "joint j: <child> has no link"),
    (link("a") + link("b") + joint("j", "b", "<mimic/>"), "joint j: <mimic> has no joint"),
    (link("a") + link("b") + joint("j", "b", '<limit lower="low"/>'), 'lower="low">; expected 1 numbers'),
    ("".join(link(f"l{number}") for number in range(1001)), "has 1001 links or joints; expected at most 1000"),
    ("<a>" * 3000 + "</a>" * 3000, "is not a URDF that can be read"),
]


@pytest.mark.parametrize(("body", "told"), BROKEN, ids=[told[:40] for _, told in BROKEN])
def test_a_broken_element_is_named(body: str, told: str, tmp_path: Path) -> None:
    for read in (load_urdf, lambda path: read_description(path, {}, {})):
        with pytest.raises(ConfigError, match=re.escape(told)) as error:
            read(write(tmp_path, body))
        assert str(tmp_path / "r.urdf") in str(error.value)


def test_other_files_are_no_urdf(tmp_path: Path) -> None:
    laughs = "".join(f'<!ENTITY a{n + 1} "{f"&a{n};" * 10}">' for n in range(9))
    texts = {
        "<html/>": "begins with <html>, expected <robot>",
        "<robot/>": "<robot> has no name",
        f'<!DOCTYPE r [<!ENTITY a0 "laugh">{laughs}]><robot name="&a9;"/>': "is not a URDF that can be read",
        '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="r">&x;</robot>': "is not a URDF that can be read",
    }
    for text, told in texts.items():
        (tmp_path / "r.urdf").write_text(text)
        with at_most_seconds(20), pytest.raises(ConfigError, match=told):
            load_urdf(tmp_path / "r.urdf")


# --- The command.


def test_errors_name_the_user_s_file(tmp_path: Path) -> None:
    """Not its changed copy in a temporary folder."""
    path = write(tmp_path / "lab", *fingers("", "gaa", "gb"))
    with pytest.raises(ConfigError) as error:
        adopt.adopt(adopt.Args(path, tmp_path / "out"))
    assert str(error.value).startswith(f"{path}: the fingers of the hand on a do not both move")
    assert "Note: joint gb mimics gaa" in str(error.value)


def test_a_material_outlives_the_link_that_defines_it(tmp_path: Path) -> None:
    """The hand of an arm is cut off; the arm keeps its color."""
    from xew.sim_warp.robots.user.hands import graft_hand

    gray = '<material name="gray"><color rgba="0.6 0.6 0.65 1"/></material>'
    path = write_urdf(tmp_path)
    head, finger, tail = path.read_text().rpartition('<link name="finger_b">')
    path.write_text(head.replace(gray, '<material name="gray"/>') + finger + tail)
    tree = ElementTree.parse(path).getroot()
    graft_hand(tree, load_urdf(path), ROBOTS["franka_panda"], "arm6")
    ElementTree.ElementTree(tree).write(tmp_path / "changed.urdf")
    assert color(tmp_path / "changed.urdf", "link1") == [(153, 153, 166)]
