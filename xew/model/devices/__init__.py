"""Many devices and hosts: the mesh, where parameters and batches lie on it, and the start of the processes."""

__all__ = ["sharding"]
