"""Forward kinematics of many configurations on a device: arrays in, arrays out, nothing copied to the host.

Poses are x y z [m] and quaternion x y z w with w >= 0. The same row gives the same bits in any batch on the same device.
"""

import numpy as np
import warp as wp

from xew.sim_warp.embodiment.urdf import Urdf
from xew.sim_warp.geometry.poses import pose_from_matrix
from xew.sim_warp.kinematics.kernels import FIXED, SLIDING, TURNING, kinematics_kernels

BLOCK = 64
"""Number of threads of a block: with 65,536 configurations every multiprocessor of a large GPU has some."""
KINDS = {"fixed": FIXED, "prismatic": SLIDING, "revolute": TURNING, "continuous": TURNING}


class BatchedKinematics:
    """Forward kinematics of one URDF on one device.

    Args:
        urdf: the robot description.
        device: Warp's name of a device, None for Warp's default.
        dtype: wp.float32 or wp.float64.
    """

    def __init__(self, urdf: Urdf, device: str | None = None, dtype: type = wp.float32) -> None:
        self.links = (urdf.root, *(joint.child for joint in urdf.tree))
        """Names of the links, in the order of the poses."""
        self.columns = len(urdf.joint_names)
        self.device = wp.get_device(device)
        self.dtype = dtype
        self._kernels = kinematics_kernels(dtype)
        self._tree = _pack(urdf, self.links, self._kernels, self.device)
        self._arrays: tuple[wp.array | None, wp.array | None] = (None, None)
        self._launch: wp.Launch | None = None

    def poses(self, rows: wp.array, out: wp.array | None = None) -> wp.array:
        """Poses of all links in the frame of the root link.

        Args:
            rows: [n j] of this dtype on this device, positions of the moving joints [rad or m] in the order of
                `Urdf.joint_names`.
            out: the array that an earlier call with as many rows returned; it is written again. Repeating a call with the
                same two arrays, their numbers changed in place, costs the host least.

        Returns:
            [n l 7] of this dtype, in the order of `links`. The array is a view: numbers of neighboring rows are adjacent.

        Raises:
            ValueError: an array does not fit.
        """
        if self._launch is not None and self._arrays[0] is rows and self._arrays[1] is out:
            self._launch.launch()
            return out
        if rows.ndim != 2 or rows.shape[1] != self.columns:
            raise ValueError(f"joint positions have shape {rows.shape}, expected (configurations, {self.columns}).")
        shape = (len(rows), len(self.links), 7)
        if out is not None and out.shape != shape:
            raise ValueError(f"out has shape {out.shape}, expected {shape}: pass the array that a call returned.")
        if out is None:
            out = wp.empty((*shape[1:], shape[0]), dtype=self.dtype, device=self.device).transpose((2, 0, 1))
        if len(rows) == 0:
            return out
        self._arrays = (rows, out)
        self._launch = wp.launch(
            self._kernels.forward_kinematics,
            len(rows),
            inputs=[self._tree, rows],
            outputs=[out.transpose((1, 2, 0))],
            device=self.device,
            block_dim=BLOCK,
            record_cmd=True,
        )
        self._launch.launch()
        return out


def _pack(urdf: Urdf, links: tuple[str, ...], kernels: object, device: wp.Device) -> object:
    """Device arrays of the links, see `kinematics_kernels`; the root link comes first and has no joint."""
    joints = urdf.tree
    names = urdf.joint_names
    tree = kernels.Tree()  # type: ignore[attr-defined]
    tree.above = wp.array([-1, *(links.index(joint.parent) for joint in joints)], dtype=int, device=device)
    tree.kind = wp.array([FIXED, *(KINDS[joint.kind] for joint in joints)], dtype=int, device=device)
    origins = pose_from_matrix(np.stack([np.eye(4), *(joint.origin for joint in joints)]))
    tree.origin = wp.array(origins, dtype=kernels.frame, device=device)  # type: ignore[attr-defined]
    axes = np.stack([np.zeros(3), *(joint.axis for joint in joints)])
    tree.axis = wp.array(axes, dtype=kernels.vector, device=device)  # type: ignore[attr-defined]
    columns = [0, *(names.index(joint.name) if joint.name in names else 0 for joint in joints)]
    tree.column = wp.array(columns, dtype=int, device=device)
    return tree
