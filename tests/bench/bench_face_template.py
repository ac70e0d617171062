"""How far are the template's eyes, mouth and nose from those of the video, in held-out frames that show the face?

`python -m tests.bench.bench_face_template RUN...` poses the registered template of finished runs
(`texture/template.npz`) with the motion of held-out frames, and compares corners of eyes and mouth and the tip of the
nose with MediaPipe's face mesh in these frames: median distance in millimetres at the depth of the face, as it is, and
after the mean shift of each frame is removed, which is an error of the frame's pose.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from pipeline.body.body import canonical_to_world
from pipeline.body.files import load_body, load_camera, load_motion
from pipeline.capture.capture import load_capture
from pipeline.capture.face_detector import FaceDetector
from pipeline.capture.frame_selection import HELDOUT
from pipeline.geometry.camera import project
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.io.image import to_uint8
from pipeline.template.face.landmarks import FACE_LANDMARKS
from pipeline.template.files import load_fitted_template

POINTS = (
    "eye_outer_left",
    "eye_outer_right",
    "eye_inner_left",
    "eye_inner_right",
    "mouth_corner_left",
    "mouth_corner_right",
    "nose_tip",
)
MIN_FACING = 0.8
"""Cosine between the direction of the face and that to the camera; the detector guesses the far side of a profile."""


def main(runs: list[str]) -> None:
    """Print one line a run."""
    print("run            frames  median mm  95 % mm  without shift: median mm  95 % mm")
    for run in map(Path, runs):
        errors_m = landmark_errors_m(run)
        if len(errors_m) == 0:
            print(f"{run.name:14} no held-out frame shows the face from in front")
            continue
        own = errors_m - errors_m.mean(axis=1, keepdims=True)
        figures = [1e3 * np.quantile(np.linalg.norm(e, axis=2), q) for e in (errors_m, own) for q in (0.5, 0.95)]
        print(
            f"{run.name:14} {len(errors_m):6} {figures[0]:10.1f} {figures[1]:8.1f} {figures[2]:25.1f} {figures[3]:8.1f}"
        )


def landmark_errors_m(run: Path) -> Float[np.ndarray, "n l 2"]:
    """Return the differences (m, in the plane of the picture) of held-out frames that show the face from in front."""
    body, capture = load_body(run / "body" / "body.npz"), load_capture(run / "frames")
    camera, fitted = load_camera(run / "body" / "camera.npz"), load_fitted_template(run / "texture")
    if fitted is None:
        return np.zeros((0, len(POINTS), 2))
    numbers, vertices = (np.array(column) for column in zip(*(FACE_LANDMARKS[name] for name in POINTS), strict=True))
    points = torch.from_numpy(fitted.registration.vertices[vertices].astype(np.float32))
    weights = torch.from_numpy(body.skin_weights[vertices])
    transforms, detector = canonical_to_world(body, load_motion(run / "mesh" / "motion.npz")), FaceDetector()
    errors = []
    for position in capture.positions(HELDOUT).tolist():
        world = linear_blend_skinning(points, weights, transforms[position : position + 1])[0]
        head = transforms[position, body.joint("Head"), :3, :3].numpy()
        to_camera = camera.centre_m() - world.numpy().mean(axis=0)
        if (head @ [0.0, 0.0, 1.0]) @ to_camera / np.linalg.norm(to_camera) < MIN_FACING:
            continue
        at_px, depth_m = (values.numpy() for values in project(world, camera))
        found = detector.detect_face_of_person(
            to_uint8(capture.image(position)), capture.landmarks_px[position], capture.landmarks_world_m[position]
        )
        if np.isfinite(found[numbers]).all():
            errors.append((at_px - found[numbers, :2]) * depth_m[:, None] / camera.fx)
    return np.array(errors).reshape(-1, len(POINTS), 2)


if __name__ == "__main__":
    main(sys.argv[1:])
