"""What a viewer in front of a face sees of a mesh: the foremost face and its depth at each pixel."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from pipeline.geometry.camera import Camera, project
from pipeline.geometry.mesh import Mesh
from pipeline.kernels.raster import rasterize
from pipeline.template.face.frame import FaceFrame

SIZE_PX = 640
_DISTANCE_M = 2.0
_HALF_VIEW = 0.7
"""Half of the side of the picture, in units of the face."""


@dataclass(frozen=True)
class FrontView:
    """A picture of face indices (-1: nothing) and depths (m), with its camera and its distance to the eyes."""

    camera: Camera
    face_id: Int[np.ndarray, "h w"]
    depth_m: Float[np.ndarray, "h w"]
    distance_m: float

    def sees(self, points_m: Float[np.ndarray, "n 3"], tolerance_m: float) -> Bool[np.ndarray, "n"]:
        """Return which points nothing hides."""
        at_px, own_m = project(torch.from_numpy(points_m).float(), self.camera)
        column, row = np.clip(at_px.numpy().astype(int), 0, SIZE_PX - 1).T
        hidden = (self.face_id[row, column] >= 0) & (own_m.numpy() > self.depth_m[row, column] + tolerance_m)
        return np.asarray(~hidden)


def view_from_front(mesh: Mesh, frame: FaceFrame) -> FrontView:
    """Return the view of a mesh along the z axis of a face, with the eyes above the centre and the mouth below."""
    world_to_camera = np.eye(4, dtype=np.float32)
    world_to_camera[:3, :3] = frame.axes * np.array([[1.0], [-1.0], [-1.0]])
    centre_m = frame.to_canonical_m(np.array([[0.0, -0.4, 0.0]]))[0]
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ (centre_m + _DISTANCE_M * frame.axes[2])
    focal_px = 0.5 * SIZE_PX * _DISTANCE_M / (_HALF_VIEW * frame.size_m)
    camera = Camera(focal_px, focal_px, SIZE_PX / 2, SIZE_PX / 2, SIZE_PX, SIZE_PX, world_to_camera)
    vertices, faces = torch.from_numpy(mesh.vertices).float(), torch.from_numpy(mesh.faces).int()
    face_id, _, depth_m = rasterize(*project(vertices, camera), faces, SIZE_PX, SIZE_PX)
    return FrontView(camera, face_id.numpy(), depth_m.numpy(), _DISTANCE_M)
