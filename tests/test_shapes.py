"""The canary of the shape checks: when these calls pass, no annotation in the house is being checked."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from pipeline.geometry.mesh import Mesh


def test_a_wrong_shape_is_refused() -> None:
    flat_vertices = np.zeros((3, 2), dtype=np.float32)
    with pytest.raises(TypeCheckError):
        Mesh(flat_vertices, np.array([[0, 1, 2]], dtype=np.int32)).face_normals()


def test_a_wrong_dtype_is_refused() -> None:
    vertices = np.zeros((3, 3), dtype=np.float32)
    with pytest.raises(TypeCheckError):
        Mesh(vertices, np.array([[0.0, 1.0, 2.0]])).face_normals()


def test_right_shapes_pass() -> None:
    Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], dtype=np.int32)).face_normals()
