"""Pictures of a textured mesh, and the cameras that walk around one."""

import math

import cv2
import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.geometry.camera import Camera, project
from pipeline.kernels.raster import rasterize
from pipeline.kernels.texture_sampling import supersample_texture
from pipeline.kernels.texture_sampling.reference import sample_texture_reference


def sample_texture(texture: Float[Tensor, "th tw c"], uv: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Bilinear look-up. UV origin bottom-left, row 0 of the texture at the top (v = 1), texel centres at +0.5.

    Outside [0, 1] the border texel is repeated. Differentiable in both arguments.

    >>> sample_texture(torch.tensor([[[1.0], [0.0]]]), torch.tensor([[0.25, 0.5], [0.5, 0.5]])).tolist()
    [[1.0], [0.5]]
    """
    return sample_texture_reference(texture, uv)


def render_textured(
    vertices_world: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    faces_uv: Int[Tensor, "f 3"],
    uv: Float[Tensor, "t 2"],
    texture: Float[Tensor, "th tw c"],
    camera: Camera,
    supersampling: int = 3,
) -> Float[Tensor, "h w c+1"]:
    """Texture colours premultiplied by coverage, and the coverage, in [0, 1]; unlit.

    Each pixel is the mean of `supersampling` x `supersampling` bilinear look-ups, which antialiases silhouettes,
    seams and texels.

    Args:
        vertices_world: metres. faces: corners into the vertices. faces_uv: corners of the same faces into `uv`.
    """
    fine = camera.scaled(float(supersampling))
    vertices_px, depth_m = project(vertices_world, fine)
    face_id, barycentric, _ = rasterize(vertices_px, depth_m, faces, fine.height, fine.width)
    return supersample_texture(face_id, barycentric, faces_uv, uv, texture, supersampling)


def blur_coverage(
    premultiplied: Float[np.ndarray, "h w channels"], sigma_px: float
) -> Float[np.ndarray, "h w channels"]:
    """The picture with the coverage in its last channel blurred, as by a lens and a mask that are not sharp.

    Colours are not blurred where the surface covers a pixel: a texture made from pictures has their blur already. Where
    it covers none they are carried outward.

    Args:
        spread_px: standard deviation of the Gaussian.
    """
    if sigma_px <= 0.0:
        return premultiplied
    size = 2 * math.ceil(4.0 * sigma_px) + 1
    blurred = cv2.GaussianBlur(premultiplied, (size, size), sigma_px, borderType=cv2.BORDER_REPLICATE)
    coverage, softened = premultiplied[..., -1:], blurred[..., -1:]
    extrapolated = blurred[..., :-1] / np.maximum(softened, 1e-6)
    own = premultiplied[..., :-1] / np.maximum(coverage, 1e-6)
    colour = np.where(coverage > 0.5, own, extrapolated)
    return np.concatenate([colour * softened, softened], axis=2)


def turntable_camera(
    box_min_m: Float[np.ndarray, "3"], box_max_m: Float[np.ndarray, "3"], angle: float, width: int, height: int
) -> Camera:
    """A camera of long focal length that sees a whole box from all around, level with the box's centre.

    Args:
        lowest_m, highest_m: corners of the box, world, +Y up.
        angle: radians around +Y; 0 looks at the front (the camera stands on +Z), pi/2 stands on +X.
        width, height: of the image in pixels.
    """
    centre, size = 0.5 * (box_min_m + box_max_m), box_max_m - box_min_m
    radius = 0.5 * math.hypot(size[0], size[2])
    distance = 6.0 * max(size[1], 2.0 * radius)
    focal_px = 0.94 * (distance - radius) * min(height / size[1], width / (2.0 * radius))
    backward = np.array([math.sin(angle), 0.0, math.cos(angle)])
    right = np.array([math.cos(angle), 0.0, -math.sin(angle)])
    world_to_camera = np.eye(4, dtype=np.float32)
    world_to_camera[:3, :3] = np.stack([right, [0.0, -1.0, 0.0], -backward])
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ (centre + distance * backward)
    return Camera(focal_px, focal_px, width / 2.0, height / 2.0, width, height, world_to_camera)
