"""Data parallel and FSDP training: the mesh, sharding of parameters and batches, and starting the processes.

Batches are sharded over both axes of the mesh. Parameters, moving average and optimizer moments are copied along `data` and
sharded along `fsdp`; each layer is gathered when it is computed. Results depend on the mesh only by the order of sums.
"""

import functools
import math
import os
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax import Array
from jax.sharding import AbstractMesh, AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Int, Shaped

from xew.config import ConfigError

AXES = ("data", "fsdp")
"""Names of the mesh's axes."""
SMALL = 2**14
"""Size of an array (of one layer) below which it is copied to every device instead of sharded."""
TASK_COUNTS = ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")
"""Variables in which launchers give the number of processes."""
NOTICE_S, JOIN_S = 5, 300
"""Times until a process says that it waits for others, and until it ends without them [s]."""
LAUNCH = (
    "Start all by Slurm's srun or Open MPI's mpirun, or set JAX_COORDINATOR_ADDRESS=host:port, JAX_NUM_PROCESSES and "
    "JAX_PROCESS_ID in each; JAX_NUM_PROCESSES=1 runs this process alone."
)
LAYERS = "blocks"
"""Name of the subtree whose arrays have a leading axis of layers, which is never sharded."""


@dataclass(frozen=True)
class MeshSettings:
    """Sizes of the mesh's axes; -1 takes the remaining devices."""

    data: int = -1
    """Number of copies of the parameters, each with its shard of the batch."""
    fsdp: int = 1
    """Number of shards of parameters and optimizer, each with its shard of the batch too."""


def start_processes(force: bool = False, environment: Mapping[str, str] = os.environ) -> None:
    """Join the other processes of this run if `force` is true or a launcher has started several.

    A launcher sets JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID, or Slurm's or Open MPI's variables for more
    than one task. JAX_NUM_PROCESSES=1 runs a process alone. If the others do not come, the process ends after JOIN_S.

    Raises:
        ConfigError: the variables are invalid or contradict each other, or the other processes cannot be reached.
    """
    coordinator = environment.get("JAX_COORDINATOR_ADDRESS")
    named = {"num_processes": "JAX_NUM_PROCESSES", "process_id": "JAX_PROCESS_ID"}
    numbers: dict[str, Any] = {key: _number(environment, name) for key, name in named.items() if name in environment}
    tasks = max(_number(environment, name) for name in TASK_COUNTS)
    count = numbers.get("num_processes", tasks)
    is_alone = count == 1 and ("num_processes" in numbers or not coordinator)
    if is_alone and not force:
        return
    _check_launch(coordinator, count, environment)
    joined = threading.Event()
    threading.Thread(target=_watch, args=(joined, count - 1), daemon=True).start()
    try:
        jax.distributed.initialize(coordinator, **numbers, initialization_timeout=2 * JOIN_S)
    except Exception as error:  # JAX's readers of launchers' variables raise KeyError, IndexError and others
        raise ConfigError(f"cannot join the other processes: {str(error).rstrip('.')}. {LAUNCH}") from error
    finally:
        joined.set()


def _number(environment: Mapping[str, str], name: str) -> int:
    """The whole number in a launcher's variable, 1 without it."""
    try:
        return int(environment.get(name, 1))
    except ValueError as error:
        raise ConfigError(f"{name} is {environment[name]!r}, expected a whole number. {LAUNCH}") from error


def _check_launch(coordinator: str | None, count: int, environment: Mapping[str, str]) -> None:
    """Raise ConfigError if the coordinator has no port, or if this is one process of an interactive shell in a Slurm step."""
    if coordinator is not None:
        host, _, port = coordinator.rpartition(":")
        if not host or not port.isdecimal():
            raise ConfigError(f"JAX_COORDINATOR_ADDRESS is {coordinator!r}, expected host:port, such as {coordinator}:12355.")
    elif "SLURM_PTY_PORT" in environment:
        raise ConfigError(f"this is a shell of a Slurm step of {count} tasks, where only one process was started. {LAUNCH}")


def _watch(joined: threading.Event, others: int) -> None:
    """Say that this process waits for others, and end it after JOIN_S, when JAX would abort without an explanation."""
    if joined.wait(NOTICE_S):
        return
    missing = f"{others} other process{'es' if others > 1 else ''} of this run" if others > 0 else "the other processes"
    print(f"waiting up to {JOIN_S} s for {missing}. {LAUNCH}", file=sys.stderr, flush=True)
    if not joined.wait(JOIN_S - NOTICE_S):
        print(f"error: {missing} did not come within {JOIN_S} s. {LAUNCH}", file=sys.stderr, flush=True)
        os._exit(2)


def mesh_shape(settings: MeshSettings, devices: int) -> tuple[int, int]:
    """Sizes of the axes data and fsdp on this many devices. Raises ConfigError unless they use all devices."""
    sizes = (settings.data, settings.fsdp)
    known = math.prod(size for size in sizes if size != -1)
    mesh = f"mesh is data {settings.data} x fsdp {settings.fsdp}"
    if sizes.count(-1) > 1 or min(sizes) < -1 or 0 in sizes:
        raise ConfigError(f"{mesh}; expected positive numbers, or -1 for one of them (the remaining devices).")
    if devices % known or (-1 not in sizes and known != devices):
        raise ConfigError(f"{mesh}, there are {devices} devices; the product must be {devices} (-1 takes the rest).")
    data, fsdp = (size if size != -1 else devices // known for size in sizes)
    return data, fsdp


def make_mesh(settings: MeshSettings, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """The mesh over the given devices, by default all devices of all processes."""
    devices = jax.devices() if devices is None else devices
    shape = mesh_shape(settings, len(devices))
    return jax.make_mesh(shape, AXES, axis_types=(AxisType.Auto,) * 2, devices=devices)


def check_batch(batch: int, accumulate: int, devices: int) -> None:
    """Raise ConfigError unless each of the `accumulate` parts of the batch divides evenly over the devices."""
    if batch % (devices * accumulate):
        near = max(1, round(batch / (devices * accumulate))) * devices * accumulate
        raise ConfigError(
            f"train.batch is {batch}; it must be a multiple of {devices} devices x train.accumulate {accumulate} = "
            f"{devices * accumulate}, for example {near}."
        )


def parameter_spec(path: Sequence[Any], shape: Sequence[int], fsdp: int) -> PartitionSpec:
    """Sharding of an array: its largest axis that `fsdp` divides (the last of equals), but not the axis of layers."""
    first = 1 if LAYERS in path and len(shape) > 1 else 0
    candidates = [axis for axis in range(first, len(shape)) if shape[axis] % fsdp == 0]
    if fsdp == 1 or not candidates or math.prod(shape[first:]) < SMALL:
        return PartitionSpec()
    chosen = max(candidates, key=lambda axis: (shape[axis], axis))
    return PartitionSpec(*("fsdp" if axis == chosen else None for axis in range(len(shape))))


def place_shapes(shapes: Any, mesh: Mesh | AbstractMesh) -> Any:
    """Add shardings on the mesh to a tree of shapes and types (parameters, optimizer)."""

    def place(path: tuple[Any, ...], leaf: Any) -> jax.ShapeDtypeStruct:
        spec = parameter_spec(path_names(path), leaf.shape, mesh.shape["fsdp"])
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=NamedSharding(mesh, spec))

    return jax.tree_util.tree_map_with_path(place, shapes)


def place_like(shapes: Any, like: Any) -> Any:
    """Add shardings to a tree of shapes and types, on the mesh or device of another tree."""
    sharding = jax.tree.leaves(like)[0].sharding
    if isinstance(sharding, NamedSharding) and isinstance(sharding.mesh, Mesh):
        return place_shapes(shapes, sharding.mesh)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), shapes)


def path_names(path: Sequence[Any]) -> tuple[str, ...]:
    """The names along a path in a tree, such as (blocks, self_attn, q, kernel)."""
    names = [str(getattr(entry, "key", getattr(entry, "name", getattr(entry, "idx", entry)))) for entry in path]
    return tuple(names[:-1] if names and names[-1] == "value" else names)  # NNX appends "value"


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Sharding of the leading axis over all devices."""
    return NamedSharding(mesh, PartitionSpec(AXES))


def replicated_sharding(mesh: Mesh) -> NamedSharding:
    """Sharding of an array that is copied to every device."""
    return NamedSharding(mesh, PartitionSpec())


def process_samples(mesh: Mesh, batch: int) -> Int[np.ndarray, " n"]:
    """Sorted indices [n] of the samples of a batch that this process loads."""
    slices = batch_sharding(mesh).addressable_devices_indices_map((batch,)).values()
    return np.unique(np.concatenate([np.arange(batch)[index] for index in slices]))


def place_batch(batch: Any, mesh: Mesh) -> Any:
    """Place this process's samples, a tree of arrays [b' ...], on the mesh as its part of the batch [b ...]."""
    sharding = batch_sharding(mesh)
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(sharding, leaf), batch)


def shard_over_batch(values: Shaped[Array, "b ..."]) -> Shaped[Array, "b ..."]:
    """Constrain activations [b ...] to be sharded over the batch alone, if a mesh is set.

    The compiler may otherwise shard their features, which cuDNN's attention does not support.
    """
    mesh = jax.sharding.get_abstract_mesh()
    axes = tuple(axis for axis in AXES if axis in mesh.axis_names)
    even = axes and values.shape[0] % math.prod(mesh.shape[axis] for axis in axes) == 0
    return jax.lax.with_sharding_constraint(values, PartitionSpec(axes)) if even else values


def gather_parameters(parameters: Any, *, layer: bool = False) -> Any:
    """Gather parameters that are sharded along `fsdp` on every device; their gradients are summed and sharded again.

    The compiler may otherwise move activations, many times a layer. Without `fsdp` the parameters are returned unchanged.

    Args:
        parameters: tree of arrays.
        layer: whether they are one layer's, without the axis of layers; otherwise all, and the layers are left sharded.
    """
    fsdp = dict(jax.sharding.get_abstract_mesh().shape).get("fsdp", 1)
    if fsdp == 1:
        return parameters

    def gather(path: tuple[Any, ...], leaf: Array) -> Array:
        names = path_names(path)
        if layer:
            return _gather(leaf, PartitionSpec(*parameter_spec((LAYERS, *names), (1, *leaf.shape), fsdp)[1:]))
        return leaf if LAYERS in names else _gather(leaf, parameter_spec(names, leaf.shape, fsdp))

    return jax.tree_util.tree_map_with_path(gather, parameters)


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def _gather(leaf: Array, spec: PartitionSpec) -> Array:
    return jax.lax.with_sharding_constraint(leaf, PartitionSpec())


def _gather_forward(leaf: Array, spec: PartitionSpec) -> tuple[Array, None]:
    return _gather(leaf, spec), None


def _gather_backward(spec: PartitionSpec, _: None, gradient: Array) -> tuple[Array]:
    return (jax.lax.with_sharding_constraint(gradient, spec),)


_gather.defvjp(_gather_forward, _gather_backward)
