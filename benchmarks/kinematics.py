"""Forward kinematics of many configurations: our kernel beside pytorch-kinematics and newton.eval_fk, same device, same run.

    python -m benchmarks.kinematics [--device cpu|cuda:0] [--robots franka_panda aloha_agilex] [--configurations N]

All three pose every link of the URDF at the same configurations, drawn within the joint limits, in float32, from a
device array into device arrays. pytorch-kinematics (`pip install 'xew[reference]'`) gives 4 x 4 matrices, Newton and we
give positions and quaternions; newton.eval_fk computes velocities as well. Before anything is timed all are compared, to
1e-5 in every element of position [m] and rotation matrix. One call is waited for, or twenty back to back (their mean).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated
from xml.etree import ElementTree

import newton
import numpy as np
import tyro
import warp as wp
from scipy.spatial.transform import Rotation

from benchmarks.common import format_versions, is_installed
from xew.sim_warp.kinematics.batched import BatchedKinematics
from xew.sim_warp.robots import Urdf, get_robot, load_urdf

TOLERANCE = 1e-5
"""Largest difference between two of them [m, and elements of rotation matrices]."""
COMPARED = 4096
"""Number of configurations that are compared link by link."""
ROUNDS = 15
CALLS = 20
"""Number of calls of a round that are not waited for in between."""
PACKAGES = ("warp-lang", "newton", "torch", "pytorch-kinematics", "numpy")
Poses = dict[str, tuple[np.ndarray, np.ndarray]]
"""Positions [n 3] and rotation matrices [n 3 3] by link."""


@dataclass(frozen=True)
class Args:
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda:0")] = None
    """Default: a GPU if Warp finds one."""
    robots: tuple[str, ...] = ("franka_panda", "aloha_agilex")
    configurations: int = 0
    """Number of configurations; 0 for 65,536 on a GPU and 1,024 on a CPU."""
    compiled: bool = False
    """Time pytorch-kinematics under torch.compile too."""


@dataclass(frozen=True)
class Contender:
    name: str
    run: Callable[[], object]
    """Pose all links once; does not wait for the device."""
    poses: Callable[[], Poses]
    """What the last run left, of the first `COMPARED` configurations."""


def kernel_contender(urdf: Urdf, joint_pos: np.ndarray, device: str) -> Contender:
    """Our kernel at configurations [n j] float32 rad."""
    batched = BatchedKinematics(urdf, device)
    rows = wp.array(joint_pos, device=device)
    out = batched.poses(rows)

    def poses() -> Poses:
        found = out.numpy()[:COMPARED]
        return {link: split_poses(found[:, number]) for number, link in enumerate(batched.links)}

    return Contender("xew kernel", lambda: batched.poses(rows, out=out), poses)


def newton_contender(urdf: Urdf, joint_pos: np.ndarray, device: str) -> Contender:
    """Newton at configurations [n j] float32 rad: one world each, built from the URDF without its shapes."""
    one = newton.ModelBuilder()
    one.add_urdf(remove_shapes(urdf), floating=False, ignore_inertial_definitions=True)
    all_worlds = newton.ModelBuilder()
    all_worlds.replicate(one, len(joint_pos))
    model = all_worlds.finalize(device=device)
    state = model.state()
    order = [urdf.joint_names.index(name) for name in shorten_labels(one.joint_label) if name in urdf.joint_names]
    assert one.joint_coord_count == len(order) == joint_pos.shape[1], "Newton has other joints than the URDF"
    joint_q = wp.array(joint_pos[:, order].ravel(), dtype=float, device=device)
    joint_qd = wp.zeros_like(joint_q)

    def poses() -> Poses:
        found = state.body_q.numpy().reshape(len(joint_pos), one.body_count, 7)[:COMPARED]
        return {link: split_poses(found[:, number]) for number, link in enumerate(shorten_labels(one.body_label))}

    return Contender("newton.eval_fk", lambda: newton.eval_fk(model, joint_q, joint_qd, state), poses)


def pytorch_contender(urdf: Urdf, joint_pos: np.ndarray, device: str, compiled: bool) -> Contender:
    """pytorch-kinematics at configurations [n j] float32 rad."""
    import pytorch_kinematics
    import torch

    chain = pytorch_kinematics.build_chain_from_urdf(remove_shapes(urdf).encode())
    chain = chain.to(dtype=torch.float32, device=device)
    names = chain.get_joint_parameter_names()
    columns = [urdf.joint_names.index(name) for name in names]
    rows = torch.tensor(joint_pos[:, columns], dtype=torch.float32, device=device)
    call = torch.compile(chain.forward_kinematics_tensor) if compiled else chain.forward_kinematics
    last: list = [None]

    def run() -> None:
        last[0] = call(rows)

    def poses() -> Poses:
        if compiled:
            frames = {chain.idx_to_frame[index]: matrix for index, matrix in enumerate(last[0])}
        else:
            frames = {link: frame.get_matrix() for link, frame in last[0].items()}
        host = {link: matrix[:COMPARED].cpu().numpy() for link, matrix in frames.items()}
        return {link: (matrix[:, :3, 3], matrix[:, :3, :3]) for link, matrix in host.items()}

    return Contender("pytorch-kinematics" + (", torch.compile" if compiled else ""), run, poses)


def split_poses(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses [n 7] as positions and rotation matrices."""
    return pose[:, :3], Rotation.from_quat(pose[:, 3:]).as_matrix()


def shorten_labels(labels: list[str]) -> list[str]:
    return [label.rsplit("/", 1)[-1] for label in labels]


def remove_shapes(urdf: Urdf) -> str:
    """The XML of a URDF less what forward kinematics does not need."""
    root = ElementTree.parse(urdf.path).getroot()
    for link in root.iter("link"):
        for part in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(part)
    for joint in root.iter("joint"):
        for part in joint.findall("mimic"):
            joint.remove(part)
    return ElementTree.tostring(root, encoding="unicode")


def draw_configurations(urdf: Urdf, count: int) -> np.ndarray:
    """[n j] float32, uniform within the limits, of joints without any within half a turn to either side."""
    joints = [urdf.joints[name] for name in urdf.joint_names]
    lower, upper = np.array([(max(joint.lower, -np.pi), min(joint.upper, np.pi)) for joint in joints]).T
    return np.random.default_rng(0).uniform(lower, upper, (count, len(joints))).astype(np.float32)


def check(urdf: Urdf, contenders: list[Contender]) -> float:
    """The largest difference between any two; all must have posed every link, and moved it."""
    found = [contender.poses() for contender in contenders]
    worst = 0.0
    for contender, poses in zip(contenders, found, strict=True):
        assert set(poses) == set(urdf.links), f"{contender.name} has not the links of the URDF"
        for link, parts in poses.items():
            for mine, other in zip(found[0][link], parts, strict=True):
                worst = max(worst, float(np.abs(mine - other).max()))
        assert worst < TOLERANCE, f"{contender.name} differs from {contenders[0].name} by {worst:.1e}"
    last = urdf.joints[urdf.joint_names[-1]].child
    assert np.ptp(found[0][last][0], axis=0).max() > 0.1, "nothing moves"
    return worst


def wait(device: str) -> None:
    wp.synchronize_device(device)
    if wp.get_device(device).is_cuda:
        import torch

        torch.cuda.synchronize()


def median_seconds(run: Callable[[], object], device: str, calls: int) -> float:
    """Median over rounds of the time of a call, of `calls` that are waited for together."""
    rounds = []
    for _ in range(ROUNDS):
        wait(device)
        start = time.perf_counter()
        for _ in range(calls):
            run()
        wait(device)
        rounds.append((time.perf_counter() - start) / calls)
    return float(np.median(rounds))


def race(urdf: Urdf, count: int, device: str, compiled: bool) -> None:
    joint_pos = draw_configurations(urdf, count)
    contenders = [kernel_contender(urdf, joint_pos, device), newton_contender(urdf, joint_pos, device)]
    if is_installed("pytorch-kinematics"):
        contenders += [pytorch_contender(urdf, joint_pos, device, kind) for kind in ((False, True) if compiled else (False,))]
    else:
        print("pytorch-kinematics is not installed and left out; pip install 'xew[reference]' brings it")
    for contender in contenders:
        contender.run()
        wait(device)
    worst = check(urdf, contenders)
    print(f"\n{urdf.name}: {count} configurations of {len(urdf.joint_names)} joints, {len(urdf.links)} links each; ", end="")
    print(f"all agree to {worst:.1e} m and in rotation matrices")
    print(f"{'':36s}{'one call [ms]':>15s}{'ratio':>8s}{'back to back [ms]':>19s}{'ratio':>8s}{'M poses/s':>11s}")
    base: tuple[float, float] | None = None
    for contender in contenders:
        one, many = (1e3 * median_seconds(contender.run, device, calls) for calls in (1, CALLS))
        base = base or (one, many)
        rate = count * len(urdf.links) / many / 1e3
        print(f"{contender.name:36s}{one:15.4f}{one / base[0]:8.1f}{many:19.4f}{many / base[1]:8.1f}{rate:11.1f}")


def main(args: Args) -> None:
    device = wp.get_device(args.device)
    count = args.configurations or (65536 if device.is_cuda else 1024)
    print(f"{device.name} ({device.alias}), float32")
    print(format_versions(PACKAGES))
    for key in args.robots:
        race(load_urdf(get_robot(key).urdf), count, device.alias, args.compiled)


if __name__ == "__main__":
    wp.config.quiet = True
    main(tyro.cli(Args, description=__doc__))
