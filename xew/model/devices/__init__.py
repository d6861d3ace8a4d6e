"""Many devices and hosts: the mesh, how parameters and batches are sharded over it, and starting the processes."""

__all__ = ["sharding"]
