"""The shortest arc takes one direction to the other, turns about their common normal, and survives opposite ones."""

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from data_tools.synthetic.rig.directions import shortest_arc

coordinates = st.floats(-1.0, 1.0, allow_nan=False)
directions = st.tuples(coordinates, coordinates, coordinates).filter(lambda d: sum(c * c for c in d) > 0.01)


@given(start=directions, end=directions)
def test_start_lands_on_end(start: tuple[float, ...], end: tuple[float, ...]) -> None:
    a, b = torch.tensor(start, dtype=torch.float64), torch.tensor(end, dtype=torch.float64)
    rotation = shortest_arc(a, b)
    assert torch.allclose(rotation @ a / a.norm(), b / b.norm(), atol=1e-6)
    assert torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-9)
    assert torch.linalg.det(rotation) == pytest.approx(1.0)


@given(start=directions, end=directions)
def test_the_arc_is_the_shortest(start: tuple[float, ...], end: tuple[float, ...]) -> None:
    a, b = torch.tensor(start, dtype=torch.float64), torch.tensor(end, dtype=torch.float64)
    between = torch.dot(a, b) / (a.norm() * b.norm())
    assume(abs(between) < 0.999)
    turned = torch.arccos(((torch.trace(shortest_arc(a, b)) - 1) / 2).clamp(-1, 1))
    assert turned == pytest.approx(torch.arccos(between).item(), abs=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_opposite_directions(axis: int) -> None:
    start = torch.zeros(3)
    start[axis] = 2.0
    assert torch.allclose(shortest_arc(start, -start) @ start, -start, atol=1e-5)
