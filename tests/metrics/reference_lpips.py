"""The package `lpips` with the weights that xew reads; needs the extra `reference`."""

import functools
import sys
import types
from collections.abc import Callable

import numpy as np

from xew.metrics.networks.alexnet import read_alexnet


@functools.cache
def reference_lpips() -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """The real `lpips` network on uint8 videos [t h w 3], its trunk filled from our file (no download)."""
    import torch

    network = _lpips_without_torchvision(torch)
    _fill(torch, network, read_alexnet())

    def distance(prediction: np.ndarray, target: np.ndarray) -> np.ndarray:
        signed = [torch.from_numpy(v.transpose(0, 3, 1, 2).astype(np.float32) / 127.5 - 1) for v in (prediction, target)]
        with torch.no_grad():
            return network(*signed).reshape(-1).numpy()

    return distance


def _lpips_without_torchvision(torch: object) -> object:
    """`lpips` imports torchvision for the trunk's layers alone; a stand-in with AlexNet's layers serves where it is absent."""
    nn = torch.nn

    def alexnet(pretrained: bool = False, **_: object) -> object:
        layers = [nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU()]
        layers += [nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(), nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU()]
        layers += [nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU(), nn.MaxPool2d(3, 2)]
        return types.SimpleNamespace(features=nn.Sequential(*layers))

    stand_in = types.ModuleType("torchvision")
    stand_in.models = types.SimpleNamespace(alexnet=alexnet)
    before = sys.modules.get("torchvision")
    sys.modules["torchvision"] = stand_in
    try:
        import lpips

        return lpips.LPIPS(net="alex", version="0.1", pretrained=True, pnet_rand=True, verbose=False).eval()
    finally:
        if before is None:
            del sys.modules["torchvision"]
        else:
            sys.modules["torchvision"] = before


def _fill(torch: object, network: object, weights: dict[str, np.ndarray]) -> None:
    convolutions = [module for module in network.net.modules() if isinstance(module, torch.nn.Conv2d)]
    assert len(convolutions) == 5
    for i, convolution in enumerate(convolutions):
        kernel = torch.from_numpy(weights[f"conv{i}_kernel"].transpose(3, 2, 0, 1).copy())
        convolution.weight.data.copy_(kernel)
        convolution.bias.data.copy_(torch.from_numpy(weights[f"conv{i}_bias"].copy()))
