import math

import pytest

from data_tools.evaluate.truth import load_ground_truth
from pipeline.body.files import load_body
from tests.bench.bench_body import COLUMNS, KNOWN_INPUTS, format_row, known_input_configs


def test_known_input_configs_hold_the_true_values(smoke_run):
    capture = smoke_run.parent / "capture"
    camera, bare = load_ground_truth(capture).camera, load_body(capture / "truth" / "bare.npz")
    known_inputs = dict(known_input_configs(capture))
    assert tuple(known_inputs) == KNOWN_INPUTS
    half_side_px = 0.5 * max(camera.width, camera.height)
    seen_deg = known_inputs["focal and stature"].field_of_view_deg
    assert half_side_px / math.tan(math.radians(seen_deg / 2)) == pytest.approx(camera.fx)
    assert (
        known_inputs["stature"].height_m == known_inputs["focal and stature"].height_m == pytest.approx(bare.height_m())
    )
    assert (
        known_inputs["stature"].field_of_view_deg
        is known_inputs["nothing"].field_of_view_deg
        is known_inputs["nothing"].height_m
        is None
    )


def test_row_has_a_value_for_each_column():
    figures = {name: float(place) for place, name in enumerate(COLUMNS.values())}
    assert format_row({"capture": "turn", "known_inputs": "nothing"} | figures).split()[2:] == [
        str(n) for n in range(len(COLUMNS))
    ]
