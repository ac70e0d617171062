"""Choice of the compute device: the CPU or a CUDA GPU."""

from typing import Literal

import torch

from pipeline.core.errors import UserError

CPU = torch.device("cpu")
DeviceChoice = Literal["auto", "cpu", "cuda"]


def select_device(choice: DeviceChoice, option: str) -> torch.device:
    """Return the device for a value of a `device` option; `auto` selects a CUDA GPU where torch can use one.

    Args:
        choice: value of the option.
        option: name of the option with its section, for the message.

    Raises:
        UserError: the choice is `cuda` and torch finds no CUDA GPU.
    """
    if choice == "cpu" or (choice == "auto" and not torch.cuda.is_available()):
        return CPU
    if not torch.cuda.is_available():
        reason = "finds no CUDA GPU" if torch.version.cuda else "was built without CUDA"
        raise UserError(
            f"{option}=cuda, but torch {torch.__version__} {reason}: install the CUDA build with "
            f"`make venv EXTRA=cuda`, or set {option}=cpu"
        )
    return torch.device("cuda", torch.cuda.current_device())
