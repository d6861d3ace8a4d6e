"""The paper's printed figures, checked against one another.

Its distance table is rebuilt from its scores and distances, and the percentages of its text from its tables. One question is
ours: what comes out if workspaces are compared in the frame of the arm's base, as the text says that they were.

    python -m lab.paper_figures [--out paper_figures.md]
"""
