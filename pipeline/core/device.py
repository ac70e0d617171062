"""Where the heavy arithmetic runs: on the processor or on a CUDA graphics card."""

from typing import Literal

import torch

from pipeline.core.errors import UserError

CPU = torch.device("cpu")
DeviceChoice = Literal["auto", "cpu", "cuda"]


def select_device(choice: DeviceChoice, option: str) -> torch.device:
    """The device that a choice means on this machine; `auto` takes a graphics card where torch can use one.

    Raises:
        UserError: `cuda` is asked for and torch sees no such card; `option` names the option to change.
    """
    if choice == "cpu" or (choice == "auto" and not torch.cuda.is_available()):
        return CPU
    if not torch.cuda.is_available():
        reason = "sees no CUDA graphics card" if torch.version.cuda else "was built without CUDA"
        raise UserError(
            f"{option}=cuda, but torch {torch.__version__} {reason}; `make venv EXTRA=cuda` installs the CUDA build, "
            f"{option}=cpu does without"
        )
    return torch.device("cuda", torch.cuda.current_device())
