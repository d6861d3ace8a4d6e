"""Videos that are wrong in a known way, to measure estimators and metrics by."""

__all__ = ["matrix", "perturbations", "predictors"]
