"""Encoding of instructions for the network: ids of words, or embeddings of a frozen text encoder.

Reads  instructions; for UMT5 the encoder's weights and tokenizer.json
Writes int32 [tokens] for the network's own table of words, or float32 [tokens width], zero past the end
To add one: a `TextEncoder` and one line in TEXT_ENCODERS; from outside the repo, `module:NAME`.

Embeddings of UMT5 are cached in <cache>/text, so only the first run needs its 11 GB.
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

from xew.config import CONVERTER, ConfigError
from xew.episode import check_forms
from xew.files import demand_regular, read_json, replacing, write_text
from xew.model.text.umt5 import UMT5S, load_umt5

VOCABULARY = 8192
"""Number of rows of the learned table; row 0 is padding and stays zero."""
END, PAD = "</s>", "<pad>"
ENCODE_BATCH = 16
"""Number of instructions that are embedded at once."""
LENGTH_STEP = 32
"""Number of tokens to a multiple of which sequences are padded, to compile few shapes."""


@dataclass(frozen=True)
class TextSource:
    """Settings of an experiment for its text encoder."""

    tokens: int
    """Largest number of tokens of the network."""
    weights: Path | None
    tokenizer: Path | None
    cache: Path
    """Folder for embeddings."""


@dataclass(frozen=True)
class TextEncoder:
    """A text encoder."""

    encode: Callable[[TextSource, Sequence[str]], list[np.ndarray]]
    """Function from instructions to int32 [n] (learned) or float32 [n width]; longer results than the network takes are cut."""
    width: int | None = None
    """Width of the embeddings; None takes the model size's."""
    learned: bool = False
    """Whether ids index the network's learned table."""


@dataclass(frozen=True)
class Instructions:
    """The text encoder of an experiment with its settings."""

    encoder: TextEncoder
    source: TextSource
    prefix: str = ""
    """Prefix of every instruction."""

    def encode(self, instructions: Iterable[str]) -> dict[str, np.ndarray]:
        """Distinct instructions -> int32 [l] of a learned table, or float32 [l e]; zero-padded.

        Raises:
            ConfigError: an encoder's files are missing or do not fit.
        """
        distinct = list(dict.fromkeys(instructions))
        encoded = self.encoder.encode(self.source, [self.prefix + instruction for instruction in distinct])
        return {instruction: _pad(array, self.source.tokens) for instruction, array in zip(distinct, encoded, strict=True)}


def _pad(array: np.ndarray, tokens: int) -> np.ndarray:
    return np.pad(array[:tokens], ((0, tokens - len(array[:tokens])), *((0, 0),) * (array.ndim - 1)))


def encode_words(source: TextSource, instructions: Sequence[str]) -> list[np.ndarray]:
    """Rows [n] int32 of the network's table, by the hash of each word."""
    return [np.array([_row(word) for word in _words(instruction)], np.int32) for instruction in instructions]


def _words(instruction: str) -> list[str]:
    return re.findall(r"[a-z0-9]+", instruction.lower())


def _row(word: str) -> int:
    return 1 + int.from_bytes(hashlib.sha256(word.encode()).digest()[:8]) % (VOCABULARY - 1)


def clean(text: str) -> str:
    """Clean a prompt as Wan does: repair characters, unescape HTML entities twice, collapse spaces."""
    return re.sub(r"\s+", " ", html.unescape(html.unescape(ftfy.fix_text(text)))).strip()


def load_tokenizer(path: Path) -> tokenizers.Tokenizer:
    """The tokenizer of a local copy of `google/umt5-xxl` (its folder, or its tokenizer.json).

    Raises:
        ConfigError: there is none, or it is not a T5 tokenizer.
    """
    file = path / "tokenizer.json" if path.is_dir() else path
    if not file.is_file():
        raise ConfigError(
            f"there is no tokenizer at {file}; set model.text_tokenizer to the folder google/umt5-xxl of Wan's files."
        )
    try:
        tokenizer = tokenizers.Tokenizer.from_file(str(file))
    except Exception as error:  # the library raises no narrower type
        raise ConfigError(f"{file} is not a tokenizer ({error}); expected the tokenizer.json of google/umt5-xxl.") from error
    lacking = [token for token in (END, PAD) if tokenizer.token_to_id(token) is None]
    if lacking:
        raise ConfigError(f"{file} has no token {' and no '.join(lacking)}; expected the tokenizer.json of google/umt5-xxl.")
    tokenizer.no_padding()
    tokenizer.no_truncation()
    return tokenizer


def token_ids(tokenizer: tokenizers.Tokenizer, text: str, tokens: int) -> Int[np.ndarray, " n"]:
    """Ids int32 [n] of a cleaned text, cut to `tokens` with the end token."""
    ids = tokenizer.encode(clean(text), add_special_tokens=False).ids
    return np.array([*ids[: tokens - 1], tokenizer.token_to_id(END)], np.int32)


def encode_with_umt5(name: str) -> Callable[[TextSource, Sequence[str]], list[np.ndarray]]:
    """The `TextEncoder.encode` of an encoder in `UMT5S`; embeddings are cached."""

    def encode(source: TextSource, instructions: Sequence[str]) -> list[np.ndarray]:
        cache = _EmbeddingCache(source, name)
        stored = {instruction: cache.read(instruction, UMT5S[name].dim) for instruction in instructions}
        embeddings = {instruction: embedding for instruction, embedding in stored.items() if embedding is not None}
        missing = [instruction for instruction in instructions if instruction not in embeddings]
        if missing:
            for instruction, embedding in zip(missing, _embed(source, name, missing), strict=True):
                cache.write(instruction, embedding)
                embeddings[instruction] = embedding
        return [embeddings[instruction] for instruction in instructions]

    return encode


def _embed(source: TextSource, name: str, instructions: Sequence[str]) -> Iterator[np.ndarray]:
    """UMT5's embeddings [n width] float32 of instructions, computed in batches in bfloat16 as in Wan."""
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
    """Weights and tokenizer of the config."""
    paths = {"text_weights": source.weights, "text_tokenizer": source.tokenizer}
    missing = [f"model.{field}" for field, path in paths.items() if path is None]
    if source.weights is None or source.tokenizer is None:
        raise ConfigError(
            f"the text encoder needs {' and '.join(missing)}; set the paths of "
            "models_t5_umt5-xxl-enc-bf16.pth (or its safetensors) and of google/umt5-xxl, or choose model.text: learned."
        )
    return source.weights, source.tokenizer


class _EmbeddingCache:
    """Embeddings on disk, named by a hash of the instruction and of the encoder's files.

    The files' hashes are stored too, so embeddings can be read without the files.
    """

    def __init__(self, source: TextSource, name: str) -> None:
        self.folder = source.cache
        self.notes = self.folder / "sources.json"
        self.source = [name, source.tokens, *(self._fingerprint(path) for path in _files(source))]

    def path(self, instruction: str) -> Path:
        key = hashlib.sha256(json.dumps([*self.source, instruction]).encode()).hexdigest()[:16]
        return self.folder / f"{key}.npy"

    def read(self, instruction: str, width: int) -> np.ndarray | None:
        """The embedding [n width] float32 of an instruction; None if it is not there or damaged."""
        try:
            with demand_regular(self.path(instruction)).open("rb") as file:
                embedding: np.ndarray = np.load(file)
            check_forms({"embedding": embedding}, {"embedding": f"float32 n {width}"})
            return embedding
        except Exception:  # NumPy has many
            return None

    def write(self, instruction: str, embedding: np.ndarray) -> None:
        with replacing(self.path(instruction), within=self.folder.parent) as temporary, temporary.open("wb") as file:
            np.save(file, embedding)

    def _read_notes(self) -> dict[str, str]:
        """The noted hashes; none if they are damaged."""
        try:
            return CONVERTER.structure(read_json(self.notes), dict[str, str])
        except Exception:  # cattrs has many
            return {}

    def _fingerprint(self, path: Path) -> str:
        """SHA-256 of sizes, beginnings and ends of a file or of a folder's files."""
        noted = self._read_notes()
        if not path.exists():
            if str(path) not in noted:
                raise ConfigError(
                    f"there is no {path}, which the text encoder needs; get Wan2.2's text encoder, or fix the path."
                )
            return noted[str(path)]
        files = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
        digest = hashlib.sha256()
        for file in files:
            digest.update(f"{file.name if path.is_dir() else ''} {file.stat().st_size}".encode())
            digest.update(_ends(file))
        if noted.get(str(path)) != digest.hexdigest():
            text = json.dumps(noted | {str(path): digest.hexdigest()}, indent=1) + "\n"
            write_text(self.notes, text, within=self.folder.parent)
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
