"""A first texture of the head, good enough for the face detector: the mean of frames that see the face from in front.

The template is registered before the atlas of the person is made, because the atlas may be the template's.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from pipeline.body.body import Body
from pipeline.geometry.atlas import rasterize_texels, unwrap
from pipeline.geometry.mesh import Mesh
from pipeline.mesh.files import MeshArtifact
from pipeline.template.face.filmed_landmarks import FilmedFaces
from pipeline.template.face.landmarks import (
    Detector,
    FaceLandmarks,
    choose_landmarks,
    load_landmarks,
    rendered_landmarks_m,
    save_landmarks,
)
from pipeline.template.regions import is_template_body
from pipeline.template.registration import Registration, register_template
from pipeline.texture.bake import TexturedSurface, average_views, texels_to_texture
from pipeline.texture.settings import TextureSettings
from pipeline.texture.views import BakeView

SIZE_PX = 1024
MAX_FRAMES = 40
"""Frames of the mean, those that see the face most from in front."""

MIN_COSINE = 0.3
"""Mean cosine between the front of the head and the direction to the camera; frames below do not show the face."""


def register_person(
    body: Body,
    skinned: MeshArtifact,
    views: Sequence[BakeView],
    faces: FilmedFaces,
    make_detector: Callable[[], Detector],
    settings: TextureSettings,
    checkpoint: Path | None = None,
) -> Registration | None:
    """Return the template on the person; None for a body of a model file.

    Args:
        body: the fitted body in the A-pose.
        skinned: the person's mesh in the A-pose.
        views: training frames.
        faces: detected in training frames.
        make_detector: constructs the detector of face landmarks.
        settings: of the projection of frames.
        checkpoint: file of the landmarks, which an interrupted run of the same inputs need not find again; None: none.
    """
    if not is_template_body(body):
        return None
    if checkpoint is not None and checkpoint.exists():
        landmarks = load_landmarks(checkpoint)
    else:
        landmarks = find_landmarks(body, skinned, views, faces, make_detector, settings)
        if checkpoint is not None:
            save_landmarks(checkpoint, landmarks)
    return register_template(body, skinned.outside(), landmarks)


def find_landmarks(
    body: Body,
    skinned: MeshArtifact,
    views: Sequence[BakeView],
    faces: FilmedFaces,
    make_detector: Callable[[], Detector],
    settings: TextureSettings,
) -> FaceLandmarks | None:
    """Return the landmarks of the face on the person's surface, or None where no frame shows a plausible face."""
    mesh = skinned.mesh
    head = skinned.dense_skin_weights(len(body.joint_names)).numpy()[:, body.joint("Head")] > 0.5
    shell = Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[head[mesh.faces].all(axis=1)]))
    front = head & (mesh.vertex_normals()[:, 2] > 0.5)
    if not front.any() or len(shell.faces) == 0:
        return None
    cosines = np.array([float(view.view_cosine.numpy()[front].mean()) for view in views])
    order = np.argsort(-cosines, kind="stable")[:MAX_FRAMES]
    chosen = [views[k] for k in order if cosines[k] > MIN_COSINE]
    if not chosen:
        return None
    atlas = unwrap(shell, np.zeros(len(shell.faces), np.int32), SIZE_PX, settings.padding_px)
    texels = rasterize_texels(atlas, SIZE_PX)
    mean = average_views(chosen, TexturedSurface.from_arrays(shell.faces, atlas, texels), settings)
    with closing(make_detector()) as detector:
        rendered_m = rendered_landmarks_m(body, shell, atlas, texels_to_texture(mean.value(), texels), detector)
    return choose_landmarks(body, rendered_m, faces.on_surface(shell, body))
