"""How much arithmetic a training step does, counted on the model, and how much devices can do at most."""

from xew.model.network.dit import flops
from xew.model.settings.parts import ClipInputs, Learning

PEAK_FLOPS = {"H100": 989e12, "H200": 989e12, "A100": 312e12}
"""Dense bfloat16 FLOPs a second by the maker's data sheets, by part of the device's name."""


def flops_of_step(learning: Learning, inputs: ClipInputs) -> float:
    """Model FLOPs of one training step over all devices: three times the forward pass, recomputation not counted."""
    settings, network = learning.settings, learning.network
    visibility = network.settings.visibility
    forward = flops(network.size, inputs.grids, batch=settings.batch, channels=network.channels, visibility=visibility)
    return 3 * settings.chunks * forward


def peak_flops(device_kind: str) -> float | None:
    """FLOPs a second of one device by its name; None where it is not known, and then no MFU is logged."""
    return next((peak for name, peak in PEAK_FLOPS.items() if name in device_kind), None)
