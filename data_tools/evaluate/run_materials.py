"""Score light and albedo of a texture stage on a finished run against the ground truth of its capture.

With the run's own mesh and poses: errors of these are in all figures. `data_tools.evaluate.materials` is without them.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from data_tools.evaluate.compare_avatar import compare_highlights, observed_colours
from data_tools.evaluate.comparison import REQUIRED_STAGES, Comparison
from data_tools.evaluate.materials import SAMPLES, gain_to_truth, inner_psnr_db, relit_psnr_db, scale_linear
from data_tools.evaluate.truth import load_ground_truth
from data_tools.synthetic.rig.subject import Subject
from data_tools.synthetic.scene.renderer import pose_vertices
from pipeline.avatar.finished_run import load_finished_run
from pipeline.body.body import canonical_to_world
from pipeline.capture.frame_selection import HELDOUT
from pipeline.geometry.mesh import Mesh
from pipeline.io.image import to_float, to_uint8
from pipeline.metrics.alignment import align_surfaces_icp
from pipeline.texture.files import load_texture

RELIT_FRAMES = 3


def score_run_materials(capture: Path, run: Path, texture_dir: Path) -> dict[str, float]:
    """Return the figures of `data_tools.evaluate.materials.score_maps` of a texture, without the error of the gains.

    Args:
        capture: synthetic, of which the run was made.
        run: with finished stages up to mesh.
        texture_dir: folder of a texture stage on this run.

    Raises:
        UserError: an artifact or the ground truth cannot be read.
    """
    inputs = {name: run / name for name in REQUIRED_STAGES} | {"texture": texture_dir}
    coverage = to_float(load_texture(texture_dir).coverage)
    return score_comparison(
        Comparison(load_finished_run(inputs), coverage, load_ground_truth(capture), capture / "truth")
    )


def score_comparison(comparison: Comparison) -> dict[str, float]:
    """Return the figures of `score_run_materials`."""
    points, own, true = observed_colours(comparison)
    gain, error = gain_to_truth(own, true)
    highlights = compare_highlights(comparison, points)
    names = ("specular_correlation", "roughness_error", "lamp_error_deg")
    return {
        "albedo_error": error,
        "heldout_psnr_body_db": _held_out_db(comparison),
        **_relit_db(comparison, gain),
        **{name: highlights[name] for name in names if name in highlights},
    }


def _held_out_db(comparison: Comparison) -> float:
    """Return the mean PSNR of body pixels of held-out frames under the estimated light."""
    run, values = comparison.run, []
    for position in run.capture.positions(HELDOUT).tolist():
        posed = run.avatar.pose_vertices(run.refined_canonical_to_world[position])
        drawn = run.avatar.render(posed, run.camera, SAMPLES, run.avatar.light, position)
        image, mask = to_uint8(run.capture.image(position)), to_uint8(run.capture.mask(position))
        values.append(inner_psnr_db(drawn, image, mask))
    return float(np.mean(values))


def _relit_db(comparison: Comparison, gain: Float[np.ndarray, "3"]) -> Mapping[str, float]:
    """Return the PSNR of body pixels under lights that were not filmed, in the true poses of held-out frames.

    The avatar has the joints of the truth matched and is aligned to it.

    gain: linear, a channel, of its texture.
    """
    run, truth, avatar = comparison.run, comparison.truth, comparison.run.avatar
    texture = to_uint8(scale_linear(avatar.diffuse.numpy(), gain))
    body = replace(truth.subject.body, vertices=avatar.vertices.numpy(), faces=avatar.faces.numpy())
    subject = Subject(body, avatar.uv.numpy(), avatar.faces_uv.numpy(), texture)
    frames = run.capture.frame_index[run.capture.positions(HELDOUT)]
    scores: dict[str, list[float]] = {}
    for frame in frames[np.linspace(0, len(frames) - 1, RELIT_FRAMES).round().astype(int)].tolist():
        true_pose = truth.canonical_to_world[frame]
        pose = canonical_to_world(run.body, comparison.rigs.match(truth.motion.select(np.array([frame]))))[0]
        alignment = align_surfaces_icp(comparison.avatar_surface(pose), comparison.rigs.true_surface(true_pose))
        moved = alignment.transform_mesh(Mesh(avatar.pose_vertices(pose).numpy(), body.faces))
        vertices: Float[torch.Tensor, "v 3"] = torch.from_numpy(moved.vertices).float()
        true_vertices = pose_vertices(truth.subject, true_pose)
        for name, value in relit_psnr_db(truth, subject, vertices, true_vertices).items():
            scores.setdefault(name, []).append(value)
    return {name: float(np.mean(values)) for name, values in scores.items()}
