"""The codec of a latent cache: from the weights that the config names, or of the run to adapt."""

from xew.model.codecs.codec import RUN_CODEC, RUN_REMEDY, load_kept_codec
from xew.model.codecs.contract import Codec
from xew.model.settings.parts import Encoding


def load_codec(encoding: Encoding) -> Codec:
    """The codec that the latents are made with. Raises ConfigError if its weights are missing, damaged or of another kind."""
    if encoding.start_from is None:
        return encoding.kind.open(encoding.codec)
    return load_kept_codec(encoding.kind, encoding.start_from / RUN_CODEC, RUN_REMEDY)
