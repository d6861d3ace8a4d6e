"""Settings of an experiment: what a config may hold, what it must not, and the parts that the rest of the package takes.

`xew.model.experiment` puts them together; nothing here reads a file.
"""

__all__ = ["checks", "optimizer", "parts", "settings"]
