from dataclasses import replace

import pytest

from pipeline.body.settings import FitSettings


@pytest.mark.parametrize("name", ["pose_rounds", "landmark_std_m", "initial_focal_ratio"])
def test_settings_out_of_range_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} = 0.* must be above 0"):
        replace(FitSettings(), **{name: type(getattr(FitSettings, name))(0)})


def test_the_principal_point_can_be_fixed() -> None:
    assert replace(FitSettings(), principal_point_std_ratio=0.0).principal_point_std_ratio == 0.0


@pytest.mark.parametrize(
    ("values", "names"),
    [
        ({"exif_focal_std": 0.6}, "exif_focal_std = 0.6 must be at most initial_focal_std = 0.5"),
        ({"hand_std_m": 0.01}, "fitted_hand_std_m = 0.012 must be at most hand_std_m = 0.01"),
    ],
)
def test_contradicting_settings_are_refused(values: dict[str, float], names: str) -> None:
    with pytest.raises(ValueError, match=names):
        replace(FitSettings(), **values)
