"""Read a NeuMan scene (Jiang et al., ECCV 2022): a person filmed by a moving camera.

    images/                    undistorted images, named by number
    segmentations/             one mask per image with the same name, 0 on the person and 255 elsewhere
    sparse/                    COLMAP model
    smpl_output_optimized.pkl, smpl_output_romp.pkl
                               joblib: {1: {pose (n, 72), betas (n, 10)}}, rows by image number
    alignments.npy             {name: (4, 3)}: similarity, from homogeneous rows of SMPL's output to COLMAP's world
    train_split.txt, val_split.txt, test_split.txt
                               names of images, as written by NeuMan's training

Only the images and the model are required. The pipeline has one fixed camera: the poses written here are relative to
the camera, and the trajectory of the camera is not written.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from data_tools.convert.colmap import ColmapModel, find_colmap_model, read_colmap_model
from data_tools.convert.joblib_pickle import load_joblib
from data_tools.convert.recording import Recording, mask_folder_reader, require_image_size
from data_tools.convert.smpl_arrays import smpl_poses_from_arrays
from pipeline.capture.smpl_poses import SmplPoses
from pipeline.capture.user_files import CameraCalibration
from pipeline.capture.video import FrameSource, open_frame_source
from pipeline.core.errors import UserError
from pipeline.io.safe_pickle import load_npy

_POSES = ("smpl_output_optimized.pkl", "smpl_output_romp.pkl")
_SPLITS = {"train": "train_split.txt", "validation": "val_split.txt", "heldout": "test_split.txt"}


def is_neuman(folder: Path) -> bool:
    """Return whether the folder has images and a COLMAP model."""
    return find_colmap_model(folder) is not None and (folder / "images").is_dir()


def read_neuman(folder: Path) -> Recording:
    """Read one scene; images and masks are read on demand.

    Raises:
        UserError: an existing file cannot be read, or does not match the images.
    """
    model_folder = find_colmap_model(folder)
    if model_folder is None:
        raise UserError(f"{folder} has no COLMAP model in sparse/; supply a NeuMan scene")
    source, model = open_frame_source(folder), read_colmap_model(model_folder)
    poses_path = next((folder / name for name in _POSES if (folder / name).is_file()), None)
    masks = folder / "segmentations"
    has_poses = poses_path is not None and (folder / "alignments.npy").is_file()
    return Recording(
        source=source,
        read_mask=mask_folder_reader(masks, source, person_is_dark=True) if masks.is_dir() else None,
        camera=_require_single_camera(model, source, model_folder),
        split=_read_split(folder, source),
        poses=_read_poses(poses_path, folder / "alignments.npy", source, model) if poses_path and has_poses else None,
    )


def _require_single_camera(model: ColmapModel, source: FrameSource, path: Path) -> CameraCalibration:
    used = {model.cameras[camera_id] for camera_id in model.camera_id_of.values() if camera_id in model.cameras}
    if len(used) != 1:
        raise UserError(f"{path} has {len(used)} cameras for its images; supply a recording of one camera")
    one = used.pop()
    require_image_size(source, one.width, one.height, path)
    return one.camera


def _read_split(folder: Path, source: FrameSource) -> dict[str, list[int]] | None:
    if not all((folder / name).is_file() for name in _SPLITS.values()):
        return None
    frame_of_name = {image.name: index for index, image in enumerate(source.files)}
    split = {}
    for kind, name in _SPLITS.items():
        names = (folder / name).read_text(encoding="utf-8").split()
        if unknown := next((image_name for image_name in names if image_name not in frame_of_name), None):
            raise UserError(f"{folder / name} names {unknown}, which is not in images/; supply the matching images")
        split[kind] = [frame_of_name[image_name] for image_name in names]
    return split


def _read_poses(path: Path, alignments_path: Path, source: FrameSource, model: ColmapModel) -> SmplPoses:
    """Return the poses of the images that have a camera pose and an alignment."""
    people, alignments = load_joblib(path), load_npy(alignments_path)
    aligned = alignments.item() if alignments.shape == () and alignments.dtype == object else None
    person = next(iter(people.values())) if isinstance(people, dict) and len(people) == 1 else None
    if not isinstance(person, dict) or not isinstance(aligned, dict) or not {"pose", "betas"} <= set(person):
        raise UserError(
            f"{path} or {alignments_path} does not hold the poses of one person in NeuMan's format; replace it"
        )
    frames = [
        (index, image)
        for index, image in enumerate(source.files)
        if image.name in aligned and image.name in model.world_to_camera and image.stem.isdigit()
    ]
    rows = [int(image.stem) for _, image in frames]
    if not rows or max(rows) >= min(len(person["pose"]), len(person["betas"])):
        raise UserError(
            f"{path} has poses of {len(person['pose'])} images, which do not match {source.path}; replace it"
        )
    arrays = {name: np.array([np.reshape(person[name][row], -1) for row in rows]) for name in ("pose", "betas")}
    arrays["transl"] = np.zeros((len(rows), 3))
    smpl_to_camera = np.stack(
        [_smpl_to_camera(model.world_to_camera[image.name], np.asarray(aligned[image.name])) for _, image in frames]
    )
    return smpl_poses_from_arrays(arrays, np.array([index for index, _ in frames]), smpl_to_camera, "neutral", path)


def _smpl_to_camera(
    world_to_camera: Float[np.ndarray, "4 4"], alignment: Float[np.ndarray, "4 3"]
) -> Float[np.ndarray, "4 4"]:
    """Return the rigid transform from SMPL's output (metres) to the camera, without the scale of the alignment."""
    matrix = np.eye(4)
    matrix[:3] = world_to_camera[:3, :3] @ alignment.T
    matrix[:3, 3] += world_to_camera[:3, 3]
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    matrix[:3] /= scale
    return matrix
