"""Remeshing of the canonical mesh: to a target edge length, and adaptively to the image error."""

from collections.abc import Callable
from functools import partial

import fast_simplification
import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.body.body import Body
from pipeline.core.progress import warn
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import (
    OpenSurfaceError,
    closest_points_on_mesh,
    remesh_isotropic,
    repair,
    signed_distance_m,
    subdivide,
)
from pipeline.mesh.extraction.isosurface import hand_skin_weights
from pipeline.mesh.face import HAIR_OFFSET_M, face_weight, head_vertices, is_ear
from pipeline.mesh.settings import MeshSettings

DECIMATION_FACE_RATIO = 3.0
"""Ratio of the number of faces after decimation to the number of faces after remeshing."""
DETAIL_EDGE_RATIO = 0.5
"""Edge length at face and hands, in target edge lengths: fingers and lips are thinner than cloth is smooth."""
TOLERANCE_RATIO, DETAIL_TOLERANCE_RATIO = 0.1, 0.15
"""Distance by which remeshing to longer edges, and that of face and hands, may move the surface, in edge lengths."""
FREE, DETAILED, HEAD = 0, 1, 2
"""Parts of the mesh: `HEAD` is what is no face and no ear, mostly hair."""
EQUILATERAL_AREA_RATIO = 0.43
"""Area of an equilateral triangle divided by its squared edge length (0.433)."""
MAX_FACE_EXCESS, MAX_UNIFORM_TRIALS = 0.02, 6
"""Share by which uniform remeshing may exceed the number of faces, and the number of edge lengths that it tries."""


def remesh_to_edge_length(mesh: Mesh, target_edge_m: float, body: Body) -> Mesh:
    """Decimate and remesh a surface to well-shaped triangles with the target edge length, half of it at face and hands.

    At face and hands edges are shorter still where longer ones would move the surface. If a step leaves holes that
    cannot be closed, that step is skipped with a warning.

    Args:
        mesh: a closed, smooth surface, m.
        target_edge_m: edge length to reach, m.
        body: the fitted body in the pose of the mesh; it tells where face and hands are.
    """
    target_face_area_m2 = EQUILATERAL_AREA_RATIO * target_edge_m**2
    dense_face_count = int(mesh.face_areas_m2().sum() / target_face_area_m2 * DECIMATION_FACE_RATIO)
    if len(mesh.faces) > dense_face_count:
        mesh = keep_if_repair_fails(
            lambda: decimate(mesh, dense_face_count), mesh, "the mesh is not decimated before remeshing"
        )
    return keep_if_repair_fails(
        lambda: _remesh_in_two_sizes(mesh, target_edge_m, body),
        mesh,
        "the mesh is not remeshed, so its edge lengths are not uniform",
    )


def _remesh_in_two_sizes(mesh: Mesh, target_edge_m: float, body: Body) -> Mesh:
    for detailed, edge_m in ((False, target_edge_m), (True, DETAIL_EDGE_RATIO * target_edge_m)):
        selected = detailed_faces(mesh, body) == detailed
        if selected.any():
            part = None if selected.all() else selected
            tolerance_m = DETAIL_TOLERANCE_RATIO * edge_m if detailed else None
            mesh = remesh_isotropic(mesh, edge_m, iterations=3, selected=part, tolerance_m=tolerance_m)
    return mesh


def faces_by_part(mesh: Mesh, body: Body) -> Int[np.ndarray, "f"]:
    """Return the part of each mesh face: `DETAILED` at hands, face and ears of the person, else `HEAD` or `FREE`."""
    centres_m = mesh.vertices[mesh.faces].mean(axis=1)
    distance_m, nearest, _ = closest_points_on_mesh(centres_m, body.mesh())
    vertex = body.faces[nearest, 0]
    at_hand, at_head = (hand_skin_weights(body) > 0.5)[vertex], head_vertices(body)[vertex]
    at_ear = is_ear(centres_m, body) & at_head & (distance_m < HAIR_OFFSET_M)
    parts = np.where(at_head, HEAD, FREE)
    parts[at_hand | at_ear | face_of_person(mesh, body)] = DETAILED
    return parts


def detailed_faces(mesh: Mesh, body: Body) -> Bool[np.ndarray, "f"]:
    """Return the mesh faces that are `DETAILED`."""
    return faces_by_part(mesh, body) == DETAILED


def face_of_person(mesh: Mesh, body: Body) -> Bool[np.ndarray, "f"]:
    """Return the mesh faces at the face of the person, without hair; none if the body has no head joint."""
    centres_m = mesh.vertices[mesh.faces].mean(axis=1)
    found = face_weight(centres_m, np.zeros(len(centres_m)), body) > 0.5  # weights fall with the distance
    if found.any():
        distance_m = signed_distance_m(centres_m[found], body.mesh())
        found[found] = face_weight(centres_m[found], distance_m, body) > 0.5
    return found


def decimate(mesh: Mesh, face_count: int) -> Mesh:
    """Reduce a surface to about `face_count` faces by quadric edge collapse, and close it.

    Raises:
        OpenSurfaceError: the result could not be repaired.
    """
    vertices, faces = fast_simplification.simplify(mesh.vertices, mesh.faces, target_count=face_count)
    return repair(Mesh(vertices.astype(np.float32), faces.astype(np.int32)))


def keep_if_repair_fails(change: Callable[[], Mesh], before: Mesh, consequence: str) -> Mesh:
    """Return the result of `change`; if it raises OpenSurfaceError, warn and return the mesh before it."""
    try:
        return change()
    except OpenSurfaceError as error:
        warn(f"{error}; {consequence}")
        return before


def remesh_adaptively(
    mesh: Mesh,
    errors: Float[np.ndarray, "f"],
    kept: Bool[np.ndarray, "f"],
    target_edge_m: float,
    max_faces: int,
    settings: MeshSettings,
) -> Mesh:
    """Subdivide the faces with a large image error, decimate and remesh those with a small one (IHM paper, 2.3).

    Args:
        mesh: a closed surface, m.
        errors: accumulated image error of each face.
        kept: faces that are not decimated.
        target_edge_m: target edge length, m.
        max_faces: no face is subdivided beyond this number of faces.
        settings: percentiles of the error, and the edge length of decimated regions.

    Returns:
        The new mesh; if decimation would leave holes, the faces with a small error stay, with a warning.
    """
    low = (errors <= np.percentile(errors, settings.decimate_percentile)) & ~kept
    fine, _ = subdivide(mesh, _faces_to_subdivide(errors, max_faces, settings.subdivide_percentile))
    # The subdivision keeps these faces, but not their indices: find them by their vertices.
    keys = {tuple(face) for face in np.sort(mesh.faces[low], axis=1).tolist()}
    selected = np.array([tuple(face) in keys for face in np.sort(fine.faces, axis=1).tolist()])
    if not selected.any():
        return fine
    decimated_edge_m = settings.decimated_edge_ratio * target_edge_m
    return keep_if_repair_fails(
        lambda: remesh_isotropic(
            fine, decimated_edge_m, iterations=3, selected=selected, tolerance_m=TOLERANCE_RATIO * decimated_edge_m
        ),
        fine,
        "the faces with a small image error are not decimated in this round",
    )


def remesh_uniformly(mesh: Mesh, detailed: Bool[np.ndarray, "f"], face_count: int) -> Mesh:
    """Remesh to a uniform edge length that gives `face_count` faces, at most `MAX_FACE_EXCESS` more.

    Edges are shorter where longer ones would move the surface by more than a tenth of their length.

    Args:
        mesh: a closed surface, m.
        detailed: faces that stay as they are, from `detailed_faces`.
        face_count: number of faces to reach, the detailed ones included.

    Returns:
        The new mesh; if no tried edge length gives the number of faces, that with the nearest number.
    """
    kept, aim = np.count_nonzero(detailed), (1.0 + 0.5 * MAX_FACE_EXCESS) * face_count
    wanted = max(1.0, aim - kept)
    edge_m = float(np.sqrt(mesh.face_areas_m2()[~detailed].sum() / (EQUILATERAL_AREA_RATIO * wanted)))
    trials: list[Mesh] = []
    for _ in range(MAX_UNIFORM_TRIALS):
        trial = keep_if_repair_fails(
            partial(
                remesh_isotropic, mesh, edge_m, iterations=3, selected=~detailed, tolerance_m=TOLERANCE_RATIO * edge_m
            ),
            mesh,
            "the mesh is not remeshed to a uniform edge length",
        )
        trials.append(trial)
        if trial is mesh or face_count <= len(trial.faces) <= (1.0 + MAX_FACE_EXCESS) * face_count:
            return trial
        edge_m *= float(np.sqrt(max(1, len(trial.faces) - kept) / wanted))
    return min(trials, key=lambda trial: abs(len(trial.faces) - aim))


def _faces_to_subdivide(
    errors: Float[np.ndarray, "f"], max_faces: int, subdivide_percentile: float
) -> Bool[np.ndarray, "f"]:
    """Return the faces above the percentile, or those with the largest errors that the face budget allows."""
    high = errors > np.percentile(errors, subdivide_percentile)
    face_budget = max(0, max_faces - len(errors)) // 4
    if high.sum() <= face_budget:
        return high
    if face_budget == 0:
        return np.zeros_like(high)
    smallest = len(errors) - face_budget
    return high & (errors >= np.partition(errors, smallest)[smallest])
