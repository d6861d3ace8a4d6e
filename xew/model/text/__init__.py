"""Encoding of instructions: a learned table of words, or embeddings of Wan's frozen UMT5 encoder."""

__all__ = ["instructions", "umt5"]
