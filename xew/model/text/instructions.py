"""The instruction as the network gets it: ids of words, or embeddings of a frozen text encoder.

Reads  instructions; for UMT5 the encoder's weights and tokenizer.json
Writes int32 [tokens] for the network's own table of words, or float32 [tokens width], zero past the end
To add one: a `TextEncoder` and one line in TEXT_ENCODERS; from outside the repo, `module:NAME`.

Embeddings of UMT5 are computed once an instruction and kept in <cache>/text, so that only the first run needs its 11 GB.
"""

import hashlib
import html
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ftfy
import jax
import numpy as np
import tokenizers
from flax import nnx
from jaxtyping import Int

from xew.config import ConfigError
from xew.files import read_json, replacing
from xew.model.text.umt5 import UMT5S, load_umt5

VOCABULARY = 8192
"""Number of rows of the learned table; row 0 is that of no word and stays zero."""
END, PAD = "</s>", "<pad>"
ENCODE_BATCH = 16
"""Number of instructions that are embedded at once."""
LENGTH_STEP = 32
"""Number of tokens of which sequences are padded to a multiple, so that few shapes are compiled."""


@dataclass(frozen=True)
class TextSource:
    """What an experiment gives its encoder to work with."""

    tokens: int
    """Largest number of tokens that the network takes."""
    weights: Path | None
    tokenizer: Path | None
    cache: Path
    """Folder for embeddings, made where one is written."""


@dataclass(frozen=True)
class TextEncoder:
    """One way to turn instructions into what the network takes."""

    encode: Callable[[TextSource, Sequence[str]], list[np.ndarray]]
    """Function from instructions to int32 [n] (learned) or float32 [n width]; what is longer than the network takes is cut."""
    width: int | None = None
    """Width of the embeddings; None where the model's size says it."""
    learned: bool = False
    """Whether the network itself has the table that the ids are rows of."""


@dataclass(frozen=True)
class Instructions:
    """How an experiment's instructions become what its network takes."""

    encoder: TextEncoder
    source: TextSource
    prefix: str = ""
    """Text put before every instruction."""

    def encode(self, instructions: Iterable[str]) -> dict[str, np.ndarray]:
        """Every distinct instruction as the network takes it.

        Returns:
            By instruction, int32 [l] where the table is learned, else float32 [l e]; zero past the end of the text.

        Raises:
            ConfigError: an encoder's files are missing or do not fit.
        """
        distinct = list(dict.fromkeys(instructions))
        encoded = self.encoder.encode(self.source, [self.prefix + instruction for instruction in distinct])
        return {instruction: _pad(array, self.source.tokens) for instruction, array in zip(distinct, encoded, strict=True)}


def _pad(array: np.ndarray, tokens: int) -> np.ndarray:
    return np.pad(array[:tokens], ((0, tokens - len(array[:tokens])), *((0, 0),) * (array.ndim - 1)))


# A table that the network learns: needs no files.


def encode_words(source: TextSource, instructions: Sequence[str]) -> list[np.ndarray]:
    """Rows [n] int32 of the network's table by the hash of each word; an unknown word has one too, which means nothing yet."""
    return [np.array([_row(word) for word in _words(instruction)], np.int32) for instruction in instructions]


def _words(instruction: str) -> list[str]:
    return re.findall(r"[a-z0-9]+", instruction.lower())


def _row(word: str) -> int:
    return 1 + int.from_bytes(hashlib.sha256(word.encode()).digest()[:8]) % (VOCABULARY - 1)


# UMT5, as Wan uses it.


def clean(text: str) -> str:
    """Repaired characters, no HTML entities (also doubly escaped ones), single spaces: Wan's cleaning of prompts."""
    return re.sub(r"\s+", " ", html.unescape(html.unescape(ftfy.fix_text(text)))).strip()


def load_tokenizer(path: Path) -> tokenizers.Tokenizer:
    """The tokenizer of a local copy of `google/umt5-xxl` (its folder, or its tokenizer.json).

    Raises:
        ConfigError: there is none, or it is no tokenizer of T5's kind.
    """
    file = path / "tokenizer.json" if path.is_dir() else path
    if not file.is_file():
        raise ConfigError(
            f"there is no tokenizer at {file}; model.text_tokenizer is the folder google/umt5-xxl of Wan's files."
        )
    try:
        tokenizer = tokenizers.Tokenizer.from_file(str(file))
    except Exception as error:  # the library raises no narrower kind
        raise ConfigError(f"{file} is no tokenizer ({error}); expected the tokenizer.json of google/umt5-xxl.") from error
    lacking = [token for token in (END, PAD) if tokenizer.token_to_id(token) is None]
    if lacking:
        raise ConfigError(f"{file} has no token {' and no '.join(lacking)}; expected the tokenizer.json of google/umt5-xxl.")
    tokenizer.no_padding()
    tokenizer.no_truncation()
    return tokenizer


def token_ids(tokenizer: tokenizers.Tokenizer, text: str, tokens: int) -> Int[np.ndarray, " n"]:
    """Ids int32 [n] of a cleaned text, cut so that with the end token they are at most `tokens`."""
    ids = tokenizer.encode(clean(text), add_special_tokens=False).ids
    return np.array([*ids[: tokens - 1], tokenizer.token_to_id(END)], np.int32)


def encode_with_umt5(name: str) -> Callable[[TextSource, Sequence[str]], list[np.ndarray]]:
    """The `TextEncoder.encode` of an encoder in `UMT5S`: it reads what was embedded before, and computes and keeps the rest."""

    def encode(source: TextSource, instructions: Sequence[str]) -> list[np.ndarray]:
        cache = _EmbeddingCache(source, name)
        missing = [instruction for instruction in instructions if not cache.path(instruction).exists()]
        if missing:
            for instruction, embedding in zip(missing, _embed(source, name, missing), strict=True):
                cache.write(instruction, embedding)
        return [np.load(cache.path(instruction)) for instruction in instructions]

    return encode


def _embed(source: TextSource, name: str, instructions: Sequence[str]) -> Iterator[np.ndarray]:
    """UMT5's embeddings [n width] float32 of instructions, in batches, in bfloat16 as Wan computes them."""
    weights, folder = _files(source)
    tokenizer = load_tokenizer(folder)
    ids = [token_ids(tokenizer, instruction, source.tokens) for instruction in instructions]
    graph, params = nnx.split(load_umt5(weights, UMT5S[name]))

    @jax.jit
    def forward(params: Any, ids: jax.Array, lengths: jax.Array) -> jax.Array:
        return nnx.merge(graph, params)(ids, lengths)

    for start in range(0, len(ids), ENCODE_BATCH):
        group = ids[start : start + ENCODE_BATCH]
        lengths = np.array([len(row) for row in group], np.int32)
        longest = -(-int(lengths.max()) // LENGTH_STEP) * LENGTH_STEP
        embedded = np.asarray(forward(params, np.stack([_pad(row, longest) for row in group]), lengths))
        yield from (embedding[:n] for embedding, n in zip(embedded, lengths, strict=True))


def _files(source: TextSource) -> tuple[Path, Path]:
    """Weights and tokenizer that the config names."""
    named = {"text_weights": source.weights, "text_tokenizer": source.tokenizer}
    lacking = [f"model.{field}" for field, path in named.items() if path is None]
    if source.weights is None or source.tokenizer is None:
        raise ConfigError(
            f"the text encoder needs its files, and {' and '.join(lacking)} not set; give the paths of "
            "models_t5_umt5-xxl-enc-bf16.pth (or its safetensors) and of google/umt5-xxl, or choose model.text: learned."
        )
    return source.weights, source.tokenizer


class _EmbeddingCache:
    """Embeddings on disk, each named by its instruction and by what the encoder's files hold.

    What the files held is noted too, so that where they are not at hand the embeddings still are.
    """

    def __init__(self, source: TextSource, name: str) -> None:
        self.folder = source.cache
        self.notes = self.folder / "sources.json"
        self.source = [name, source.tokens, *(self._fingerprint(path) for path in _files(source))]

    def path(self, instruction: str) -> Path:
        key = hashlib.sha256(json.dumps([*self.source, instruction]).encode()).hexdigest()[:16]
        return self.folder / f"{key}.npy"

    def write(self, instruction: str, embedding: np.ndarray) -> None:
        with replacing(self.path(instruction)) as temporary, temporary.open("wb") as file:
            np.save(file, embedding)

    def _fingerprint(self, path: Path) -> str:
        """Sizes, beginnings and ends of a file or of a folder's files."""
        noted = read_json(self.notes) if self.notes.exists() else {}
        if not path.exists():
            if str(path) not in noted:
                raise ConfigError(
                    f"there is no {path}, which config and encoder need; get Wan2.2's text encoder, or fix the path."
                )
            return noted[str(path)]
        files = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
        digest = hashlib.sha256()
        for file in files:
            digest.update(f"{file.name if path.is_dir() else ''} {file.stat().st_size}".encode())
            digest.update(_ends(file))
        if noted.get(str(path)) != digest.hexdigest():
            self.folder.mkdir(parents=True, exist_ok=True)
            with replacing(self.notes) as temporary:
                temporary.write_text(json.dumps(noted | {str(path): digest.hexdigest()}, indent=1) + "\n")
        return digest.hexdigest()


def _ends(file: Path, size: int = 1 << 20) -> bytes:
    with file.open("rb") as opened:
        beginning = opened.read(size)
        opened.seek(max(file.stat().st_size - size, 0))
        return beginning + opened.read(size)


TEXT_ENCODERS = {
    "learned": TextEncoder(encode_words, learned=True),
    "umt5": TextEncoder(encode_with_umt5("xxl"), width=UMT5S["xxl"].dim),
    "umt5_tiny": TextEncoder(encode_with_umt5("tiny"), width=UMT5S["tiny"].dim),
}
