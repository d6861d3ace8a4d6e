"""Training of the packaged codec: pictures decoded once into memory, the step, and a report.

    python -m lab.codec lab/codec/codec.yaml --data DATA

A step's samples and noise depend only on the seed and the step, so a resumed run repeats them.
"""

__all__ = ["pictures", "report", "sampling", "settings", "step"]
