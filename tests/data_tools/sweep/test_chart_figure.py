"""The chart: Pareto front, positions of the markers, and equal files for equal runs."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_tools.sweep.chart_figure import (
    SIZE_PANELS,
    TIME_PANELS,
    ChartPoint,
    draw_chart,
    pareto_front,
    preset_means,
    save_figure,
)

QUICK = ChartPoint(
    "ann", "quick", 0, 10.0, 20.0, {"mesh_psnr_full_db": 24.0, "field_psnr_full_db": 25.0}, [(8.0, 22.0, 18.0)]
)
SLOW = ChartPoint("ann", "slow", 0, 100.0, 200.0, {"mesh_psnr_full_db": 28.0, "field_psnr_full_db": 30.0})
WHOLE, _, CHAMFER, _ = TIME_PANELS
WORSE = ChartPoint("ann", "worse", 0, 110.0, 210.0, {"mesh_psnr_full_db": 23.0})

coarse = st.integers(0, 6).map(float)


@given(st.lists(st.tuples(coarse, coarse), max_size=12), st.booleans())
def test_pareto_front_against_a_sorted_scan(entries: list[tuple[float, float]], higher: bool) -> None:
    """Reference: in order of time, each entry that is better than all before it, and its equals."""
    sign = 1.0 if higher else -1.0
    found: set[tuple[float, float]] = set()
    best = float("-inf")
    for seconds, score in sorted(set(entries), key=lambda entry: (entry[0], -sign * entry[1])):
        if sign * score > best:
            best = sign * score
            found.add((seconds, score))
    front = pareto_front(entries, higher)
    assert front == sorted(front, key=lambda index: (entries[index][0], -sign * entries[index][1]))
    assert {index for index, entry in enumerate(entries) if entry in found} == set(front)


def test_means_over_seeds() -> None:
    again = replace(QUICK, seed=1, seconds=40.0, scores={"mesh_psnr_full_db": 26.0})
    assert preset_means([QUICK, again, SLOW], WHOLE) == {"quick": (30.0, 25.0), "slow": (200.0, 28.0)}
    field = replace(WHOLE, score="field_psnr_full_db")
    assert preset_means([QUICK, again, SLOW], field) == {"quick": (20.0, 25.0), "slow": (200.0, 30.0)}
    assert preset_means([QUICK], CHAMFER) == {}


def test_a_preset_has_the_range_of_its_seeds() -> None:
    again = replace(QUICK, seed=1, seconds=40.0, scores={"mesh_psnr_full_db": 26.0})
    (axes,) = draw_chart([QUICK, again], "").axes
    bars = [line for line in axes.get_lines() if line.get_linewidth() == 2 and len(line.get_xydata()) == 2]
    assert [[tuple(end) for end in bar.get_xydata()] for bar in bars] == [
        [(20.0, 25.0), (40.0, 25.0)],
        [(30.0, 24.0), (30.0, 26.0)],
    ]


def test_size_panels_have_sizes_along_their_axis() -> None:
    scores = {"mesh_psnr_body_db": 24.0, "field_psnr_body_db": 26.0}
    sized = replace(QUICK, scores=scores, sizes={"parameters": 1e6, "glb_bytes": 4e6})
    figure = draw_chart([sized, replace(SLOW, scores=scores)], "", SIZE_PANELS)
    assert [axes.get_xlabel() for axes in figure.axes] == ["parameters of the field", "bytes of the .glb"]
    dots = [
        [tuple(line.get_xydata()[0]) for line in axes.get_lines() if line.get_marker() == "."] for axes in figure.axes
    ]
    assert dots == [[(1e6, 26.0)], [(4e6, 24.0)]]
    with pytest.raises(ValueError, match="at least one run with a score"):
        draw_chart([QUICK], "", SIZE_PANELS)


def test_panels_without_scores_are_left_out() -> None:
    assert len(draw_chart([QUICK, SLOW], "").axes) == 1
    known = replace(SLOW, capture="bob", scores={**SLOW.scores, "chamfer_mm": 5.0})
    figure = draw_chart([QUICK, known], "")
    assert [axes.get_title(loc="left") for axes in figure.axes] == [
        f"{capture}: {panel.title}" for capture in ("ann", "bob") for panel in (WHOLE, CHAMFER)
    ]
    assert [axes.get_visible() for axes in figure.axes] == [True, False, True, True]
    with pytest.raises(ValueError, match="at least one run with a score"):
        draw_chart([replace(QUICK, scores={})], "")


def test_markers_are_at_the_scores() -> None:
    (axes,) = draw_chart([QUICK, SLOW, WORSE], "").axes
    assert axes.get_xscale() == "log"
    lines = [[tuple(map(float, place)) for place in line.get_xydata()] for line in axes.get_lines()]
    assert [(10.0, 25.0)] in lines  # the field, before the mesh
    assert [(20.0, 24.0)] in lines
    assert [(8.0, 22.0)] in lines  # while it learnt
    rings = [line for line in axes.get_lines() if line.get_markersize() == 12]
    assert [[*map(tuple, ring.get_xydata())] for ring in rings] == [[(20.0, 24.0), (200.0, 28.0)]]


def test_equal_runs_give_equal_files(tmp_path: Path) -> None:
    texts = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        save_figure(draw_chart([QUICK, SLOW], "commit <abc>; 2 cores"), tmp_path / name, "chart", dpi=130)
        texts.append((tmp_path / name / "chart.svg").read_bytes())
        assert (tmp_path / name / "chart.png").stat().st_size > 5000
    assert texts[0] == texts[1]
    words = {element.text for element in ElementTree.fromstring(texts[0]).iter() if element.tag.endswith("text")}
    assert {"quick", "slow", "commit <abc>; 2 cores", "Pareto front"} <= words
