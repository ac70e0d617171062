"""The surface of an exported avatar against the one that was written."""

from pathlib import Path

import numpy as np

from pipeline.avatar.exported_surface import ExportedSurface
from pipeline.avatar.gltf import encode_glb
from pipeline.avatar.rig import build_rig
from pipeline.io.glb import GlbFile
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
