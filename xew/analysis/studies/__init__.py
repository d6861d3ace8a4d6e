"""A whole study: its steps, what is done, the cost of the rest, and where it runs. A step runs if its inputs or its product
differ from the ledger.
"""

__all__ = ["config", "cost", "ledger", "machines", "plan", "processes", "runner", "status"]
