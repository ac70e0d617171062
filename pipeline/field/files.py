"""The artifacts of the field stage: the radiance field as safetensors, its occupancy grid as npz."""

from pathlib import Path

import numpy as np
import torch

from pipeline.core.errors import UserError
from pipeline.field.field import RadianceField
from pipeline.field.occupancy import BinaryOccupancy
from pipeline.field.positional_mlp import PositionalMlp
from pipeline.io.npz import load_npz, save_npz
from pipeline.io.tensors import load_tensors, save_tensors
from pipeline.kernels.hashgrid import GridLayout


def save_field(path: Path, field: RadianceField) -> None:
    """Write a field's weights, the shape of its hash grid or network, and its way of inverse skinning."""
    layout = field.layout
    description = {
        "cells_per_axis": [list(cells) for cells in layout.cells_per_axis],
        "features": layout.features,
        "log2_rows": layout.log2_rows,
        "hidden_width": field.hidden.shape[1],
        "trunk": [len(field.trunk.layers), field.trunk.width] if field.trunk else None,
        "inverse_skinning": field.inverse_skinning,
    }
    save_tensors(path, dict(field.state_dict()), description)


def load_field(path: Path) -> RadianceField:
    """Read a field; UserError when the file is no field."""
    tensors, description = load_tensors(path)
    try:
        cells = tuple((int(x), int(y), int(z)) for x, y, z in description["cells_per_axis"])
        layout = GridLayout(cells, description["features"], description["log2_rows"])
        # Files from before there was a choice have neither key.
        trunk = PositionalMlp(*description["trunk"]) if description.get("trunk") else None
        method = description.get("inverse_skinning", "baked")
        bounds_m, width = tensors["bounds_m"].numpy(), description["hidden_width"]
        field = RadianceField(bounds_m, layout, width, trunk=trunk, inverse_skinning=method)
        field.load_state_dict(tensors)
    except (KeyError, RuntimeError, TypeError) as error:
        raise UserError(f"{path} holds no field ({error}); run stages.field again") from None
    return field.requires_grad_(False)


def save_occupancy(path: Path, occupancy: BinaryOccupancy) -> None:
    """Write the occupied cells and their box."""
    save_npz(path, {"occupied": occupancy.occupied.cpu().numpy(), "bounds_m": occupancy.bounds_m.cpu().numpy()})


def load_occupancy(path: Path) -> BinaryOccupancy:
    """Read the occupied cells and their box."""
    arrays = load_npz(path)
    return BinaryOccupancy(torch.from_numpy(arrays["occupied"].astype(np.uint8)), torch.from_numpy(arrays["bounds_m"]))
