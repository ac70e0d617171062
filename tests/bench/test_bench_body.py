import math

import pytest

from data_tools.evaluate.truth import load_truth
from pipeline.body.files import load_body
from tests.bench.bench_body import COLUMNS, TOLD, line, ways


def test_each_way_tells_what_it_says(smoke_run):
    capture = smoke_run.parent / "capture"
    camera, bare = load_truth(capture).camera, load_body(capture / "truth" / "bare.npz")
    told = dict(ways(capture))
    assert tuple(told) == TOLD
    half_side_px = 0.5 * max(camera.width, camera.height)
    seen_deg = told["focal and stature"].field_of_view_deg
    assert half_side_px / math.tan(math.radians(seen_deg / 2)) == pytest.approx(camera.fx)
    assert told["stature"].height_m == told["focal and stature"].height_m == pytest.approx(bare.height_m())
    assert told["stature"].field_of_view_deg is told["nothing"].field_of_view_deg is told["nothing"].height_m is None


def test_a_line_has_a_figure_under_each_head():
    figures = {name: float(place) for place, name in enumerate(COLUMNS.values())}
    assert line({"capture": "turn", "told": "nothing"} | figures).split()[2:] == [str(n) for n in range(len(COLUMNS))]
