"""The shape that the refinement tests reconstruct, its views, and a dented copy as initial mesh."""

import numpy as np
import pytest

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from tests.mesh.egg import Views, egg_mesh, render_views, single_joint_body


@pytest.fixture(scope="session")
def egg() -> Mesh:
    return egg_mesh()


@pytest.fixture(scope="session")
def egg_body(egg: Mesh) -> Body:
    return single_joint_body(egg)


@pytest.fixture(scope="session")
def egg_views(egg: Mesh, egg_body: Body) -> Views:
    return render_views(egg, egg_body)


@pytest.fixture(scope="session")
def dented_egg(egg: Mesh) -> Mesh:
    wave_m = 0.02 * np.sin(9 * egg.vertices).sum(axis=1, keepdims=True)
    return Mesh((egg.vertices + wave_m * egg.vertex_normals()).astype(np.float32), egg.faces)
