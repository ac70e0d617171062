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
from pipeline.body.fit.detections.face_observations import face_landmarks, facing_cosine
from pipeline.capture.capture import Capture
from pipeline.geometry.camera import Camera, pixel_rays
from pipeline.geometry.mesh import Mesh
from pipeline.template.face.landmarks import LANDMARK_NUMBERS, LANDMARK_VERTICES

MIN_FACING_COSINE = 0.8
"""Cosine of the largest angle between face and view: farther aside, the detector's nose and lips lie on the outline."""
MIN_FRAMES = 5
"""Fewer frames are not used."""
RAY_SCALE_M, ROBUST_STEPS = 0.005, 20
"""Distance from a ray at which it has a quarter of its weight, and steps of reweighting."""
DEPTH_STD_M = 0.02
"""Standard deviation of the depth of the body's face."""


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
        origin_m, direction = self.canonical_rays(body)
        vertices, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
        points_m = np.full(origin_m.shape, np.nan)
        for ray in np.ndindex(origin_m.shape[:2]):
            # All hits, nearest first; `first=True` returns an arbitrary hit for a ray without any.
            hits = igl.ray_mesh_intersect(origin_m[ray], direction[ray], vertices, faces)
            if hits:
                points_m[ray] = origin_m[ray] + hits[0][1] * direction[ray]
        if (np.isfinite(points_m[..., 0]).sum(axis=0) < MIN_FRAMES).any():
            return None
        return np.nanmedian(points_m, axis=0)

    def triangulate(self, body: Body) -> Float[np.ndarray, "l 3"] | None:
        """Return the points (m, canonical frame) nearest to the rays of `FACE_LANDMARKS`; None if too few show them.

        A robust mean (Geman and McClure). The depth is uncertain, and biased where turned faces show the outline of the
        nose: the body's is a weak prior.

        body: the fitted body in the A-pose.
        """
        if len(self.faces_px) < MIN_FRAMES:
            return None
        origin_m, direction = self.canonical_rays(body)
        across = np.eye(3) - direction[..., :, None] * direction[..., None, :]
        prior_m = body.vertices[LANDMARK_VERTICES].astype(np.float64)
        prior_weight = np.diag([0.0, 0.0, (RAY_SCALE_M / DEPTH_STD_M) ** 2])
        weight = np.ones(origin_m.shape[:2])
        for _ in range(ROBUST_STEPS):
            normal = np.einsum("nl,nlab->lab", weight, across) + prior_weight
            right = np.einsum("nl,nlab,nlb->la", weight, across, origin_m) + prior_m @ prior_weight
            points_m = np.linalg.solve(normal, right[..., None])[..., 0]
            distance_m = np.linalg.norm(np.einsum("nlab,nlb->nla", across, points_m - origin_m), axis=2)
            weight = 1.0 / (1.0 + (distance_m / RAY_SCALE_M) ** 2) ** 2
        return points_m

    def canonical_rays(self, body: Body) -> tuple[Float[np.ndarray, "n l 3"], Float[np.ndarray, "n l 3"]]:
        """Return origins (m) and unit directions of the rays of `FACE_LANDMARKS` in the canonical frame."""
        weights = torch.from_numpy(body.skin_weights[LANDMARK_VERTICES])
        to_world = torch.einsum("lj,njab->nlab", weights, self.canonical_to_world).double().numpy()
        back = np.linalg.inv(to_world)
        pixels_px = torch.from_numpy(self.faces_px[:, LANDMARK_NUMBERS].reshape(-1, 2)).double()
        origin_m, direction = (ray.numpy().reshape(*back.shape[:2], 3) for ray in pixel_rays(self.camera, pixels_px))
        origin_m = np.einsum("nlab,nlb->nla", back[..., :3, :3], origin_m) + back[..., :3, 3]
        direction = np.einsum("nlab,nlb->nla", back[..., :3, :3], direction)
        return origin_m, direction / np.linalg.norm(direction, axis=2, keepdims=True)
