"""Change the shape of a person: the body model's own change between two shapes, carried over by the correspondence.

A point of the surface moves as the point of the template does on which it lies, so that clothes keep their offset. The
displacements are smoothed where the surface has no clear place on the body (skirts, hair, armpits).
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse

from pipeline.body.body import Body, load_anny
from pipeline.core.errors import UserError
from pipeline.geometry.linear_systems import factorise_positive_definite
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh, laplacian
from pipeline.template.registration import Registration

SHAPE_KEYS = ("height", "weight", "muscle", "age")
"""Phenotypes of the built-in body that can be changed; each in [0, 1] (`PHENOTYPE_DEFAULTS`)."""

MAX_CHANGE = 0.5
"""Largest change of a key: half of the model's range."""

SHAPE_KEY_STEP = 0.2
"""Change that a morph target of a shape key makes at weight 1."""

_CLEAR_M = 0.01
"""Surface at this distance from the template has half of the weight in the smoothed displacements."""

_SMOOTHING = 4.0


@dataclass(frozen=True)
class ShapeChange:
    """Displacements of the body model in the A-pose, m: of its vertices and of its joints."""

    vertices_m: Float[np.ndarray, "v 3"]
    joints_m: Float[np.ndarray, "j 3"]


def parse_shape(entries: Sequence[str]) -> dict[str, float]:
    """Return the changes of `["weight=+0.2", ...]` by key.

    Raises:
        UserError: an entry is not a change of a known key by at most `MAX_CHANGE`, or a key comes twice.
    """
    changes: dict[str, float] = {}
    for entry in entries:
        match = re.fullmatch(r"(\w[\w-]*)=([+-]?(?:\d+\.?\d*|\.\d+))", entry.strip())
        known = match is not None and match[1] in SHAPE_KEYS and match[1] not in changes
        if match is None or not known or abs(float(match[2])) > MAX_CHANGE:
            raise UserError(
                f"--shape {entry} is no change of a shape: use {', '.join(SHAPE_KEYS)}, each once and from "
                f"{-MAX_CHANGE} to +{MAX_CHANGE}, such as weight=+0.2"
            )
        changes[match[1]] = float(match[2])
    return changes


def shape_change(body: Body, changes: Mapping[str, float]) -> ShapeChange:
    """Return how the built-in body moves when its shape changes.

    A person at the end of a key's range (fitted weights of 0.98 occur) moves as one who is as far from the end as the
    change needs.

    Args:
        body: the fitted built-in body.
        changes: of phenotypes by name, each within `MAX_CHANGE`.
    """
    model = load_anny()
    start = torch.tensor([body.shape[name] for name in model.shape_names])
    end = start.clone()
    for name, change in changes.items():
        column = model.shape_names.index(name)
        start[column] = float(np.clip(body.shape[name], max(0.0, -change), min(1.0, 1.0 - change)))
        end[column] = start[column] + change
    before, after = model.at_shape(start), model.at_shape(end)
    return ShapeChange(
        after.vertices.astype(np.float64) - before.vertices, after.joints_m.astype(np.float64) - before.joints_m
    )


def carry_to_surface(change: ShapeChange, registration: Registration, mesh: Mesh) -> Float[np.ndarray, "v 3"]:
    """Return the displacements of a person's vertices.

    Minimises sum_i w_i |u_i - d_i|^2 + smoothing * |L u|^2 with the displacement d_i of the template's nearest point,
    w_i that falls with the distance to it, and the Laplacian L of the mesh.
    """
    skin = registration.skin()
    distance_m, face, barycentric = closest_points_on_mesh(mesh.vertices, skin)
    wanted = np.einsum("vk,vkc->vc", barycentric, change.vertices_m[skin.faces[face]])
    weight = 1.0 / (1.0 + (distance_m / _CLEAR_M) ** 2) ** 2 + 1e-6
    operator = sparse.csc_matrix(laplacian(mesh))
    factor = factorise_positive_definite(sparse.diags(weight) + _SMOOTHING * operator.T @ operator)
    return np.asarray(factor.solve(weight[:, None] * wanted))


def reshape_body(body: Body, change: ShapeChange, changes: Mapping[str, float]) -> Body:
    """Return the body in its new shape."""
    shape = dict(body.shape)
    for name, value in changes.items():
        shape[name] = float(np.clip(shape[name] + value, 0.0, 1.0))
    return replace(
        body,
        vertices=(body.vertices + change.vertices_m).astype(np.float32),
        joints_m=(body.joints_m + change.joints_m).astype(np.float32),
        shape=shape,
    )


def reshape_registration(registration: Registration, change: ShapeChange) -> Registration:
    """Return the registered template in the new shape."""
    return replace(registration, vertices=registration.vertices + change.vertices_m)
