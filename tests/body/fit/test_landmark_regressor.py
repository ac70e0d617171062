import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.landmark_regressor import (
    LANDMARK_COUNT,
    LANDMARK_OFFSET_COUNT,
    LANDMARKS,
    LEFT_RIGHT_PAIRS,
    landmark_regressor,
    landmark_std_ratio,
    mirror_permutation,
)
from pipeline.body.fit.linear_body import linearise_body


def test_the_table_names_every_landmark_once() -> None:
    assert sorted(index for landmark in LANDMARKS for index in landmark.indices) == list(range(LANDMARK_COUNT))


def test_landmarks_have_their_tabulated_positions_and_are_symmetric() -> None:
    body = load_anny()
    model = linearise_body(body, body.shape_defaults)
    rest = landmark_regressor(model).points(model, torch.zeros(LANDMARK_OFFSET_COUNT, dtype=torch.float64)).rest_m[0]
    for landmark in LANDMARKS:
        assert torch.allclose(
            rest[landmark.indices[0]], torch.tensor(body.landmark_positions_m[landmark.name]).double(), atol=1e-6
        )
    for left, right in LEFT_RIGHT_PAIRS:
        assert torch.allclose(rest[left] * torch.tensor([-1.0, 1.0, 1.0]), rest[right], atol=1e-6)
        assert rest[left, 0] > 0  # the person's left is +X


def test_landmarks_follow_the_shape() -> None:
    body = load_anny()
    default = linearise_body(body, body.shape_defaults)
    shape = body.shape_defaults.clone()
    shape[body.shape_names.index("lowerleg-length")] = 0.5
    longer = linearise_body(body, shape)
    regressor, offsets = landmark_regressor(default), torch.zeros(LANDMARK_OFFSET_COUNT, dtype=torch.float64)
    shins = []
    for model in (default, longer):
        rest = regressor.points(model, offsets).rest_m[0]
        shins.append((rest[25] - rest[27]).norm())
    assert shins[1] > shins[0] + 0.02


def test_offsets_are_mirrored() -> None:
    body = load_anny()
    model = linearise_body(body, body.shape_defaults)
    regressor = landmark_regressor(model)
    offsets = torch.zeros(LANDMARK_OFFSET_COUNT, dtype=torch.float64)
    knee = next(row for row, landmark in enumerate(LANDMARKS) if landmark.name == "knee")
    offsets[3 * knee : 3 * knee + 3] = torch.tensor([0.01, 0.02, 0.03])
    moved = regressor.points(model, offsets).rest_m[0] - regressor.points(model, 0 * offsets).rest_m[0]
    assert torch.allclose(moved[25], torch.tensor([0.01, 0.02, 0.03]).double())
    assert torch.allclose(moved[26], torch.tensor([-0.01, 0.02, 0.03]).double())
    assert torch.count_nonzero(moved) == 6


def test_swapping_twice_is_the_identity() -> None:
    order = mirror_permutation(LEFT_RIGHT_PAIRS)
    assert [order[index] for index in order] == list(range(LANDMARK_COUNT))
    assert order[0] == 0
    assert order[11] == 12


def test_standard_deviations_are_symmetric() -> None:
    std_ratio = landmark_std_ratio()
    assert torch.equal(std_ratio, std_ratio[mirror_permutation(LEFT_RIGHT_PAIRS)])
