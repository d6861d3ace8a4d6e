"""Score tables to means, intervals and verdicts, by robot and by a study's variants.

Draws, levels, floors and verdicts are those of `xew.statistics`, as everywhere.
"""

__all__ = ["grades", "suites"]
