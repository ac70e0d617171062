"""A closed, coloured shape and views of it, for the tests of the refinement."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pipeline.body.body import Body
from pipeline.geometry.camera import Camera
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import axis_angle_to_matrix
from pipeline.geometry.skinning import rigid_transform
from pipeline.geometry.surface import isosurface, remesh_isotropic
from pipeline.mesh.settings import MeshSettings
from pipeline.mesh.skin_transfer import transfer_skin
from pipeline.mesh.vertex_optimisation import RefinementInputs
from pipeline.mesh.views import PosedView, render_posed_view

SIZE_PX = 72
CAMERA = Camera(150.0, 150.0, SIZE_PX / 2, SIZE_PX / 2, SIZE_PX, SIZE_PX)
DISTANCE_M = 1.6
EDGE_M = 0.06
SETTINGS = MeshSettings(frames_per_step=2, learning_rate=0.002)

Views = tuple[list[PosedView], list[PosedView]]
"""Training views and validation views."""


class Pattern(torch.nn.Module):
    """A smooth colour pattern in canonical space with a learnable contrast."""

    def __init__(self, contrast: float = 0.4) -> None:
        super().__init__()
        self.contrast = torch.nn.Parameter(torch.tensor(contrast))

    def forward(self, points: Tensor) -> Tensor:
        waves = torch.sin(points * torch.tensor([14.0, 11.0, 17.0]) + torch.tensor([0.0, 1.0, 2.0]))
        return 0.5 + self.contrast * waves


PATTERN = Pattern().requires_grad_(False)


def egg_mesh(spacing_m: float = 0.05) -> Mesh:
    """A closed, irregular shape with a diameter of about half a metre."""
    axis = np.arange(-0.5, 0.5001, spacing_m)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    radius = 0.3 + 0.05 * np.sin(4 * x + 1) * np.cos(5 * y) + 0.04 * np.sin(6 * z)
    values = radius - np.sqrt(x**2 + (0.8 * y) ** 2 + z**2)
    return remesh_isotropic(isosurface(values, 0.0, np.full(3, -0.5), spacing_m), EDGE_M, tolerance_m=0.1 * EDGE_M)


def single_joint_body(mesh: Mesh) -> Body:
    return Body(
        joint_names=("Hips",),
        parents=np.array([-1], dtype=np.int32),
        joints_m=np.zeros((1, 3), dtype=np.float32),
        vertices=mesh.vertices,
        faces=mesh.faces,
        skin_weights=np.ones((len(mesh.vertices), 1), dtype=np.float32),
        shape={},
    )


def render_views(mesh: Mesh, body: Body) -> Views:
    """Eight training views around the mesh, and four validation views between them."""
    skin, views = transfer_skin(mesh, body), []
    for angle in np.arange(12) * (2 * np.pi / 12):
        rotation = axis_angle_to_matrix(torch.tensor([[0.2 * np.sin(3 * angle), angle, 0.0]], dtype=torch.float32))
        pose = rigid_transform(rotation, torch.tensor([[0.0, 0.0, -DISTANCE_M]]))
        blank = torch.zeros(SIZE_PX, SIZE_PX, dtype=torch.uint8)
        view = PosedView(blank[..., None].expand(-1, -1, 3), blank, CAMERA, pose)
        with torch.no_grad():
            image, alpha, _ = render_posed_view(torch.from_numpy(mesh.vertices), skin, view, PATTERN)
        straight = torch.where(alpha[..., None] > 1e-3, image / alpha[..., None].clamp_min(1e-3), 0.0).clamp(0, 1)
        pixels, mask = (255 * straight).round().byte(), (255 * alpha.clamp(0, 1)).round().byte()
        views.append(replace(view, image=pixels, mask=mask))
    return [view for i, view in enumerate(views) if i % 3], views[::3]


def refinement_inputs(body: Body, views: Views, **changes: object) -> RefinementInputs:
    """Inputs with two rounds of 40 steps and fixed colours, unless changed."""
    inputs = RefinementInputs(
        body=body,
        train=views[0],
        validation=views[1],
        shader=Pattern().requires_grad_(False),
        target_edge_m=EDGE_M,
        rounds=2,
        steps=40,
        max_faces=3000,
        settings=SETTINGS,
    )
    return replace(inputs, **changes)
