"""Compare the highlights of the texture stage with a learnt specular feature, on a synthetic capture.

python -m data_tools.evaluate.learnt_specular CAPTURE [--frames 48] [--seed 0]

The baseline is the appearance model of IHM: a diffuse colour and a feature at each point, and a network of feature and
view direction (`learnt_feature`). Both are fitted to what the same training frames show at the vertices of the true
mesh in the true poses, and predict the vertices in held-out frames. Directions are in canonical space, as in the field
of IHM. The penalty of what the network adds is chosen on validation frames. `relit`: vertices under lights that were
not filmed; the network has learnt the highlights of the filmed light, so only its diffuse colour is relit.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from data_tools.command import run_command
from data_tools.evaluate.learnt_feature import FeatureRows, LearntFeature, fit_feature, mean_squared_error
from data_tools.evaluate.materials import NEW_LIGHTS, gain_to_truth, write_true_run
from data_tools.evaluate.truth import load_ground_truth
from data_tools.synthetic.scene.capture import SyntheticCapture
from data_tools.synthetic.scene.renderer import Light, face_exponents, shade, shiny_faces
from pipeline.body.files import load_body
from pipeline.capture.capture import load_capture
from pipeline.capture.frame_selection import HELDOUT, TRAIN, VALIDATION
from pipeline.geometry.colour import linear_to_srgb
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.mesh.files import load_mesh
from pipeline.texture.light import VideoLight, exponent_of_roughness
from pipeline.texture.lighting.light_evidence import estimate_light
from pipeline.texture.lighting.light_fit import ViewObservations, observe_light, observe_visibility
from pipeline.texture.lighting.specular import SpecularFit, fit_specular
from pipeline.texture.lighting.specular_regression import HighlightRegression
from pipeline.texture.settings import DEFAULT_SETTINGS
from pipeline.texture.vertex_texels import vertex_surface
from stages.texture import load_poses, load_views

PENALTIES = (1e-5, 1e-3, 1e-1)
"""Candidates of the penalty of what the network adds; the first is NeRF2Mesh's."""


@dataclass(frozen=True)
class VertexTruth:
    """The true surface at the vertices of a mesh.

    Attributes:
        albedo: sRGB. shiny: 1 where the surface has highlights, else 0. exponent: of the highlights.
    """

    albedo: Float[np.ndarray, "v 3"]
    shiny: Float[np.ndarray, "v"]
    exponent: Float[np.ndarray, "v"]


@dataclass(frozen=True)
class Views:
    """What training, validation and held-out frames show.

    Attributes:
        parts: by split.
        light: of the video, where it helps; else uniform.
        specular: highlights of the texture stage.
        rotation: canonical to world, of each vertex in each view, by split.
    """

    parts: dict[int, ViewObservations]
    light: VideoLight
    specular: SpecularFit
    rotation: dict[int, Float[np.ndarray, "n v 3 3"]]

    def rows(self, split: int, light: VideoLight) -> HighlightRegression:
        """Return the rows of a split under a light."""
        return HighlightRegression.of_views(self.parts[split], light)

    def feature_rows(self, split: int, light: VideoLight) -> FeatureRows:
        """Return the rows of a split for the learnt feature."""
        rows = self.rows(split, light)
        rotation = self.rotation[split][rows.view, rows.vertex]
        direction = np.einsum("kij,ki->kj", rotation, rows.to_camera)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        colour = linear_to_srgb(np.clip(rows.linear, 0.0, 1.0))
        weight = self.parts[split].rows.weight
        columns = (torch.from_numpy(each).float() for each in (direction, rows.irradiance, colour, weight))
        return FeatureRows(torch.from_numpy(rows.vertex), *columns)


def main(argv: Sequence[str]) -> None:
    """Print the table of one capture."""
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.evaluate.learnt_specular", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("capture", type=Path, help="folder of the synthetic capture")
    parser.add_argument("--frames", type=int, default=48, help="frames used, evenly spaced (default 48)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the network (default 0)")
    options = parser.parse_args(argv)
    truth = load_ground_truth(options.capture)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_true_run(truth, folder, options.frames, 0.0)
        for name, scores in compare_models(truth, folder, options.seed).items():
            print(f"{name:32}", " ".join(f"{score} {value:6.2f}" for score, value in scores.items()))


def compare_models(truth: SyntheticCapture, run: Path, seed: int) -> dict[str, dict[str, float]]:
    """Return PSNR (dB, weighted, of vertices) of each model in held-out frames and under `NEW_LIGHTS`.

    run: with the true mesh and poses, see `write_true_run`.
    """
    views, surface = observe_views(run), true_vertices(truth, run)
    count = len(surface.albedo)
    uniform = VideoLight.uniform(1)
    scores = {}
    for name, light in (("colour", uniform), ("light", views.light)):
        train, held_out = views.rows(TRAIN, light), views.rows(HELDOUT, light)
        albedo = train.albedo(count, 0.0)
        predicted = albedo[held_out.vertex] * held_out.irradiance
        scores[name] = _scores(held_out, predicted, albedo, np.zeros(count), None, surface)
        model = fit_by_validation(views, light, albedo, seed)
        rows = views.feature_rows(HELDOUT, light)
        added, diffuse = model.added(rows).numpy().astype(np.float64), model.diffuse().numpy().astype(np.float64)
        predicted = diffuse[held_out.vertex] * held_out.irradiance + added
        scores[f"{name} + learnt feature"] = _scores(held_out, predicted, diffuse, np.zeros(count), None, surface)
    specular = views.specular
    exponent = None if specular.roughness is None else exponent_of_roughness(specular.roughness.astype(np.float64))
    strength = specular.strength.astype(np.float64)
    train, held_out = (views.rows(split, views.light) for split in (TRAIN, HELDOUT))
    fitted, shown = (strength[rows.vertex] * rows.lobe(specular.highlights, exponent) for rows in (train, held_out))
    albedo = train.albedo(count, fitted)
    predicted = albedo[held_out.vertex] * held_out.irradiance + shown[:, None]
    own = np.full(count, specular.highlights.exponent) if exponent is None else exponent
    return scores | {"light + lobe": _scores(held_out, predicted, albedo, strength, own, surface)}


def observe_views(run: Path) -> Views:
    """Observe the vertices in all frames of a run, and fit light and highlights to the training frames."""
    inputs = {name: run / name for name in ("frames", "body", "mesh")}
    body, skinned, capture = load_body(run / "body" / "body.npz"), load_mesh(run / "mesh"), load_capture(run / "frames")
    positions = {split: capture.positions(split) for split in (TRAIN, VALIDATION, HELDOUT)}
    loaded = {split: load_views(capture, part, inputs, body, skinned) for split, part in positions.items()}
    mesh, surface = skinned.mesh, vertex_surface(skinned.mesh)
    between = (positions[TRAIN], positions[VALIDATION])
    evidence = estimate_light(loaded[TRAIN], loaded[VALIDATION], surface, mesh.edges(), between, DEFAULT_SETTINGS)
    rows = {split: observe_light(part, surface, DEFAULT_SETTINGS) for split, part in loaded.items()}
    parts = {}
    for split, part in loaded.items():
        visibility = np.ones(len(rows[split].vertex))
        if evidence.light.casts_shadows:
            visibility = observe_visibility(part, surface.faces, rows[split], evidence.light.key_direction)
        parts[split] = ViewObservations(part, rows[split], visibility, np.ones(len(part)))
    weights = skinned.dense_skin_weights(len(body.joint_names)).numpy()
    joints = load_poses(inputs, body)[0].numpy()[..., :3, :3]
    rotation = {split: np.einsum("vj,njab->nvab", weights, joints[part]) for split, part in positions.items()}
    light = evidence.light if evidence.helps else VideoLight.uniform(1)
    specular = SpecularFit.matte(len(mesh.vertices))
    if evidence.helps:
        specular = fit_specular(evidence.train, evidence.validation, evidence.light, mesh)
    return Views(parts, light, specular, rotation)


def true_vertices(truth: SyntheticCapture, run: Path) -> VertexTruth:
    """Return the true surface at the vertices of the mesh of a run in the A-pose of the truth."""
    subject = truth.subject
    _, face, barycentric = closest_points_on_mesh(load_mesh(run / "mesh").mesh.vertices, subject.body.mesh())
    uv = torch.from_numpy((subject.uv[subject.faces_uv[face]] * barycentric[..., None]).sum(axis=1)).float()
    albedo = sample_texture(subject.texture_tensor(), uv).numpy()
    shiny = shiny_faces(subject, truth.light)[face] * float(truth.light.specular_strength)
    return VertexTruth(albedo, shiny, face_exponents(subject, truth.light)[face])


def fit_by_validation(views: Views, light: VideoLight, albedo: Float[np.ndarray, "v 3"], seed: int) -> LearntFeature:
    """Fit the learnt feature with each of `PENALTIES`; return the fit that validation frames prefer."""
    train, validation = (views.feature_rows(split, light) for split in (TRAIN, VALIDATION))
    fits = [fit_feature(train, torch.from_numpy(albedo).float(), penalty, seed) for penalty in PENALTIES]
    return min(fits, key=lambda fit: mean_squared_error(fit, validation))


def _scores(
    held_out: HighlightRegression,
    predicted: Float[np.ndarray, "k 3"],
    albedo: Float[np.ndarray, "v 3"],
    strength: Float[np.ndarray, "v"],
    exponent: Float[np.ndarray, "v"] | None,
    surface: VertexTruth,
) -> dict[str, float]:
    """Return the scores of one model.

    predicted: linear colours of held-out rows. albedo: linear. strength, exponent: of its highlights.
    """
    vertex, known = held_out.vertex, albedo.any(axis=1)[held_out.vertex]
    gain, _ = gain_to_truth(linear_to_srgb(albedo[vertex[known]]), surface.albedo[vertex[known]])
    balanced = linear_to_srgb(np.clip(gain * albedo, 0.0, 1.0))
    sharpness = surface.exponent if exponent is None else exponent
    relit = []
    for light in NEW_LIGHTS.values():
        own = _relight(held_out, balanced, strength, sharpness, light)
        true = _relight(held_out, surface.albedo, surface.shiny, surface.exponent, light)
        relit.append(_psnr_db(own, true, known, held_out.weight))
    shown, filmed = (linear_to_srgb(np.clip(each, 0.0, 1.0)) for each in (predicted, held_out.linear))
    scores = {"held out": _psnr_db(shown, filmed, known, held_out.weight), "relit": float(np.mean(relit))}
    shiny = known & (surface.shiny[vertex] > 0.0)
    if shiny.any():
        scores["held out, shiny"] = _psnr_db(shown, filmed, shiny, held_out.weight)
        scores["held out, matte"] = _psnr_db(shown, filmed, known & ~shiny, held_out.weight)
    return scores


def _relight(
    rows: HighlightRegression,
    albedo: Float[np.ndarray, "v 3"],
    strength: Float[np.ndarray, "v"],
    exponent: Float[np.ndarray, "v"],
    light: Light,
) -> Float[np.ndarray, "k 3"]:
    """Return the sRGB colours of rows under another light, without cast shadows; albedo: sRGB."""
    at_rows = (albedo[rows.vertex], rows.normal, rows.to_camera, np.ones(len(rows.vertex)))
    shine = (strength[rows.vertex], exponent[rows.vertex])
    colour, normal, to_camera, visibility, shiny, sharpness = (
        torch.from_numpy(np.asarray(each, dtype=np.float32)) for each in (*at_rows, *shine)
    )
    of_strength_1 = replace(light, specular_strength=1.0)
    return np.asarray(shade(colour, normal, to_camera, visibility, of_strength_1, shiny, sharpness).numpy())


def _psnr_db(
    own: Float[np.ndarray, "k 3"],
    true: Float[np.ndarray, "k 3"],
    rows: Bool[np.ndarray, "k"],
    weight: Float[np.ndarray, "k"],
) -> float:
    error = np.average(((own - true)[rows] ** 2).mean(axis=1), weights=weight[rows])
    return float(-10.0 * np.log10(max(float(error), 1e-10)))


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
