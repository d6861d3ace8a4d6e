"""How long a frame takes: our rasteriser by stage, and Newton's SensorCamera on the same scene in the same run.

    python benchmarks/render.py [--device cpu|cuda] [--frames N]

The workload is the two passes that an episode needs: the scene (two Panda arms and three things over the table, colour
with anti-aliasing and shadows of three lights, robot mask) and the robot alone by its commands (colour, mask, optical
flow), 320x240. Meshes are refined to about 7,000 triangles for the robot and 2,700 for the things. SensorCamera renders
colour (MSAA 4, shadows of one light) and shape index for each of the two passes; it has no optical flow.
"""

import time
from collections import defaultdict
from dataclasses import dataclass

import newton
import numpy as np
import tyro
import warp as wp
from newton.sensors import SensorCamera

from xew.sim_warp import geometry
from xew.sim_warp.camera import HEAD_CAMERA
from xew.sim_warp.geometry import Mesh
from xew.sim_warp.render import Body, Frames, Renderer, World
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.robots.bodies import robot_bodies, robot_pose
from xew.sim_warp.stage import stage_mesh

FRAMES_PER_WORLD = 24
ROUNDS = 3
REFINED = 200
"""Triangles that a link has at least."""


@dataclass(frozen=True)
class Workload:
    robot: list[Body]
    things: list[Body]
    robot_pose: np.ndarray
    """[t b 7]."""
    pose: np.ndarray
    """[t b 7] of robot and things."""

    @property
    def triangle_counts(self) -> tuple[int, int]:
        return sum(len(b.mesh.triangles) for b in self.robot), sum(len(b.mesh.triangles) for b in self.things)


def workload() -> Workload:
    """Both arms over the table, swinging; poses chosen so that they fill a good part of the image."""
    robot = ROBOTS["franka_panda"]
    action = np.zeros((FRAMES_PER_WORLD, 16))
    action[:, 0:7] = (-0.4, 0.7, 0.0, -1.5, 0.0, 2.2, 0.785)
    action[:, 8:15] = (0.5, 0.7, 0.0, -1.4, 0.0, 2.2, 0.785)
    action[:, [0, 8]] += np.linspace(0, 0.3, FRAMES_PER_WORLD)[:, None] * (1, -1)
    bodies = [Body(refined(body.mesh, REFINED), True) for body in robot_bodies(robot)]
    balls = [geometry.sphere(0.03, (200, 60, 60), 3), geometry.sphere(0.04, (60, 160, 60), 3)]
    things = [Body(shape, False) for shape in (*balls, geometry.cylinder(0.03, 0.1, (60, 60, 200)))]
    thing_pose = np.tile([0.0, 0, 0, 0, 0, 0, 1], (FRAMES_PER_WORLD, 3, 1))
    thing_pose[..., :3] = ((-0.1, -0.1, 0.77), (0.15, 0.1, 0.78), (0.02, -0.05, 0.79))
    pose = robot_pose(robot, action)
    return Workload(bodies, things, pose, np.concatenate([pose, thing_pose], 1))


def refined(mesh: Mesh, at_least: int) -> Mesh:
    """The same surface in more triangles: each is quartered until there are enough."""
    while len(mesh.triangles) < at_least:
        a, b, c = mesh.vertices[mesh.triangles].swapaxes(0, 1)
        na, nb, nc = mesh.normals.swapaxes(0, 1)
        mesh = Mesh(
            _quarters(a, b, c).reshape(-1, 3),
            np.arange(12 * len(a), dtype=np.int32).reshape(-1, 3),
            mesh.colors.repeat(4, 0),
            _quarters(na, nb, nc),
        )
    return mesh


def _quarters(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    corners = (a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca)
    return np.stack(corners, 1).reshape(-1, 3, 3).astype(np.float32)


class TimedRenderer(Renderer):
    """Adds up what each kernel takes; the device is waited for after each, so use it for shares, not for the sum."""

    def __init__(self, device: str) -> None:
        super().__init__(device)
        self.seconds: dict[str, float] = defaultdict(float)

    def _launch(self, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list, outputs: list) -> None:
        start = time.perf_counter()
        super()._launch(kernel, dim, inputs, outputs)
        wp.synchronize_device(self.device)
        self.seconds[kernel.key] += time.perf_counter() - start


def scene_pass(renderer: Renderer, work: Workload, worlds: int) -> list[Frames]:
    return renderer.render_batch([World([*work.robot, *work.things], work.pose)] * worlds)


def command_pass(renderer: Renderer, work: Workload, worlds: int) -> list[Frames]:
    return renderer.render_batch([World(work.robot, work.robot_pose)] * worlds, ground=False, optical_flow=True)


def check(work: Workload, scene: Frames, command: Frames) -> None:
    """The workload is what it says: robot, things and shadows are there, and something moves."""
    assert scene.rgb.shape == command.rgb.shape == (FRAMES_PER_WORLD, 240, 320, 3)
    assert scene.robot_mask.mean() > 0.05 and command.robot_mask.mean() > 0.05
    assert (np.linalg.norm(command.optical_flow[0], axis=-1) > 0.5).mean() > 0.03
    assert work.triangle_counts[0] > 6000 and work.triangle_counts[1] > 2000


def best_seconds(action: object) -> float:
    """The shortest of a few rounds, after one to warm up."""
    action()
    rounds = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        action()
        rounds.append(time.perf_counter() - start)
    return min(rounds)


def newton_model(bodies: list[Body], with_stage: bool, worlds: int, device: str) -> newton.Model:
    world = newton.ModelBuilder()
    world.default_shape_cfg.density = 0.0
    for body in bodies:
        link = world.add_body(mass=1.0)
        color = tuple(body.mesh.colors[0] / 255)
        mesh = newton.Mesh(body.mesh.vertices, body.mesh.triangles.ravel(), compute_inertia=False)
        world.add_shape_mesh(link, mesh=mesh, color=color)
    builder = newton.ModelBuilder()
    builder.replicate(world, worlds)
    if with_stage:
        mesh = stage_mesh()
        builder.add_shape_mesh(-1, mesh=newton.Mesh(mesh.vertices, mesh.triangles.ravel(), compute_inertia=False))
    return builder.finalize(device=device)


def sensor_camera(bodies: list[Body], pose: np.ndarray, with_stage: bool, worlds: int, device: str) -> tuple[float, float]:
    """Seconds a frame, and the share of pixels that show anything but stage or background."""
    model = newton_model(bodies, with_stage, worlds, device)
    state = model.state()
    frames = np.arange(worlds) % len(pose)
    state.body_q.assign(pose[frames].reshape(-1, 7).astype(np.float32))
    config = SensorCamera.RenderConfig(enable_shadows=with_stage, anti_aliasing=SensorCamera.AntiAliasing.MSAA)
    camera = SensorCamera(model, default_render_config=config)
    camera.create_default_light(enable_shadows=True, direction=wp.vec3(0.0, 0.447, -0.894))
    rays = SensorCamera.compute_camera_rays_pinhole(320, 240, camera_fov=float(np.radians(37.0)), sample_count=4, device=device)
    # SensorCamera looks along -z with y up
    rotation = HEAD_CAMERA.extrinsics[:3, :3].T @ np.diag([1.0, -1.0, -1.0])
    place = wp.transform(wp.vec3(*HEAD_CAMERA.position), wp.quat_from_matrix(wp.mat33(*rotation.ravel())))
    places = wp.array([place] * worlds, dtype=wp.transformf, device=device)
    color = camera.allocate_image_color(worlds, 320, 240)
    shape_index = camera.allocate_image_shape_index(worlds, 320, 240)

    def update() -> None:
        model.bvh_refit_shapes(state)
        camera.update(state, places, rays, color_image=color, shape_index_image=shape_index)
        color.numpy()
        shape_index.numpy()

    seconds = best_seconds(update) / worlds
    shown = shape_index.numpy()
    return seconds, float((shown < len(bodies) * worlds).mean())


def report(label: str, milliseconds: dict[str, float]) -> None:
    print(f"{label:28s}" + "  ".join(f"{name} {value:.3g}" for name, value in milliseconds.items()))


def main(device: str = "cpu", frames: int = 0) -> None:
    """Print milliseconds a frame.

    Args:
        device: Warp's name of the device.
        frames: frames of a batch, 0 for 24 on a CPU and 6144 on a GPU.
    """
    on_gpu = wp.get_device(device).is_cuda
    worlds = max(1, (frames or (6144 if on_gpu else FRAMES_PER_WORLD)) // FRAMES_PER_WORLD)
    work = workload()
    renderer, timed = Renderer(device), TimedRenderer(device)
    check(work, scene_pass(renderer, work, 1)[0], command_pass(renderer, work, 1)[0])
    count = worlds * FRAMES_PER_WORLD
    robot, things = work.triangle_counts
    print(f"{count} frames, robot of {robot} and things of {things} triangles, on {wp.get_device(device)}")
    total = 0.0
    for label, render in (("scene", scene_pass), ("command", command_pass)):
        seconds = best_seconds(lambda render=render: render(renderer, work, worlds))
        timed.seconds.clear()
        render(timed, work, worlds)
        stages = {name: s / count * 1e3 for name, s in timed.seconds.items()}
        report(f"xew {label} [ms/frame]", {"all": seconds / count * 1e3} | stages)
        total += seconds / count
    views = min(count, 256 if on_gpu else 4)
    scene, shown = sensor_camera([*work.robot, *work.things], work.pose, True, views, device)
    command, robot_shown = sensor_camera(work.robot, work.robot_pose, False, views, device)
    assert shown > 0.05 and robot_shown > 0.05, f"SensorCamera shows too little: {shown:.3f}, {robot_shown:.3f}"
    report("SensorCamera [ms/frame]", {"scene": scene * 1e3, "command": command * 1e3})
    ratio = (scene + command) / total
    print(f"both passes: xew {total * 1e3:.3g} ms, SensorCamera {(scene + command) * 1e3:.3g} ms: {ratio:.2f} times as long")


if __name__ == "__main__":
    tyro.cli(main)
