"""Scores -> claims: tables, figures, correlations and the report. Imports neither JAX nor Warp."""
