"""Training of the shipped codec: pictures decoded once into memory, the step, and a report.

    python -m lab.codec lab/codec/codec.yaml --data DATA


A step's samples and noise depend on the seed and the number of the step alone: a resumed run repeats them.
"""

__all__ = ["pictures", "report", "sampling", "settings", "step"]
