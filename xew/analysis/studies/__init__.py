"""What a study is, which commands it takes, what of it is done, and where the rest runs."""

__all__ = ["config", "cost", "ledger", "machines", "plan", "step"]
