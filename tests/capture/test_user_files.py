"""Files beside a video: what is read from each layout, and the sentence for each that does not fit."""

import json

import h5py
import numpy as np
import pytest
from PIL import ExifTags, Image

from pipeline.capture.smpl_poses import save_smpl_poses
from pipeline.capture.user_files import CameraCalibration, load_user_files
from pipeline.capture.video import FrameSource, open_frame_source, read_frames
from pipeline.core.errors import UserError
from pipeline.io.image import write_gray, write_rgb, write_rgba
from pipeline.io.npz import save_npz
from tests.capture.test_smpl_poses import make_poses

CAMERA = {"fx": 500.0, "fy": 510.0, "cx": 64.0, "cy": 48.0}
HALF_TURN = np.diag([-1.0, 1.0, -1.0, 1.0])


@pytest.fixture
def source(tmp_path) -> FrameSource:
    """Three pictures, 128 wide and 96 high."""
    for name in ("x1", "x2", "x10"):
        write_rgb(tmp_path / f"{name}.jpg", np.full((96, 128, 3), 90, np.uint8))
    return open_frame_source(tmp_path)


def masks() -> np.ndarray:
    return np.arange(3, dtype=np.uint8)[:, None, None] * np.ones((1, 4, 6), np.uint8)


def test_no_user_files(tmp_path, source):
    user_files = load_user_files(tmp_path, source)
    assert (user_files.read_mask, user_files.mask_source, user_files.landmarks, user_files.camera) == (
        None,
        "",
        None,
        None,
    )
    assert load_user_files(tmp_path / "video.mp4", source).camera is None


def write_masks(folder, **levels: int) -> None:
    """Masks by the names of their files, each with a person of one level in its middle."""
    (folder / "masks").mkdir()
    for name, level in levels.items():
        write_gray(folder / "masks" / f"{name}.png", person(level))


def person(level: int, around: int = 0) -> np.ndarray:
    mask = np.full((4, 6), around, np.uint8)
    mask[1:3, 2:4] = level
    return mask


def levels_of(user_files) -> list[int]:
    return [int(user_files.read_mask(index)[1, 2]) for index in range(3)]


def test_mask_folder_by_name(tmp_path, source):
    write_masks(tmp_path, x1=85, x2=170, x10=255, other=99)
    assert levels_of(load_user_files(tmp_path, source)) == [85, 170, 255]


def test_mask_folder_by_order(tmp_path, source):
    write_masks(tmp_path, m2=170, m1=85, m10=255)
    assert levels_of(load_user_files(tmp_path, source)) == [85, 170, 255]
    assert levels_of(load_user_files(tmp_path, FrameSource(tmp_path, (), 3, 25.0))) == [85, 170, 255]


def test_extra_mask_is_refused_when_names_do_not_match(tmp_path, source):
    write_masks(tmp_path, m1=10, m2=20, m3=30, m4=40)
    with pytest.raises(UserError, match="masks has 4 entries for 3 frames"):
        load_user_files(tmp_path, source)


def test_hidden_files_are_no_masks(tmp_path, source):
    """macOS adds a `._*` to each file on other file systems."""
    write_masks(tmp_path, m1=85, m2=170, m10=255)
    for name in ("m1", "m2", "m10"):
        (tmp_path / "masks" / f"._{name}.png").write_bytes(b"\0\5\26\7")
    assert levels_of(load_user_files(tmp_path, source)) == [85, 170, 255]


def test_cut_outs_in_the_mask_folder_are_read_by_their_alpha(tmp_path, source):
    """As rembg writes them: the person's colours, dark trousers among them, before transparent black."""
    (tmp_path / "masks").mkdir()
    for name, level in (("x1", 255), ("x2", 128), ("x10", 255)):
        write_rgba(tmp_path / "masks" / f"{name}.png", np.dstack([person(30), person(30), person(40), person(level)]))
    assert levels_of(load_user_files(tmp_path, source)) == [255, 128, 255]
    write_gray(tmp_path / "masks" / "x2.png", person(255))
    with pytest.raises(UserError, match=r"masks/x2\.png has no transparency, x1\.png has; make the background"):
        load_user_files(tmp_path, source)


def test_masks_numbered_from_another_start_are_refused(tmp_path, source):
    """As many as there are images, most of them named as one: in natural order each would belong to another frame."""
    write_masks(tmp_path, x2=20, x10=30, x11=40)
    with pytest.raises(UserError, match="with the names of images, but none for x1;"):
        load_user_files(tmp_path, source)


def write_images_with_alpha(folder, alphas: list[np.ndarray]) -> FrameSource:
    (folder / "images").mkdir()
    for k, alpha in enumerate(alphas):
        rgba = np.dstack([np.full((*alpha.shape, 3), (90, 80, 70), np.uint8), alpha])
        write_rgba(folder / "images" / f"{k}.png", rgba)
    return open_frame_source(folder)


def test_alpha_channel_is_the_mask_unless_masks_are_supplied(tmp_path):
    source = write_images_with_alpha(tmp_path, [person(level) for level in (0, 128, 255)])
    user_files = load_user_files(tmp_path, source)
    assert (levels_of(user_files), user_files.mask_source) == ([0, 128, 255], "the images' alpha channel")
    write_masks(tmp_path, m1=51, m2=102, m3=255)
    assert levels_of(load_user_files(tmp_path, source)) == [51, 102, 255]


def test_one_image_without_transparency_is_named(tmp_path):
    source = write_images_with_alpha(tmp_path, [person(255), person(255), np.full((4, 6), 255, np.uint8)])
    with pytest.raises(UserError, match=r"2\.png has no transparency, 0\.png has; make the background"):
        load_user_files(tmp_path, source)


def test_transparency_after_an_opaque_first_image_is_not_ignored(tmp_path):
    source = write_images_with_alpha(tmp_path, [np.full((4, 6), 255, np.uint8), person(255), person(255)])
    with pytest.raises(UserError, match=r"0\.png has no transparency, 1\.png has"):
        load_user_files(tmp_path, source)


def test_alpha_is_turned_as_the_colours_are(tmp_path):
    """EXIF orientation 6: the picture is shown after a clockwise quarter turn."""
    (tmp_path / "images").mkdir()
    pixels = np.full((8, 12, 4), (40, 40, 40, 0), np.uint8)
    pixels[5:, 2:9] = (200, 90, 60, 255)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    for k in range(2):
        Image.fromarray(pixels).save(tmp_path / "images" / f"{k}.png", exif=exif)
    source = open_frame_source(tmp_path)
    frame = next(read_frames(source, lambda _: True, 1000))
    mask = load_user_files(tmp_path, source).read_mask(0)
    assert mask.shape == (12, 8)
    np.testing.assert_array_equal(mask > 0, frame.rgb[..., 0] > 100)
    np.testing.assert_array_equal(mask > 0, np.rot90(pixels[..., 3], k=-1) > 0)


def test_a_folder_of_zeros_and_ones_is_brought_to_255(tmp_path, source):
    write_masks(tmp_path, m1=0, m2=1, m3=0)
    assert levels_of(load_user_files(tmp_path, source)) == [0, 255, 0]


@pytest.mark.parametrize("highest", [1, 200, 65535])
def test_a_folder_of_16_bits_is_brought_to_255(tmp_path, source, highest):
    """Labels 0 and 1 round to nothing in 8 bits."""
    (tmp_path / "masks").mkdir()
    for name, level in (("m1", 0), ("m2", highest), ("m3", highest // 2)):
        write_gray(tmp_path / "masks" / f"{name}.png", person(1).astype(np.uint16) * level)
    half = {1: 0, 200: 128, 65535: 127}[highest]
    assert levels_of(load_user_files(tmp_path, source)) == [0, 255, half]


def test_the_largest_level_of_a_folder_counts_as_255(tmp_path, source):
    """As in an array; a mask with nothing but specks of 1 still shows nobody."""
    write_masks(tmp_path, m1=1, m2=100, m3=200)
    assert levels_of(load_user_files(tmp_path, source)) == [1, 128, 255]


def test_empty_masks_are_refused(tmp_path, source):
    write_masks(tmp_path, m1=0, m2=0, m3=0)
    with pytest.raises(UserError, match="masks/: all 3 masks looked at are empty; masks are white where the person is"):
        load_user_files(tmp_path, source)


@pytest.mark.parametrize("kind", ["masks/", "masks.npz", "masks.hdf5", "alpha"])
@pytest.mark.parametrize("n_inverted", [1, 2])
def test_inverted_masks_are_refused(tmp_path, kind, n_inverted):
    """Black where the person is, in two of three masks; one alone may show a picture without the person."""
    masks = [person(0, 255)] * n_inverted + [person(255)] * (3 - n_inverted)
    alphas = masks if kind == "alpha" else [np.full((4, 6), 255, np.uint8)] * 3
    source = write_images_with_alpha(tmp_path, alphas)
    if kind == "masks/":
        (tmp_path / "masks").mkdir()
        for k, mask in enumerate(masks):
            write_gray(tmp_path / "masks" / f"{k}.png", mask)
    elif kind == "masks.npz":
        save_npz(tmp_path / kind, {"masks": np.stack(masks)})
    elif kind == "masks.hdf5":
        with h5py.File(tmp_path / kind, "w") as file:
            file["masks"] = np.stack(masks)
    if n_inverted == 1:
        assert load_user_files(tmp_path, source).read_mask is not None
        return
    with pytest.raises(UserError, match=rf"{kind}.*: 2 of 3 masks looked at are white in all four corners, .* invert"):
        load_user_files(tmp_path, source)


def test_mask_arrays_are_brought_to_255(tmp_path, source):
    save_npz(tmp_path / "masks.npz", {"masks": masks() > 1})
    assert load_user_files(tmp_path, source).read_mask(2).max() == 255
    (tmp_path / "masks.npz").unlink()
    with h5py.File(tmp_path / "masks.hdf5", "w") as file:
        file["masks"] = masks() // 2
    user_files = load_user_files(tmp_path, source)
    assert user_files.mask_source == "masks.hdf5"
    assert [int(user_files.read_mask(i).max()) for i in range(3)] == [0, 0, 255]


def test_poses_of_frames_that_there_are(tmp_path, source):
    save_smpl_poses(tmp_path / "smpl_poses.npz", make_poses(1))
    assert load_user_files(tmp_path, source).smpl_poses.gender == "female"
    save_smpl_poses(tmp_path / "smpl_poses.npz", make_poses(2))
    with pytest.raises(UserError, match="has poses of frames 0 to 4, .* has 0 to 2"):
        load_user_files(tmp_path, source)


def test_landmarks_with_and_without_the_rest(tmp_path, source):
    points = np.random.default_rng(0).uniform(0, 50, (3, 33, 2))
    save_npz(tmp_path / "landmarks.npz", {"landmarks_px": points})
    landmarks = load_user_files(tmp_path, source).landmarks
    np.testing.assert_allclose(landmarks.landmarks_px, points, rtol=1e-6)
    assert (landmarks.visibility == 1).all()
    assert landmarks.landmarks_world_m is None


def test_landmarks_that_are_unknown_are_not_visible(tmp_path, source):
    points = np.zeros((3, 33, 2))
    points[1, 4] = np.nan
    save_npz(tmp_path / "landmarks.npz", {"landmarks_px": points, "landmarks_world_m": np.ones((3, 33, 3))})
    landmarks = load_user_files(tmp_path, source).landmarks
    assert np.argwhere(landmarks.visibility == 0).tolist() == [[1, 4]]
    assert (landmarks.landmarks_world_m == 1).all()


def test_camera_for_smaller_images(tmp_path, source):
    pose = HALF_TURN.copy()
    pose[2, 3] = 3
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA | {"world_to_camera": pose.tolist()}))
    camera = load_user_files(tmp_path, source).camera.to_camera(0.5, 64, 48)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (250, 255, 32, 24)
    np.testing.assert_array_equal(camera.world_to_camera, pose)


@pytest.mark.parametrize(
    "wrong",
    [
        2 * np.eye(4),
        np.diag([1.0, -1.0, 1.0, 1.0]),
        np.full((4, 4), np.nan),
        np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 3, 1]]),
    ],
    ids=["scaled", "mirrored", "nan", "transposed"],
)
def test_a_pose_that_is_no_rotation_and_shift_is_refused(tmp_path, source, wrong):
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA | {"world_to_camera": wrong.tolist()}))
    with pytest.raises(UserError, match="`world_to_camera` must be a rotation and a translation in metres"):
        load_user_files(tmp_path, source)


def test_off_centre_principal_point_requires_image_size(tmp_path, source):
    """The camera of pictures of half the size has it at a quarter of these; a cropped video may have it there too."""
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA | {"cx": 32.0, "cy": 24.0}))
    with pytest.raises(UserError, match=r'cx 32, cy 24 are far .* which are 128x96; .* "width": 128, "height": 96'):
        load_user_files(tmp_path, source)
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA | {"cx": 32.0, "cy": 24.0, "width": 128, "height": 96}))
    assert load_user_files(tmp_path, source).camera.cx == 32


def test_split_assigns_each_listed_frame(tmp_path):
    recording = FrameSource(tmp_path, (), 30, 25.0)
    (tmp_path / "split.json").write_text('{"train": [12, 3, 4], "validation": [8], "heldout": [29, 0]}')
    split = load_user_files(tmp_path, recording).split
    np.testing.assert_array_equal(split.frame_index, [0, 3, 4, 8, 12, 29])
    np.testing.assert_array_equal(split.split, [2, 0, 0, 1, 0, 2])
    np.testing.assert_array_equal(split.for_frames(np.array([29, 8, 3])), [2, 1, 0])


def test_a_split_without_validation_takes_every_eighth_training_frame(tmp_path):
    recording = FrameSource(tmp_path, (), 60, 25.0)
    (tmp_path / "split.json").write_text(json.dumps({"train": list(range(0, 40, 2)), "heldout": [41]}))
    split = load_user_files(tmp_path, recording).split
    np.testing.assert_array_equal(split.frame_index[split.split == 1], [8, 24])
    assert (split.split == 0).sum() == 18


def test_lens_distortion_is_taken_out_of_pictures_and_points():
    """A bright dot drawn where the distorted lens sees it must land where the ideal pinhole projects it."""
    k1, focal, centre = -0.25, 100.0, 64.0
    camera = CameraCalibration(focal, focal, centre, centre, (k1, 0.0, 0.0, 0.0))
    ideal = np.array([0.4, 0.3])
    distorted = ideal * (1 + k1 * (ideal**2).sum())
    seen_px, expected_px = centre + focal * distorted, centre + focal * ideal
    rows, columns = np.mgrid[:128, :128] + 0.5
    dot = 250 * np.exp(-((columns - seen_px[0]) ** 2 + (rows - seen_px[1]) ** 2) / 8)
    picture = camera.undistort(np.repeat(dot[..., None], 3, axis=2).astype(np.uint8), 1.0)[..., 0].astype(float)
    found = np.array([(picture * columns).sum(), (picture * rows).sum()]) / picture.sum()
    np.testing.assert_allclose(found, expected_px, atol=0.15)
    np.testing.assert_allclose(camera.undistort_points(seen_px[None])[0], expected_px, atol=1e-2)


def test_without_distortion_nothing_is_resampled():
    picture = np.random.default_rng(0).integers(0, 255, (8, 8, 3), dtype=np.uint8)
    camera = CameraCalibration(10.0, 10.0, 4.0, 4.0, (0.0, 0.0, 0.0, 0.0))
    assert camera.undistort(picture, 1.0) is picture
    points = np.zeros((2, 2))
    assert camera.undistort_points(points) is points


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("camera.json", "{", "is not a camera"),
        ("camera.json", json.dumps({"fx": 1}), "is not a camera"),
        ("camera.json", json.dumps([1, 2]), "is not a camera"),
        ("camera.json", json.dumps(CAMERA | {"fx": -1}), "above 0"),
        ("camera.json", json.dumps(CAMERA | {"distortion": [0.1]}), "distortion needs"),
        ("camera.json", json.dumps(CAMERA | {"world_to_camera": [1, 2]}), "is not a camera"),
        ("camera.json", json.dumps(CAMERA | {"distortion": [0.1, 0.0, np.nan, 0.0]}), "all numbers finite"),
        ("camera.json", json.dumps(CAMERA | {"cx": np.inf}), "all numbers finite"),
        ("camera.json", json.dumps(CAMERA | {"cx": 300.0}), "are far from the centre of the images"),
        ("camera.json", json.dumps(CAMERA | {"width": 128}), "is not a camera .'height'."),
        ("camera.json", json.dumps(CAMERA | {"width": 64, "height": 48}), "for images of 64x48, those .* are 128x96"),
        ("split.json", "[0, 1]", "is not a split"),
        ("split.json", '{"train": 3, "heldout": [1]}', "is not a split"),
        ("split.json", '{"train": [0.5], "heldout": [1]}', "is not a split"),
        ("split.json", '{"train": [0], "test": [1]}', "unknown list test; there are train, validation, heldout"),
        ("split.json", '{"train": [0], "heldout": [1]}', "no frame for validation"),
        ("split.json", '{"train": [0], "validation": [1], "heldout": []}', "no frame for heldout"),
        ("split.json", '{"train": [0], "validation": [1], "heldout": [0]}', "a frame twice"),
        ("split.json", '{"train": [0], "validation": [1], "heldout": [3]}', "up to 3, .* has 0 to 2"),
        ("masks.npz", "x", "masks.npz"),
        ("masks.hdf5", "x", "masks.hdf5"),
        ("landmarks.npz", "x", "landmarks.npz"),
    ],
)
def test_a_file_that_does_not_fit_is_named(tmp_path, source, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(UserError, match=message):
        load_user_files(tmp_path, source)


@pytest.mark.parametrize(
    ("name", "arrays", "message"),
    [
        ("masks.npz", {"mask": masks()}, "no array `masks`"),
        ("masks.npz", {"masks": masks()[0]}, "frames, height, width"),
        ("masks.npz", {"masks": masks()[:2]}, "2 entries for 3 frames"),
        ("masks.npz", {"masks": masks()[[0, 1, 2, 2]]}, "4 entries for 3 frames"),
        ("landmarks.npz", {"landmarks_px": np.zeros((3, 17, 2))}, "must have shape"),
        ("landmarks.npz", {"landmarks_px": np.zeros((2, 33, 2))}, "2 entries for 3 frames"),
        ("landmarks.npz", {"landmarks_px": np.zeros((4, 33, 2))}, "4 entries for 3 frames"),
        (
            "landmarks.npz",
            {"landmarks_px": np.zeros((3, 33, 2)), "landmarks_visibility": np.eye(3, 33) * 2},
            "of frame 0 is outside",
        ),
        (
            "landmarks.npz",
            {"landmarks_px": np.zeros((3, 33, 2)), "landmarks_world_m": np.zeros((3, 33, 2))},
            "correct its shape",
        ),
        (
            "landmarks.npz",
            {"landmarks_px": np.zeros((3, 33, 2)), "landmarks_visibility": np.zeros(3)},
            "correct its shape",
        ),
    ],
)
def test_arrays_that_do_not_fit_are_named(tmp_path, source, name, arrays, message):
    save_npz(tmp_path / name, arrays)
    with pytest.raises(UserError, match=message):
        load_user_files(tmp_path, source)
