"""Runs on disk: what a run folder holds, who may write it, and its checkpoints."""

__all__ = ["checkpoint"]
