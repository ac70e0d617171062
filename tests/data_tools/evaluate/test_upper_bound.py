"""The person of the true world in the fitted one: on the same pixels, at the same size in the image."""

import numpy as np
import torch

from data_tools.evaluate.upper_bound import _true_to_fitted_world
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.rotation import axis_angle_to_matrix


def test_the_person_stays_on_its_pixels_under_another_focal_length_principal_point_and_world() -> None:
    true = Camera(600.0, 600.0, 270.0, 270.0, 540, 540)
    tilt = np.eye(4, dtype=np.float32)
    tilt[:3, :3] = axis_angle_to_matrix(torch.tensor([0.2, 0.1, -0.05])).numpy()
    tilt[:3, 3] = 0.1, -0.9, 0.2
    fitted = Camera(410.0, 410.0, 171.0, 186.0, 360, 360, (true.world_to_camera @ tilt).astype(np.float32))
    roots_m = torch.tensor([[0.0, 0.1, -3.0], [0.4, -0.2, -2.5]])
    scale = 0.93
    for root_m, matrix in zip(roots_m, _true_to_fitted_world(roots_m, scale, true, fitted), strict=True):
        person_m = root_m + 0.001 * torch.eye(3)
        moved_m = (person_m.double() @ matrix[:3, :3].T + matrix[:3, 3]).float()
        torch.testing.assert_close(
            (moved_m[1:] - moved_m[:1]).norm(dim=1), torch.full((2,), scale * 0.001 * 2**0.5), atol=2e-6, rtol=0
        )
        true_px, fitted_px = project(person_m, true)[0], project(moved_m, fitted)[0]
        assert (fitted_px - true_px * 360 / 540).abs().max() < 0.02
