"""The .obj, read by trimesh, and its .mtl."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.avatar.obj import ObjMaps, write_obj
from pipeline.geometry.mesh import Mesh

UV = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.25, 0.75], [1.0, 1.0]], dtype=np.float32)
FACES_UV = np.array([[0, 1, 2], [1, 4, 2], [3, 2, 0], [4, 3, 2]], dtype=np.int32)
DIFFUSE_ONLY = ObjMaps("avatar_diffuse.png")


@pytest.fixture(scope="module")
def tetrahedron() -> Mesh:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1.5, 0], [0, 0, 0.123456]], dtype=np.float32)
    return Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32))


def written(folder: Path, mesh: Mesh, maps: ObjMaps = DIFFUSE_ONLY) -> Path:
    path = folder / "avatar.obj"
    write_obj(path, mesh, UV, FACES_UV, mesh.vertex_normals(), maps)
    return path


def test_trimesh_reads_the_same_corners(tmp_path: Path, tetrahedron: Mesh) -> None:
    read = trimesh.load(written(tmp_path, tetrahedron), process=False)
    corners = np.asarray(read.vertices)[read.faces]
    np.testing.assert_allclose(corners, tetrahedron.vertices[tetrahedron.faces], atol=1e-6)
    np.testing.assert_allclose(np.asarray(read.visual.uv)[read.faces], UV[FACES_UV], atol=1e-6)
    np.testing.assert_allclose(
        np.asarray(read.vertex_normals)[read.faces], tetrahedron.vertex_normals()[tetrahedron.faces], atol=2e-4
    )


def test_indices_start_at_one_and_uv_has_its_own(tmp_path: Path, tetrahedron: Mesh) -> None:
    lines = written(tmp_path, tetrahedron).read_text().splitlines()
    faces = [line for line in lines if line.startswith("f ")]
    assert faces[1] == "f 1/2/1 2/5/2 4/3/4"
    assert len(faces) == 4
    assert sum(line.startswith("vt ") for line in lines) == 5


def test_the_material_references_the_maps(tmp_path: Path, tetrahedron: Mesh) -> None:
    maps = ObjMaps("avatar_diffuse.png", "avatar_specular.png", None, "avatar_roughness.png", 48.0)
    path = written(tmp_path, tetrahedron, maps)
    assert path.read_text().startswith("mtllib avatar.mtl\n")
    material = path.with_suffix(".mtl").read_text().splitlines()
    assert {"map_Kd avatar_diffuse.png", "map_Ks avatar_specular.png", "Ks 1 1 1"} <= set(material)
    assert {"Ns 48", "map_Pr avatar_roughness.png"} <= set(material)


def test_a_matte_material_has_no_specular_map(tmp_path: Path, tetrahedron: Mesh) -> None:
    material = written(tmp_path, tetrahedron).with_suffix(".mtl").read_text()
    assert "Ks 0 0 0" in material
    assert "map_Ks" not in material
    assert "map_Pr" not in material
