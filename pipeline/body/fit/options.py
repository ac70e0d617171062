"""Options of a fit, and the parameters of the energy that follow from them."""

from dataclasses import dataclass, replace

from pipeline.body.fit.energy import EnergyParameters
from pipeline.body.settings import DEFAULT_SETTINGS, FitSettings


@dataclass(frozen=True)
class FitOptions:
    """What is known of person and camera, and the effort of the fit.

    height_m: known stature; None: the prior of the settings.
    focal_relative_std: standard deviation of the logarithm of the true focal length over the initial one; 0 fixes it.
    principal_point_relative_std: standard deviation of the principal point about the initial one, in focal lengths; 0
        fixes it.
    shared_frames: number of frames for the shared parameters.
    rounds: largest number of matchings of the silhouettes for the shared parameters.
    vertical_is_known: whether +Y of the camera's world is up; otherwise the vertical is estimated.
    hem: height of the hem of a skirt whose outline says little of the legs, as of `Body.height_on_legs_m`; None
        without one.
    """

    height_m: float | None = None
    focal_relative_std: float = FitSettings.initial_focal_std
    principal_point_relative_std: float = 0.0
    shared_frames: int = 48
    rounds: int = 8
    vertical_is_known: bool = True
    hem: float | None = None
    settings: FitSettings = DEFAULT_SETTINGS


def landmark_parameters(options: FitOptions) -> EnergyParameters:
    """Return the parameters of the first fit to landmarks: intrinsics and landmark offsets are fixed."""
    parameters = EnergyParameters.from_settings(options.settings)
    if options.height_m is None:
        return parameters
    return replace(parameters, height_m=options.height_m, height_std_m=options.settings.known_stature_std_m)


def free_parameters(options: FitOptions) -> EnergyParameters:
    """Return the parameters of the fit to landmarks in which all unknown shared parameters are free."""
    parameters = replace(landmark_parameters(options), free_landmark_offsets=True)
    if options.focal_relative_std > 0.0:
        parameters = replace(parameters, free_focal=True, log_focal_std=options.focal_relative_std)
    if options.principal_point_relative_std > 0.0:
        parameters = replace(
            parameters, free_principal_point=True, principal_point_std=options.principal_point_relative_std
        )
    return parameters


def shared_parameters(options: FitOptions) -> EnergyParameters:
    """Return the parameters of the fit to landmarks and silhouettes."""
    return with_silhouettes(free_parameters(options), options.settings)


def with_silhouettes(parameters: EnergyParameters, settings: FitSettings) -> EnergyParameters:
    """Return the parameters with less weight of the landmarks, whose errors are larger and correlated."""
    return replace(
        parameters,
        landmark_std_m=settings.silhouette_landmark_std_m,
        landmark_3d_std_m=settings.silhouette_landmark_3d_std_m,
    )
