"""Outcomes: what commands cause, as predicted video shows it, against what they cause in the simulator.

    measures.py  outcome accuracy, progress error, counterfactual retrieval
    poses.py     poses of objects from tracked points
    judge.py     what a judge of an episode knows, and progress of estimated poses
    variants.py  what happens under other commands in a scene, and whose end a video shows

Policy ranking rests on rates alone: `xew.statistics.ranking`.
"""

__all__ = ["judge", "measures", "poses", "variants"]
