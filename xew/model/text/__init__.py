"""Instructions to numbers: words that the network learns, or embeddings of Wan's frozen UMT5 encoder."""

__all__ = ["instructions", "umt5"]
