"""Read a folder of images with masks in a separate folder, or in the alpha channel.

    images/, frames/, ... or the folder itself   images
    masks/, mask/, matte/, ...                   one mask per image, with the same names or in the same order; the
                                                 person is bright

`camera.json`, `split.json`, `landmarks.npz` and `smpl_poses.npz` in the format of `pipeline.capture.user_files` are
copied. A folder with `masks/`, or with alpha in its images, needs no conversion.
"""

from pathlib import Path

from data_tools.convert.recording import Recording, mask_folder_reader
from pipeline.capture.smpl_poses import SMPL_POSES_NPZ
from pipeline.capture.video import open_frame_source
from pipeline.core.command import format_command
from pipeline.core.errors import UserError
from pipeline.io.image import read_alpha

_MASK_FOLDERS = ("masks", "mask", "mattes", "matte", "alpha", "segmentations", "segmentation")
_FILES_TO_COPY = ("camera.json", "split.json", "landmarks.npz", SMPL_POSES_NPZ)


def is_image_folder(folder: Path) -> bool:
    """Return whether a folder of images has a mask folder, or a transparent pixel in its first image."""
    source = open_frame_source(folder)
    return bool(source.files) and (_find_masks(folder) is not None or bool(read_alpha(source.files[0]).min() < 255))


def read_image_folder(folder: Path) -> Recording:
    """Read the structure of the folder; images and masks are read on demand.

    Raises:
        UserError: images or masks are missing, or their numbers differ.
    """
    source, masks = open_frame_source(folder), _find_masks(folder)
    if not is_image_folder(folder):
        raise UserError(
            f"{folder} has no mask folder and no alpha channel; it needs no conversion: {format_command(folder)}"
        )
    return Recording(
        source=source,
        read_mask=mask_folder_reader(masks, source) if masks else lambda index: read_alpha(source.files[index]),
        files_to_copy=tuple(folder / name for name in _FILES_TO_COPY if (folder / name).is_file()),
    )


def _find_masks(folder: Path) -> Path | None:
    return next((folder / name for name in _MASK_FOLDERS if (folder / name).is_dir()), None)
