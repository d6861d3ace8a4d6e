"""The registry of codecs, and codecs that are kept in a folder. What each promises is said in contract.py.

To add one: a class with the methods of `Codec`, and one line in CODECS.
"""

from pathlib import Path

from xew.config import ConfigError, pick
from xew.model.codecs.autoencoders import ConvAutoencoderCodec, WanVaeCodec
from xew.model.codecs.contract import Codec, CodecSettings, LatentSize

CODECS: dict[str, type[Codec]] = {
    "conv_autoencoder": ConvAutoencoderCodec,
    "wan_vae": WanVaeCodec,
}

RUN_CODEC = "codec"
"""Name of the folder in a run that holds its codec."""
RUN_REMEDY = "copy the whole run again, or train again"
"""Sentence on what to do where a run's codec is damaged or lost."""


def codec_class(settings: CodecSettings) -> type[Codec]:
    """The class of codec that a config names. Raises ConfigError if there is none of that name."""
    return pick(CODECS, settings.name, "codec")


def latent_size(settings: CodecSettings) -> LatentSize:
    """Spatial factor and channels of a config's latents. Raises ConfigError if its codec cannot be used."""
    return codec_class(settings).latent_size(settings)


def load_kept_codec(kind: type[Codec], folder: Path, remedy: str) -> Codec:
    """The codec of this class that is kept in a folder.

    Raises:
        ConfigError: the folder lacks a file or is damaged; `remedy` says what to do.
    """
    try:
        return kind.load(folder)
    except ConfigError:
        raise
    except FileNotFoundError as error:
        raise ConfigError(f"{folder.parent} lacks its codec ({error.filename}); {remedy}.") from error
    except Exception as error:  # zipfile, zlib, NumPy and safetensors each have their own
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ConfigError(f"{folder} is damaged ({reason}); {remedy}.") from error
