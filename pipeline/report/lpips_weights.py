"""The weights of LPIPS, if another program has installed them on this machine. Nothing is downloaded."""

import sys
from pathlib import Path

import torch
from torch import Tensor

ALEXNET_FILE = "alexnet-owt-7be5be79.pth"
"""File name of torchvision's AlexNet in torch's hub folder."""

LPIPS_LAYERS_FILE = Path("lpips/weights/v0.1/alex.pth")
"""Path of the layer weights inside the package lpips."""

WEIGHTS_MISSING_NOTE = (
    f"not computed: {ALEXNET_FILE} is not in torch's hub folder, or the package lpips with {LPIPS_LAYERS_FILE} is "
    "not installed; nothing is downloaded"
)


def find_lpips_weights() -> dict[str, Tensor] | None:
    """Return AlexNet's features and the channel weights of the five layers by name; None if a file is missing."""
    backbone = Path(torch.hub.get_dir()) / "checkpoints" / ALEXNET_FILE
    layers = next(
        (Path(folder) / LPIPS_LAYERS_FILE for folder in sys.path if (Path(folder) / LPIPS_LAYERS_FILE).is_file()), None
    )
    if layers is None or not backbone.is_file():
        return None
    found: dict[str, Tensor] = {}
    for path in (backbone, layers):
        found |= torch.load(path, map_location="cpu", weights_only=True)
    return found
