"""A folder of pictures whose masks lie in a folder beside them, or in the pictures' own alpha channel.

    images/, frames/, ... or the folder itself   the pictures
    masks/, mask/, matte/, ...                   as many masks, named as the pictures are or in the same order, the
                                                 person bright

`camera.json`, `split.json` and `landmarks.npz` in the form of `pipeline.capture.user_files` are carried over. A folder
that has `masks/`, or pictures with alpha, needs no conversion.
"""

from pathlib import Path

from data_tools.convert.recording import Recording, mask_folder_reader
from pipeline.capture.video import open_frame_source
from pipeline.core.errors import UserError
from pipeline.io.image import read_alpha

_MASK_FOLDERS = ("masks", "mask", "mattes", "matte", "alpha", "segmentations", "segmentation")
_FILES_TO_COPY = ("camera.json", "split.json", "landmarks.npz")


def is_image_folder(folder: Path) -> bool:
    """True for a folder of pictures with one of the mask folders, or whose first picture is partly transparent."""
    source = open_frame_source(folder)
    return bool(source.files) and (_find_masks(folder) is not None or bool(read_alpha(source.files[0]).min() < 255))


def read_image_folder(folder: Path) -> Recording:
    """Look at the folder; pictures and masks are read later.

    Raises:
        UserError: there are no pictures, no masks, or not as many of both.
    """
    source, masks = open_frame_source(folder), _find_masks(folder)
    if not is_image_folder(folder):
        raise UserError(
            f"{folder} has no masks beside its pictures and no alpha in them; the pipeline takes it as it is"
        )
    return Recording(
        source=source,
        read_mask=mask_folder_reader(masks, source) if masks else lambda index: read_alpha(source.files[index]),
        files_to_copy=tuple(folder / name for name in _FILES_TO_COPY if (folder / name).is_file()),
    )


def _find_masks(folder: Path) -> Path | None:
    return next((folder / name for name in _MASK_FOLDERS if (folder / name).is_dir()), None)
