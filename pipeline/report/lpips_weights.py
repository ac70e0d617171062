"""The weights of LPIPS, where other programs have left them on this machine. Nothing is ever downloaded."""

import sys
from pathlib import Path

import torch
from torch import Tensor

ALEXNET_FILE = "alexnet-owt-7be5be79.pth"
"""The file that torchvision keeps in torch's hub folder."""

LPIPS_LAYERS_FILE = Path("lpips/weights/v0.1/alex.pth")
"""The file inside the package lpips."""

WEIGHTS_MISSING_NOTE = (
    f"absent: {ALEXNET_FILE} is not in torch's hub folder, or the package lpips with {LPIPS_LAYERS_FILE} "
    "is not installed; "
    "nothing is downloaded"
)


def find_lpips_weights() -> dict[str, Tensor] | None:
    """AlexNet's features and the five layers' channel weights by name, or None when one of the two files is absent."""
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
