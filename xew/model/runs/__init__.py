"""Runs on disk: what a run folder holds, who may write it, its checkpoints, and where an adapted run started from."""

__all__ = ["checkpoint", "folder", "roundtrip", "start"]
