"""Age and weight of the generated person."""

from pathlib import Path

import numpy as np
import pytest

from data_tools.sample import main
from data_tools.synthetic.person.person import make_person
from pipeline.body.body import Body
from pipeline.core.errors import UserError


def head_share(body: Body) -> float:
    """Height above the neck joint over the stature."""
    top_m = float(body.vertices[:, 1].max())
    return (top_m - float(body.joints_m[body.joint("Neck"), 1])) / body.height_m()


def test_a_child_has_a_larger_head_and_heavy_people_are_wider() -> None:
    adult, child, heavy = (
        make_person(3, 64, phenotypes=phenotypes)[1] for phenotypes in ({}, {"age": 0.2}, {"weight": 1.0})
    )
    assert head_share(child) > 1.2 * head_share(adult)
    assert heavy.height_m() == pytest.approx(adult.height_m(), rel=0.03)
    spine = heavy.joint("Spine")
    girth = [np.ptp(b.vertices[b.skin_weights[:, spine] > 0.5], axis=0)[[0, 2]].sum() for b in (adult, heavy)]
    assert girth[1] > 1.05 * girth[0]


def test_a_phenotype_out_of_its_range_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"--age 1.5 is out of range; choose a value from 0.0 to 1.0"):
        main([str(tmp_path / "out"), "--age", "1.5"])
