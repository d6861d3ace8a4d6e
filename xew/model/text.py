"""Text encoders: instructions to a fixed number of embeddings, zero-padded.

To add one: a function (instruction, tokens, width) -> float32 [tokens width], and one line in TEXT_ENCODERS.
"""

import hashlib
import re

import numpy as np


def hashed_words(instruction: str, tokens: int, width: int) -> np.ndarray:
    """Needs no weights: each word is a fixed random vector, drawn from its hash. float32 [tokens width]."""
    words = re.findall(r"[a-z0-9]+", instruction.lower())[:tokens]
    embeddings = np.zeros((tokens, width), np.float32)
    for row, word in zip(embeddings, words, strict=False):
        seed = int.from_bytes(hashlib.sha256(word.encode()).digest()[:8])
        row[:] = np.random.default_rng(seed).standard_normal(width, np.float32)
    return embeddings


TEXT_ENCODERS = {"hashed_words": hashed_words}
