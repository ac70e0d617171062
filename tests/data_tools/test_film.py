"""The command film: what is in the file is what was rendered, and bad input writes nothing."""

from pathlib import Path

import av
import numpy as np
import pytest
import torch

from data_tools import film
from data_tools.film import film_motion, main
from data_tools.pose import main as pose
from data_tools.synthetic.scene.movie import FOR_PLAYERS, write_video
from pipeline.avatar.film import FPS, HEIGHT_PX, WIDTH_PX, FilmView, render_film, turntable_motion
from pipeline.avatar.finished_run import load_textured_avatar
from pipeline.body.body import canonical_to_world
from pipeline.core.errors import UserError
from pipeline.core.manifest import digest_files
from pipeline.geometry.camera import project
from stages.export import STAGE, Config, load_scene
from tests.field.scene import PaintedScene


def read_film(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        assert container.streams.video[0].average_rate == FPS
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def load(run: Path):
    return load_scene({name: run / name for name in STAGE.needs}, Config())


def test_a_clip_is_filmed_and_the_export_keeps_its_bytes(run: Path) -> None:
    before = digest_files(run / "export")
    main([str(run), "--clip", "capture"])
    frames = read_film(run / "film" / "capture" / "film.mp4")
    loaded = load(run)
    motion = film_motion("capture", loaded)
    length_s = loaded.motion.time_s[-1] - loaded.motion.time_s[0]
    assert abs(len(frames) / FPS - length_s) <= 1.01 / FPS
    assert frames[0].shape == (HEIGHT_PX, WIDTH_PX, 3)
    rendered = list(render_film(load_textured_avatar(run / "mesh", run / "texture"), loaded.body, motion))
    for made, read in zip(rendered, frames, strict=True):
        error = made.astype(float) - read
        assert 10.0 * np.log10(255.0**2 / np.mean(error**2)) > 38.0
    assert digest_files(run / "export") == before
    assert sorted(path.name for path in (run / "film").iterdir()) == ["capture"]


def test_the_turntable_turns_once_and_closes(scene: PaintedScene) -> None:
    motion = turntable_motion(scene.body, 0.0)
    transforms = canonical_to_world(scene.body, motion)
    nose = torch.tensor([0.0, 1.5, 0.1, 1.0])
    places = (transforms[:, 0] @ nose)[:, :3] - torch.from_numpy(motion.root_translation_m)
    angle = np.unwrap(np.arctan2(places[:, 0].numpy(), places[:, 2].numpy()))
    steps = np.diff(angle)
    np.testing.assert_allclose(steps, 2.0 * np.pi / len(motion.time_s), atol=1e-4)
    np.testing.assert_allclose(transforms[0].numpy(), np.tile(np.eye(4), (transforms.shape[1], 1, 1)), atol=1e-6)


def test_the_camera_sees_the_whole_box_from_above(scene: PaintedScene) -> None:
    low_high = np.array([[-0.9, 0.0, -0.5], [0.7, 2.1, 0.6]])
    view = FilmView(low_high)
    corners = torch.tensor([[x, y, z] for x in low_high[:, 0] for y in low_high[:, 1] for z in low_high[:, 2]])
    pixels, depth_m = project(corners.float(), view.camera)
    assert depth_m.min() > 0.1
    assert pixels.min() > 0.0
    assert pixels[:, 0].max() < WIDTH_PX
    assert pixels[:, 1].max() < HEIGHT_PX
    point_m = np.array([3.0, 0.0, -2.0])
    moved, _ = project(corners.float() + torch.from_numpy(point_m).float(), view.at(point_m))
    np.testing.assert_allclose(moved.numpy(), pixels.numpy(), atol=1e-2)


def test_the_lines_of_the_ground_are_where_they_project() -> None:
    view, point_m = FilmView(np.array([[-0.9, 0.0, -0.5], [0.7, 2.1, 0.6]])), np.array([0.2, 0.0, -0.1])
    row, column = HEIGHT_PX - view.ground.first_row - 40, 300
    x_m, z_m = view.ground.x_z_m[:, row, column]
    pixel = project(torch.tensor([[x_m, 0.0, z_m]]), view.camera)[0][0].numpy()
    np.testing.assert_allclose(pixel, [column + 0.5, HEIGHT_PX - 40 + 0.5], atol=0.02)
    darkness = view.ground.line_darkness(point_m)
    for world_m, is_dark in ((0.5, True), (0.25, False)):
        place = torch.tensor([[world_m, 0.0, 0.25]])
        pixels = project(place, view.at(point_m))[0].numpy().astype(int)
        assert (darkness[pixels[0, 1] - view.ground.first_row, pixels[0, 0]] > 0.03) == is_dark


def test_the_film_shows_the_white_person_and_a_shadow_on_grey(run: Path) -> None:
    loaded = load(run)
    avatar = load_textured_avatar(run / "mesh", run / "texture")
    first = next(render_film(avatar, loaded.body, film_motion(None, loaded)))
    assert (first == 255).all(axis=2).sum() > 10_000
    assert first[0].max() < 220
    lower = first[HEIGHT_PX // 2 :]
    assert lower.min() < 0.85 * np.median(lower)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--clip", "dance"], "there is no clip dance; choose capture, idle or turntable"),
        (["--clip", "none.bvh"], "none.bvh does not exist"),
        (["--clip", "/"], "there is no clip /; choose capture"),
        (["--name", "a/b"], "is not the name of a folder"),
    ],
)
def test_bad_input_is_one_sentence_and_writes_nothing(
    arguments: list[str], words: str, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The scene, which takes seconds, is not loaded for it."""
    monkeypatch.setattr(film, "load_scene", lambda inputs, config: pytest.fail("the scene was loaded"))
    before = sorted(path.name for path in run.rglob("*"))
    with pytest.raises(UserError, match=words):
        main([str(run), *arguments])
    assert sorted(path.name for path in run.rglob("*")) == before


def test_clips_without_hips_of_no_length_or_of_too_many_frames_are_named(run: Path, tmp_path: Path) -> None:
    pose([str(run), "--name", "motion"])
    text = (run / "pose" / "motion" / "capture.bvh").read_text()
    lines = text.splitlines()
    start = next(row for row, line in enumerate(lines) if line.startswith("Frames:"))
    short = [*lines[: start + 1], "Frame Time: 0.0002", *lines[start + 2 :]]
    clips = {
        "legs": (text.replace("mixamorig:Hips", "Tail"), "no joint for Hips"),
        "short": ("\n".join(short), "a film needs at least"),
        "still": ("\n".join([*lines[: start + 1], "Frame Time: 0", *lines[start + 2 :]]), "not a complete BVH file"),
        "long": (text.replace(lines[start], "Frames: 10000000"), "has 10000000 frames"),
    }
    for name, (content, words) in clips.items():
        (tmp_path / f"{name}.bvh").write_text(content)
        with pytest.raises(UserError, match=rf"{name}\.bvh.*{words}"):
            main([str(run), "--clip", str(tmp_path / f"{name}.bvh")])
    assert not (run / "film").exists()


def test_a_film_for_players_has_half_chroma_and_true_colours(tmp_path: Path) -> None:
    colours = np.array([[200, 30, 30], [30, 160, 60], [40, 60, 190], [120, 120, 120]], np.uint8)
    frame = np.repeat(np.repeat(colours.reshape(2, 2, 3), 64, axis=0), 64, axis=1)
    write_video(tmp_path / "colours.mp4", [frame] * 3, FPS, FOR_PLAYERS)
    with av.open(str(tmp_path / "colours.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.pix_fmt == "yuv420p"
        decoded = next(container.decode(video=0))
        assert decoded.colorspace == 1  # ITU-R BT.709
    (shown,) = read_film(tmp_path / "colours.mp4")[:1]
    assert np.abs(shown[16:48, 16:48].astype(int) - colours[0]).max() <= 4


@pytest.mark.parametrize("name", ["capture", "idle", "turntable"])
def test_a_file_does_not_replace_the_film_of_a_clip(run: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / f"{name}.bvh").write_text("HIERARCHY")
    with pytest.raises(UserError, match=f"{name} is the name of a film .* --name"):
        main([str(run), "--clip", str(tmp_path / f"{name}.bvh")])
    assert not (run / "film").exists()
