"""From scores to claims: tables, figures, correlations, distances, the report, and the runner of whole studies.

The files at the root are commands and what other code imports; all else lies one level down. Nothing here imports JAX or Warp.
"""

__all__ = [
    "correlation",
    "distance",
    "distances",
    "paper",
    "report",
    "reports",
    "scores",
    "statistics",
    "studies",
    "study",
    "study_analyse",
    "tables",
]
