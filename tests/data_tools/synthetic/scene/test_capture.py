"""The sample command: equal bytes for equal seeds, layout of the folders, and user errors."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from data_tools.command import run_command
from data_tools.sample import main
from data_tools.synthetic.person.person import make_person
from data_tools.synthetic.rig.subject import Subject, save_subject
from data_tools.synthetic.scene.capture import CAPTURE_VERSION, distance_to_middle_m, novel_cameras, portrait_camera
from data_tools.synthetic.scene.movie import write_video
from pipeline.body.files import load_camera, load_motion, save_body
from pipeline.capture.video import open_frame_source, read_frames
from pipeline.geometry.camera import DEFAULT_WORLD_TO_CAMERA, project
from pipeline.io.image import read_rgba
from pipeline.kernels.common.thread_pool import torch_threads
from tests.data_tools.conftest import SAMPLE_OPTIONS


def read_all_bytes(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_same_seed_same_bytes(sample: Path, tmp_path: Path) -> None:
    main([str(tmp_path / "again"), *SAMPLE_OPTIONS])
    first, second = read_all_bytes(sample), read_all_bytes(tmp_path / "again")
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []


@pytest.mark.parametrize("threads", [1, 2])
def test_the_number_of_threads_changes_no_byte(sample: Path, tmp_path: Path, threads: int) -> None:
    with torch_threads(threads):
        person, bare = make_person(0, texture_px=512)
    save_subject(tmp_path, person)
    save_body(tmp_path / "bare.npz", bare)
    for name in ("bare.npz", "clothed.npz", "labels.npz", "texture.png"):
        assert (tmp_path / name).read_bytes() == (sample / "truth" / name).read_bytes(), name


def test_layout(sample: Path) -> None:
    assert [path.name for path in (sample / "video").iterdir()] == ["video.mp4"]
    assert open_frame_source(sample / "video").n_frames == 6
    assert len(list((sample / "truth" / "masks").iterdir())) == 6
    assert len(list((sample / "truth" / "novel_views").glob("*.png"))) == 2
    assert len(load_motion(sample / "truth" / "novel_poses" / "motion.npz").frame_index) == 2
    settings = json.loads((sample / "truth" / "capture_settings.json").read_text())
    assert settings["seed"] == 0
    assert settings["version"] == CAPTURE_VERSION
    assert settings["light"]["key_intensity"] > 0
    assert not list(sample.parent.glob("*.part"))


def test_novel_views_show_the_whole_person(sample: Path) -> None:
    """The novel cameras are at other positions, and the whole person is in their images."""
    capture_camera = load_camera(sample / "truth" / "camera.npz")
    for index in range(2):
        camera = load_camera(sample / "truth" / "novel_views" / f"{index:06d}.npz")
        assert np.linalg.norm(camera.centre_m() - capture_camera.centre_m()) > 1.0
        alpha = read_rgba(sample / "truth" / "novel_views" / f"{index:06d}.png")[:, :, 3]
        assert (alpha > 127).mean() > 0.04
        assert not alpha[[0, -1]].any()
        assert not alpha[:, [0, -1]].any()


def test_cameras_are_rigid_and_centred() -> None:
    camera, ground_m = portrait_camera(540, 1.8, 3.6, 0.8)
    middle = torch.from_numpy(ground_m + [0.0, 0.9, 0.0])[None].float()
    distance_m = distance_to_middle_m(camera, ground_m, 1.8)
    for novel in novel_cameras(camera, ground_m, 1.8, 5, distance_m):
        rotation = novel.world_to_camera[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-6)
        place_px, depth_m = project(middle, novel)
        assert np.allclose(place_px[0].numpy(), [270.0, 270.0], atol=0.01)
        assert depth_m[0] == pytest.approx(3.6, rel=0.01)
        up_px, _ = project(middle + torch.tensor([0.0, 0.1, 0.0]), novel)
        assert up_px[0, 1] < place_px[0, 1]


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(-15.0, 5.0), (10.0, -3.0), (0.0, 5.0)])
def test_pitch_and_roll_turn_the_optical_axis_and_the_vertical(pitch_deg: float, roll_deg: float) -> None:
    """The axis is pitched above the horizon; the vertical in the image is turned against the camera's roll."""
    camera, ground_m = portrait_camera(540, 1.8, 3.6, 0.6, pitch_deg, roll_deg)
    optical_axis = camera.world_to_camera[2, :3]
    assert optical_axis[1] == pytest.approx(np.sin(np.radians(pitch_deg)), abs=1e-6)
    assert optical_axis[0] == pytest.approx(0.0, abs=1e-6)
    middle = np.array([0.0, 0.0, -3.6])
    ends = torch.from_numpy(np.stack([middle, middle + [0.0, 0.01, 0.0]])).float()
    place_px, depth_m = project(ends, camera)
    assert np.allclose(place_px[0].numpy(), [270.0, 270.0], atol=1e-3)
    assert depth_m[0] == pytest.approx(3.6, rel=1e-6)
    right, down = (place_px[1] - place_px[0]).tolist()
    # A camera that is rolled clockwise shows the world turned counterclockwise: the top moves to the left.
    assert np.degrees(np.arctan2(-right, -down)) == pytest.approx(roll_deg, abs=0.1)
    assert ground_m.tolist() == pytest.approx([0.0, -0.52 * 1.8, -3.6])


def test_level_camera_is_the_default_pose() -> None:
    camera, _ = portrait_camera(540, 1.8, 3.6, 0.8, 0.0, 0.0)
    assert np.array_equal(camera.world_to_camera, DEFAULT_WORLD_TO_CAMERA)
    nearly_level, _ = portrait_camera(540, 1.8, 3.6, 0.8, 1e-6, 0.0)
    assert np.allclose(nearly_level.world_to_camera, DEFAULT_WORLD_TO_CAMERA, atol=1e-6)


def test_person_covers_the_requested_image_height() -> None:
    camera, ground_m = portrait_camera(540, 1.8, 3.6, 0.8)
    ends = torch.from_numpy(np.stack([ground_m, ground_m + [0.0, 1.8, 0.0]])).float()
    place_px, _ = project(ends, camera)
    assert place_px[0, 1] - place_px[1, 1] == pytest.approx(0.8 * 540, abs=0.1)


def test_video_preserves_colours(tmp_path: Path) -> None:
    """Saturated one-pixel stripes are preserved: no chroma subsampling, only the rounding of YUV."""
    frame = np.zeros((64, 64, 3), dtype=np.uint8)
    frame[:, ::2] = (200, 30, 30)
    frame[:, 1::2] = (30, 60, 190)
    write_video(tmp_path / "video.mp4", [frame, frame[::-1].copy()], 24.0)
    decoded = [f.rgb for f in read_frames(open_frame_source(tmp_path / "video.mp4"), lambda index: True, 64)]
    assert len(decoded) == 2
    assert np.abs(decoded[0].astype(int) - frame).max() <= 3


def test_video_without_frames_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one frame"):
        write_video(tmp_path / "video.mp4", [], 24.0)


def test_existing_folder_is_an_error(sample: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = read_all_bytes(sample)
    assert run_command(main, [str(sample)]) == 2
    assert capsys.readouterr().err.startswith(f"error: {sample} already exists")
    assert read_all_bytes(sample) == before


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--frames", "1"),
        ("--size", "101"),
        ("--size", "8"),
        ("--fill", "1.5"),
        ("--samples", "0"),
        ("--seed", "-1"),
        ("--turns", "0"),
        ("--flare-m", "0.7"),
        ("--heel-m", "0.2"),
        ("--distortion", "-0.6"),
    ],
)
def test_options_out_of_range_are_errors(
    option: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(main, [str(tmp_path / "out"), option, value]) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert option in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        (["--turns", "2", "--arc", "90"], "remove it, or --bvh and --arc"),
        (["--turns", "2", "--bvh", "walk.bvh"], "remove it, or --bvh and --arc"),
        (["--flare-m", "0.2"], "add --legwear skirt"),
        (["--trouser-flare-m", "0.05", "--legwear", "skirt"], "is of trousers"),
        (["--age", "0.1", "--heel-m", "0.12"], "--heel-m 0.12 is too high"),
    ],
)
def test_options_that_would_have_no_effect_are_errors(
    options: list[str], advice: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(main, [str(tmp_path / "out"), *options]) == 2
    assert advice in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_subject_round_trip(subject: Subject) -> None:
    assert subject.texture.dtype == np.uint8
    assert subject.faces_uv.max() < len(subject.uv)
    assert subject.uv.min() >= 0
    assert subject.uv.max() <= 1
