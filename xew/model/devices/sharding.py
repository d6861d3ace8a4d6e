"""Many devices and hosts: the mesh, how parameters and batches are sharded over it, and starting the processes.

The mesh has two axes. Batches are sharded over both. Parameters, their moving average and the optimizer's moments are copied
along `data` and sharded along `fsdp` (each layer's are gathered when it is computed). The numbers do not depend on the mesh,
up to the order of sums.
"""

import functools
import math
import os
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
"""Number of numbers (in one layer) below which an array is copied to every device: gathering it costs more than it weighs."""
LAYERS = "blocks"
"""Name below which arrays have a leading axis of layers, over which the network scans: it is never sharded."""


@dataclass(frozen=True)
class MeshSettings:
    """How many ways the devices share the work; -1 means what the other leaves."""

    data: int = -1
    """Number of copies of the parameters, each with its shard of the batch."""
    fsdp: int = 1
    """Number of shards of parameters and optimizer, each with its shard of the batch too."""


def start_processes(force: bool = False, environment: Mapping[str, str] = os.environ) -> None:
    """Join the other processes of this run, if a launcher has started several.

    It does so when asked, or when the variables of a launcher are set: JAX_COORDINATOR_ADDRESS with JAX_NUM_PROCESSES and
    JAX_PROCESS_ID (one pair for each process), or those of Slurm or Open MPI with more than one task, which JAX reads itself.

    Raises:
        ConfigError: the variables contradict each other, or the others were not found.
    """
    tasks = max(int(environment.get(name, 1)) for name in ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE"))
    coordinator = environment.get("JAX_COORDINATOR_ADDRESS")
    if not (force or coordinator or tasks > 1):
        return
    try:
        named = {"num_processes": "JAX_NUM_PROCESSES", "process_id": "JAX_PROCESS_ID"}
        numbers: dict[str, Any] = {key: int(environment[name]) for key, name in named.items() if name in environment}
        jax.distributed.initialize(coordinator, **numbers)
    except (ValueError, RuntimeError) as error:
        raise ConfigError(
            f"cannot join the other processes: {error}. Set JAX_COORDINATOR_ADDRESS=host:port, JAX_NUM_PROCESSES and "
            "JAX_PROCESS_ID in each, or start them with Slurm's srun or Open MPI's mpirun."
        ) from error


def mesh_shape(settings: MeshSettings, devices: int) -> tuple[int, int]:
    """Sizes of the axes data and fsdp on a number of devices. Raises ConfigError if they do not fill them exactly."""
    asked = (settings.data, settings.fsdp)
    known = math.prod(size for size in asked if size != -1)
    if asked.count(-1) > 1 or min(asked) < -1 or 0 in asked:
        raise ConfigError(
            f"mesh is data {asked[0]} x fsdp {asked[1]}; give positive numbers, at most one of them -1 (the rest)."
        )
    if devices % known or (-1 not in asked and known != devices):
        raise ConfigError(
            f"mesh is data {asked[0]} x fsdp {asked[1]}, there are {devices} devices; the product must be {devices} "
            "(-1 takes what the other leaves)."
        )
    data, fsdp = (size if size != -1 else devices // known for size in asked)
    return data, fsdp


def make_mesh(settings: MeshSettings, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """The mesh over all devices of all processes, or over the given ones."""
    devices = jax.devices() if devices is None else devices
    shape = mesh_shape(settings, len(devices))
    return jax.make_mesh(shape, AXES, axis_types=(AxisType.Auto,) * 2, devices=devices)


def check_batch(batch: int, accumulate: int, devices: int) -> None:
    """Raise ConfigError unless every device gets equally many samples of each of the `accumulate` parts of the batch."""
    if batch % (devices * accumulate):
        near = max(1, round(batch / (devices * accumulate))) * devices * accumulate
        raise ConfigError(
            f"train.batch is {batch}; it must be a multiple of {devices} devices x train.accumulate {accumulate} = "
            f"{devices * accumulate}, for example {near}."
        )


def parameter_spec(path: Sequence[Any], shape: Sequence[int], fsdp: int) -> PartitionSpec:
    """Axis of an array that is sharded: the largest that `fsdp` divides (the last of equals), but no axis of layers."""
    first = 1 if LAYERS in path and len(shape) > 1 else 0
    candidates = [axis for axis in range(first, len(shape)) if shape[axis] % fsdp == 0]
    if fsdp == 1 or not candidates or math.prod(shape[first:]) < SMALL:
        return PartitionSpec()
    chosen = max(candidates, key=lambda axis: (shape[axis], axis))
    return PartitionSpec(*("fsdp" if axis == chosen else None for axis in range(len(shape))))


def place_shapes(shapes: Any, mesh: Mesh | AbstractMesh) -> Any:
    """Give a tree of shapes and types (parameters, optimizer) their places on the mesh; only shapes and names are looked at."""

    def place(path: tuple[Any, ...], leaf: Any) -> jax.ShapeDtypeStruct:
        spec = parameter_spec(path_names(path), leaf.shape, mesh.shape["fsdp"])
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=NamedSharding(mesh, spec))

    return jax.tree_util.tree_map_with_path(place, shapes)


def place_like(shapes: Any, like: Any) -> Any:
    """Give a tree of shapes and types their places on the mesh of another tree, or on its device."""
    sharding = jax.tree.leaves(like)[0].sharding
    if isinstance(sharding, NamedSharding) and isinstance(sharding.mesh, Mesh):
        return place_shapes(shapes, sharding.mesh)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), shapes)


def path_names(path: Sequence[Any]) -> tuple[str, ...]:
    """The plain names along a path in a tree, such as (blocks, self_attn, q, kernel)."""
    names = [str(getattr(entry, "key", getattr(entry, "name", getattr(entry, "idx", entry)))) for entry in path]
    return tuple(names[:-1] if names and names[-1] == "value" else names)  # NNX ends a parameter's path so


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Sharding of the leading axis over all devices."""
    return NamedSharding(mesh, PartitionSpec(AXES))


def replicated_sharding(mesh: Mesh) -> NamedSharding:
    """Sharding of an array that every device has a copy of."""
    return NamedSharding(mesh, PartitionSpec())


def process_samples(mesh: Mesh, batch: int) -> Int[np.ndarray, " n"]:
    """Indices [n] of the samples of the whole batch that this process loads, in order."""
    slices = batch_sharding(mesh).addressable_devices_indices_map((batch,)).values()
    return np.unique(np.concatenate([np.arange(batch)[index] for index in slices]))


def place_batch(batch: Any, mesh: Mesh) -> Any:
    """Put this process's samples, any tree of arrays [b' ...], on the mesh as its shard of the whole batch [b ...]."""
    sharding = batch_sharding(mesh)
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(sharding, leaf), batch)


def shard_over_batch(values: Shaped[Array, "b ..."]) -> Shaped[Array, "b ..."]:
    """Tell the compiler that activations [b ...] stay sharded over the batch alone, where a mesh is set.

    Left to itself it may shard their features where it has sharded the parameters', which cuDNN's attention cannot take.
    """
    mesh = jax.sharding.get_abstract_mesh()
    axes = tuple(axis for axis in AXES if axis in mesh.axis_names)
    even = axes and values.shape[0] % math.prod(mesh.shape[axis] for axis in axes) == 0
    return jax.lax.with_sharding_constraint(values, PartitionSpec(axes)) if even else values


def gather_parameters(parameters: Any, *, layer: bool = False) -> Any:
    """Gather parameters that are sharded along `fsdp` on every device; their gradients are summed and sharded again.

    Left to itself the compiler moves activations instead wherever they are the smaller, many times a layer. Nothing is done
    where no mesh is set or it does not shard.

    Args:
        parameters: any tree of arrays.
        layer: they are those of one layer, without the axis of layers; else all, of which the layers are left as they are.
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
