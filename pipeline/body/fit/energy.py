"""The energy that the fit minimises: a sum of terms (`pipeline.body.fit.terms`) over one set of unknowns."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.body.fit.camera_parameters import INTRINSICS_COUNT, apply_intrinsics_delta
from pipeline.body.fit.detections.landmarks_3d import Landmark3dTerm
from pipeline.body.fit.ground_contact import Contact
from pipeline.body.fit.landmark_regressor import (
    FACE_MESH_START,
    LANDMARK_OFFSET_COUNT,
    POSE_LANDMARK_COUNT,
    LandmarkRegressor,
    landmark_std_ratio,
)
from pipeline.body.fit.levenberg_marquardt import NormalEquations
from pipeline.body.fit.linear_body import LinearBody
from pipeline.body.fit.posed_points import Contour, pose_points, pose_skeleton
from pipeline.body.fit.prior.posture import Posture, estimate_posture
from pipeline.body.fit.prior.priors import PosePrior, ShapePrior
from pipeline.body.fit.root_placement import world_to_perspective
from pipeline.body.fit.state import FitState, Observations
from pipeline.body.fit.terms import (
    ContactTerm,
    EnergyTerm,
    LandmarkTerm,
    Linearisation,
    MotionTerm,
    PosePriorTerm,
    SharedPriorTerm,
    SilhouetteTerm,
)
from pipeline.body.settings import FitSettings
from pipeline.geometry.camera import Camera
from pipeline.kernels.common.thread_pool import shared_thread_pool

FRAMES_PER_CHUNK = 16
"""Frames whose image terms are evaluated together: the largest of their arrays (2 MB) stays in the cache of a core,
and they do not grow with the recording. On any machine the same, so that sums have the same order."""

VERTICAL_PRINCIPAL_POINT_RATIO = 0.2
"""Standard deviation of the principal point down the image over the one across it. A pitch of the camera shows the same
picture to first order, and is estimated from more (`pipeline.body.fit.vertical.gravity`)."""


@dataclass(frozen=True)
class EnergyParameters:
    """Standard deviations and cutoffs of the terms, and which shared parameters are free.

    Standard deviations in metres are measured at the depth of the person; cutoffs are in standard deviations.

    landmark_std_m, hand_std_m, face_std_m: of the landmarks of pose, hands and face in the image.
    single_landmark_std_m: of one pose landmark by itself, for what a frame shows (`Objective.image_hessian`); with
    silhouettes `landmark_std_m` is larger, because the errors of landmarks are correlated.
    landmark_3d_std_m: of the detected 3D landmarks across the view.
    contour_std_m: of the silhouette.
    height_m, height_std_m: prior of the stature.
    log_focal_std: of the logarithm of the focal length.
    principal_point_std: across the image, in focal lengths.
    """

    landmark_std_m: float = FitSettings.landmark_std_m
    hand_std_m: float = FitSettings.hand_std_m
    face_std_m: float = FitSettings.face_std_m
    single_landmark_std_m: float = FitSettings.landmark_std_m
    landmark_cutoff: float = FitSettings.landmark_cutoff
    landmark_3d_std_m: float = FitSettings.landmark_3d_std_m
    contour_std_m: float = FitSettings.contour_std_m
    contour_cutoff: float = FitSettings.contour_cutoff
    motion_cutoff: float = FitSettings.motion_cutoff
    landmark_offset_std_m: float = FitSettings.landmark_offset_std_m
    height_m: float = FitSettings.mean_stature_m
    height_std_m: float = FitSettings.mean_stature_std_m
    log_focal_std: float = FitSettings.initial_focal_std
    principal_point_std: float = 0.05
    free_shape: bool = True
    free_landmark_offsets: bool = False
    free_focal: bool = False
    free_principal_point: bool = False

    @staticmethod
    def from_settings(settings: FitSettings) -> "EnergyParameters":
        """Return the parameters of a fit to landmarks alone, with an unknown stature."""
        return EnergyParameters(
            landmark_std_m=settings.landmark_std_m,
            hand_std_m=settings.hand_std_m,
            face_std_m=settings.face_std_m,
            single_landmark_std_m=settings.landmark_std_m,
            landmark_cutoff=settings.landmark_cutoff,
            landmark_3d_std_m=settings.landmark_3d_std_m,
            contour_std_m=settings.contour_std_m,
            contour_cutoff=settings.contour_cutoff,
            motion_cutoff=settings.motion_cutoff,
            landmark_offset_std_m=settings.landmark_offset_std_m,
            height_m=settings.mean_stature_m,
            height_std_m=settings.mean_stature_std_m,
        )

    def landmark_stds_m(self) -> Float[Tensor, "l"]:
        """Return the standard deviation of each landmark in the image, metres at the depth of the person."""
        std_m = self.landmark_std_m * landmark_std_ratio()
        std_m[POSE_LANDMARK_COUNT:FACE_MESH_START] = self.hand_std_m
        std_m[FACE_MESH_START:] = self.face_std_m
        return std_m

    def has_free_shared_parameters(self) -> bool:
        """Return whether any shared parameter is free."""
        return self.free_shape or self.free_landmark_offsets or self.free_focal or self.free_principal_point


@dataclass(frozen=True)
class Objective:
    """The energy of a recording, callable with a state.

    px_per_m: image scale at the person in each frame (`compute_px_per_m`), constant during a minimisation.
    motion_std: standard deviations of `motion_residuals`; None: `default_motion_std`, which admits fast motion.
    contact: needs fixed shared parameters.
    """

    model: LinearBody
    regressor: LandmarkRegressor
    pose_prior: PosePrior
    shape_prior: ShapePrior
    observations: Observations
    parameters: EnergyParameters
    px_per_m: Float[Tensor, "n"]
    contour: Contour | None = None
    motion_std: Float[Tensor, "p"] | None = None
    contact: Contact | None = None

    def __call__(self, state: FitState) -> NormalEquations:
        """Return the normal equations of all terms at a state."""
        linearisation = self._linearise(state)
        frame_count, joint_count = state.rotations.shape[:2]
        shape_count = len(state.shape)
        shared_count = shape_count + LANDMARK_OFFSET_COUNT + INTRINSICS_COUNT if linearisation.has_shared else 0
        system = NormalEquations.zeros(frame_count, 3 * joint_count + 3, shared_count)
        self._add_image_terms(system, linearisation, self.parameters)
        for term in self._prior_terms():
            term.add_to(system, linearisation)
        if shared_count:
            system.fix_parameters(self._free_shared_mask(shape_count))
        return system

    def image_hessian(self, prior: PosePrior, state: FitState) -> Float[Tensor, "n p p"]:
        """Return the Gauss-Newton Hessian of landmarks, silhouettes and a pose prior by the pose of each frame."""
        frame_count, joint_count = state.rotations.shape[:2]
        system = NormalEquations.zeros(frame_count, 3 * joint_count + 3, 0)
        linearisation = replace(self._linearise(state), has_shared=False)
        parameters = replace(self.parameters, landmark_std_m=self.parameters.single_landmark_std_m)
        replace(self, contact=None)._add_image_terms(system, linearisation, parameters)
        PosePriorTerm(prior).add_to(system, linearisation)
        return system.frame_hessian

    def estimate_posture(self, prior: PosePrior, state: FitState) -> Posture | None:
        """Return the posture of a fitted state, see `estimate_posture`; prior: that of anyone."""
        return estimate_posture(prior, state.rotations, self.observations.time_s, self.image_hessian(prior, state))

    def retract(self, state: FitState, frame_step: Tensor, shared_step: Tensor) -> FitState:
        """Return the state after a step, with its shape clamped to the range of the shape prior."""
        updated = state.retract(frame_step, shared_step, self.observations.camera)
        return replace(updated, shape=updated.shape.clamp(self.shape_prior.lower_bound, self.shape_prior.upper_bound))

    def _linearise(self, state: FitState) -> Linearisation:
        model = self.model.at_shape(state.shape)
        skeleton = pose_skeleton(model, state.rotations, state.root_m)
        landmarks = pose_points(model, skeleton, self.regressor.points(model, state.landmark_offsets_m))
        has_shared = self.parameters.has_free_shared_parameters()
        return Linearisation(state, self.observations.camera, model, skeleton, landmarks, has_shared)

    def _add_image_terms(self, system: NormalEquations, at: Linearisation, parameters: EnergyParameters) -> None:
        """Add the terms of single frames: chunks of frames side by side, summed in their order."""
        all_frames_3d = Landmark3dTerm.fitted_to(
            self.observations, parameters.landmark_3d_std_m, parameters.landmark_cutoff, at
        )
        frame_count, parameter_count, shared_count = system.border.shape
        chunks = [slice(start, start + FRAMES_PER_CHUNK) for start in range(0, frame_count, FRAMES_PER_CHUNK)]

        def evaluate(rows: slice) -> NormalEquations:
            here = at.select(rows)
            part = NormalEquations.zeros(len(here.state.root_m), parameter_count, shared_count)
            landmarks_3d = replace(all_frames_3d, observations=all_frames_3d.observations.select(rows))
            for term in (landmarks_3d, *self._image_terms(parameters, rows)):
                term.add_to(part, here)
            return part

        for rows, part in zip(chunks, shared_thread_pool(torch.get_num_threads()).map(evaluate, chunks), strict=True):
            system.add_frames(rows, part)

    def _prior_terms(self) -> list[EnergyTerm]:
        """Return the terms that no image enters."""
        parameters, centre_std = self.parameters, self.parameters.principal_point_std
        return [
            PosePriorTerm(self.pose_prior),
            MotionTerm(self.observations.time_s, self.motion_std, parameters.motion_cutoff),
            SharedPriorTerm(
                self.shape_prior,
                parameters.landmark_offset_std_m,
                (centre_std, VERTICAL_PRINCIPAL_POINT_RATIO * centre_std, parameters.log_focal_std),
                parameters.height_m,
                parameters.height_std_m,
            ),
        ]

    def _image_terms(self, parameters: EnergyParameters, rows: slice) -> list[EnergyTerm]:
        """Return the terms of some frames but that of the 3D landmarks."""
        px_per_m, cutoff = self.px_per_m[rows], parameters.landmark_cutoff
        stds_m = parameters.landmark_stds_m()
        terms: list[EnergyTerm] = [LandmarkTerm(self.observations.select(rows), stds_m, px_per_m, cutoff)]
        if self.contour is not None:
            contour = self.contour.select(rows)
            terms.append(SilhouetteTerm(contour, parameters.contour_std_m, px_per_m, parameters.contour_cutoff))
        if self.contact is not None:
            terms.append(ContactTerm(self.contact.select(rows)))
        return terms

    def _free_shared_mask(self, shape_count: int) -> Bool[Tensor, "g"]:
        parameters = self.parameters
        free = torch.ones(shape_count + LANDMARK_OFFSET_COUNT + INTRINSICS_COUNT, dtype=torch.bool)
        free[:shape_count] = parameters.free_shape
        free[shape_count:-INTRINSICS_COUNT] = parameters.free_landmark_offsets
        free[-INTRINSICS_COUNT:-1], free[-1] = parameters.free_principal_point, parameters.free_focal
        return free


def compute_px_per_m(state: FitState, camera: Camera) -> Float[Tensor, "n"]:
    """Return the image scale at the depth of the root joint, pixels per metre."""
    return apply_intrinsics_delta(camera, state.intrinsics_delta).fx * torch.exp(
        -world_to_perspective(state.root_m, camera)[:, 2]
    )
