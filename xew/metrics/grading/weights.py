"""Whether the weights that metrics need are installed: asked before long work that needs them at its end."""

from collections.abc import Iterable

from xew.config import ConfigError
from xew.metrics import METRICS, perceptual
from xew.metrics.networks import alexnet


def check_weights(metrics: Iterable[str] = tuple(METRICS)) -> None:
    """Raise ConfigError unless what these metrics (keys of METRICS) need is installed; the message says what would bring it."""
    if any(METRICS[name].function.__module__ == perceptual.__name__ for name in metrics):
        try:
            alexnet.read_alexnet()
        except FileNotFoundError as error:
            raise ConfigError(str(error)) from error
