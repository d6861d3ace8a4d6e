"""Many devices and hosts: the mesh, sharding of parameters and batches, and processes that share the GPUs."""

__all__ = ["parts", "sharding"]
