"""One offline page from score tables: its sections, charts, pictures and HTML."""

__all__ = ["charts", "page", "paper", "pictures", "study", "study_charts", "study_strips"]
