"""The registry of codecs, and loading a codec from a folder.

To add a codec: a class with the methods of `Codec` (contract.py), and one line in CODECS.
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
"""Name of the folder of a run's codec."""
RUN_REMEDY = "copy the whole run again, or train again"
"""Remedy if a run's codec is damaged or lost."""


def codec_class(settings: CodecSettings) -> type[Codec]:
    """The codec class of a config. Raises ConfigError if the name is unknown."""
    return pick(CODECS, settings.name, "codec")


def latent_size(settings: CodecSettings) -> LatentSize:
    """Spatial factor and channels of a config's latents. Raises ConfigError if its codec cannot be used."""
    return codec_class(settings).latent_size(settings)


def load_kept_codec(kind: type[Codec], folder: Path, remedy: str) -> Codec:
    """Load a codec of this class from a folder. Raises ConfigError with `remedy` if a file is missing or damaged."""
    try:
        return kind.load(folder)
    except ConfigError:
        raise
    except FileNotFoundError as error:
        raise ConfigError(f"{folder.parent} lacks its codec ({error.filename}); {remedy}.") from error
    except Exception as error:  # zipfile, zlib, NumPy and safetensors each raise their own
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ConfigError(f"{folder} is damaged ({reason}); {remedy}.") from error
