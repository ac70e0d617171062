"""The report of a small run whose errors are known in closed form."""

import json
import math
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.capture.capture import Capture, load_capture, mask_path, save_capture
from pipeline.core.errors import UserError
from pipeline.core.manifest import digest_files
from pipeline.core.progress import take_warnings
from pipeline.io.image import write_gray
from pipeline.report.lpips_weights import find_lpips_weights
from pipeline.report.settings import ReportSettings
from stages.report import STAGE, Config, run, scored_positions
from tests.stages.report_run import COLOUR_ERROR, FRAME_INDEX, make_run

CONFIG = Config(
    samples_per_pixel_side=3,
    max_page_frames=2,
    turntable_views=4,
    fit_held_out_poses=True,
)
SETTINGS = ReportSettings(turntable_height_px=64, head_height_px=64)
QUICK = Config(samples_per_pixel_side=1, max_page_frames=1, turntable_views=2, score_unrefined_mesh=False)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return make_run(tmp_path_factory.mktemp("runs") / "small")


@pytest.fixture(scope="module")
def out(inputs: dict[str, Path]) -> Path:
    folder = inputs["frames"].parent / "report.part"
    folder.mkdir()
    before = {name: digest_files(path) for name, path in inputs.items()}
    metrics = run(inputs, folder, CONFIG, SETTINGS)
    assert metrics["mesh_psnr_body"] > metrics["field_psnr_body"]
    assert before == {name: digest_files(path) for name, path in inputs.items()}  # inputs are read only
    return folder


@pytest.fixture(scope="module")
def report(out: Path) -> dict:
    return json.loads((out / "report.json").read_text())


def test_all_declared_files_are_written(out: Path):
    assert {path.name for path in out.iterdir()} == set(STAGE.makes)


def test_the_mesh_error_is_the_colour_error_that_was_put_in(report: dict):
    expected_db = 20 * math.log10(255 / COLOUR_ERROR)
    scores = report["heldout"]["mesh"]
    # Pixels on the outline are half white, so their error is smaller: 0.2 dB on so small a picture.
    assert expected_db - 0.05 < scores["psnr_body"] < expected_db + 0.4
    assert scores["mask_iou"] > 0.99
    assert scores["psnr_full"] > scores["psnr_box"] > scores["psnr_body"] - 0.1  # white on white flatters


def test_the_full_image_dilutes_the_body_error_by_its_share(report: dict, inputs: dict[str, Path]):
    capture = load_capture(inputs["frames"])
    shares = {int(i): capture.mask(k).mean() for k, i in enumerate(capture.frame_index)}
    for row in report["heldout"]["frames"]:
        gained_db = -10 * math.log10(shares[row["index"]])
        assert row["mesh"]["psnr_full"] - row["mesh"]["psnr_body"] == pytest.approx(gained_db, abs=0.4)


def test_only_frames_divisible_by_eight_are_scored(report: dict):
    assert [row["index"] for row in report["heldout"]["frames"]] == [0, 8, 16]
    assert "3 frames" in report["heldout"]["protocol"]


def test_poses_without_refinement_score_worse(report: dict):
    heldout = report["heldout"]
    assert heldout["mesh_unrefined"]["mask_iou"] < heldout["mesh"]["mask_iou"] - 0.05
    assert heldout["mesh_unrefined"]["psnr_body"] < heldout["mesh"]["psnr_body"] - 1


def test_the_mesh_is_drawn_with_the_softness_of_the_masks(report: dict):
    # The painted masks are antialiased by square pixels: nothing is left to soften.
    assert report["masks"]["edge_blur_sigma_px"] == pytest.approx(12**-0.5, abs=0.08)
    assert report["heldout"]["mesh_sharp"]["psnr_full"] == pytest.approx(
        report["heldout"]["mesh"]["psnr_full"], abs=0.3
    )


def test_the_field_without_refinement_is_scored_only_on_request(report: dict):
    assert "field_unrefined" not in report["heldout"]
    assert "mesh_unrefined" in report["heldout"]["frames"][0]


def test_poses_fitted_to_held_out_images_are_scored_apart(report: dict, out: Path):
    heldout = report["heldout"]
    assert {"field_pose_fitted", "mesh_pose_fitted"} <= heldout.keys()
    assert "pose_fitted are not held-out scores" in heldout["protocol"]
    # the refined poses of this run are the true ones, so the fit has nothing to find
    assert heldout["mesh_pose_fitted"]["psnr_body"] == pytest.approx(heldout["mesh"]["psnr_body"], abs=1.0)
    held_out, apart = re.findall(
        r"<h3>((?:Held-out|Poses fitted)[^<]*)</h3><table>(.*?)</table>", (out / "index.html").read_text()
    )
    assert "pose fitted" not in held_out[1]
    assert "mesh pose fitted" in apart[1]


def test_lpips_is_present_or_reported_missing(report: dict):
    has_weights = find_lpips_weights() is not None
    assert ("lpips_full" in report["heldout"]["mesh"]) == has_weights
    assert report["heldout"]["lpips"].startswith("AlexNet" if has_weights else "not computed")


def test_an_untrained_field_is_worse_than_the_mesh(report: dict):
    assert report["heldout"]["field"]["psnr_body"] < report["heldout"]["mesh"]["psnr_body"]


def test_figures_of_the_other_stages_are_passed_on(report: dict, inputs: dict[str, Path]):
    assert report["masks"]["count"] == len(FRAME_INDEX)
    assert report["body"] == {"landmark_error_px": 3.5, "silhouette_iou": 0.9}
    assert report["export"]["texture_px"] == 64
    assert report["export"]["glb_bytes"] == (inputs["export"] / "avatar.glb").stat().st_size
    assert report["mesh"]["watertight"] is True
    assert report["mesh"]["components"] == 1
    assert report["seconds"]["total"] == pytest.approx(21 + report["seconds"]["report"], abs=1e-2)
    assert report["seconds"]["report"] > 0
    assert report["peak_rss_mib"]["report"] > 50


def test_the_page_shows_the_chosen_frames(out: Path):
    page = (out / "index.html").read_text()
    assert page.count('class="card frame"') == CONFIG.max_page_frames
    assert page.count('data-kind="mesh"') == CONFIG.max_page_frames
    assert "<title>small</title>" in page


def test_sheets_show_the_avatar(out: Path):
    turntable = cv2.imread(str(out / "turntable.jpg"))
    assert turntable.shape[0] > 2 * SETTINGS.turntable_height_px
    assert (turntable < 200).any(axis=2).mean() > 0.1
    assert cv2.imread(str(out / "heldout.jpg")) is not None
    clay = cv2.imread(str(out / "clay.jpg"))
    assert clay.shape[0] > 4 * SETTINGS.turntable_height_px  # smooth, flat, normals, head
    smooth = clay[: SETTINGS.turntable_height_px].astype(int)
    assert np.abs(smooth - smooth.mean(axis=2, keepdims=True)).max() < 12  # grey, but for the compression
    page = (out / "index.html").read_text()
    titles = re.findall(r'class="card turntable"><h3>([^<]*)</h3>', page)
    assert [title.split(":")[0] for title in titles] == [
        *(
            "A-pose",
            "Head, as exported",
            "Rest pose, clay",
            "Rest pose, clay, flat shading",
            "Rest pose, normals",
            "Head, clay",
        ),
        *("Pose of frame 8, held out", "Pose of frame 8, held out, clay"),
    ]


def test_without_held_out_frames_the_reason_is_named(inputs: dict[str, Path], tmp_path: Path):
    frames = tmp_path / "frames"
    shutil.copytree(inputs["frames"], frames)
    fields = load_capture(frames).__dict__ | {"split": np.zeros(len(FRAME_INDEX), dtype=np.uint8)}
    save_capture(Capture(**fields))
    with pytest.raises(UserError, match="every eighth frame"):
        run(inputs | {"frames": frames}, tmp_path, CONFIG, SETTINGS)


def test_a_held_out_frame_without_a_person_is_left_out_with_a_warning(inputs: dict[str, Path], tmp_path: Path):
    """Of three held-out frames one has an empty mask and one a person of 10 px: what no metric can say is not said."""
    frames = tmp_path / "frames"
    shutil.copytree(inputs["frames"], frames)
    blank = np.zeros_like(cv2.imread(str(mask_path(frames, 0)), cv2.IMREAD_GRAYSCALE))
    write_gray(mask_path(frames, 0), blank)
    small = blank.copy()
    small[20:30, 20:40] = 255
    write_gray(mask_path(frames, 16), small)
    take_warnings()
    out = tmp_path / "report"
    out.mkdir()
    run(inputs | {"frames": frames}, out, QUICK, SETTINGS)
    assert [row["index"] for row in json.loads((out / "report.json").read_text())["heldout"]["frames"]] == [8]
    empty, tiny = take_warnings()
    assert "held-out frame 0 is not scored: no pixel of its mask" in empty
    assert "held-out frame 16 is not scored: the foreground has 20 x 10 px" in tiny
    write_gray(mask_path(frames, 8), blank)
    with pytest.raises(UserError, match=r"no held-out frame of .*frames can be scored \(frame 0: no pixel"):
        scored_positions(load_capture(frames))
    assert len(take_warnings()) == 3


def test_as_many_held_out_frames_are_scored_as_asked_for(inputs: dict[str, Path], tmp_path: Path):
    run(inputs, tmp_path, QUICK.model_copy(update={"frames": 2}), SETTINGS)
    heldout = json.loads((tmp_path / "report.json").read_text())["heldout"]
    assert [row["index"] for row in heldout["frames"]] == [0, 16]
    assert "3 frames were held out; 2 of them" in heldout["protocol"]


def test_without_a_manifest_the_command_is_named(inputs: dict[str, Path], tmp_path: Path):
    with pytest.raises(UserError, match="python -m stages mesh"):
        run(inputs | {"mesh": tmp_path / "mesh"}, tmp_path, CONFIG, SETTINGS)
