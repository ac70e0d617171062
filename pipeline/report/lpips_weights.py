"""The weights of LPIPS, where other programs have left them on this machine. Nothing is ever downloaded."""

import sys
from pathlib import Path

import torch
from torch import Tensor

ALEXNET = "alexnet-owt-7be5be79.pth"
"""The file that torchvision keeps in torch's hub folder."""

LAYERS = Path("lpips/weights/v0.1/alex.pth")
"""The file inside the package lpips."""

ABSENT = (
    f"absent: {ALEXNET} is not in torch's hub folder, or the package lpips with {LAYERS} is not installed; "
    "nothing is downloaded"
)


def find_lpips_weights() -> dict[str, Tensor] | None:
    """AlexNet's features and the five layers' channel weights by name, or None when one of the two files is absent."""
    backbone = Path(torch.hub.get_dir()) / "checkpoints" / ALEXNET
    layers = next((Path(folder) / LAYERS for folder in sys.path if (Path(folder) / LAYERS).is_file()), None)
    if layers is None or not backbone.is_file():
        return None
    found: dict[str, Tensor] = {}
    for path in (backbone, layers):
        found |= torch.load(path, map_location="cpu", weights_only=True)
    return found
