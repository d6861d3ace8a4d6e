"""Many devices and hosts: the mesh, sharding of parameters and batches, and starting the processes."""

__all__ = ["sharding"]
