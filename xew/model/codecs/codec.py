"""The registry of codecs; what each promises is said in contract.py. To add one: a class there, and one line in CODECS."""

from typing import Any

from xew.config import pick
from xew.model.codecs.autoencoders import ConvAutoencoderCodec, WanVaeCodec
from xew.model.codecs.contract import Codec, CodecSettings
from xew.model.codecs.patches import PatchCodec

CODECS: dict[str, type[Codec]] = {
    "patch_pca": PatchCodec,
    "conv_autoencoder": ConvAutoencoderCodec,
    "wan_vae": WanVaeCodec,
}


def codec_class(settings: CodecSettings) -> type[Any]:
    """The class of codec that a config names, with what `Codec` asks. Raises ConfigError if there is none of that name."""
    return pick(CODECS, settings.name, "codec")
