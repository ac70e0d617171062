"""The comparison of hole filling, on a ball with a smooth texture."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.geometry.atlas import rasterize_texels, unwrap
from pipeline.geometry.mesh import Mesh
from pipeline.io.image import to_uint8, write_gray, write_rgb
from pipeline.io.npz import save_npz
from tests.bench.bench_hole_filling import HOLES, main


def test_both_methods_fill_holes_of_a_smooth_texture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    mesh = Mesh(sphere.vertices.astype(np.float32), sphere.faces.astype(np.int32))
    atlas = unwrap(mesh, np.zeros(len(mesh.faces), dtype=np.int32), 256, 4)
    texels = rasterize_texels(atlas, 256)
    colour = texels.to_texture(texels.interpolate(mesh.faces, mesh.vertices) + np.float32(0.5))
    for name in ("mesh", "texture"):
        (tmp_path / name).mkdir()
    save_npz(tmp_path / "mesh" / "mesh.npz", {"vertices": mesh.vertices, "faces": mesh.faces})
    layout = {"uv": atlas.uv, "faces_uv": atlas.faces_uv, "vertex_of_uv": atlas.vertex_of_uv}
    save_npz(tmp_path / "texture" / "atlas.npz", layout)
    write_rgb(tmp_path / "texture" / "diffuse.png", to_uint8(colour))
    write_gray(tmp_path / "texture" / "coverage.png", to_uint8(texels.coverage_mask().astype(np.float32)))
    main([str(tmp_path)])
    rows = np.array([line.split()[1:] for line in capsys.readouterr().out.splitlines()[1:]], dtype=float)
    np.testing.assert_allclose(rows[:, 0], [radius_m for radius_m, _ in HOLES])
    assert (rows[:, 1] > 0.0).all()
    assert (rows[:, 2:4] > 22.0).all()
    assert rows[-1, 2] > rows[-1, 3]
