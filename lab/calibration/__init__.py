"""Calibration of the estimators and metrics of `evaluate` by videos that are wrong in a known way (docs/calibration.md).

    python -m lab.calibration --data data --codec runs/fixed --out calibration
    python -m lab.calibration --data data --predictors --out calibration

`perturbations` renders wrong motions with their true masks and points. `predictors` makes videos from right to gray, and
`matrix` holds every metric's value for each of them and says whether the metric puts them in order. `calibrate` is the command.
"""

__all__ = ["calibrate", "matrix", "perturbations", "predictors"]
