"""How long a frame takes: our two fused passes, and the same outputs by Newton's SensorCamera, same scenes, same run.

    python -m benchmarks.render [--device cpu|cuda:0] [--frames N] [--workloads 2] [--pictures DIR]
                                [--cameras head wrist_left] [--size 640x480]

The workload is what an episode needs from each camera, 320x240 unless --size says otherwise: the scene (two Panda arms and
three things over the table, color with anti-aliasing and shadows, robot mask, visibility of keypoints) and the robot alone by
its commands (color, mask, exact optical flow). It is drawn with capsules for links, with the robot's own meshes, and with
meshes of 2,000 triangles a link.
SensorCamera is called once for each of the two: color (MSAA 4; in the scene with the shadows of one light, where ours has
three), shape index for the mask, and depth, from which visibility and flow would have to be computed; that is not timed.
Capsules are primitives to it and triangles to us. "kernels" is the time on the device, "with copies" until all images are on
the host; on a CPU the two are one. Before a figure is printed, the silhouettes of both are compared.
"""

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import cv2
import newton
import numpy as np
import tyro
import warp as wp
from newton.sensors import SensorCamera
from scipy.spatial.transform import Rotation

from benchmarks.common import format_versions, intersection_over_union, label_picture
from xew.protocol import ARMS
from xew.sim_warp.cameras import fix_camera, get_camera, place_camera
from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.camera import Camera
from xew.sim_warp.geometry.meshes import Color, Mesh
from xew.sim_warp.rendering.bodies import robot_bodies, robot_pose
from xew.sim_warp.rendering.observe import keypoint_positions
from xew.sim_warp.rendering.render import Body, Frames, Renderer, World
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.stage import stage_mesh

FRAMES_PER_WORLD = 24
ROUNDS = 5
PER_LINK = 2000
"""Number of triangles of a link in the heaviest workload."""
VIEWS = {"cpu": 4, "cuda": 256}
"""Number of frames that SensorCamera renders in a call."""
AGREEMENT = 0.95
"""Least intersection over union of the silhouettes of robot and things in the pictures of both."""
WHITE = 0xFFFFFFFF
LIGHT = 0.6
"""Strength of SensorCamera's one light: a white table stays below white."""
JOINTS_BEFORE = (
    np.array((-0.061, -0.046, -0.122, -2.320, 0.247, 2.781, 0.392)),
    np.array((0.151, 0.255, -0.037, -2.013, -0.142, 2.785, 1.023)),
)
JOINTS_AFTER = (
    np.array((-0.335, 0.433, 0.094, -1.765, 0.209, 2.696, 0.359)),
    np.array((0.235, 0.479, -0.052, -1.588, -0.137, 2.578, 1.077)),
)
"""Joint positions of the left and right arm [rad], between which two tools go over the table and down to it."""
PACKAGES = ("warp-lang", "newton", "numpy")


@dataclass(frozen=True)
class Args:
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda:0")] = None
    """Default: a GPU if Warp finds one."""
    frames: int = 0
    """Number of frames of a batch of ours, 0 for 24 on a CPU and 6144 on a GPU."""
    pictures: Path | None = None
    """Folder for pictures of both side by side, one a workload."""
    workloads: tuple[int, ...] = (0, 1, 2)
    """0 capsules, 1 the robot's own meshes, 2 meshes of 2,000 triangles a link."""
    cameras: tuple[str, ...] = ("head",)
    """Names of cameras, or files of custom ones."""
    size: str | None = None
    """Pixels of a picture, such as 640x480; default: each camera's own."""


@dataclass(frozen=True)
class Capsule:
    """A capsule in the frame of its body; a sphere where it has no length."""

    radius: float
    half_length: float
    axis: int
    """0, 1, 2 for x, y, z."""
    center: tuple[float, float, float]

    @property
    def rpy(self) -> tuple[float, float, float]:
        return ((0.0, np.pi / 2, 0.0), (-np.pi / 2, 0.0, 0.0), (0.0, 0.0, 0.0))[self.axis]

    def mesh(self, color: Color) -> Mesh:
        if self.half_length == 0:
            return meshes.sphere(self.radius, color).transformed(self.center)
        return meshes.capsule(self.radius, 2 * self.half_length, color, 24).transformed(self.center, self.rpy)


@dataclass(frozen=True)
class Thing:
    """A body of one color; SensorCamera is given the capsule where there is one."""

    mesh: Mesh
    is_robot: bool
    capsule: Capsule | None = None

    @property
    def body(self) -> Body:
        return Body(self.mesh, self.is_robot)


@dataclass(frozen=True)
class Workload:
    name: str
    robot: list[Thing]
    things: list[Thing]
    robot_pose: np.ndarray
    """[t b 7]."""
    pose: np.ndarray
    """[t b 7] of robot and things."""
    points: np.ndarray
    """[t k 3] keypoints."""
    camera: Camera
    """With one pose, or one for each frame."""

    @property
    def scene(self) -> World:
        return World([thing.body for thing in (*self.robot, *self.things)], self.pose, self.points)

    @property
    def command(self) -> World:
        return World([thing.body for thing in self.robot], self.robot_pose)


def workloads(camera_name: str = "head", size: str | None = None) -> list[Workload]:
    """Both hands at work over the table, before a camera."""
    robot = ROBOTS["franka_panda"]
    action = np.zeros((FRAMES_PER_WORLD, 16))
    share = np.linspace(0, 1, FRAMES_PER_WORLD)[:, None]
    for (joints, gripper), start, end in zip(ARMS, JOINTS_BEFORE, JOINTS_AFTER, strict=True):
        action[:, joints] = (1 - share) * start + share * end
        action[:, gripper] = 1.0
    pose, points = robot_pose(robot, action), keypoint_positions(robot, action)
    camera = place_camera(fix_camera(get_camera(camera_name, size), robot), robot, action)
    thing_pose = np.tile([0.0, 0, 0, 0, 0, 0, 1], (FRAMES_PER_WORLD, 3, 1))
    thing_pose[..., :3] = ((-0.1, -0.1, 0.77), (0.15, 0.1, 0.78), (0.02, -0.05, 0.795))
    together = np.concatenate([pose, thing_pose], 1)
    shapes = (Capsule(0.03, 0.0, 2, (0, 0, 0)), Capsule(0.04, 0.0, 2, (0, 0, 0)), Capsule(0.025, 0.03, 2, (0, 0, 0)))
    colors: tuple[Color, ...] = ((200, 60, 60), (60, 160, 60), (60, 60, 200))
    things = [Thing(shape.mesh(color), False, shape) for shape, color in zip(shapes, colors, strict=True)]
    links = [paint_one_color(body.mesh) for body in robot_bodies(robot)]
    fitted = [fit_capsule(mesh) for mesh in links]
    drawn = {
        "capsules": [Thing(capsule.mesh(main_color(mesh)), True, capsule) for capsule, mesh in zip(fitted, links, strict=True)],
        "own meshes": [Thing(mesh, True) for mesh in links],
        f"{PER_LINK} triangles a link": [Thing(refine(mesh, PER_LINK), True) for mesh in links],
    }
    return [Workload(name, parts, things, pose, together, points, camera) for name, parts in drawn.items()]


def main_color(mesh: Mesh) -> Color:
    colors, counts = np.unique(mesh.colors, axis=0, return_counts=True)
    red, green, blue = (int(value) for value in colors[counts.argmax()])
    return red, green, blue


def paint_one_color(mesh: Mesh) -> Mesh:
    """A shape of Newton's has one color, so all have."""
    colors = np.tile(np.array(main_color(mesh), np.uint8), (len(mesh.triangles), 1))
    return Mesh(mesh.vertices, mesh.triangles, colors, mesh.normals)


def fit_capsule(mesh: Mesh) -> Capsule:
    """About the size of a link: along its longest side, as thick as the mean of the others."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    size, center = high - low, (low + high) / 2
    axis = int(size.argmax())
    radius = float(np.delete(size, axis).mean() / 2)
    x, y, z = (float(value) for value in center)
    return Capsule(radius, max(0.01, float(size[axis]) / 2 - radius), axis, (x, y, z))


def refine(mesh: Mesh, wanted: int) -> Mesh:
    """The same surface in more triangles: the largest are quartered until there are enough."""
    while len(mesh.triangles) < wanted:
        corners = mesh.vertices[mesh.triangles]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        split = np.argsort(-area)[: -(-(wanted - len(area)) // 3)]
        kept = np.setdiff1d(np.arange(len(area)), split)
        vertices = np.concatenate([corners[kept].reshape(-1, 3), _quarter(corners[split]).reshape(-1, 3)])
        normals = np.concatenate([mesh.normals[kept], _quarter(mesh.normals[split])])
        colors = np.concatenate([mesh.colors[kept], mesh.colors[split].repeat(4, 0)])
        mesh = Mesh(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), colors, normals)
    return mesh


def _quarter(corners: np.ndarray) -> np.ndarray:
    """[f 3 3] -> [4f 3 3]."""
    a, b, c = corners.swapaxes(0, 1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = (a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca)
    return np.stack(parts, 1).reshape(-1, 3, 3).astype(np.float32)


# ---- ours


def scene_pass(renderer: Renderer, work: Workload, worlds: int) -> list[Frames]:
    return renderer.render_batch([work.scene] * worlds, repeat_camera(work.camera, worlds))


def command_pass(renderer: Renderer, work: Workload, worlds: int) -> list[Frames]:
    return renderer.render_batch([work.command] * worlds, repeat_camera(work.camera, worlds), ground=False, optical_flow=True)


def repeat_camera(camera: Camera, worlds: int) -> Camera:
    """The camera for several worlds: one that moves has a pose for each frame of all."""
    return replace(camera, extrinsics=np.tile(camera.extrinsics, (worlds, 1, 1))) if camera.moves else camera


def check(scene: Frames, command: Frames, camera: Camera) -> None:
    """The workload is what it says: robot and keypoints are there, and something moves."""
    assert scene.rgb.shape == command.rgb.shape == (FRAMES_PER_WORLD, camera.height, camera.width, 3)
    assert scene.robot_mask.mean() > 0.05 and command.robot_mask.mean() > 0.05
    if not camera.moves:  # a hand stands still before its own camera and hides its keypoints
        assert (scene.point_body >= 0).any() and scene.point_depth.max() > 0.5
        assert (np.linalg.norm(command.optical_flow[0], axis=-1) > 0.5).mean() > 0.02


# ---- SensorCamera's


def newton_model(things: list[Thing], with_stage: bool, worlds: int, device: str) -> newton.Model:
    world = newton.ModelBuilder()
    world.default_shape_cfg.density = 0.0
    for thing in things:
        _add_thing(world, world.add_body(mass=1.0, inertia=wp.diag(wp.vec3(1.0)), lock_inertia=True), thing)
    builder = newton.ModelBuilder()
    builder.replicate(world, worlds)
    if with_stage:
        mesh = stage_mesh()
        for color in np.unique(mesh.colors, axis=0):
            triangles = mesh.triangles[(mesh.colors == color).all(1)]
            part = newton.Mesh(mesh.vertices, triangles.ravel(), compute_inertia=False)
            builder.add_shape_mesh(-1, mesh=part, color=tuple(color / 255))
    return builder.finalize(device=device)


def _add_thing(builder: newton.ModelBuilder, link: int, thing: Thing) -> None:
    color = tuple(value / 255 for value in main_color(thing.mesh))
    capsule = thing.capsule
    if capsule is None:
        mesh = newton.Mesh(thing.mesh.vertices, thing.mesh.triangles.ravel(), normals=_vertex_normals(thing.mesh))
        builder.add_shape_mesh(link, mesh=mesh, color=color)
    elif capsule.half_length == 0:
        builder.add_shape_sphere(link, radius=capsule.radius, color=color)
    else:
        turn = Rotation.from_euler("xyz", capsule.rpy).as_quat()
        frame = wp.transform(wp.vec3(*capsule.center), wp.quat(*turn))
        builder.add_shape_capsule(link, xform=frame, radius=capsule.radius, half_height=capsule.half_length, color=color)


def _vertex_normals(mesh: Mesh) -> np.ndarray:
    normals = np.zeros_like(mesh.vertices)
    np.add.at(normals, mesh.triangles.ravel(), mesh.normals.reshape(-1, 3))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)


def _sensor_place(extrinsics: np.ndarray) -> wp.transformf:
    """Pose of a SensorCamera, which looks along -z with y up; `extrinsics` [4 4] from world to camera."""
    rotation = extrinsics[:3, :3].T @ np.diag([1.0, -1.0, -1.0])
    position = -extrinsics[:3, :3].T @ extrinsics[:3, 3]
    return wp.transform(wp.vec3(*position), wp.quat_from_matrix(wp.mat33(*rotation.ravel())))


class Sensor:
    """SensorCamera at a camera's place, one world a view."""

    def __init__(
        self, things: list[Thing], pose: np.ndarray, camera: Camera, with_stage: bool, views: int, device: str
    ) -> None:
        self.things, self.device = len(things) * views, device
        self.model = newton_model(things, with_stage, views, device)
        self.state = self.model.state()
        self.state.body_q.assign(pose[np.arange(views) % len(pose)].reshape(-1, 7).astype(np.float32))
        config = SensorCamera.RenderConfig(enable_shadows=with_stage, anti_aliasing=SensorCamera.AntiAliasing.MSAA)
        self.camera = SensorCamera(self.model, default_render_config=config)
        self.camera.create_default_light(direction=wp.vec3(0.0, 0.447, -0.894), color=(LIGHT, LIGHT, LIGHT))
        fov = float(2 * np.arctan(camera.height / 2 / camera.intrinsics[1, 1]))
        size = camera.width, camera.height
        self.rays = SensorCamera.compute_camera_rays_pinhole(*size, camera_fov=fov, sample_count=4, device=device)
        poses = np.broadcast_to(camera.extrinsics, (len(pose), 4, 4))
        self.places = wp.array(
            [_sensor_place(poses[view % len(poses)]) for view in range(views)], dtype=wp.transformf, device=device
        )
        self.color = self.camera.allocate_image_color(views, *size)
        self.shape_index = self.camera.allocate_image_shape_index(views, *size)
        self.depth = self.camera.allocate_image_depth_forward(views, *size)
        self.clear = SensorCamera.ClearData(clear_color=WHITE)

    def render(self) -> None:
        self.model.bvh_refit_shapes(self.state)
        images = {"color_image": self.color, "shape_index_image": self.shape_index, "forward_depth_image": self.depth}
        self.camera.update(self.state, self.places, self.rays, clear_data=self.clear, **images)

    def render_to_device(self) -> None:
        self.render()
        wp.synchronize_device(self.device)

    def render_to_host(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Color [n h w] uint32, shape index [n h w] and depth [n h w] m of all views."""
        self.render()
        return self.color.numpy(), self.shape_index.numpy(), self.depth.numpy()

    def picture(self) -> tuple[np.ndarray, np.ndarray]:
        """Color [h w 3] uint8 and mask of robot and things [h w] of the first view."""
        color, shape_index, _ = self.render_to_host()
        rgba = color[0].view(np.uint8).reshape(*color[0].shape, 4)
        return rgba[..., :3].copy(), shape_index[0] < self.things


# ---- the race


def median_seconds(action: Callable[[], object]) -> float:
    """Over a few rounds, after one that compiles."""
    action()
    rounds = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        action()
        rounds.append(time.perf_counter() - start)
    return float(np.median(rounds))


def kernel_seconds(action: Callable[[], object]) -> dict[str, float]:
    """Time on a GPU by kernel, and of copies; nothing on a CPU."""
    wp.timing_begin()
    action()
    spent: dict[str, float] = defaultdict(float)
    for result in wp.timing_end():
        name = result.name.removeprefix("forward kernel ").removesuffix("_cuda_kernel_forward")
        spent[name] += result.elapsed / 1e3
    return spent


def is_copy(name: str) -> bool:
    return name.startswith("memcpy")


@dataclass(frozen=True)
class Cost:
    """Seconds a frame."""

    kernels: float
    with_copies: float

    def __add__(self, other: "Cost") -> "Cost":
        return Cost(self.kernels + other.kernels, self.with_copies + other.with_copies)


def our_cost(name: str, action: Callable[[], object], count: int) -> Cost:
    """What our frames cost; prints what each kernel takes on a GPU."""
    whole = median_seconds(action) / count
    spent = kernel_seconds(action)
    spent_by_kernel = {
        kernel: seconds for kernel, seconds in sorted(spent.items(), key=lambda item: -item[1]) if seconds / count > 5e-8
    }
    if spent_by_kernel:
        listed = ", ".join(f"{kernel} {1e6 * seconds / count:.2f}" for kernel, seconds in spent_by_kernel.items())
        print(f"  {name} [us/frame]: {listed}")
    on_device = sum(seconds for kernel, seconds in spent.items() if not is_copy(kernel)) / count
    return Cost(on_device or whole, whole)


def their_cost(sensor: Sensor, views: int) -> Cost:
    return Cost(median_seconds(sensor.render_to_device) / views, median_seconds(sensor.render_to_host) / views)


def race(work: Workload, renderer: Renderer, worlds: int, pictures: Path | None) -> None:
    device = renderer.device.alias
    count, views = worlds * FRAMES_PER_WORLD, VIEWS["cuda" if renderer.device.is_cuda else "cpu"]
    scene, command = scene_pass(renderer, work, 1)[0], command_pass(renderer, work, 1)[0]
    check(scene, command, work.camera)
    triangles = [sum(len(thing.mesh.triangles) for thing in part) for part in (work.robot, work.things)]
    print(f"\n{work.name}: robot of {triangles[0]} and things of {triangles[1]} triangles, {len(work.robot)} links")
    fused = our_cost("scene", lambda: scene_pass(renderer, work, worlds), count)
    fused += our_cost("robot alone", lambda: command_pass(renderer, work, worlds), count)
    whole = Sensor([*work.robot, *work.things], work.pose, work.camera, True, views, device)
    alone = Sensor(work.robot, work.robot_pose, work.camera, False, views, device)
    seen = {"scene": whole.picture(), "robot alone": alone.picture()}
    own = renderer.render_batch([work.scene], work.camera, body=True)[0].body[0] >= 0
    pairs = (own, seen["scene"][1]), (command.robot_mask[0], seen["robot alone"][1])
    same = [intersection_over_union(*pair) for pair in pairs]
    assert min(same) > AGREEMENT, f"the silhouettes agree only to {same[0]:.3f} and {same[1]:.3f}"
    separate = their_cost(whole, views) + their_cost(alone, views)
    print(f"  silhouettes agree to {same[0]:.3f} (scene) and {same[1]:.3f} (robot alone), intersection over union")
    print(f"  {'both passes [ms/frame]':44s}{'kernels':>10s}{'with copies':>13s}{'frames/s':>10s}")
    for label, cost in ((f"xew, {count} frames a call", fused), (f"SensorCamera, {views} frames a call", separate)):
        print(f"  {label:44s}{1e3 * cost.kernels:10.4f}{1e3 * cost.with_copies:13.4f}{1 / cost.with_copies:10.0f}")
    ratios = separate.kernels / fused.kernels, separate.with_copies / fused.with_copies
    print(f"  {'SensorCamera takes as long, times':44s}{ratios[0]:10.2f}{ratios[1]:13.2f}")
    if pictures:
        panels = {"xew": scene.rgb[0], "SensorCamera": seen["scene"][0]}
        panels |= {"xew, robot alone": command.rgb[0], "SensorCamera, robot alone": seen["robot alone"][0]}
        save_pictures(pictures / f"render_{work.name.replace(' ', '_')}.png", panels)


def save_pictures(path: Path, panels: dict[str, np.ndarray]) -> None:
    """Write pictures [h w 3] uint8 side by side at twice their size, two a row, with labels."""
    path.parent.mkdir(parents=True, exist_ok=True)
    labeled = [label_picture(image, label) for label, image in panels.items()]
    sheet = np.vstack([np.hstack(labeled[row : row + 2]) for row in range(0, len(labeled), 2)])
    if not cv2.imwrite(str(path), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR)):
        raise OSError(f"{path} cannot be written; choose another folder with --pictures.")


def main(args: Args) -> None:
    device = wp.get_device(args.device)
    worlds = max(1, (args.frames or (6144 if device.is_cuda else FRAMES_PER_WORLD)) // FRAMES_PER_WORLD)
    print(f"{device.name} ({device.alias})")
    print(format_versions(PACKAGES))
    renderer = Renderer(device.alias)
    for name in args.cameras:
        found = workloads(name, args.size)
        for work in (found[number] for number in args.workloads):
            print(f"\ncamera {name}, {work.camera.width}x{work.camera.height}")
            race(work, renderer, worlds, args.pictures)


if __name__ == "__main__":
    wp.config.quiet = True
    main(tyro.cli(Args, description=__doc__))
