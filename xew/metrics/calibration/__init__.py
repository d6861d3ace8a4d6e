"""Videos that are wrong in a known way, to measure estimators and metrics by.

`perturbations` renders wrong motions with their true masks and points. `predictors` makes videos from right to gray, and
`matrix` says what every metric makes of them and whether it puts them in order.
"""

__all__ = ["matrix", "perturbations", "predictors"]
