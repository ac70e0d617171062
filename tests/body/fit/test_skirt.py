"""A skirt that stands off the legs: its outline says little of them, once its hem is known."""

import cv2
import numpy as np
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.fit import fit_body
from pipeline.body.fit.linear_body import ACTIVE_JOINTS
from pipeline.body.fit.options import FitOptions
from pipeline.body.fit.silhouette_icp import crop_mask_window, match_silhouettes, skirt_faces
from pipeline.geometry.camera import project
from pipeline.geometry.mesh import Mesh
from tests.body.acting import SyntheticRecording, synthetic_recording

FRAMES, HEM = 12, 1.0
WAIST_M, HEM_M = 0.18, 0.34
"""Radii of the skirt."""


def masks_with_skirt(scene: SyntheticRecording) -> list[np.ndarray]:
    """The masks with a cone that hangs vertically from the hips to the knees."""
    angle = torch.linspace(0.0, 2.0 * np.pi, 40, dtype=torch.float64)
    circle = torch.stack([torch.cos(angle), torch.zeros(40, dtype=torch.float64), torch.sin(angle)], dim=1)
    masks = scene.masks()
    legs = [[ACTIVE_JOINTS.index(side + name) for side in ("Left", "Right")] for name in ("UpLeg", "Leg")]
    for mask, joints_m in zip(masks, scene.joints_m(), strict=True):
        hips_m, knees_m = (joints_m[pair].mean(dim=0) for pair in legs)
        hem_m = torch.stack([hips_m[0], knees_m[1], hips_m[2]])
        rim_m = torch.cat([hips_m + WAIST_M * circle, hem_m + HEM_M * circle])
        outline = cv2.convexHull(project(rim_m, scene.camera)[0].round().int().numpy())
        cv2.fillConvexPoly(mask, outline, 255)
    return masks


def test_legs_below_a_skirt_keep_their_girth() -> None:
    scene = synthetic_recording(load_anny(), FRAMES)
    windows = [crop_mask_window(mask) for mask in masks_with_skirt(scene)]
    hidden = scene.model.faces[torch.from_numpy(skirt_faces(scene.model, scene.state, HEM))].long().unique()
    true = scene.model.at_shape(scene.state.shape)
    mesh = Mesh(true.vertices_m.float().numpy(), true.faces.numpy())
    normals, outwards_m = mesh.vertex_normals()[hidden.numpy()], []
    for hem in (None, HEM):
        options = FitOptions(scene.model.height_m()[0], 0.0, shared_frames=FRAMES, rounds=3, hem=hem)
        result = fit_body(load_anny(), scene.observations(scene.camera), windows, options)
        moved_m = result.body.vertices[hidden.numpy()] - mesh.vertices[hidden.numpy()]
        outwards_m.append(float((moved_m * normals).sum(axis=1).mean()))
    assert outwards_m[0] > 0.012
    assert abs(outwards_m[1]) < 0.006


def test_a_skirt_hides_hips_and_thighs_alone() -> None:
    scene = synthetic_recording(load_anny(), 2)
    posed = scene.model.at_shape(scene.state.shape)
    hidden = skirt_faces(scene.model, scene.state, HEM)
    joint = scene.model.skin_weights.argmax(1)[scene.model.faces[:, 0].long()].numpy()
    names = {ACTIVE_JOINTS[k] for k in np.unique(joint[hidden])}
    assert {"Hips", "LeftUpLeg", "RightUpLeg"} <= names
    assert not names & {"Head", "LeftHand", "LeftForeArm", "LeftFoot", "RightFoot"}
    knees_m = posed.joints_m[ACTIVE_JOINTS.index("LeftLeg"), 1]
    corners_m = posed.vertices_m[scene.model.faces[:, 0].long(), 1].numpy()
    assert corners_m[hidden].min() > float(knees_m) - 0.001


def test_the_outline_of_a_skirt_has_no_weight_and_legs_beyond_it_have_all() -> None:
    scene = synthetic_recording(load_anny(), 2)
    wide = [crop_mask_window(mask) for mask in masks_with_skirt(scene)]
    narrow = [crop_mask_window(cv2.erode(mask, np.ones((5, 5), np.uint8))) for mask in scene.masks()]
    of_skirt, hidden = skirt_faces(scene.model, scene.state, HEM), torch.ones(len(scene.model.vertices_m)).bool()
    hidden[scene.model.faces[torch.from_numpy(~of_skirt)].long().flatten()] = False
    for windows, is_wide in ((wide, True), (narrow, False)):
        found = []
        for hem in (None, HEM):
            contour, _ = match_silhouettes(scene.model, scene.state, scene.observations(scene.camera), windows, hem)
            found.append(float(contour.weight[hidden[contour.corners].all(-1)].sum()))
        assert found[0] > 5.0
        assert (found[1] < 0.02 * found[0]) if is_wide else (found[1] > 0.95 * found[0])
