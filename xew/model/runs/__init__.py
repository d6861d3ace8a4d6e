"""Runs on disk: the run folder, its checkpoints and log, and the origin of an adapted run."""

__all__ = ["checkpoint", "folder", "layout", "log", "roundtrip", "session"]
