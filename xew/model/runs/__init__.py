"""Runs on disk: what a run folder holds, who may write it, its checkpoints and log, and where an adapted run started from."""

__all__ = ["checkpoint", "folder", "layout", "log", "roundtrip", "session"]
