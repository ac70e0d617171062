"""Settings of the mesh stage: values out of range and contradictions are refused by name."""

import pytest

from pipeline.mesh.settings import MeshSettings


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"learning_rate": 0.0}, "learning_rate = 0.0 is not allowed"),
        ({"coarse_scale": 1.5}, "coarse_scale = 1.5 is not allowed"),
        ({"coarse_step_ratio": 0.0}, "coarse_step_ratio = 0.0 is not allowed"),
        ({"isovalues_per_m": ()}, "isovalues_per_m"),
        ({"isovalues_per_m": (8.0, -1.0)}, "isovalues_per_m"),
        ({"decimate_percentile": 96.0}, "decimate_percentile = 96.0 and subdivide_percentile = 95.0 contradict"),
        ({"decimated_edge_ratio": 0.5}, "decimated_edge_ratio = 0.5 is not allowed"),
        ({"remeshing": "uniform"}, "remeshing = uniform and remeshed_faces = 0 contradict"),
        ({"remeshed_faces": 500}, "remeshing = error and remeshed_faces = 500 contradict"),
        ({"final_faces": -1}, "final_faces = -1 is not allowed"),
    ],
)
def test_values_out_of_range_and_contradictions_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MeshSettings(**changes)
