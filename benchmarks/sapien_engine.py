"""Frames and physics steps a second beside SAPIEN, the engine that RoboTwin's data comes from: one episode, one run.

    python -m benchmarks.sapien_engine [--device cpu|cuda:0] [--task place_empty_cup] [--robot franka_panda] [--pictures DIR]

An episode of ours is planned and simulated, and its frames are rendered at 320x240 by SAPIEN (`pip install sapien`, a Vulkan
device is needed) and by us: robot from the same URDF, things from the same meshes, table, wall, ground, lights and camera of
RoboTwin. SAPIEN runs as its users run it, one scene frame by frame: `set_qpos`, `set_pose`, `update_render`, `take_picture`,
`get_picture`. Rasterized is its shader pack "default", ray traced its "rt" with 32 samples a pixel, path depth 8 and the
denoiser OIDN, as in RoboTwin. Ours is `Renderer.render_batch` with shadows of all three lights and robot mask, up to images
on the host. Physics: SAPIEN's PhysX on the CPU, one world, 4 ms a step, driven along the same commands; ours in MuJoCo's C
engine, one world, and on a GPU in MuJoCo Warp. Before a figure is printed, the robot's silhouettes in both
pictures are compared.
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import trimesh
import tyro
import warp as wp

from benchmarks.common import format_versions, intersection_over_union, label_picture
from xew.sim_warp import stage
from xew.sim_warp.geometry.camera import HEAD_CAMERA
from xew.sim_warp.geometry.meshes import Mesh
from xew.sim_warp.kinematics.expert import joint_commands
from xew.sim_warp.kinematics.forward import joint_positions
from xew.sim_warp.physics import Motion, simulate
from xew.sim_warp.physics.template import PAD_FRICTION
from xew.sim_warp.physics.worlds import STEPS_PER_FRAME, TIME_STEP, World
from xew.sim_warp.rendering.bodies import robot_bodies, robot_pose
from xew.sim_warp.rendering.observe import scene_things
from xew.sim_warp.rendering.render import Body, Frames, Renderer
from xew.sim_warp.rendering.render import World as RenderedWorld
from xew.sim_warp.robots import RobotSpec, get_robot, load_urdf
from xew.sim_warp.scene import Scene, scene_rng
from xew.sim_warp.tasks import get_task

PATH_DEPTH = 8
DRIVE = (1000.0, 200.0)
"""Stiffness and damping of the arms' drives, RoboTwin's."""
ROUNDS = 3
OFF_COURSE = 0.05
"""Farthest that a driven arm may end from its last command [rad]."""
AGREEMENT = 0.9
"""Least intersection over union of the robot's silhouettes in SAPIEN's picture and in ours."""
Frame = np.ndarray


@dataclass(frozen=True)
class Args:
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda:0")] = None
    """Of our renderer and physics. Default: a GPU if Warp finds one."""
    task: str = "place_empty_cup"
    robot: str = "franka_panda"
    seed: int = 0
    frames: int = 0
    """Frames of the episode that SAPIEN renders in a round, 0 for all; ray traced at most 60."""
    batch: int = 0
    """Frames that we render at a time, 0 for 6,144 on a GPU and 24 on a CPU."""
    worlds: int = 256
    """Worlds that MuJoCo Warp steps together."""
    scenes: int = 0
    """Where not 0, time SAPIEN's batched rasteriser (RenderSystemGroup) too, on this many scenes at once."""
    samples: int = 32
    """A pixel, ray traced; fewer only to try the script without a GPU."""
    denoiser: Literal["oidn", "optix", "none"] = "oidn"
    """OIDN needs a GPU; "none" only to try the script without one."""
    pictures: Path | None = None
    """Folder for one picture of each, side by side."""


@dataclass(frozen=True)
class Episode:
    """What is rendered and simulated on both sides."""

    robot: RobotSpec
    scene: Scene
    action: np.ndarray
    """[t 16] commands."""
    motion: Motion

    @property
    def things(self) -> tuple[list[Body], np.ndarray]:
        """All bodies but the robot's, and their poses [t b 7], world."""
        return scene_things(self.scene, self.motion.object_pose, self.motion.object_joint)

    @property
    def world(self) -> RenderedWorld:
        things, pose = self.things
        return RenderedWorld(
            [*robot_bodies(self.robot), *things],
            np.concatenate([robot_pose(self.robot, self.motion.joint_pos), pose], 1),
        )


def make_episode(args: Args) -> Episode:
    """Plan and simulate it on the CPU, in MuJoCo's C engine."""
    task, robot = get_task(args.task), get_robot(args.robot)
    scene = task.sample(scene_rng(args.task, args.seed), args.seed)
    commands = joint_commands(robot, [task.plan(scene).path()])[0]
    if commands.problem:
        sys.exit(f"{args.robot} cannot do {args.task}/{args.seed} ({commands.problem}); choose another --seed.")
    motion = simulate([World(robot, scene, commands.action)], "cpu")[0]
    return Episode(robot, scene, commands.action, motion)


# ---- SAPIEN's side


class Theirs:
    """The episode as a SAPIEN scene.

    Args:
        folder: for mesh files.
        shader: "default" rasterizes, "rt" traces rays.
        rendered: False leaves pictures out and puts collision shapes in.
    """

    def __init__(self, sapien: Any, episode: Episode, folder: Path, shader: str = "default", rendered: bool = True) -> None:
        self.sapien, self.episode, self.folder = sapien, episode, folder
        self.scene = sapien.Scene()  # with PhysX on the CPU and a render system, which the URDF loader needs
        self.scene.set_timestep(TIME_STEP)
        self.rendered = rendered
        self._add_stage()
        self.robots = [self._add_robot(index) for index in range(1 if episode.robot.one_urdf_holds_both_arms else 2)]
        self.things = self._add_rendered_things() if rendered else self._add_solid_things()
        if rendered:
            self._add_lights()
            sapien.render.set_camera_shader_dir(shader)
            self.camera = self._add_camera()

    def show(self, frame: int, picture: str = "Color") -> Frame:
        """Pose everything as at a frame and take a picture [h w 4], on the host."""
        for robot, qpos in zip(self.robots, self.joint_pos, strict=True):
            robot.set_qpos(qpos[frame])
        for thing, pose in zip(self.things, self.thing_pose, strict=True):
            thing.set_pose(pose[frame])
        self.scene.update_render()
        self.camera.take_picture()
        return self.camera.get_picture(picture)

    def prepare(self) -> None:
        """Put the recorded states into SAPIEN's order, outside of what is timed."""
        measured = joint_positions(self.episode.robot, self.episode.motion.joint_pos)
        self.joint_pos = [self._reorder(robot, pos) for robot, pos in zip(self.robots, measured, strict=True)]
        poses = self.episode.things[1]
        self.thing_pose = [[self._pose(pose) for pose in poses[:, index]] for index in range(poses.shape[1])]

    def robot_mask(self, frame: int) -> np.ndarray:
        """[h w] bool."""
        ids = {link.entity.per_scene_id for robot in self.robots for link in robot.links}
        return np.isin(self.show(frame, "Segmentation")[..., 1], list(ids))

    def drive(self) -> Callable[[int], None]:
        """A function that takes the commands of a frame and steps on to the next."""
        commands = joint_positions(self.episode.robot, self.episode.action)
        targets = [self._reorder(robot, pos) for robot, pos in zip(self.robots, commands, strict=True)]
        joints = [robot.active_joints for robot in self.robots]
        for robot, own, positions in zip(self.robots, joints, targets, strict=True):
            robot.set_qpos(positions[0])
            for joint in own:
                joint.set_drive_properties(*DRIVE)

        def advance(frame: int) -> None:
            for own, positions in zip(joints, targets, strict=True):
                for joint, target in zip(own, positions[frame], strict=True):
                    joint.set_drive_target(target)
            for _ in range(STEPS_PER_FRAME):
                self.scene.step()

        return advance

    def distance_off_course(self) -> float:
        """Largest distance of a joint of the arms from its last command [rad]."""
        commands = joint_positions(self.episode.robot, self.episode.action[-1:])
        own = {name for arm in self.episode.robot.arms for name in arm.joints}
        off = [
            np.abs(robot.get_qpos() - self._reorder(robot, pos)[0])[[joint.name in own for joint in robot.active_joints]].max()
            for robot, pos in zip(self.robots, commands, strict=True)
        ]
        return float(max(off))

    def _reorder(self, robot: Any, joint_pos: np.ndarray) -> np.ndarray:
        names = load_urdf(self.episode.robot.urdf).joint_names
        return joint_pos[:, [names.index(joint.name) for joint in robot.active_joints]].astype(np.float32)

    def _pose(self, pose: Sequence[float] | np.ndarray) -> Any:
        x, y, z, qx, qy, qz, qw = (float(value) for value in pose)
        return self.sapien.Pose([x, y, z], [qw, qx, qy, qz])

    def _add_robot(self, copy: int) -> Any:
        loader = self.scene.create_urdf_loader()
        loader.fix_root_link = True
        loader.set_material(PAD_FRICTION, PAD_FRICTION, 0.0)
        robot = loader.load(str(self.episode.robot.urdf))
        for link in robot.links:
            link.disable_gravity = True  # as our arms are: their weight is balanced, and their own links pass each other
            for shape in link.collision_shapes:
                shape.set_collision_groups([1, 1, 1 << copy, 0])
        robot.set_root_pose(self._pose(self.episode.robot.arms[copy].root_pose))
        return robot

    def _add_stage(self) -> None:
        top = [0.0, 0.0, stage.TABLE_TOP - stage.TABLE_SIZE[2] / 2]
        height = stage.TABLE_TOP - stage.TABLE_SIZE[2]
        legs = [[x * stage.LEG_XY[0], y * stage.LEG_XY[1], height / 2] for x in (-1, 1) for y in (-1, 1)]
        self._add_box(top, stage.TABLE_SIZE, stage.TABLE_COLOR)
        for leg in legs:
            self._add_box(leg, (stage.LEG_SIZE, stage.LEG_SIZE, height), stage.TABLE_COLOR)
        self._add_box(list(stage.WALL_CENTER), stage.WALL_SIZE, stage.WALL_COLOR)
        self._add_box([0, 0, -0.05], (stage.GROUND_SIZE, stage.GROUND_SIZE, 0.1), stage.GROUND_COLOR)

    def _add_box(self, center: list[float], size: Sequence[float], color: Sequence[int]) -> None:
        builder = self.scene.create_actor_builder()
        half = [length / 2 for length in size]
        if self.rendered:
            builder.add_box_visual(half_size=half, material=self._material(color))
        else:
            builder.add_box_collision(half_size=half)
        builder.set_initial_pose(self.sapien.Pose(center))
        builder.build_static()

    def _material(self, color: Sequence[int] | np.ndarray) -> Any:
        return self.sapien.render.RenderMaterial(base_color=[*(stage.linear_from_srgb(np.asarray(color))), 1.0], roughness=0.7)

    def _add_rendered_things(self) -> list[Any]:
        actors = []
        for number, body in enumerate(self.episode.things[0]):
            builder = self.scene.create_actor_builder()
            for part, (mesh, color) in enumerate(one_color_parts(body.mesh)):
                path = self.folder / f"thing{number}_{part}.obj"
                mesh.export(path, include_normals=True)
                builder.add_visual_from_file(str(path), material=self._material(color))
            actors.append(builder.build_kinematic())
        return actors

    def _add_solid_things(self) -> list[Any]:
        """Bodies with their hulls and masses; lids are left out."""
        actors = []
        for number, thing in enumerate(self.episode.scene.objects):
            if not thing.shape.hulls:
                continue
            builder = self.scene.create_actor_builder()
            volume = sum(trimesh.convex.convex_hull(points).volume for points in thing.shape.hulls)
            for part, points in enumerate(thing.shape.hulls):
                path = self.folder / f"hull{number}_{part}.obj"
                trimesh.convex.convex_hull(points).export(path)
                builder.add_convex_collision_from_file(str(path), density=(thing.mass or 1.0) / volume)
            builder.set_initial_pose(self._pose(thing.pose))
            actors.append(builder.build_static() if thing.is_fixed else builder.build())
        return actors

    def _add_lights(self) -> None:
        self.scene.set_ambient_light([stage.AMBIENT] * 3)
        for light in stage.LIGHTS:
            color = [light.intensity] * 3
            if light.position is None:
                self.scene.add_directional_light(list(light.direction), color, shadow=True)
            else:
                self.scene.add_point_light(list(light.position), color, shadow=True)

    def _add_camera(self) -> Any:
        fov = 2 * np.arctan(HEAD_CAMERA.height / 2 / HEAD_CAMERA.intrinsics[1, 1])
        camera = self.scene.add_camera("head", HEAD_CAMERA.width, HEAD_CAMERA.height, float(fov), 0.1, 100.0)
        right, down, forward = HEAD_CAMERA.extrinsics[:3, :3]
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([forward, -right, -down], 1)
        matrix[:3, 3] = HEAD_CAMERA.position
        camera.entity.set_pose(self.sapien.Pose(matrix))
        return camera


def one_color_parts(mesh: Mesh) -> list[tuple[trimesh.Trimesh, np.ndarray]]:
    """The triangles of each color, with a vertex and a normal for every corner, and the color [3] uint8."""
    parts = []
    for color in np.unique(mesh.colors, axis=0):
        own = (mesh.colors == color).all(1)
        corners = mesh.vertices[mesh.triangles[own]].reshape(-1, 3)
        faces = np.arange(len(corners)).reshape(-1, 3)
        normals = mesh.normals[own].reshape(-1, 3)
        parts.append((trimesh.Trimesh(corners, faces, vertex_normals=normals, process=False), color))
    return parts


def load_sapien(args: Args) -> Any:
    """The package, set up to trace rays as RoboTwin does. Ends with a clear line where it cannot render."""
    try:
        import sapien
    except ImportError:
        sys.exit("SAPIEN is not installed; pip install sapien, then run this again.")
    sapien.set_log_level("error")
    sapien.render.set_log_level("error")
    sapien.render.set_global_config(max_num_materials=8192)
    try:
        sapien.render.RenderSystem()
    except RuntimeError as error:
        sys.exit(
            f"SAPIEN finds no Vulkan device to render on ({error}); it needs a driver with Vulkan, and libvulkan.so.1. "
            "`vulkaninfo --summary` lists the devices; VK_ICD_FILENAMES names a driver."
        )
    sapien.render.set_ray_tracing_samples_per_pixel(args.samples)
    sapien.render.set_ray_tracing_path_depth(PATH_DEPTH)
    sapien.render.set_ray_tracing_denoiser(args.denoiser)
    return sapien


def measure_their_frames(scene: Theirs, frames: Sequence[int]) -> float:
    """Frames a second, the median of a few rounds after a frame that compiles shaders."""
    scene.show(frames[0])
    rates = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        for frame in frames:
            scene.show(frame)
        rates.append(len(frames) / (time.perf_counter() - start))
    return statistics.median(rates)


def measure_their_batches(sapien: Any, episode: Episode, folder: Path, scenes: int) -> float:
    """Frames a second of SAPIEN's RenderSystemGroup, poses from a CUDA buffer, pictures left on the GPU.

    Every scene is posed as at a frame of the episode; the buffer is what its GPU physics would have filled.
    """
    import torch

    copies = [Theirs(sapien, episode, folder) for _ in range(scenes)]
    poses: list[list[float]] = []
    for number, copy in enumerate(copies):
        copy.prepare()
        copy.show(number % len(episode.action))
        entities = [link.entity for robot in copy.robots for link in robot.links] + copy.things
        for entity in entities:
            body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
            if body is not None:
                for shape in body.render_shapes:
                    shape.set_gpu_pose_batch_index(len(poses))
            poses.append([*entity.pose.p, *entity.pose.q, *([0.0] * 6)])
    group = sapien.render.RenderSystemGroup([copy.scene.render_system for copy in copies])
    cameras = group.create_camera_group([copy.camera for copy in copies], ["Color"])
    buffer = torch.tensor(poses, dtype=torch.float32, device="cuda")
    group.set_cuda_poses(sapien.CudaArray(buffer))

    def take() -> None:
        group.update_render()
        cameras.take_picture()
        cameras.get_picture_cuda("Color")
        torch.cuda.synchronize()

    take()
    shown = cameras.get_picture_cuda("Color").torch()
    assert shown.shape[0] == scenes and float(shown[..., :3].float().std()) > 0.01, "the batched pictures are empty"
    seconds = []
    for _ in range(10):
        start = time.perf_counter()
        take()
        seconds.append(time.perf_counter() - start)
    return scenes / statistics.median(seconds)


def measure_their_steps(sapien: Any, episode: Episode, folder: Path) -> tuple[float, float]:
    """Physics steps a second of one world along the whole episode, and how far things end from where they end in ours [m]."""
    rates = []
    for _ in range(ROUNDS):
        scene = Theirs(sapien, episode, folder, rendered=False)
        advance = scene.drive()
        start = time.perf_counter()
        for frame in range(1, len(episode.action)):
            advance(frame)
        rates.append((len(episode.action) - 1) * STEPS_PER_FRAME / (time.perf_counter() - start))
        assert scene.distance_off_course() < OFF_COURSE, (
            f"SAPIEN's robot is {scene.distance_off_course():.2f} rad off its last command"
        )
    ours = [
        pose for thing, pose in zip(episode.scene.objects, episode.motion.object_pose[-1], strict=True) if thing.shape.hulls
    ]
    off = [np.linalg.norm(thing.pose.p - pose[:3]) for thing, pose in zip(scene.things, ours, strict=True)]
    return statistics.median(rates), float(max(off))


# ---- our side


def measure_our_frames(renderer: Renderer, episode: Episode, count: int) -> float:
    """Frames a second, images on the host, of about `count` at a time."""
    worlds = [episode.world] * max(1, round(count / len(episode.action)))
    renderer.render_batch(worlds)
    rates = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        frames = renderer.render_batch(worlds)
        rates.append(sum(len(f.rgb) for f in frames) / (time.perf_counter() - start))
    return statistics.median(rates)


def measure_our_steps(episode: Episode, worlds: int, device: str) -> float:
    """World-steps a second: what a longer episode takes more than a shorter one, so that building the model does not count."""
    long = np.concatenate([episode.action, episode.action[::-1], episode.action])
    seconds = []
    for action in (episode.action, long):
        batch = [World(episode.robot, episode.scene, action)] * worlds
        simulate(batch, device)
        rounds = []
        for _ in range(ROUNDS):
            start = time.perf_counter()
            simulate(batch, device)
            rounds.append(time.perf_counter() - start)
        seconds.append(statistics.median(rounds))
    return worlds * (len(long) - len(episode.action)) * STEPS_PER_FRAME / (seconds[1] - seconds[0])


def to_rgb(image: np.ndarray) -> np.ndarray:
    """SAPIEN's RGBA [h w 4] float32 as RoboTwin stores it: [h w 3] uint8."""
    return (image[..., :3] * 255).clip(0, 255).astype(np.uint8)


def save_pictures(folder: Path, panels: dict[str, np.ndarray]) -> None:
    """Write pictures [h w 3] uint8 side by side at twice their size, with labels."""
    folder.mkdir(parents=True, exist_ok=True)
    labeled = [label_picture(image, label) for label, image in panels.items()]
    cv2.imwrite(str(folder / "sapien.png"), cv2.cvtColor(np.hstack(labeled), cv2.COLOR_RGB2BGR))


def print_rate(label: str, rate: float, own: float | None, unit: str) -> None:
    beside = f"{own / rate:9.1f} times" if own else ""
    print(f"  {label:62s}{rate:12,.1f} {unit:10s}{beside}")


def compare_frames(args: Args, sapien: Any, episode: Episode, folder: Path, renderer: Renderer) -> None:
    on_gpu = renderer.device.is_cuda
    own_frames: Frames = renderer.render_batch([episode.world])[0]
    middle = len(episode.action) * 6 // 10
    panels = {"xew": own_frames.rgb[middle]}
    rates = {}
    count = args.frames or len(episode.action)
    for label, shader, most in (("rasterized", "default", count), ("ray traced", "rt", min(count, 60))):
        scene = Theirs(sapien, episode, folder, shader)
        scene.prepare()
        if shader == "default":
            same = intersection_over_union(scene.robot_mask(middle), own_frames.robot_mask[middle])
            assert same > AGREEMENT, f"the robot's silhouettes agree only to {same:.3f}"
            print(f"frame {middle}: the robot's silhouettes agree to {same:.3f} (intersection over union)")
        panels[f"SAPIEN {label}"] = to_rgb(scene.show(middle))
        frames = np.linspace(0, len(episode.action) - 1, most).astype(int).tolist()
        rates[label] = measure_their_frames(scene, frames)
    own = measure_our_frames(renderer, episode, args.batch or (6144 if on_gpu else 24))
    print("\nframes of 320x240 on the host                                                                       ours is")
    print_rate("xew, shadows of three lights, anti-aliased, with robot mask", own, None, "frames/s")
    print_rate("SAPIEN, rasterized, one scene", rates["rasterized"], own, "frames/s")
    label = f"SAPIEN, ray traced, {args.samples} samples, depth {PATH_DEPTH}, denoiser {args.denoiser}, one scene"
    print_rate(label, rates["ray traced"], own, "frames/s")
    if args.scenes:
        batched = measure_their_batches(sapien, episode, folder, args.scenes)
        print_rate(f"SAPIEN, rasterized, {args.scenes} scenes in a batch, left on the GPU", batched, own, "frames/s")
    if args.pictures:
        save_pictures(args.pictures, panels)


def compare_steps(args: Args, sapien: Any, episode: Episode, folder: Path, device: wp.Device) -> None:
    theirs, off = measure_their_steps(sapien, episode, folder)
    one = measure_our_steps(episode, 1, "cpu")
    print(f"\nphysics, steps of {1000 * TIME_STEP:.0f} ms; in the two engines things end at most {1000 * off:.0f} mm apart")
    print_rate("SAPIEN, PhysX on the CPU, one world", theirs, None, "steps/s")
    print_rate("xew, MuJoCo's C engine on the CPU, one world", one, None, "steps/s")
    if device.is_cuda:
        many = measure_our_steps(episode, args.worlds, device.alias)
        print_rate(f"xew, MuJoCo Warp, {args.worlds} worlds", many, None, "steps/s")
        print(f"  xew on the GPU makes {many / theirs:.1f} times SAPIEN's steps, on one CPU core {one / theirs:.2f} times")
    else:
        print(f"  xew makes {one / theirs:.2f} times SAPIEN's steps")


def main(args: Args) -> None:
    device = wp.get_device(args.device)
    sapien = load_sapien(args)
    print(f"{device.name} ({device.alias})")
    print(format_versions(("sapien", "warp-lang", "newton", "mujoco", "numpy")))
    print(f"SAPIEN renders on:\n{str(sapien.render.get_device_summary()).strip()}")
    episode = make_episode(args)
    things = sum(len(body.mesh.triangles) for body in episode.things[0])
    triangles = sum(len(body.mesh.triangles) for body in robot_bodies(episode.robot))
    print(f"\n{args.task}/{args.seed}, {episode.robot.title}: {len(episode.action)} frames, ", end="")
    print(f"robot of {triangles} and things of {things} triangles")
    with tempfile.TemporaryDirectory() as folder:
        compare_frames(args, sapien, episode, Path(folder), Renderer(device.alias))
        compare_steps(args, sapien, episode, Path(folder), device)


if __name__ == "__main__":
    wp.config.quiet = True
    main(tyro.cli(Args, description=__doc__))
