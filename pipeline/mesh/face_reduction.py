"""Reduction of the faces of the refined mesh to what its images need.

Most colour detail is in the texture, so that a mesh with fewer faces looks the same. Edges are collapsed where the
surface changes least (Garland and Heckbert, "Surface simplification using quadric error metrics", 1997), until a render
of the mesh is measurably worse.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from jaxtyping import Bool, Int

from pipeline.core.progress import track
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import OpenSurfaceError, closest_points_on_mesh, collapse_edges
from pipeline.mesh.remeshing import DETAILED, FREE, HEAD, keep_if_repair_fails
from pipeline.mesh.settings import MeshSettings

MAX_TRIALS = 10

MAX_SHARES = {DETAILED: 0.3, HEAD: 0.1}
"""Share of the faces of a limit that a part may keep; where it has more, it is collapsed to it."""


def reduce_faces(
    mesh: Mesh,
    parts: Int[np.ndarray, "f"],
    psnr_db: Callable[[Mesh], float],
    settings: MeshSettings,
    face_limit: int | None = None,
) -> Mesh:
    """Remove as many faces as cost at most `settings.max_reduction_loss_db`, and those above a limit.

    A limit that costs more is reached in one collapse. Below it, each trial multiplies the number of faces by
    `settings.reduction_ratio`; the first that costs more, has no fewer faces or leaves holes ends the search. With
    `settings.final_faces` there is one trial, to this number of faces, which may cost anything.

    Args:
        mesh: a closed surface, m; returned as it is (the same object) if the first trial fails, or if it has no more
            than `settings.final_faces`.
        parts: part of each face, from `pipeline.mesh.remeshing.faces_by_part`. Only `FREE` faces are removed: views of
            the whole person hardly show what the others are needed for (hands, the face, the outline of the head).
        psnr_db: PSNR of renders of a mesh, dB.
        settings: see `MeshSettings`.
        face_limit: more faces are removed until there are at most as many, whatever it costs; unused with
            `settings.final_faces`.
    """
    if settings.final_faces:
        return _reduce_to(*_limit_parts(mesh, parts, settings.final_faces), settings.final_faces)
    lowest_psnr_db = psnr_db(mesh) - settings.max_reduction_loss_db
    if face_limit is not None:
        mesh, parts = _limit_parts(mesh, parts, face_limit)
    limited = mesh
    if face_limit is not None and len(mesh.faces) > face_limit:
        limited = _reduce_to(mesh, parts, face_limit)
        if len(limited.faces) <= face_limit and psnr_db(limited) < lowest_psnr_db:
            return limited
    reduced = _reduce_by_loss(mesh, limited, parts == FREE, lambda trial: psnr_db(trial) >= lowest_psnr_db, settings)
    if face_limit is None or len(reduced.faces) <= face_limit:
        return reduced
    # the collapse of the mesh left holes: that of the reduced mesh may not
    return _reduce_to(reduced, np.full(len(reduced.faces), FREE), face_limit)


def _reduce_by_loss(
    mesh: Mesh,
    best: Mesh,
    is_free: Bool[np.ndarray, "f"],
    is_good: Callable[[Mesh], bool],
    settings: MeshSettings,
) -> Mesh:
    """Return the smallest good mesh of the trials that have fewer faces than `best`, else `best`."""
    kept, free = np.count_nonzero(~is_free), np.count_nonzero(is_free)
    counts = [int(free * settings.reduction_ratio**trial) for trial in range(1, MAX_TRIALS + 1)]
    for count in track([count for count in counts if kept + count < len(best.faces)], "reduce faces"):
        try:
            reduced = collapse_edges(mesh, is_free, count)
        except OpenSurfaceError:
            break
        if not is_good(reduced) or len(reduced.faces) >= len(best.faces):
            break
        best = reduced
    return best


def _limit_parts(mesh: Mesh, parts: Int[np.ndarray, "f"], face_limit: int) -> tuple[Mesh, Int[np.ndarray, "g"]]:
    """Collapse each part to its share (`MAX_SHARES`) of a limit that the mesh exceeds; return the mesh and its parts.

    A part keeps as many more as the other faces leave of the limit.
    """
    for part, share in MAX_SHARES.items():
        selected = parts == part
        count = max(int(share * face_limit), face_limit - int(np.count_nonzero(~selected)))
        if len(mesh.faces) <= face_limit or np.count_nonzero(selected) <= count:
            continue
        reduced = keep_if_repair_fails(
            partial(collapse_edges, mesh, selected, count), mesh, f"face, hands and head keep {selected.sum()} faces"
        )
        _, nearest, _ = closest_points_on_mesh(reduced.vertices[reduced.faces].mean(axis=1), mesh)
        mesh, parts = reduced, parts[nearest]
    return mesh, parts


def _reduce_to(mesh: Mesh, parts: Int[np.ndarray, "f"], face_count: int) -> Mesh:
    if len(mesh.faces) <= face_count:
        return mesh
    is_free = parts == FREE
    if np.count_nonzero(~is_free) >= face_count:
        is_free = np.ones_like(is_free)
    # two faces less: a collapse removes two at once, and the result may have one or two more than asked for
    wanted = face_count - int(np.count_nonzero(~is_free)) - 2
    return keep_if_repair_fails(
        lambda: collapse_edges(mesh, is_free, max(0, wanted)),
        mesh,
        f"the mesh keeps its {len(mesh.faces)} faces",
    )
