import numpy as np
import pytest

from pipeline.body.body import canonical_to_world
from pipeline.field.rendering import render_field
from pipeline.field.trainer import Trainer
from pipeline.field.validation import Validator
from pipeline.metrics.images import composite_on_white, composite_premultiplied_on_white

HELD = np.array([2, 5])


@pytest.fixture(scope="module")
def validator(scene) -> Validator:
    return Validator(scene.motion.select(HELD), scene.camera, [(scene.images[row], scene.masks[row]) for row in HELD])


def test_subsampled_images_are_pixels_of_the_full_images(validator: Validator, trained: Trainer):
    subsampled_validator = validator.subsampled()
    poses = validator.pose_warps(trained, refined=False)
    whole, few = validator.render(trained, poses)[0], subsampled_validator.render(trained, poses)[0]
    sides = few.shape[:2]
    picked = whole[2::5, 2::5][: sides[0], : sides[1]].astype(int)
    assert np.array_equal(
        subsampled_validator.ground_truth[0][0], validator.ground_truth[0][0][2::5, 2::5][: sides[0], : sides[1]]
    )
    # The rays differ by rounding; a sample in a neighbouring cell changes a few pixels.
    assert np.quantile(np.abs(few - picked), 0.99) <= 2


def test_the_subsampled_psnr_is_that_of_the_selected_pixels(validator: Validator, trained: Trainer):
    subsampled_validator = validator.subsampled()
    poses = validator.pose_warps(trained, refined=False)
    kept = [
        render[2::5, 2::5][: subsampled_validator.camera.height, : subsampled_validator.camera.width]
        for render in validator.render(trained, poses)
    ]
    assert subsampled_validator.mean_psnr_db(subsampled_validator.render(trained, poses)) == pytest.approx(
        subsampled_validator.mean_psnr_db(kept), abs=0.2
    )


def test_frames_are_rendered_in_their_own_poses(scene, validator: Validator, trained: Trainer):
    poses, skin = validator.pose_warps(trained, refined=False), trained.scene.skin
    for row, render in enumerate(validator.render(trained, poses)):
        alone = Validator(
            validator.motion.select(np.array([row])), validator.camera, validator.ground_truth[row : row + 1]
        )
        assert np.array_equal(alone.render(trained, alone.pose_warps(trained, refined=False))[0], render)
        pose = canonical_to_world(scene.body, validator.motion)[row]
        drawn = render_field(trained.field, trained.occupancy.binary(), scene.body, pose, scene.camera, skin)
        assert np.array_equal(composite_premultiplied_on_white(drawn.numpy()), render)


def test_psnr_of_the_ground_truth_is_infinite_and_of_no_frames_nan(validator: Validator):
    assert validator.mean_psnr_db([composite_on_white(*truth) for truth in validator.ground_truth]) == (np.inf, np.inf)
    assert all(np.isnan(Validator(validator.motion.select(np.zeros(0, int)), validator.camera, []).mean_psnr_db([])))
