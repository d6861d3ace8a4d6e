"""Words as rows of a learned table, and UMT5 as Wan uses it: cleaning, tokenizer, embeddings kept on disk, clear errors."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tokenizers
from flax import nnx

from tests.golden import FOLDER, golden
from tests.networks import TINY_CODEC
from xew.config import ConfigError
from xew.model.experiment import Experiment, load_experiment
from xew.model.network.dit import WorldModel
from xew.model.text.instructions import VOCABULARY, clean, load_tokenizer, token_ids
from xew.model.text.umt5 import UMT5S, Umt5Encoder, official_layout
from xew.model.weights.writing import save_weights

TEXTS = ("Place the empty cup on the coaster.", "beat the block with the hammer", "stack three bowls", "")
CONFIG = """
data: {root}/data
out: {root}/run
clip: {{frames: 5, height: 64, width: 80}}
codec: {{weights: TINY_CODEC}}
model: {{size: tiny, action: none, embodiment: none, history: [], reference: frame, visibility: joint, prediction: velocity,
  dtype: float32, remat: none,
  {model}}}
train: {{steps: 1, batch: 1,
  optimizer: adamw, warmup_steps: 0, decay_to: 1, ema: 0, motion_loss_weight: 0}}
""".replace("TINY_CODEC", str(TINY_CODEC))


def experiment(root: Path, model: str) -> Experiment:
    (root / "config.yaml").write_text(CONFIG.format(root=root, model=model))
    return load_experiment(root / "config.yaml")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny UMT5 in Wan's names and a unigram tokenizer of T5's kind."""
    root = tmp_path_factory.mktemp("umt5")
    tokenizer = tokenizers.Tokenizer(tokenizers.models.Unigram())
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.Metaspace()
    tokenizer.decoder = tokenizers.decoders.Metaspace()
    special = ["<pad>", "</s>", "<unk>"]
    trainer = tokenizers.trainers.UnigramTrainer(
        vocab_size=UMT5S["tiny"].vocabulary, special_tokens=special, unk_token="<unk>", show_progress=False
    )
    tokenizer.train_from_iterator(TEXTS * 4, trainer)
    tokenizer.save(str(root / "tokenizer.json"))
    save_weights(Umt5Encoder(UMT5S["tiny"], rngs=nnx.Rngs(0)), root / "w.safetensors", official_layout(UMT5S["tiny"]))
    return root


def umt5(files: Path, root: Path) -> Experiment:
    paths = f"text_weights: {files / 'w.safetensors'}, text_tokenizer: {files}"
    return experiment(root, f"text: umt5_tiny, {paths}")


def test_cleaning_is_wans() -> None:
    """ftfy, entities twice, single spaces (the rules of Wan's tokenizers.py)."""
    assert clean("  pick\n\tup   the cup ") == "pick up the cup"
    assert clean("salt &amp;amp; pepper") == "salt & pepper"
    assert clean("the robotâ€™s arm") == "the robot's arm"


@pytest.mark.parity
@pytest.mark.parametrize("tokens", [512, 6])
def test_tokens_are_those_of_transformers(tokens: int) -> None:
    files = FOLDER / "unigram"  # training a tokenizer gives another one in every process

    def tokenize() -> dict[str, np.ndarray]:
        import transformers

        theirs = transformers.T5TokenizerFast(tokenizer_file=str(files / "tokenizer.json"), extra_ids=0)
        options = {"truncation": True, "max_length": tokens, "add_special_tokens": True}
        return {f"text{n}": np.array(theirs(clean(text), **options).input_ids) for n, text in enumerate(TEXTS)}

    expected, tokenizer = golden(f"tokens_{tokens}", tokenize), load_tokenizer(files)
    for n, text in enumerate(TEXTS):
        assert token_ids(tokenizer, text, tokens).tolist() == expected[f"text{n}"].tolist()


def test_embeddings_are_the_encoders_and_zero_past_the_end(files: Path, tmp_path: Path) -> None:
    asked = umt5(files, tmp_path)
    found = asked.instructions.encode(TEXTS)
    encoder, tokenizer = Umt5Encoder(UMT5S["tiny"], rngs=nnx.Rngs(0)), load_tokenizer(files)
    for text, embedding in found.items():
        assert embedding.shape == (asked.size.text_tokens, asked.size.text_dim) and embedding.dtype == np.float32
        ids = token_ids(tokenizer, text, asked.size.text_tokens)
        expected = np.asarray(encoder(jnp.asarray(ids)[None], jnp.array([len(ids)])))[0]
        assert not embedding[len(ids) :].any()
        assert np.corrcoef(embedding[: len(ids)].ravel(), expected.ravel())[0, 1] > 0.99  # bfloat16
    model = nnx.eval_shape(lambda: WorldModel(asked.network))
    assert model.text_embedding.first.kernel.shape == (UMT5S["tiny"].dim, 32) and model.words is None


def test_embeddings_are_computed_once_and_outlive_the_files(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    for name in ("w.safetensors", "tokenizer.json"):
        (copy / name).write_bytes((files / name).read_bytes())
    asked = umt5(copy, tmp_path)
    first = asked.instructions.encode(TEXTS[:2])
    monkeypatch.setattr("xew.model.text.instructions.load_umt5", None)
    again = asked.instructions.encode(TEXTS[:2])
    for path in copy.iterdir():
        path.unlink()
    copy.rmdir()
    without = asked.instructions.encode(TEXTS[:2])
    for text in TEXTS[:2]:
        np.testing.assert_array_equal(first[text], again[text])
        np.testing.assert_array_equal(first[text], without[text])
    with pytest.raises(ConfigError, match="no tokenizer"):
        asked.instructions.encode(TEXTS)


@pytest.mark.parametrize("content", [b"", b"no array", "other form", "a folder"], ids=str)
def test_damaged_embeddings_are_computed_again(content: object, files: Path, tmp_path: Path) -> None:
    asked = umt5(files, tmp_path)
    first = asked.instructions.encode(TEXTS[:1])[TEXTS[0]]
    (path,) = tmp_path.rglob("*.npy")
    path.unlink()
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content == "other form":
        np.save(path, np.zeros(3))
    (notes,) = tmp_path.rglob("sources.json")
    notes.write_text("[1")
    np.testing.assert_array_equal(asked.instructions.encode(TEXTS[:1])[TEXTS[0]], first)


def test_other_weights_are_another_cache(files: Path, tmp_path: Path) -> None:
    before = umt5(files, tmp_path).instructions.encode(TEXTS[:1])[TEXTS[0]]
    other = tmp_path / "other"
    other.mkdir()
    (other / "tokenizer.json").write_bytes((files / "tokenizer.json").read_bytes())
    save_weights(Umt5Encoder(UMT5S["tiny"], rngs=nnx.Rngs(7)), other / "w.safetensors", official_layout(UMT5S["tiny"]))
    after = umt5(other, tmp_path).instructions.encode(TEXTS[:1])[TEXTS[0]]
    assert np.abs(before - after).max() > 0.1


def test_missing_files_say_what_to_do(files: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"needs model\.text_weights and model\.text_tokenizer; set"):
        experiment(tmp_path, "text: umt5").instructions.encode(TEXTS)
    gone = f"text: umt5_tiny, text_weights: {tmp_path / 'none.pth'}, text_tokenizer: {files}"
    with pytest.raises(ConfigError, match=r"none\.pth"):
        experiment(tmp_path, gone).instructions.encode(TEXTS)
    (tmp_path / "tokenizer.json").write_text("{}")
    with pytest.raises(ConfigError, match="is not a tokenizer"):
        load_tokenizer(tmp_path)


def test_words_are_rows_of_a_table_that_is_learned(tmp_path: Path) -> None:
    asked = experiment(tmp_path, "text: learned")
    found = asked.instructions.encode(("Stack three bowls!", "stack the bowls", "a b c d e f g h i j k", ""))
    stack = found["Stack three bowls!"]
    assert stack.dtype == np.int32 and stack.shape == (asked.size.text_tokens,)
    assert stack[0] == found["stack the bowls"][0] and stack[2] == found["stack the bowls"][2]
    assert stack[1] != found["stack the bowls"][1] and not stack[3:].any() and not found[""].any()
    assert all(0 < row < VOCABULARY for row in found["a b c d e f g h i j k"])

    model = WorldModel(asked.network)
    model.head.head.kernel[...] = jnp.ones_like(model.head.head.kernel[...])
    latents = jax.random.normal(jax.random.key(0), (1, *asked.inputs.latent_shape), jnp.float32)

    def loss(model: nnx.Module) -> jax.Array:
        return jnp.square(model(latents, {}, jnp.array([0.5], jnp.float32), jnp.asarray(stack)[None])).mean()

    gradient = np.asarray(nnx.grad(loss)(model).words.embedding[...])
    assert set(np.flatnonzero(np.abs(gradient).sum(-1))) == set(stack[:3])


def test_an_instruction_may_have_a_prefix(tmp_path: Path) -> None:
    plain = experiment(tmp_path, "text: learned").instructions.encode(("the arm lifts",))["the arm lifts"]
    prefixed = experiment(tmp_path, "text: learned, text_prefix: 'the arm '").instructions.encode(("lifts",))["lifts"]
    np.testing.assert_array_equal(plain, prefixed)
