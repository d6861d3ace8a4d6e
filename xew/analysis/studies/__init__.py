"""A whole study: which steps it takes, what of it is done, what the rest costs, and where it runs.

A step runs when its inputs or its product are no longer what the ledger says. A study that was stopped at any time goes on
from what is done.
"""

__all__ = ["config", "cost", "ledger", "machines", "plan", "processes", "runner", "status"]
