"""The frames stage from folder to artifact: on drawn recordings with masks beside them, and on the real ones."""

import json
import re
from unittest import mock

import cv2
import numpy as np
import pytest

from data_tools.synthetic.scene.movie import write_video
from pipeline.capture.capture import load_capture
from pipeline.capture.smpl_poses import save_smpl_poses
from pipeline.core.errors import UserError
from pipeline.core.progress import take_warnings
from pipeline.io.image import read_gray, write_gray, write_rgb
from pipeline.io.npz import load_npz, save_npz
from stages import frames
from tests.capture.test_exif_focal import tiff, with_exif
from tests.capture.test_smpl_poses import make_poses


def draw_recording(folder, n=40, repeats=1, turns=1):
    """A block that walks, each picture `repeats` times, with masks, landmarks that turn around, and a camera."""
    (folder / "masks").mkdir(parents=True)
    rng = np.random.default_rng(0)
    landmarks_px = np.full((n, 33, 2), 20.0)
    world = np.zeros((n, 33, 3))
    for k in range(n):
        place = k // repeats
        yaw = 2 * np.pi * turns * k / n
        world[k, [11, 23]] = 0.2 * np.array([np.cos(yaw), 0, np.sin(yaw)])
        mask = np.zeros((96, 128), np.uint8)
        mask[20:80, place : place + 40] = 255
        texture = rng.integers(-1, 2, (96, 128, 3)) + np.where(mask[..., None] > 0, 150 + 2 * place, 60)
        write_rgb(folder / f"{k}.png", texture.astype(np.uint8))
        write_gray(folder / "masks" / f"{k}.png", mask)
    save_npz(folder / "landmarks.npz", {"landmarks_px": landmarks_px, "landmarks_world_m": world})
    (folder / "camera.json").write_text('{"fx": 100, "fy": 100, "cx": 64, "cy": 48}')
    return folder


def run(video, out, **options):
    out.mkdir()
    return frames.run({"video": video}, out, frames.Config(workers=1, **options))


def test_a_whole_recording(tmp_path):
    metrics = run(draw_recording(tmp_path / "in"), tmp_path / "out")
    capture = load_capture(tmp_path / "out")
    np.testing.assert_array_equal(capture.frame_index, np.arange(40))
    assert (capture.frame_index[capture.positions(2)] % 8 == 0).all()
    assert (capture.frame_index[capture.positions(1)] % 8 == 4).all()
    assert (metrics["frames"], metrics["frames_heldout"], metrics["frames_validation"]) == (40, 5, 5)
    assert metrics["masks_count"] == 40
    assert metrics["unseen_arc_deg"] == pytest.approx(9, abs=0.1)
    assert capture.camera.fx == 100
    assert capture.mask_source == "masks/"
    assert capture.n_video_frames == 40
    assert capture.mask(7)[50, 20] == 1
    for name in frames.STAGE.makes:
        assert (tmp_path / "out" / name).exists()
    assert take_warnings() == []


def test_supplied_masks_with_holes_and_specks_are_a_warning(tmp_path):
    recording = draw_recording(tmp_path / "in")
    rng = np.random.default_rng(1)
    for path in (recording / "masks").iterdir():
        mask = read_gray(path)
        mask[rng.random(mask.shape) < 0.03] = 255
        write_gray(path, mask)
    run(recording, tmp_path / "out")
    (warning,) = take_warnings()
    assert "masks in masks/" in warning
    assert "use a copy without masks/" in warning


def test_duplicates_are_dropped_and_the_rest_is_thinned_out(tmp_path):
    metrics = run(draw_recording(tmp_path / "in", n=80, repeats=2), tmp_path / "out", max_frames=24)
    capture = load_capture(tmp_path / "out")
    assert metrics["dropped_duplicates"] == 40
    assert metrics["frames"] <= 24
    assert metrics["frames_heldout"] == metrics["frames_validation"] == 3
    assert (capture.frame_index % 2 == 0).all()
    assert capture.frame_index[0] == 0
    assert capture.frame_index[-1] == 78


def test_a_resumed_stage_writes_the_files_of_an_uninterrupted_one(tmp_path, monkeypatch):
    """Killed while the frames are written; the person is not detected again."""
    video = draw_recording(tmp_path / "in")
    expected = run(video, tmp_path / "whole")
    with monkeypatch.context() as patch:
        patch.setattr(frames, "write_frames", mock.Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            run(video, tmp_path / "killed")
    monkeypatch.setattr(frames, "detect_in_frames", None)
    assert frames.run({"video": video}, tmp_path / "killed", frames.Config(workers=1)) == expected
    for path in (path for path in (tmp_path / "whole").rglob("*") if path.is_file()):
        assert path.read_bytes() == (tmp_path / "killed" / path.relative_to(tmp_path / "whole")).read_bytes(), path


def test_the_last_of_several_turns_is_held_out(tmp_path):
    """72 frames of three turns: frames 48 to 71 are judged, 45 to 47 are in no split, all before are learnt from."""
    metrics = run(draw_recording(tmp_path / "in", n=72, turns=3), tmp_path / "out", split="disjoint")
    capture = load_capture(tmp_path / "out")
    assert metrics["turns"] == pytest.approx(3 * 71 / 72, abs=0.02)
    heldout, validation, train = (capture.frame_index[capture.positions(kind)] for kind in (2, 1, 0))
    assert heldout.min() == pytest.approx(48, abs=1)
    assert heldout.max() == 71
    assert max(train.max(), validation.max()) == pytest.approx(heldout.min() - 4, abs=1)
    assert (validation % 8 == 4).all()
    assert 0 in train  # held out in the interleaved split
    assert capture.split_rule == "disjoint: the last of 3 turns held out"


def test_the_last_quarter_of_a_single_turn_is_held_out(tmp_path):
    run(draw_recording(tmp_path / "in", n=40), tmp_path / "out", split="disjoint")
    capture = load_capture(tmp_path / "out")
    np.testing.assert_array_equal(capture.frame_index[capture.positions(2)], range(30, 40))
    assert capture.frame_index[capture.split != 2].max() == 27  # two frames of guard
    assert capture.split_rule == "disjoint: the last quarter held out"


def test_disjoint_frames_do_not_cost_training_frames(tmp_path):
    """Of equal numbers of frames, the same eighths are held out and used for validation."""
    folder = draw_recording(tmp_path / "in", n=80, turns=2)
    counts = []
    for split in ("interleaved", "disjoint"):
        metrics = run(folder, tmp_path / split, split=split, max_frames=32)
        counts.append([metrics[f"frames_{kind}"] for kind in ("train", "validation", "heldout")])
    assert counts == [[24, 4, 4], [24, 4, 4]]


def test_a_disjoint_split_of_a_short_recording_is_refused_with_advice(tmp_path):
    with pytest.raises(UserError, match=r"only 14 frames .* 16 are needed; use --set frames.split=interleaved, film"):
        run(draw_recording(tmp_path / "in", n=16), tmp_path / "out", split="disjoint")


def test_a_supplied_split_and_a_disjoint_one_exclude_each_other(tmp_path):
    folder = write_split(draw_recording(tmp_path / "in", n=40), range(20), [35])
    with pytest.raises(UserError, match=r"has a split.json, which frames.split=disjoint would ignore; remove one"):
        run(folder, tmp_path / "out", split="disjoint")


def write_split(folder, train, heldout):
    (folder / "split.json").write_text(json.dumps({"train": list(train), "heldout": list(heldout)}))
    return folder


def test_a_supplied_split_is_kept_frame_by_frame(tmp_path):
    """Every listed frame is used for what it is listed for, near-duplicates too; no other frame is."""
    folder = write_split(draw_recording(tmp_path / "in", n=40, repeats=2), range(3, 24), range(30, 40, 3))
    metrics = run(folder, tmp_path / "out")
    capture = load_capture(tmp_path / "out")
    np.testing.assert_array_equal(capture.frame_index, [*range(3, 24), *range(30, 40, 3)])
    np.testing.assert_array_equal(capture.frame_index[capture.positions(2)], range(30, 40, 3))
    np.testing.assert_array_equal(capture.frame_index[capture.positions(1)], [7, 15, 23])
    assert capture.split_rule == "split.json"
    assert (metrics["frames_train"], metrics["frames_validation"], metrics["frames_heldout"]) == (18, 3, 4)
    assert metrics["dropped_duplicates"] == 0


def test_supplied_poses_of_the_chosen_frames_go_on(tmp_path):
    folder = write_split(draw_recording(tmp_path / "in", n=40), range(5, 24), range(30, 40, 3))
    save_smpl_poses(folder / "smpl_poses.npz", make_poses(10))
    run(folder, tmp_path / "out")
    np.testing.assert_array_equal(load_capture(tmp_path / "out").smpl_poses.frame_index, [8, 12, 16, 20, 36])


def test_a_split_with_more_frames_than_may_be_kept_is_refused(tmp_path):
    folder = write_split(draw_recording(tmp_path / "in", n=40), range(30), [35])
    with pytest.raises(UserError, match=r"lists 31 frames, frames.max_frames is 20; .* --set frames.max_frames=31"):
        run(folder, tmp_path / "out", max_frames=20)


def test_a_split_whose_heldout_frames_show_nobody_is_refused(tmp_path):
    folder = write_split(draw_recording(tmp_path / "in", n=40), range(30), [35])
    write_gray(folder / "masks" / "35.png", np.zeros((96, 128), np.uint8))
    with pytest.raises(UserError, match="has no frame with a person"):
        run(folder, tmp_path / "out")


def test_large_images_are_stored_smaller_and_the_camera_with_them(tmp_path):
    run(draw_recording(tmp_path / "in", n=17), tmp_path / "out", max_side_px=64)
    capture = load_capture(tmp_path / "out")
    assert capture.image(0).shape == (48, 64, 3)
    assert (capture.camera.fx, capture.camera.width, capture.scale) == (50, 64, 0.5)
    np.testing.assert_allclose(capture.landmarks_px, 10)


def distort_points(points_px: np.ndarray) -> np.ndarray:
    """Where a lens with OpenCV's k1 = 0.4 shows what a pinhole would show at these points (pixel centres at +0.5)."""
    ideal = (points_px - (64, 48)) / 80
    return 80 * ideal * (1 + 0.4 * (ideal**2).sum(axis=-1, keepdims=True)) + (64, 48)


def write_distorted_recording(folder, n=17):
    """A disc of 14 pixels with a red one of 7 in it walks to the left, bent by a lens in pictures, masks and landmarks.

    Returns where a pinhole would show its centre in each frame.
    """
    (folder / "masks").mkdir(parents=True)
    (folder / "camera.json").write_text('{"fx": 80, "fy": 80, "cx": 64, "cy": 48, "distortion": [0.4, 0, 0, 0]}')
    rows, columns = np.mgrid[:96, :128] + 0.5
    seen_px = np.stack([columns, rows], axis=-1)
    ideal_px = seen_px
    for _ in range(40):
        ideal_px = ideal_px + seen_px - distort_points(ideal_px)
    centres_px = np.array([[46.0 - k, 38.0 - 0.5 * k] for k in range(n)])
    for k, centre_px in enumerate(centres_px):
        away_px = np.linalg.norm(ideal_px - centre_px, axis=-1)
        picture = np.full((96, 128, 3), 30, np.uint8)
        picture[away_px < 14, 1:] = 150
        picture[away_px < 7, 0] = 200
        write_rgb(folder / f"{k}.png", picture)
        write_gray(folder / "masks" / f"{k}.png", np.where(away_px < 14, np.uint8(255), np.uint8(0)))
    points_px = distort_points(centres_px)[:, None].repeat(33, axis=1)
    points_px[3, 13] = np.nan
    save_npz(folder / "landmarks.npz", {"landmarks_px": points_px, "landmarks_world_m": np.zeros((n, 33, 3))})
    return centres_px


@pytest.mark.parametrize("max_side_px", [128, 64])
def test_picture_mask_and_landmarks_are_undistorted_together(tmp_path, max_side_px):
    centres_px = write_distorted_recording(tmp_path / "in")
    run(tmp_path / "in", tmp_path / "out", max_side_px=max_side_px)
    capture = load_capture(tmp_path / "out")
    scale = max_side_px / 128
    assert np.abs(distort_points(centres_px) - centres_px).max() > 3
    rows, columns = np.mgrid[: capture.height, : capture.width] + 0.5
    for position, index in enumerate(capture.frame_index):
        expected_px = scale * centres_px[index]
        red = np.clip((255 * capture.image(position)[..., 0] - 30) / 170, 0, 1)
        for share, radius_px in ((capture.mask(position), 14), (red, 7)):
            found_px = np.array([(share * columns).sum(), (share * rows).sum()]) / share.sum()
            np.testing.assert_allclose(found_px, expected_px, atol=0.3 * scale)
            assert np.sqrt(share.sum() / np.pi) == pytest.approx(radius_px * scale, rel=0.03)
        points_px = capture.landmarks_px[position]
        assert np.isnan(points_px).any() == (index == 3)
        np.testing.assert_allclose(points_px[np.isfinite(points_px).all(axis=1)] - expected_px, 0, atol=0.02)
    take_warnings()


@pytest.mark.parametrize(("max_side_px", "diagonal_px"), [(128, 160), (64, 80)])
def test_the_lens_that_the_camera_wrote_reaches_the_capture(tmp_path, max_side_px, diagonal_px):
    """26 mm on 43.27 mm of film: the focal length is this share of the picture's diagonal."""
    folder = draw_recording(tmp_path / "in", n=17)
    jpeg = cv2.imencode(".jpg", cv2.imread(str(folder / "0.png")))[1].tobytes()
    (folder / "0.png").unlink()
    (folder / "0.jpg").write_bytes(with_exif(jpeg, tiff("<", 26)))
    run(folder, tmp_path / "out", max_side_px=max_side_px)
    assert load_capture(tmp_path / "out").metadata_focal_px == pytest.approx(26 / 43.27 * diagonal_px)


def test_image_fps_can_be_set(tmp_path):
    run(draw_recording(tmp_path / "in", n=17), tmp_path / "out", fps=12.5)
    capture = load_capture(tmp_path / "out")
    assert capture.fps == 12.5
    np.testing.assert_allclose(capture.time_s, np.arange(17) * 0.08)


def test_fps_option_is_refused_for_video(tmp_path):
    write_video(tmp_path / "a.mp4", np.zeros((17, 48, 64, 3), np.uint8), 25.0)
    with pytest.raises(UserError, match="a.mp4 is a video with a frame rate .* remove frames.fps"):
        run(tmp_path / "a.mp4", tmp_path / "out", fps=30.0)


def test_a_frame_with_a_mask_and_without_landmarks_is_kept(tmp_path):
    folder = draw_recording(tmp_path / "in", n=40)
    arrays = load_npz(folder / "landmarks.npz")
    arrays["landmarks_px"][7], arrays["landmarks_world_m"][7] = np.nan, np.nan
    save_npz(folder / "landmarks.npz", arrays)
    metrics = run(folder, tmp_path / "out")
    assert (metrics["frames"], metrics["dropped_no_person"]) == (40, 0)
    capture = load_capture(tmp_path / "out")
    assert np.isnan(capture.landmarks_px[7]).all()
    assert np.isnan(capture.landmarks_visibility[7]).all()
    assert np.isfinite(np.delete(capture.landmarks_px, 7, axis=0)).all()


def cut_off_feet(folder, count):
    """Put the ankles and a toe of the first frames below the picture, whose height is 96."""
    arrays = load_npz(folder / "landmarks.npz")
    arrays["landmarks_px"][:count, [27, 28, 31], 1] = 97.0
    save_npz(folder / "landmarks.npz", arrays)


def test_frames_that_cut_off_the_person_are_left_out_where_others_show_the_same_side(tmp_path):
    """A turn in steps of 4.5 degrees whose first four frames have no feet; they stay if all frames are needed."""
    folder = draw_recording(tmp_path / "in", n=80)
    cut_off_feet(folder, 4)
    run(folder, tmp_path / "out")
    assert load_capture(tmp_path / "out").frame_index[0] == 4
    assert re.search(r"4 frames of .* that cut off the person are left out, .*: 0-3$", take_warnings()[0])
    assert run(folder, tmp_path / "all", min_frames=80)["frames"] == 80


def test_a_recording_that_mostly_cuts_off_the_person_is_used_if_a_turn_does_not(tmp_path):
    """Two turns in 88 frames, without feet in the first and in six of the second: these sides stay in the first."""
    folder = draw_recording(tmp_path / "in", n=88, turns=2)
    cut_off_feet(folder, 50)
    run(folder, tmp_path / "out")
    np.testing.assert_array_equal(load_capture(tmp_path / "out").frame_index, [*range(7), *range(43, 88)])


def test_the_same_recording_gives_the_same_bytes(tmp_path):
    folder = draw_recording(tmp_path / "in", n=17)
    for name in ("a", "b"):
        run(folder, tmp_path / name)
    files = (path for path in (tmp_path / "a").rglob("*") if path.is_file() and path.name != frames.CHECKPOINT)
    written = sorted(path.relative_to(tmp_path / "a") for path in files)
    assert len(written) == 2 * 17 + 2
    for path in written:
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes()


def test_too_few_frames_are_refused(tmp_path):
    with pytest.raises(UserError, match="has 9 frames; at least"):
        run(draw_recording(tmp_path / "in", n=9), tmp_path / "out")


def test_a_person_who_stands_still_is_refused(tmp_path):
    with pytest.raises(UserError, match="only 2 frames in which the person has moved"):
        run(draw_recording(tmp_path / "in", n=40, repeats=20), tmp_path / "out")
    with pytest.raises(UserError, match="only 2 frames that differ among the 40 that were compared"):
        run(tmp_path / "in", tmp_path / "again", max_frames=24)


def test_black_frames_are_refused(tmp_path):
    (tmp_path / "in").mkdir()
    for k in range(16):
        write_rgb(tmp_path / "in" / f"{k}.png", np.zeros((64, 64, 3), np.uint8))
    with pytest.raises(UserError, match="are black"):
        run(tmp_path / "in", tmp_path / "out")


def test_a_picture_of_nobody_is_refused(tmp_path):
    (tmp_path / "in").mkdir()
    rng = np.random.default_rng(0)
    for k in range(16):
        landscape = cv2.resize(rng.integers(0, 255, (4, 4, 3), dtype=np.uint8), (64, 64))
        write_rgb(tmp_path / "in" / f"{k}.png", landscape)
    with pytest.raises(UserError, match="no person was found"):
        run(tmp_path / "in", tmp_path / "out")


@pytest.mark.parametrize(("n", "limit", "stride"), [(100, 900, 1), (900, 900, 1), (901, 900, 3), (3000, 900, 5)])
def test_detection_stride_is_odd_and_sufficient(n, limit, stride):
    assert frames.detection_stride(n, limit) == stride
    assert {index % 8 for index in range(0, 64 * stride, stride)} == set(range(8))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "message"), [("no_feet", "cut off above the feet"), ("several_people", "several people")]
)
def test_unusable_real_recordings_are_refused(shared_data, tmp_path, name, message):
    with pytest.raises(UserError, match=message):
        run(shared_data / "error" / f"{name}.mp4", tmp_path / "out", max_detection_frames=60)


@pytest.mark.slow
def test_a_real_recording(shared_data, tmp_path):
    metrics = run(shared_data / "real" / "dakse" / "video.mp4", tmp_path / "out", max_frames=24)
    assert 25 <= metrics["dropped_duplicates"] <= 60
    assert metrics["dropped_no_person"] == 0
    assert metrics["unseen_arc_deg"] < 60
