"""Charts: well-formed SVG whose lengths and places are proportional to the values."""

import math
import xml.etree.ElementTree as ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.report.charts import bar_chart, legend, line_chart


def parse(svg: str) -> ElementTree.Element:
    return ElementTree.fromstring(svg)


def test_bars_are_proportional_and_labelled():
    chart = parse(bar_chart([("a<b", 50.0), ("long", 100.0), ("none", 0.0)], "s"))
    widths = [float(rect.get("width", "nan")) for rect in chart.iter("rect")]
    assert widths[1] == pytest.approx(2 * widths[0], abs=0.1)
    assert 0 < widths[2] < 3  # a bar of nothing is still seen
    texts = [text.text for text in chart.iter("text")]
    assert texts == ["a<b", "50 s", "long", "100 s", "none", "0 s"]


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_bars_refuse_what_has_no_length(value):
    with pytest.raises(ValueError, match="finite"):
        bar_chart([("a", value)], "s")


@given(st.lists(st.tuples(st.integers(0, 500).map(float), st.floats(-60, 60)), min_size=1, max_size=30))
def test_lines_stay_inside_and_keep_their_order(points):
    line = sorted(dict(points).items())
    chart = parse(line_chart({"one": line}, "frame", "dB"))
    width, height = (float(part) for part in chart.get("viewBox", "").split()[2:])
    dots = [(float(dot.get("cx", "nan")), float(dot.get("cy", "nan"))) for dot in chart.iter("circle")]
    assert len(dots) == len(line)
    assert all(0 <= x <= width and 0 <= y <= height for x, y in dots)
    assert [x for x, _ in dots] == sorted(x for x, _ in dots)
    highest, lowest = max(range(len(line)), key=lambda i: line[i][1]), min(range(len(line)), key=lambda i: line[i][1])
    assert dots[highest][1] <= dots[lowest][1]  # larger values are drawn higher up


def test_lines_leave_out_what_is_not_finite():
    chart = parse(line_chart({"a": [(0.0, 1.0), (1.0, math.inf), (2.0, 2.0)], "b": [(0.0, math.nan)]}, "x", "y"))
    assert len(list(chart.iter("circle"))) == 2
    with pytest.raises(ValueError, match="at least one"):
        line_chart({"a": [(0.0, math.inf)]}, "x", "y")


def test_legend_names_are_escaped():
    assert "&lt;x&gt;" in legend(["<x>"])
