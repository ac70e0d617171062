"""Artifacts of the field stage: the radiance field (safetensors) and its occupied cells (npz)."""

from pathlib import Path

import numpy as np
import torch

from pipeline.core.command import rerun_command
from pipeline.core.errors import UserError
from pipeline.field.baselines.positional_mlp import PositionalMlp
from pipeline.field.field import RadianceField
from pipeline.field.occupancy import BinaryOccupancy
from pipeline.io.npz import load_npz, save_npz
from pipeline.io.tensors import load_tensors, save_tensors
from pipeline.kernels.hashgrid import GridLayout


def save_field(path: Path, field: RadianceField) -> None:
    """Write the weights of a field, the shape of its hash grid or network, and its inverse skinning method."""
    layout = field.layout
    description = {
        "cells_per_axis": [list(cells) for cells in layout.cells_per_axis],
        "features": layout.features,
        "log2_hashmap_size": layout.log2_rows,
        "hidden_width": field.hidden.shape[1],
        "trunk": [len(field.trunk.layers), field.trunk.width] if field.trunk else None,
        "inverse_skinning": field.inverse_skinning,
    }
    save_tensors(path, dict(field.state_dict()), description)


def load_field(path: Path) -> RadianceField:
    """Read a field, without gradients.

    Raises:
        UserError: the file is missing or damaged, or was written by another version.
    """
    tensors, description = load_tensors(path)
    try:
        cells = tuple((int(x), int(y), int(z)) for x, y, z in description["cells_per_axis"])
        layout = GridLayout(cells, description["features"], description["log2_hashmap_size"])
        trunk = PositionalMlp(*description["trunk"]) if description["trunk"] else None
        method = description["inverse_skinning"]
        bounds_m, width = tensors["bounds_m"].numpy(), description["hidden_width"]
        field = RadianceField(bounds_m, layout, width, trunk=trunk, inverse_skinning=method)
        field.gate = tensors.get("gate")
        field.load_state_dict(tensors)
    except (KeyError, RuntimeError, TypeError) as error:
        raise UserError(
            f"{path} holds no radiance field of this version ({error}); run {rerun_command('field', path.parent)}"
        ) from None
    return field.requires_grad_(False)


def save_occupancy(path: Path, occupancy: BinaryOccupancy) -> None:
    """Write the occupied cells and the bounds of the grid."""
    save_npz(path, {"occupied": occupancy.occupied.cpu().numpy(), "bounds_m": occupancy.bounds_m.cpu().numpy()})


def load_occupancy(path: Path) -> BinaryOccupancy:
    """Read the occupied cells and the bounds of the grid."""
    arrays = load_npz(path)
    return BinaryOccupancy(torch.from_numpy(arrays["occupied"].astype(np.uint8)), torch.from_numpy(arrays["bounds_m"]))
