"""Write a textured mesh as Wavefront .obj and .mtl.

trimesh reads these files but is not used to write them: its meshes have one index for position, UV and normal, so its
.obj would duplicate the vertices along UV seams and open the surface there; it also encodes the maps again.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.geometry.mesh import Mesh

MATERIAL = "avatar"


@dataclass(frozen=True)
class ObjMaps:
    """Names of the maps in the folder of the .mtl, and the exponent of the highlights.

    Attributes:
        diffuse: RGB.
        specular: factor of the highlights; None for a surface without.
        normal: tangent-space normals, green up; None without them.
        roughness: glTF's; None where `exponent` is that of all highlights.
        exponent: of Blinn's half-vector lobe, which is the model of .mtl.
    """

    diffuse: str
    specular: str | None = None
    normal: str | None = None
    roughness: str | None = None
    exponent: float = 20.0


def write_obj(
    path: Path,
    mesh: Mesh,
    uv: Float[np.ndarray, "t 2"],
    faces_uv: Int[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "n 3"],
    maps: ObjMaps,
    faces_normals: Int[np.ndarray, "f 3"] | None = None,
) -> None:
    """Write `path` (.obj) and the .mtl of the same name, which references the maps in the same folder.

    mesh: m, +Y up. uv: origin bottom-left, as in OBJ. normals: unit. faces_normals: normals of the corners of each
    face; None: one normal per vertex.
    """
    write_faces_obj(path, (mesh.vertices, mesh.faces), (uv, faces_uv), normals, maps, faces_normals)


def write_faces_obj(
    path: Path,
    surface: tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f k"]],
    layout: tuple[Float[np.ndarray, "t 2"], Int[np.ndarray, "f k"]],
    normals: Float[np.ndarray, "n 3"],
    maps: ObjMaps,
    faces_normals: Int[np.ndarray, "f k"] | None = None,
) -> None:
    """Write a mesh of triangles or quads as `write_obj` does.

    surface: vertices and faces. layout: texture coordinates and corners.
    """
    (vertices, faces), (uv, faces_uv) = surface, layout
    count, sides = faces.shape
    of_normals = faces if faces_normals is None else faces_normals
    corners = np.stack([faces, faces_uv, of_normals], axis=2).reshape(count, 3 * sides) + 1
    lines = [f"mtllib {path.with_suffix('.mtl').name}", f"o {MATERIAL}"]
    lines += _format_rows("v %.6f %.6f %.6f", vertices)
    lines += _format_rows("vt %.6f %.6f", uv)
    lines += _format_rows("vn %.4f %.4f %.4f", normals)
    lines += [f"usemtl {MATERIAL}", "s 1"]
    lines += _format_rows("f" + " %d/%d/%d" * sides, corners)
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    path.with_suffix(".mtl").write_text(_mtl_text(maps), encoding="ascii")


def _format_rows(row_format: str, values: np.ndarray) -> list[str]:
    return [row_format % tuple(row) for row in values.tolist()]


def _mtl_text(maps: ObjMaps) -> str:
    ks = "1" if maps.specular else "0"
    lines = [
        f"newmtl {MATERIAL}",
        "Ka 0 0 0",
        "Kd 1 1 1",
        f"Ks {ks} {ks} {ks}",
        f"Ns {maps.exponent:g}",
        "d 1",
        "illum 2",
        f"map_Kd {maps.diffuse}",
    ]
    lines += [f"map_Ks {maps.specular}"] if maps.specular else []
    # of the PBR extension of .mtl: values of `map_Ns` are exponents, of another scale in each program
    lines += [f"map_Pr {maps.roughness}"] if maps.roughness else []
    # of the PBR extension of .mtl: `map_Bump` holds heights for some readers
    lines += [f"norm {maps.normal}"] if maps.normal else []
    return "\n".join(lines) + "\n"
