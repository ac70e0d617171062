"""Reduction of the faces of the refined mesh to what its images need.

Most colour detail is in the texture, so that a mesh with longer edges looks the same. The mesh is remeshed with edges
of growing length, until a render of it is measurably worse.
"""

from collections.abc import Callable

from pipeline.core.progress import track
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import OpenSurfaceError, remesh_isotropic
from pipeline.mesh.settings import MeshSettings

MAX_TRIALS = 8


def reduce_faces(
    mesh: Mesh, edge_m: float, tolerance_m: float, psnr_db: Callable[[Mesh], float], settings: MeshSettings
) -> Mesh:
    """Remesh with the longest edges that cost at most `settings.max_reduction_loss_db`.

    Each trial multiplies the edge length by `settings.reduction_edge_ratio`; the first that costs more, has no fewer
    faces or leaves holes ends the search.

    Args:
        mesh: a closed surface, m; returned as it is (the same object) if the first trial fails.
        edge_m: typical edge length of the mesh, m.
        tolerance_m: no vertex of a trial is farther than this from the mesh, m. Thin parts keep short edges.
        psnr_db: PSNR of renders of a mesh, dB.
        settings: see `MeshSettings`.
    """
    lowest_psnr_db, best = psnr_db(mesh) - settings.max_reduction_loss_db, mesh
    for trial in track(range(1, MAX_TRIALS + 1), "reduce faces"):
        trial_edge_m = edge_m * settings.reduction_edge_ratio**trial
        try:
            reduced = remesh_isotropic(mesh, trial_edge_m, iterations=4, tolerance_m=tolerance_m)
        except OpenSurfaceError:
            break
        if psnr_db(reduced) < lowest_psnr_db or len(reduced.faces) >= len(best.faces):
            break
        best = reduced
    return best
