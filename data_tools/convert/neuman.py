"""NeuMan's scenes (Jiang et al. 2022): a person in front of a camera that moves.

    images/                    undistorted pictures, named by their number
    segmentations/             as many masks under the same names, 0 on the person and 255 around
    sparse/                    COLMAP's model
    smpl_output_optimized.pkl, smpl_output_romp.pkl
                               joblib: {1: {pose (n, 72), betas (n, 10)}}, rows by the picture's number
    alignments.npy             {name: (4, 3)}: row vectors of SMPL's output, with a 1, to COLMAP's world, with a scale
    train_split.txt, val_split.txt, test_split.txt
                               names of pictures, as NeuMan's training writes them

All but the pictures and the model may be absent. The pipeline knows one fixed camera: the person's motion relative to
the camera is what it sees and what the poses here are, so the camera's own path is not written.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from data_tools.convert.colmap import ColmapModel, find_colmap_model, read_colmap_model
from data_tools.convert.joblib_pickle import load_joblib
from data_tools.convert.recording import Recording, mask_folder_reader, require_image_size
from data_tools.convert.smpl_rows import smpl_rows
from pipeline.capture.smpl_poses import SmplPoses
from pipeline.capture.user_files import CameraCalibration
from pipeline.capture.video import FrameSource, open_frame_source
from pipeline.core.errors import UserError
from pipeline.io.safe_pickle import load_npy

_POSES = ("smpl_output_optimized.pkl", "smpl_output_romp.pkl")
_SPLITS = {"train": "train_split.txt", "validation": "val_split.txt", "heldout": "test_split.txt"}


def is_neuman(folder: Path) -> bool:
    """True for a folder with pictures and a COLMAP model."""
    return find_colmap_model(folder) is not None and (folder / "images").is_dir()


def read_neuman(folder: Path) -> Recording:
    """Look at one scene; pictures and masks are read later.

    Raises:
        UserError: a file that is there cannot be read or does not fit the pictures.
    """
    model_folder = find_colmap_model(folder)
    if model_folder is None:
        raise UserError(f"{folder} has no COLMAP model in sparse/; give a scene of NeuMan")
    source, model = open_frame_source(folder), read_colmap_model(model_folder)
    poses_path = next((folder / name for name in _POSES if (folder / name).is_file()), None)
    has_poses = poses_path is not None and (folder / "alignments.npy").is_file()
    return Recording(
        source=source,
        read_mask=_mask_reader(folder / "segmentations", source) if (folder / "segmentations").is_dir() else None,
        camera=_require_single_camera(model, source, model_folder),
        split=_read_split(folder, source),
        poses=_read_poses(poses_path, folder / "alignments.npy", source, model) if poses_path and has_poses else None,
    )


def _require_single_camera(model: ColmapModel, source: FrameSource, path: Path) -> CameraCalibration:
    used = {model.cameras[number] for number in model.camera_id_of.values() if number in model.cameras}
    if len(used) != 1:
        raise UserError(f"{path} has {len(used)} different cameras for its pictures; give a recording of one camera")
    one = used.pop()
    require_image_size(source, one.width, one.height, path)
    return one.camera


def _mask_reader(folder: Path, source: FrameSource) -> Callable[[int], UInt8[np.ndarray, "h w"]]:
    read_background_mask = mask_folder_reader(folder, source)
    return lambda index: 255 - read_background_mask(index)


def _read_split(folder: Path, source: FrameSource) -> dict[str, list[int]] | None:
    if not all((folder / name).is_file() for name in _SPLITS.values()):
        return None
    frame_of_name = {image.name: index for index, image in enumerate(source.files)}
    split = {}
    for kind, name in _SPLITS.items():
        names = (folder / name).read_text(encoding="utf-8").split()
        if unknown := next((word for word in names if word not in frame_of_name), None):
            raise UserError(f"{folder / name} names {unknown}, which is not in images/; give the pictures it is for")
        split[kind] = [frame_of_name[word] for word in names]
    return split


def _read_poses(path: Path, alignments_path: Path, source: FrameSource, model: ColmapModel) -> SmplPoses:
    """The poses of the pictures that have a camera pose and an alignment."""
    people, alignments = load_joblib(path), load_npy(alignments_path)
    aligned = alignments.item() if alignments.shape == () and alignments.dtype == object else None
    person = next(iter(people.values())) if isinstance(people, dict) and len(people) == 1 else None
    if not isinstance(person, dict) or not isinstance(aligned, dict) or not {"pose", "betas"} <= set(person):
        raise UserError(f"{path} or {alignments_path} does not hold one person's poses in NeuMan's form; replace it")
    frames = [
        (index, image)
        for index, image in enumerate(source.files)
        if image.name in aligned and image.name in model.world_to_camera and image.stem.isdigit()
    ]
    rows = [int(image.stem) for _, image in frames]
    if not rows or max(rows) >= min(len(person["pose"]), len(person["betas"])):
        raise UserError(f"{path} has poses of {len(person['pose'])} pictures, not of {source.path}; replace it")
    arrays = {name: np.array([np.reshape(person[name][row], -1) for row in rows]) for name in ("pose", "betas")}
    arrays["transl"] = np.zeros((len(rows), 3))
    smpl_to_camera = np.stack(
        [_smpl_to_camera(model.world_to_camera[image.name], np.asarray(aligned[image.name])) for _, image in frames]
    )
    return smpl_rows(arrays, np.array([index for index, _ in frames]), smpl_to_camera, "neutral", path)


def _smpl_to_camera(
    world_to_camera: Float[np.ndarray, "4 4"], alignment: Float[np.ndarray, "4 3"]
) -> Float[np.ndarray, "4 4"]:
    """From SMPL's output to camera axes; divided by the alignment's scale, a rigid motion in SMPL's metres."""
    matrix = np.eye(4)
    matrix[:3] = world_to_camera[:3, :3] @ alignment.T
    matrix[:3, 3] += world_to_camera[:3, 3]
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    matrix[:3] /= scale
    return matrix
