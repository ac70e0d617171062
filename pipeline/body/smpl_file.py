"""Reader of SMPL, SMPL-H and SMPL-X model files: `.npz`, or `.pkl` read without executing code.

    v_template     (v, 3) T-pose, metres
    shapedirs      (v, 3, b) derivative with respect to the betas; the first ten are used
    J_regressor    (j, v) joints from vertices; dense, or a scipy sparse matrix in a pickle
    kintree_table  (2, j) parents in the first row
    weights        (v, j) skin weights
    f              (t, 3) triangles

Chumpy objects and scipy matrices in pickles are read as opaque objects, of which only arrays are used.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.sparse import csc_matrix, csr_matrix

from pipeline.body.smpl import SmplArrays, SmplBody
from pipeline.core.errors import UserError
from pipeline.io.npz import read_npz
from pipeline.io.safe_pickle import OpaqueObject, load_pickle

N_BETAS = 10
"""Number of betas used: all releases have them, and most supplied fits use them."""

REQUIRED_KEYS = ("v_template", "shapedirs", "J_regressor", "kintree_table", "weights", "f")
_SPARSE = {"csc_matrix": csc_matrix, "csr_matrix": csr_matrix}
_RECORDS = (
    "chumpy.ch.Ch",
    "chumpy.reordering.Select",
    *(f"scipy.sparse.{module}{name[:3]}.{name}" for module in ("", "_") for name in _SPARSE),
)


def load_smpl(path: Path) -> SmplBody:
    """Read a body model.

    Raises:
        UserError: the file is missing, cannot be read, or is not an SMPL, SMPL-H or SMPL-X model.
    """
    values = _read(path)
    missing = [key for key in REQUIRED_KEYS if key not in values]
    if missing:
        raise UserError(f"{path} has no `{missing[0]}`; supply an SMPL, SMPL-H or SMPL-X model as .npz or .pkl")
    try:
        arrays = _validate_arrays({key: plain_array(values[key]) for key in REQUIRED_KEYS})
        return SmplBody(arrays)
    except (ValueError, TypeError, KeyError) as error:
        raise UserError(f"{path} is not an SMPL, SMPL-H or SMPL-X model ({error}); download it again") from error


def plain_array(value: object) -> np.ndarray:
    """Return the array in an array, a chumpy variable or selection, or a sparse matrix.

    Raises:
        ValueError: it is something else.
    """
    if isinstance(value, np.ndarray) and value.dtype != object:
        return value
    if not isinstance(value, OpaqueObject) or not isinstance(value.state, dict):
        raise ValueError(f"a {type(value).__name__} instead of an array")
    kind, state = type(value).__name__, value.state
    if kind == "Ch":
        return plain_array(state["x"])
    if kind == "Select":  # chumpy: selected elements of another array, indexed in row-major order
        return plain_array(state["a"]).ravel()[plain_array(state["idxs"])].reshape(state["preferred_shape"])
    return _dense(kind, state)


def _dense(kind: str, state: dict[str, Any]) -> Float[np.ndarray, "r c"]:
    parts = tuple(plain_array(state[name]) for name in ("data", "indices", "indptr"))
    matrix = _SPARSE[kind](parts, shape=tuple(int(size) for size in state["_shape"]))
    matrix.check_format(full_check=True)
    return matrix.toarray()


def _read(path: Path) -> dict[str, Any]:
    if path.suffix == ".pkl":
        values = load_pickle(path, _RECORDS)
        if not isinstance(values, dict):
            raise UserError(f"{path} holds a {type(values).__name__}, not a model; supply an SMPL model file")
        return values
    try:
        return {**read_npz(path, REQUIRED_KEYS)}
    except ValueError as error:
        raise UserError(f"{path} cannot be read as .npz or .pkl ({error}); supply an SMPL model file") from error


def _validate_arrays(arrays: dict[str, np.ndarray]) -> SmplArrays:
    """Return the arrays with checked shapes.

    Raises:
        ValueError: shapes do not match.
    """
    regressor, template = arrays["J_regressor"], arrays["v_template"]
    joints, vertices = regressor.shape
    for name, shape in (("v_template", (vertices, 3)), ("weights", (vertices, joints)), ("kintree_table", (2, joints))):
        if arrays[name].shape != shape:
            raise ValueError(f"`{name}` has shape {arrays[name].shape}, expected {shape}")
    directions = arrays["shapedirs"]
    if directions.ndim != 3 or directions.shape[:2] != (vertices, 3):
        raise ValueError(f"`shapedirs` has shape {directions.shape}, expected ({vertices}, 3, betas)")
    faces = arrays["f"].astype(np.int64)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.min() < 0 or faces.max() >= vertices:
        raise ValueError(f"`f` of shape {faces.shape} does not hold triangles of {vertices} vertices")
    parents = arrays["kintree_table"][0].astype(np.int64)
    parents[0] = -1  # the files have 2^32 - 1
    if ((parents[1:] < 0) | (parents[1:] >= np.arange(1, joints))).any():
        raise ValueError("a joint in `kintree_table` precedes its parent")
    return SmplArrays(
        template_m=template.astype(np.float64),
        shape_directions_m=directions[:, :, :N_BETAS].astype(np.float64),
        joint_regressor=regressor.astype(np.float64),
        parents=parents.astype(np.int32),
        skin_weights=arrays["weights"].astype(np.float64),
        faces=faces.astype(np.int32),
    )
