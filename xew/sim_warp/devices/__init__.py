"""Which device does the work, how many processes share it, and how a process waits for a GPU without spinning."""

__all__ = ["waiting", "workers"]
