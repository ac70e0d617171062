"""Light and highlights of a video: found on training frames, tested on validation frames, put on views."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from pipeline.core.progress import warn
from pipeline.geometry.mesh import Mesh
from pipeline.kernels.common.thread_pool import shared_thread_pool
from pipeline.texture.light import VertexGloss, VideoLight
from pipeline.texture.lighting.light_evidence import LightEvidence, estimate_light
from pipeline.texture.lighting.specular import SpecularFit, fit_specular
from pipeline.texture.settings import TextureSettings
from pipeline.texture.vertex_texels import vertex_surface
from pipeline.texture.views import BakeView


def find_light(
    views: tuple[list[BakeView], list[BakeView]],
    positions: tuple[Int[np.ndarray, "t"], Int[np.ndarray, "w"]],
    mesh: Mesh,
    settings: TextureSettings,
) -> LightEvidence | None:
    """Return the light of the video and what validation frames say about it; None without validation frames.

    views, positions: of training and validation frames; positions among the selected frames.
    """
    if not views[1]:
        warn("there are no validation frames to test the light on: it stays in the diffuse map")
        return None
    return estimate_light(*views, vertex_surface(mesh), mesh.edges(), positions, settings)


def fit_highlights(evidence: LightEvidence | None, light: VideoLight, mesh: Mesh) -> SpecularFit:
    """Return the highlights of the surface; none where no lamp was found, whose highlights they would be."""
    if evidence is None or light.is_uniform:
        return SpecularFit.matte(len(mesh.vertices))
    return fit_specular(evidence.train, evidence.validation, evidence.light, mesh)


def light_views(
    views: list[BakeView],
    light: VideoLight,
    positions: Int[np.ndarray, "k"],
    faces: Int[Tensor, "f 3"],
    specular: SpecularFit,
) -> list[BakeView]:
    """Return views with the shading of their vertices; unchanged under a uniform light of constant exposure."""
    if light.is_uniform and bool((light.gain == 1.0).all()):
        return views
    gloss = None
    if specular.strength.any():
        roughness = None if specular.roughness is None else torch.from_numpy(specular.roughness)
        gloss = VertexGloss(specular.highlights, torch.from_numpy(specular.strength), roughness)

    def shaded(view: BakeView, frame: int) -> BakeView:
        at = view.vertices_world, faces, frame
        if gloss is None:
            return replace(view, shading=light.shade_vertices(*at))
        return replace(view, shading=light.shade_specular(*at, gloss, view.camera.centre_m()))

    return shared_thread_pool(torch.get_num_threads()).map(shaded, views, positions.tolist())


def light_metrics(evidence: LightEvidence | None, light: VideoLight) -> dict[str, float]:
    """Return the figures of the estimated light."""
    if evidence is None:
        return {"light_removed": 0.0}
    return {
        "light_removed": float(not light.is_uniform),
        "light_explained": evidence.explained,
        "light_standard_errors": evidence.standard_errors,
        "key_light_standard_errors": evidence.key_standard_errors,
        "gain_log_std": float(np.log(evidence.light.gain).std()),
    }
