"""Landmarks of the face from the frames of the video: where the rays of detected landmarks meet the surface.

They need no texture. A face behind glasses or hair, which move against the skin, is blurred in the mean of frames, and
the detector guesses there.
"""

from dataclasses import dataclass

import igl
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.body.body import Body
from pipeline.body.fit.face_observations import face_landmarks, facing_cosine
from pipeline.capture.capture import Capture
from pipeline.geometry.camera import Camera, pixel_rays
from pipeline.geometry.mesh import Mesh
from pipeline.template.face.landmarks import LANDMARK_NUMBERS, LANDMARK_VERTICES

MIN_FACING_COSINE = 0.8
"""Cosine of the largest angle between face and view: farther aside, the detector's nose and lips lie on the outline."""
MIN_FRAMES = 5
"""A median of fewer frames is not used."""


@dataclass(frozen=True)
class FilmedFaces:
    """Frames in which a face detector found the person's face from in front.

    Attributes:
        faces_px: MediaPipe's face mesh, pixel centres at +0.5.
        canonical_to_world: of the joints in these frames.
        camera: of the video.
    """

    faces_px: Float[np.ndarray, "n 478 2"]
    canonical_to_world: Float[Tensor, "n j 4 4"]
    camera: Camera

    @staticmethod
    def of_capture(
        capture: Capture, positions: Int[np.ndarray, "k"], canonical_to_world: Float[Tensor, "n j 4 4"], camera: Camera
    ) -> "FilmedFaces":
        """Choose the frames among `positions` whose face is the person's and looks at the camera.

        canonical_to_world: of all frames of the capture.
        """
        if capture.faces_px is None:
            chosen = positions[:0]
            faces_px = np.zeros((0, 478, 3), np.float32)
        else:
            faces_px = capture.faces_px[positions]
            _, confidence = face_landmarks(
                faces_px, capture.landmarks_px[positions], capture.landmarks_world_m[positions]
            )
            in_front = (confidence[:, 0] > 0.0) & (facing_cosine(faces_px) > MIN_FACING_COSINE)
            chosen, faces_px = positions[in_front], faces_px[in_front]
        return FilmedFaces(faces_px[..., :2], canonical_to_world[torch.from_numpy(chosen)], camera)

    def on_surface(self, mesh: Mesh, body: Body) -> Float[np.ndarray, "l 3"] | None:
        """Return where `FACE_LANDMARKS` are on the surface (m), medians over the frames; None if too few show them.

        Args:
            mesh: the person's head in the A-pose.
            body: the fitted body in the A-pose; its vertices have the skin weights of the landmarks.
        """
        weights = torch.from_numpy(body.skin_weights[LANDMARK_VERTICES])
        to_world = torch.einsum("lj,njab->nlab", weights, self.canonical_to_world).double().numpy()
        vertices, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
        points_m = np.full((len(self.faces_px), len(LANDMARK_NUMBERS), 3), np.nan)
        for frame, (face_px, back) in enumerate(zip(self.faces_px, np.linalg.inv(to_world), strict=True)):
            rays = pixel_rays(self.camera, torch.from_numpy(face_px[LANDMARK_NUMBERS]).double())
            origin_m = np.einsum("lab,lb->la", back[:, :3, :3], rays[0].numpy()) + back[:, :3, 3]
            direction = np.einsum("lab,lb->la", back[:, :3, :3], rays[1].numpy())
            for row in range(len(LANDMARK_NUMBERS)):
                # All hits, nearest first; `first=True` returns an arbitrary hit for a ray without any.
                hits = igl.ray_mesh_intersect(origin_m[row], direction[row], vertices, faces)
                if hits:
                    points_m[frame, row] = origin_m[row] + hits[0][1] * direction[row]
        if (np.isfinite(points_m[..., 0]).sum(axis=0) < MIN_FRAMES).any():
            return None
        return np.nanmedian(points_m, axis=0)
