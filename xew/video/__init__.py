"""Videos of any model in files: read whole and as players show them, or refused with the reason."""

__all__ = ["checks", "containers", "frame_files"]
