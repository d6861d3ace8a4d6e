"""Training an autoencoder of Wan2.2's kind: `train_codec` by the name that it had for this kind alone.

Command: python -m xew.model.train_vae CONFIG [--resume | --overwrite] [--train.steps … and other overrides]
"""

import functools

from xew.model.train_codec import main as train_codec

main = functools.partial(train_codec, prog="python -m xew.model.train_vae")

if __name__ == "__main__":
    main()
