"""Masks of a recording: matched by image name, else in order."""

import numpy as np
import pytest

from data_tools.convert.recording import mask_folder_reader
from data_tools.synthetic.scene.movie import write_video
from pipeline.capture.video import open_frame_source
from pipeline.core.errors import UserError
from pipeline.io.image import write_gray
from tests.data_tools.convert import sample_data


def test_masks_of_a_video_are_in_order(tmp_path):
    """Frames of a video have no names."""
    write_video(tmp_path / "walk.mp4", sample_data.pictures(6), 25.0)
    (tmp_path / "masks").mkdir()
    for k, mask in enumerate(sample_data.masks(6)):
        write_gray(tmp_path / "masks" / f"{k}.png", 255 * mask)
        (tmp_path / "masks" / f"._{k}.png").touch()  # metadata of macOS
    source = open_frame_source(tmp_path / "walk.mp4")
    read = mask_folder_reader(tmp_path / "masks", source)
    for k, mask in enumerate(sample_data.masks(6)):
        np.testing.assert_array_equal(read(k), 255 * mask)
    (tmp_path / "masks" / "5.png").unlink()
    with pytest.raises(UserError, match="5 masks for 6 images"):
        mask_folder_reader(tmp_path / "masks", source)
