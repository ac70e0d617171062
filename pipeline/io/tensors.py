"""Tensors as safetensors files, written atomically, without pickles; equal tensors give equal bytes."""

import json
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from pipeline.core.atomic import atomic_path
from pipeline.core.errors import UserError

# A single metadata entry: the library writes several entries in an order that differs between runs.
DESCRIPTION = "description"


def save_tensors(path: Path, tensors: dict[str, Tensor], description: dict | None = None) -> None:
    """Write tensors and a JSON-serialisable description."""
    cpu_tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    text = json.dumps(description or {}, sort_keys=True)
    with atomic_path(path) as temporary_path:
        temporary_path.write_bytes(save(cpu_tensors, {DESCRIPTION: text}))


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict]:
    """Read tensors and description.

    Raises:
        UserError: the file is missing, damaged, or not a safetensors file.
    """
    try:
        with safe_open(path, framework="pt") as archive:
            description = json.loads((archive.metadata() or {}).get(DESCRIPTION, "{}"))
            return {name: archive.get_tensor(name) for name in archive.keys()}, description  # noqa: SIM118
    except (OSError, SafetensorError, ValueError) as error:
        raise UserError(f"{path} cannot be read ({error}); run the stage that writes it again") from None
