"""Write a textured mesh as Wavefront .obj and .mtl.

trimesh reads these files but is not used to write them: its meshes have one index for position, UV and normal, so its
.obj would duplicate the vertices along UV seams and open the surface there; it also encodes the maps again.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.geometry.mesh import Mesh

MATERIAL = "avatar"


def write_obj(
    path: Path,
    mesh: Mesh,
    uv: Float[np.ndarray, "t 2"],
    faces_uv: Int[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "v 3"],
    diffuse_name: str,
    specular_name: str | None,
    normal_name: str | None = None,
) -> None:
    """Write `path` (.obj) and the .mtl of the same name, which references the maps in the same folder.

    mesh: m, +Y up. uv: origin bottom-left, as in OBJ. normals: unit, one per vertex. specular_name: None for a surface
    without highlights. normal_name: tangent-space normals, green up, as `norm`; None without them.
    """
    write_faces_obj(
        path, (mesh.vertices, mesh.faces), (uv, faces_uv), normals, (diffuse_name, specular_name, normal_name)
    )


def write_faces_obj(
    path: Path,
    surface: tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f k"]],
    layout: tuple[Float[np.ndarray, "t 2"], Int[np.ndarray, "f k"]],
    normals: Float[np.ndarray, "v 3"],
    map_names: tuple[str, str | None, str | None],
) -> None:
    """Write a mesh of triangles or quads as `write_obj` does.

    surface: vertices and faces. layout: texture coordinates and corners. map_names: diffuse, specular and normal map.
    """
    (vertices, faces), (uv, faces_uv) = surface, layout
    count, sides = faces.shape
    corners = np.stack([faces, faces_uv, faces], axis=2).reshape(count, 3 * sides) + 1
    lines = [f"mtllib {path.with_suffix('.mtl').name}", f"o {MATERIAL}"]
    lines += _format_rows("v %.6f %.6f %.6f", vertices)
    lines += _format_rows("vt %.6f %.6f", uv)
    lines += _format_rows("vn %.4f %.4f %.4f", normals)
    lines += [f"usemtl {MATERIAL}", "s 1"]
    lines += _format_rows("f" + " %d/%d/%d" * sides, corners)
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    path.with_suffix(".mtl").write_text(_mtl_text(*map_names), encoding="ascii")


def _format_rows(row_format: str, values: np.ndarray) -> list[str]:
    return [row_format % tuple(row) for row in values.tolist()]


def _mtl_text(diffuse_name: str, specular_name: str | None, normal_name: str | None) -> str:
    ks = "1" if specular_name else "0"
    lines = [
        f"newmtl {MATERIAL}",
        "Ka 0 0 0",
        "Kd 1 1 1",
        f"Ks {ks} {ks} {ks}",
        "Ns 20",
        "d 1",
        "illum 2",
        f"map_Kd {diffuse_name}",
    ]
    lines += [f"map_Ks {specular_name}"] if specular_name else []
    # of the PBR extension of .mtl: `map_Bump` holds heights for some readers
    lines += [f"norm {normal_name}"] if normal_name else []
    return "\n".join(lines) + "\n"
