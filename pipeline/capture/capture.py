"""The artifact of the `frames` stage, with the one writer and the one reader that all stages use."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.capture.frame_selection import INTERLEAVED_RULE
from pipeline.capture.hand_detector import HandLandmarks
from pipeline.capture.smpl_poses import SMPL_POSES_NPZ, SmplPoses, load_smpl_poses, save_smpl_poses
from pipeline.geometry.camera import DEFAULT_WORLD_TO_CAMERA, Camera
from pipeline.io.image import read_gray, read_rgb, to_float
from pipeline.io.npz import load_npz, save_npz

FRAMES_NPZ, IMAGES_FOLDER, MASKS_FOLDER, CONTACT_SHEET = "frames.npz", "images", "masks", "contact.jpg"
_INTRINSICS = ("camera_fx", "camera_fy", "camera_cx", "camera_cy")


@dataclass(frozen=True)
class Capture:
    """The selected frames of a recording: n frames of one size, undistorted.

    frame_index: index in the recording. time_s: since the first frame of the recording.
    split: 0 train, 1 validation, 2 held out (`pipeline.capture.frame_selection.assign_splits`,
        `pipeline.capture.disjoint_split`, or user-supplied).
    split_rule: how they were split, in words.
    landmarks_px: MediaPipe's 33 landmarks, pixel centres at +0.5; nan where unknown. Visibility in [0, 1],
        nan where unknown.
    landmarks_world_m: relative to the centre of the hips, in camera axes; nan where unknown.
    camera: user-supplied camera for these images; None if unknown.
    scale: size of these images relative to the recording.
    metadata_focal_px: focal length for these images from the metadata of the recording; None if there is none.
    hands: landmarks of both hands in every frame; None if they were not detected.
    faces_px: MediaPipe's face mesh in every frame, pixels and depth in pixels (`pipeline.capture.face_detector`); nan
        without a face; None if faces were not detected.
    smpl_poses: user-supplied SMPL poses of some of these frames; None without.
    camera_pose_is_known: whether the user supplied the pose of the camera, in a world whose +Y is up.
    """

    folder: Path
    frame_index: Int[np.ndarray, "n"]
    time_s: Float[np.ndarray, "n"]
    split: UInt8[np.ndarray, "n"]
    fps: float
    width: int
    height: int
    landmarks_px: Float[np.ndarray, "n 33 2"]
    landmarks_visibility: Float[np.ndarray, "n 33"]
    landmarks_world_m: Float[np.ndarray, "n 33 3"]
    camera: Camera | None
    mask_source: str
    n_video_frames: int
    scale: float
    metadata_focal_px: float | None = None
    hands: HandLandmarks | None = None
    faces_px: Float[np.ndarray, "n 478 3"] | None = None
    smpl_poses: SmplPoses | None = None
    split_rule: str = INTERLEAVED_RULE
    camera_pose_is_known: bool = False

    def __len__(self) -> int:
        return len(self.frame_index)

    def positions(self, split: int | np.integer) -> Int[np.ndarray, "k"]:
        """Return the positions (0..n-1) of the frames of one split."""
        return np.flatnonzero(self.split == split)

    def image(self, position: int | np.integer) -> Float[np.ndarray, "h w 3"]:
        """Read the image at a position (not an index of the recording), sRGB in [0, 1]."""
        return to_float(read_rgb(image_path(self.folder, self.frame_index[position])))

    def mask(self, position: int | np.integer) -> Float[np.ndarray, "h w"]:
        """Read the alpha matte of the person at a position, in [0, 1]."""
        return to_float(read_gray(mask_path(self.folder, self.frame_index[position])))


def image_path(folder: Path, frame_index: int | np.integer) -> Path:
    """Return the path of an image by its index in the recording."""
    return folder / IMAGES_FOLDER / f"{frame_index:06d}.png"


def mask_path(folder: Path, frame_index: int | np.integer) -> Path:
    """Return the path of a mask by its index in the recording."""
    return folder / MASKS_FOLDER / f"{frame_index:06d}.png"


def save_capture(capture: Capture) -> None:
    """Write `frames.npz`, and `smpl_poses.npz` if there are poses, into the folder of the capture.

    Images and masks are written separately, while they are computed.
    """
    camera = capture.camera
    intrinsics = camera.intrinsics_px if camera else (np.nan,) * 4
    arrays: dict[str, np.ndarray] = {
        "frame_index": capture.frame_index.astype(np.int32),
        "time_s": capture.time_s.astype(np.float64),
        "split": capture.split,
        "split_rule": np.array(capture.split_rule),
        "fps": np.array(capture.fps),
        "width": np.array(capture.width, dtype=np.int32),
        "height": np.array(capture.height, dtype=np.int32),
        "landmarks_px": capture.landmarks_px.astype(np.float32),
        "landmarks_visibility": capture.landmarks_visibility.astype(np.float32),
        "landmarks_world_m": capture.landmarks_world_m.astype(np.float32),
        "camera_world_to_camera": camera.world_to_camera if camera else DEFAULT_WORLD_TO_CAMERA,
        "camera_pose_is_known": np.array(capture.camera_pose_is_known),
        "mask_source": np.array(capture.mask_source),
        "n_video_frames": np.array(capture.n_video_frames, dtype=np.int32),
        "scale": np.array(capture.scale),
        "metadata_focal_px": np.array(np.nan if capture.metadata_focal_px is None else capture.metadata_focal_px),
    }
    for name, value in zip(_INTRINSICS, intrinsics, strict=True):
        arrays[name] = np.array(value)
    if capture.hands is not None:
        arrays |= {f"hands_{name}": value for name, value in vars(capture.hands).items()}
    if capture.faces_px is not None:
        arrays["faces_px"] = capture.faces_px.astype(np.float32)
    save_npz(capture.folder / FRAMES_NPZ, arrays)
    if capture.smpl_poses is not None:
        save_smpl_poses(capture.folder / SMPL_POSES_NPZ, capture.smpl_poses)


def load_capture(frames_dir: Path) -> Capture:
    """Read the artifact of the `frames` stage; images and masks are read on access.

    Raises:
        UserError: the folder holds no readable `frames.npz`.
    """
    arrays = load_npz(frames_dir / FRAMES_NPZ)
    poses_path = frames_dir / SMPL_POSES_NPZ
    return Capture(
        folder=frames_dir,
        frame_index=arrays["frame_index"],
        time_s=arrays["time_s"],
        split=arrays["split"],
        fps=float(arrays["fps"].item()),
        width=int(arrays["width"].item()),
        height=int(arrays["height"].item()),
        landmarks_px=arrays["landmarks_px"],
        landmarks_visibility=arrays["landmarks_visibility"],
        landmarks_world_m=arrays["landmarks_world_m"],
        camera=_camera(arrays),
        mask_source=str(arrays["mask_source"].item()),
        n_video_frames=int(arrays["n_video_frames"].item()),
        scale=float(arrays["scale"].item()),
        metadata_focal_px=_metadata_focal_px(arrays),
        hands=_hands(arrays),
        faces_px=arrays.get("faces_px"),
        smpl_poses=load_smpl_poses(poses_path) if poses_path.is_file() else None,
        split_rule=str(arrays["split_rule"].item()) if "split_rule" in arrays else INTERLEAVED_RULE,
        camera_pose_is_known=bool(np.ravel(arrays.get("camera_pose_is_known", False))[0]),
    )


def _metadata_focal_px(arrays: Mapping[str, np.ndarray]) -> float | None:
    found = float(np.ravel(arrays.get("metadata_focal_px", np.nan))[0])
    return found if np.isfinite(found) else None


def _hands(arrays: Mapping[str, np.ndarray]) -> HandLandmarks | None:
    names = [field.name for field in fields(HandLandmarks)]
    if any(f"hands_{name}" not in arrays for name in names):
        return None
    return HandLandmarks(*(arrays[f"hands_{name}"] for name in names))


def _camera(arrays: Mapping[str, np.ndarray]) -> Camera | None:
    fx, fy, cx, cy = (float(arrays[name].item()) for name in _INTRINSICS)
    if not np.isfinite([fx, fy, cx, cy]).all():
        return None
    width, height = int(arrays["width"].item()), int(arrays["height"].item())
    return Camera(fx, fy, cx, cy, width, height, arrays["camera_world_to_camera"])
