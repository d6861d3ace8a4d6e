"""The study's tables in the paper's layouts, the paper's claims as inequalities, and both as text.

A `Table` is plain data; `formats` writes Markdown, LaTeX and CSV, the page of a report writes HTML.
"""

__all__ = [
    "builder",
    "claims",
    "comparisons",
    "distances",
    "findings",
    "formats",
    "labels",
    "layouts",
    "outside",
    "table",
]
