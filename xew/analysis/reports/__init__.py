"""One offline page from score tables: its sections, sentences, charts, pictures and HTML."""

__all__ = ["charts", "page", "paper", "pictures", "study", "study_beyond", "study_charts", "study_strips", "study_text"]
