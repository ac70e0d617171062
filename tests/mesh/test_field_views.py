"""Renders of the field as training views: where the cameras are, and that the renders show what the poses say."""

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.body.body import Body
from pipeline.field.field import RadianceField, hash_grid_layout
from pipeline.field.occupancy import BinaryOccupancy
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.mesh import Mesh
from pipeline.mesh import field_views as field_views_module
from pipeline.mesh.field_views import ELEVATIONS_RAD, orbit_camera, render_field_views
from tests.mesh.egg import Views

POSED = torch.tensor([[-0.3, -0.9, -2.2], [0.3, 0.9, -1.8], [0.0, 0.0, -2.0]])
CENTRE = np.array([0.0, 0.0, -2.0])
FILMING = Camera(300.0, 300.0, 40.0, 130.0, 90, 250)


def direction(camera: Camera) -> np.ndarray:
    """Unit vector from the centre of the body to the camera."""
    offset = camera.centre_m() - CENTRE
    return offset / np.linalg.norm(offset)


@pytest.mark.parametrize(
    ("azimuth_deg", "elevation_deg", "expected"),
    [
        (0.0, 0.0, (0.0, 0.0, 1.0)),
        (90.0, 0.0, (1.0, 0.0, 0.0)),
        (0.0, 30.0, (0.0, 0.5, np.sqrt(0.75))),
        (180.0, -30.0, (0.0, -0.5, -np.sqrt(0.75))),
    ],
)
def test_the_camera_is_moved_around_the_body(
    azimuth_deg: float, elevation_deg: float, expected: tuple[float, float, float]
) -> None:
    camera = orbit_camera(FILMING, POSED, np.radians(azimuth_deg), np.radians(elevation_deg))
    np.testing.assert_allclose(direction(camera), expected, atol=1e-5)
    assert np.linalg.norm(camera.centre_m() - CENTRE) == pytest.approx(2.0, rel=1e-5)
    assert camera.fx == FILMING.fx
    up_px = project(torch.tensor([[0.0, 0.1, -2.0], [0.0, -0.1, -2.0]]), camera)[0]
    assert up_px[0, 1] < up_px[1, 1]  # the head is above the feet
    assert abs(float(up_px[0, 0] - up_px[1, 0])) < 1e-2  # and the camera is not rolled


def test_the_image_holds_the_body_with_a_margin() -> None:
    camera = orbit_camera(FILMING, POSED, 1.0, 0.4)
    pixels = project(POSED, camera)[0].numpy()
    margins = [*pixels.min(axis=0), *(np.array([camera.width, camera.height]) - pixels.max(axis=0))]
    expected = 0.12 * np.ptp(pixels[:, 1])
    np.testing.assert_allclose(margins, expected, atol=2.0)


def test_renders_keep_the_pose_and_have_straight_colours(
    egg: Mesh, egg_body: Body, egg_views: Views, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The renderer is given the pose of the view and the new camera; its premultiplied colours become straight."""
    calls: list[tuple[Tensor, Camera]] = []

    def render(_field: object, _occupancy: object, _body: Body, pose: Tensor, camera: Camera, _skin: object) -> Tensor:
        calls.append((pose, camera))
        return torch.tensor([0.25, 0.0, 0.5, 0.5]).expand(camera.height, camera.width, 4)

    bounds_m = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], dtype=np.float32)
    field = RadianceField(bounds_m, hash_grid_layout(bounds_m, 0.5, 1, 2, 8), 8)
    occupancy = BinaryOccupancy(torch.ones(2, 2, 2, dtype=torch.uint8), torch.from_numpy(bounds_m))
    monkeypatch.setattr(field_views_module, "render_field", render)
    monkeypatch.setattr(field_views_module, "build_skin_grid", lambda *_: None)
    views = egg_views[0]
    renders = render_field_views(field, occupancy, egg_body, views, 4)
    assert len(renders) == len(calls) == 4
    used = [next(k for k, view in enumerate(views) if view.canonical_to_world is pose) for pose, _ in calls]
    assert (used[0], used[-1]) == (0, len(views) - 1)
    for rendered, (pose, camera) in zip(renders, calls, strict=True):
        assert rendered.canonical_to_world is pose
        assert rendered.camera is camera
        assert rendered.image.shape == (camera.height, camera.width, 3)
        assert rendered.image[0, 0].tolist() == [128, 0, 255]
        assert int(rendered.mask[0, 0]) == 128


def test_no_camera_is_a_filming_camera(egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    view = egg_views[0][0]
    posed = view.pose_vertices(torch.from_numpy(egg_body.vertices), torch.from_numpy(egg_body.skin_weights))
    centre = (0.5 * (posed.amin(0) + posed.amax(0))).numpy()
    for number in range(40):
        azimuth_rad = (number + 1) * field_views_module.AZIMUTH_STEP_RAD
        elevation_rad = ELEVATIONS_RAD[number % len(ELEVATIONS_RAD)]
        camera = orbit_camera(view.camera, posed, azimuth_rad, elevation_rad)
        old, new = (item.centre_m() - centre for item in (view.camera, camera))
        angle_rad = np.arccos(old @ new / (np.linalg.norm(old) * np.linalg.norm(new)))
        assert angle_rad > np.radians(10.0)
