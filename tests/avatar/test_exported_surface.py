"""The surface of an exported avatar against the one that was written."""

from pathlib import Path

import numpy as np
import torch

from pipeline.avatar.exported_surface import ExportedSurface
from pipeline.avatar.gltf import encode_glb
from pipeline.avatar.rig import build_rig
from pipeline.avatar.textured_avatar import TexturedAvatar
from pipeline.geometry.mesh import Mesh
from pipeline.io.glb import GlbFile
from pipeline.template.face.patch import EYE_LEFT, SKIN, TEETH
from pipeline.template.face.texture import CHART_BOXES
from tests.avatar.avatar_sample import sample_body, sample_maps, sample_motion, sample_skinned_mesh


def exported() -> ExportedSurface:
    body, motion = sample_body(), sample_motion(np.arange(2))
    glb = encode_glb(sample_skinned_mesh(body)[0], build_rig(body), {"capture": motion}, sample_maps())
    return ExportedSurface.of_glb(GlbFile(Path("avatar.glb"), glb))


def test_surface_is_the_one_that_was_written() -> None:
    surface, (written, mesh) = exported(), sample_skinned_mesh(sample_body())
    np.testing.assert_allclose(surface.mesh.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(surface.mesh.faces, mesh.faces)
    np.testing.assert_allclose(surface.vertex_normals, mesh.vertex_normals(), atol=1e-3)
    np.testing.assert_allclose(surface.uv, written.uv, atol=1e-4)
    assert surface.base_colour.shape == (64, 64, 3)


def test_the_head_has_the_colours_of_its_texture() -> None:
    """One grey texture: all covered pixels of the head have it, from every side."""
    surface = exported()
    grey = ExportedSurface(surface.mesh, surface.vertex_normals, surface.uv, np.full((8, 8, 3), 120, dtype=np.uint8))
    views = grey.render_head(views=4, height_px=60, supersampling=2)
    assert len(views) == 4
    for view in views:
        covered = view[..., 3] == 255
        assert covered.mean() > 0.2
        assert (np.abs(view[..., :3][covered].astype(int) - 120) <= 1).all()


def square(left: float, bottom: float, side: float, z_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a square in front view, m, and its two triangles."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * side + [left, bottom]
    return np.insert(corners, 2, z_m, axis=1).astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def test_coverage_of_a_moving_face_has_the_layout_of_the_file() -> None:
    """A captured square of one metre, of which the video shows a part on the left; three parts of a face lie before it.

    The exported one stands higher, as files do whose soles are at y = 0.
    """
    captured_m, faces = square(0.0, 0.0, 1.0, 0.0)
    own_uv = 0.1 + 0.8 * captured_m[:, :2]
    coverage = np.zeros((256, 256), np.uint8)
    coverage[100:156, 20:128] = 200
    avatar = TexturedAvatar(
        *(torch.from_numpy(array) for array in (captured_m, faces)),
        torch.zeros((4, 4), dtype=torch.int64),
        torch.ones((4, 4)),
        torch.from_numpy(own_uv),
        torch.from_numpy(faces),
        torch.zeros((256, 256, 3)),
    )
    parts = [(captured_m, own_uv * [0.5, 1.0])]
    for part, left_m in ((SKIN, 0.1), (EYE_LEFT, 0.6), (TEETH, 0.1)):
        corners_m = square(left_m, 0.4, 0.2, 0.01)[0]
        left, bottom, right, top = CHART_BOXES[part]
        box = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
        parts.append((corners_m, 0.5 * box * [1.0, 2.0] + [0.5, 0.0]))
    vertices, uv = (np.concatenate(arrays).astype(np.float32) for arrays in zip(*parts, strict=True))
    joined = Mesh(vertices + np.float32([0.0, 0.3, 0.0]), np.concatenate([faces + 4 * k for k in range(4)]))
    wide = ExportedSurface(joined, joined.vertex_normals(), uv, np.zeros((256, 512, 3), np.uint8))
    found = wide.coverage_map(avatar, coverage)
    assert found.shape == (256, 512)
    np.testing.assert_array_equal(found[:, :256], coverage)
    for first, expected in ((4, 200), (8, 0), (12, 0)):
        column, height = (uv[first : first + 4].mean(axis=0) * [512, 256]).astype(int)
        assert found[255 - height, column] == expected
    square_map = ExportedSurface(joined, joined.vertex_normals(), uv, np.zeros((256, 256, 3), np.uint8))
    assert square_map.coverage_map(avatar, coverage) is coverage
