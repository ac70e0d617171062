import cv2
import numpy as np
import pytest

from data_tools.synthetic.scene.lens import distort_picture
from pipeline.geometry.camera import Camera

CAMERA = Camera(200.0, 200.0, 80.0, 80.0, 160, 160)


def test_a_point_is_filmed_where_the_model_of_brown_puts_it() -> None:
    k1, point_px = -0.2, np.array([130.5, 50.5])
    image = np.zeros((160, 160), dtype=np.float64)
    rows, columns = np.mgrid[:160, :160] + 0.5
    image = np.exp(-0.5 * ((columns - point_px[0]) ** 2 + (rows - point_px[1]) ** 2) / 4.0)
    taken = distort_picture((255 * image).astype(np.uint8), CAMERA, k1).astype(np.float64)
    found_px = np.array([(taken * columns).sum(), (taken * rows).sum()]) / taken.sum()
    normalised = (point_px - 80.0) / 200.0
    expected_px = 80.0 + 200.0 * normalised * (1.0 + k1 * (normalised**2).sum())
    assert found_px == pytest.approx(expected_px, abs=0.1)


def test_opencv_undoes_it() -> None:
    smooth = cv2.GaussianBlur(np.random.default_rng(0).random((160, 160, 3)), (0, 0), 6.0)
    picture = (255 * (smooth - smooth.min()) / np.ptp(smooth)).astype(np.uint8)
    matrix = np.array([[200.0, 0.0, 79.5], [0.0, 200.0, 79.5], [0.0, 0.0, 1.0]])
    back = cv2.undistort(distort_picture(picture, CAMERA, -0.2), matrix, np.array([-0.2, 0.0, 0.0, 0.0]))
    inside = (slice(20, -20), slice(20, -20))
    assert np.abs(back[inside].astype(int) - picture[inside]).max() <= 4
