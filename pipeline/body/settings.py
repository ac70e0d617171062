"""Constants of the body fit that were fixed by measurement.

Users do not set them; sweeps and ablations do: `stages.body.run(..., settings=replace(FitSettings(), pose_rounds=6))`.
Figures are from docs/decisions/body.md: joint errors with the hips aligned / absolute.
"""

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class FitSettings:
    """Settings of the fit that are no options. Standard deviations in metres are at the depth of the person.

    Raises:
        ValueError: a setting is outside its range, or two settings contradict each other; the message names them.

    Attributes:
        initial_focal_ratio: focal length at the start if nothing is known, over the longer image side.
        initial_focal_std: standard deviation of the logarithm of that focal length.
        exif_focal_std: the same for a focal length from the metadata of the recording.
        principal_point_std_ratio: standard deviation of an unknown principal point about the image centre, over the
            longer image side; 0 fixes it there. Images tell it to 8 % only: with 0.05 it strayed by 1 to 3 % on
            uncropped turns, and took the focal length along (docs/decisions/body.md).
        landmark_steps: Levenberg-Marquardt steps of a fit to landmarks alone.
        silhouette_steps: the same between two matchings of the silhouettes.
        pose_rounds: matchings of the silhouettes in the fit of all poses. Three more: 16.2 -> 15.8 mm.
        landmark_std_m, landmark_3d_std_m: standard deviation of a landmark in the image and in 3D, before silhouettes
            are used.
        silhouette_landmark_std_m, silhouette_landmark_3d_std_m: the same with silhouettes. 3D, turn / walk: 0.2 m
            28.2 / 64.6 mm, 0.4 m 20.4 / 55.9 mm, 1 m 20.0 / 63.8 mm.
        hand_std_m, fitted_hand_std_m: standard deviation of the hand landmarks before and after the shape is fitted.
        face_std_m, fitted_face_std_m: the same for the landmarks of the face detector.
        landmark_cutoff: cutoff of the robust landmark terms, standard deviations.
        contour_std_m, contour_cutoff: standard deviation and cutoff of the silhouette term.
        motion_cutoff: cutoff of the motion prior, standard deviations.
        landmark_offset_std_m: standard deviation of the landmark positions on the body.
        mean_stature_m, mean_stature_std_m: prior of the stature if it is not known. A loose prior let it sink to
            1.56 m.
        known_stature_std_m: standard deviation of a known stature.
        camera_tilt_std_deg: standard deviation of pitch and roll of a camera about level, before anything is seen.
            Cameras look down by up to 15 degrees, and a turn determines the vertical to 1.5 degrees.
        body_axis_std_deg: standard deviation of the mean axis of the body over a turn from the vertical.
        stature_spread_m: standard deviation of the stature of adults, reported as the uncertainty of an unknown one.
    """

    initial_focal_ratio: float = 1.2
    initial_focal_std: float = 0.5
    exif_focal_std: float = 0.1
    principal_point_std_ratio: float = 0.01
    landmark_steps: int = 12
    silhouette_steps: int = 3
    pose_rounds: int = 3
    landmark_std_m: float = 0.025
    landmark_3d_std_m: float = 0.08
    silhouette_landmark_std_m: float = 0.06
    silhouette_landmark_3d_std_m: float = 0.4
    hand_std_m: float = 0.060
    fitted_hand_std_m: float = 0.012
    face_std_m: float = 0.15
    fitted_face_std_m: float = 0.008
    landmark_cutoff: float = 3.0
    contour_std_m: float = 0.010
    contour_cutoff: float = 4.0
    motion_cutoff: float = 4.0
    landmark_offset_std_m: float = 0.012
    mean_stature_m: float = 1.70
    mean_stature_std_m: float = 0.02
    known_stature_std_m: float = 0.005
    stature_spread_m: float = 0.09
    camera_tilt_std_deg: float = 10.0
    body_axis_std_deg: float = 0.7

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (value >= 0 if field.name == "principal_point_std_ratio" else value > 0):
                raise ValueError(f"{field.name} = {value} must be above 0")
        for loose, tight in (
            ("initial_focal_std", "exif_focal_std"),
            ("hand_std_m", "fitted_hand_std_m"),
            ("face_std_m", "fitted_face_std_m"),
            ("mean_stature_std_m", "known_stature_std_m"),
        ):
            if getattr(self, tight) > getattr(self, loose):
                raise ValueError(
                    f"{tight} = {getattr(self, tight)} must be at most {loose} = {getattr(self, loose)}: it is the "
                    "standard deviation of the better known value"
                )


DEFAULT_SETTINGS = FitSettings()
