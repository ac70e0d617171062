"""The distortion of a lens: Brown, "Close-range camera calibration" (1971), first radial coefficient."""

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.geometry.camera import Camera


def distort_picture(image: UInt8[np.ndarray, "h w *c"], camera: Camera, k1: float) -> UInt8[np.ndarray, "h w *c"]:
    """Return the picture as a lens with distortion takes it; the border is continued.

    k1: of OpenCV; straight lines bulge outwards where it is negative.
    """
    # OpenCV's pixel centres are whole numbers.
    matrix = np.array([[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]])
    rows, columns = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    # To 1e-9 px, in 100 steps at most.
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
    source = cv2.undistortPointsIter(pixels, matrix, np.array([k1, 0.0, 0.0, 0.0]), np.eye(3), matrix, criteria)
    x, y = np.moveaxis(source.reshape(camera.height, camera.width, 2).astype(np.float32), -1, 0)
    taken: np.ndarray = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return taken
