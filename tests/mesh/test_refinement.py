"""Refinement against pictures of a known mesh: errors fall, bad rounds are undone, the surface stays sound."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.body.body import Body
from pipeline.core.progress import take_warnings
from pipeline.geometry.camera import Camera
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import axis_angle_to_matrix
from pipeline.geometry.skinning import rigid_transform
from pipeline.geometry.surface import OpenSurfaceError, is_closed_manifold, isosurface, remesh_isotropic
from pipeline.mesh import refinement as refine_module
from pipeline.mesh.refinement import RefinementState, refine, remesh_adaptively
from pipeline.mesh.vertex_optimisation import (
    FromDifferential,
    RefinementConfig,
    RefinementInputs,
    factorise_smoothing_matrix,
    optimise_vertices,
)
from pipeline.mesh.views import (
    PosedView,
    SkinnedTopology,
    accumulate_face_errors,
    composite_target,
    crop_posed_view,
    pixel_footprint_m,
    render_posed_view,
    silhouette_iou,
    transfer_skin,
    validation_psnr_db,
)

SIZE_PX = 72
CAMERA = Camera(150.0, 150.0, SIZE_PX / 2, SIZE_PX / 2, SIZE_PX, SIZE_PX)
CONFIG = RefinementConfig(rounds=2, steps=40, frames_per_step=2, learning_rate=0.002, max_faces=3000)
EDGE_M = 0.06


def egg(spacing: float = 0.05) -> Mesh:
    """A closed lumpy shape of half a metre."""
    axis = np.arange(-0.5, 0.5001, spacing)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    radius = 0.3 + 0.05 * np.sin(4 * x + 1) * np.cos(5 * y) + 0.04 * np.sin(6 * z)
    return remesh_isotropic(
        isosurface(radius - np.sqrt(x**2 + (0.8 * y) ** 2 + z**2), 0.0, np.full(3, -0.5), spacing), EDGE_M
    )


class Pattern(torch.nn.Module):
    """A smooth coloured pattern in canonical space, whose contrast can be learnt."""

    def __init__(self, contrast: float = 0.4) -> None:
        super().__init__()
        self.contrast = torch.nn.Parameter(torch.tensor(contrast))

    def forward(self, points: Tensor) -> Tensor:
        waves = torch.sin(points * torch.tensor([14.0, 11.0, 17.0]) + torch.tensor([0.0, 1.0, 2.0]))
        return 0.5 + self.contrast * waves


shader = Pattern().requires_grad_(False)


@pytest.fixture(scope="module")
def truth() -> Mesh:
    return egg()


@pytest.fixture(scope="module")
def body(truth: Mesh) -> Body:
    return Body(
        joint_names=("Hips",),
        parents=np.array([-1], dtype=np.int32),
        joints_m=np.zeros((1, 3), dtype=np.float32),
        vertices=truth.vertices,
        faces=truth.faces,
        skin_weights=np.ones((len(truth.vertices), 1), dtype=np.float32),
        shape={},
    )


@pytest.fixture(scope="module")
def views(truth: Mesh, body: Body) -> tuple[list[PosedView], list[PosedView]]:
    """Pictures of the truth from eight sides, and from four sides between them."""
    skin, made = transfer_skin(truth, body), []
    for angle in np.arange(12) * (2 * np.pi / 12):
        turn = axis_angle_to_matrix(torch.tensor([[0.2 * np.sin(3 * angle), angle, 0.0]], dtype=torch.float32))
        blank = torch.zeros(SIZE_PX, SIZE_PX, dtype=torch.uint8)
        view = PosedView(
            blank[..., None].expand(-1, -1, 3), blank, CAMERA, rigid_transform(turn, torch.tensor([[0.0, 0.0, -1.6]]))
        )
        with torch.no_grad():
            image, alpha, _ = render_posed_view(torch.from_numpy(truth.vertices), skin, view, shader)
        colours = torch.where(alpha[..., None] > 1e-3, image / alpha[..., None].clamp_min(1e-3), 0.0).clamp(0, 1)
        made.append(replace(view, image=(255 * colours).round().byte(), mask=(255 * alpha.clamp(0, 1)).round().byte()))
    return [view for i, view in enumerate(made) if i % 3], made[::3]


@pytest.fixture(scope="module")
def dented(truth: Mesh) -> Mesh:
    wave = 0.02 * np.sin(9 * truth.vertices).sum(axis=1, keepdims=True)
    return Mesh((truth.vertices + wave * truth.vertex_normals()).astype(np.float32), truth.faces)


def task_of(
    body: Body, views: tuple, config: RefinementConfig = CONFIG, seed: int = 0, **changes: object
) -> RefinementInputs:
    return replace(
        RefinementInputs(body, views[0], views[1], Pattern().requires_grad_(False), EDGE_M, config, seed), **changes
    )


def distance_m(mesh: Mesh, truth: Mesh) -> float:
    """Mean distance along the normal of corresponding vertices (same triangles)."""
    return float(np.abs(np.sum((mesh.vertices - truth.vertices) * truth.vertex_normals(), axis=1)).mean())


def test_truth_renders_as_its_pictures(truth: Mesh, body: Body, views: tuple) -> None:
    skin = transfer_skin(truth, body)
    assert validation_psnr_db(truth, skin, views[1], shader) > 45  # what rounding to 8 bits leaves
    assert silhouette_iou(truth, skin, views[1]) > 0.98
    assert accumulate_face_errors(truth, skin, views[0], shader).max() < 0.5


def test_optimisation_finds_the_shape_again(truth: Mesh, dented: Mesh, body: Body, views: tuple) -> None:
    skin = transfer_skin(dented, body)
    result = optimise_vertices(dented, skin, task_of(body, views, CONFIG.model_copy(update={"steps": 80})), seed=0)
    assert distance_m(result, truth) < 0.4 * distance_m(dented, truth)
    gain_db = validation_psnr_db(result, skin, views[1], shader) - validation_psnr_db(dented, skin, views[1], shader)
    assert gain_db > 4.0
    np.testing.assert_array_equal(result.faces, dented.faces)


def test_the_global_offset_moves_all_vertices_alike(truth: Mesh, body: Body, views: tuple) -> None:
    shift = np.array([0.01, -0.015, 0.0], dtype=np.float32)
    config = CONFIG.model_copy(update={"learning_rate": 1e-9, "global_learning_rate": 0.002, "steps": 60})
    moved = Mesh(truth.vertices + shift, truth.faces)
    result = optimise_vertices(moved, transfer_skin(moved, body), task_of(body, views, config), seed=0)
    offset = result.vertices - moved.vertices
    np.testing.assert_allclose(offset, np.broadcast_to(offset[0], offset.shape), atol=1e-5)
    np.testing.assert_allclose(offset[0], -shift, atol=0.003)


def test_rounds_improve_and_stay_sound(dented: Mesh, body: Body, views: tuple) -> None:
    seen = []
    result = refine(dented, task_of(body, views), seen.append)
    assert result.finished
    assert list(result.validation_psnr_db) == sorted(result.validation_psnr_db)
    assert result.validation_psnr_db[-1] > result.validation_psnr_db[0] + 3.0
    assert is_closed_manifold(result.mesh)
    assert [state.rounds_done for state in seen][-1] == result.rounds_done


def test_going_on_from_a_round_ends_with_the_same_bytes(dented: Mesh, body: Body, views: tuple) -> None:
    config = CONFIG.model_copy(update={"steps": 8})
    seen: list[RefinementState] = []
    whole = refine(dented, task_of(body, views, config, 3, shader=Pattern()), seen.append)
    assert not seen[0].finished
    resumed = refine(seen[0], task_of(body, views, config, 3, shader=Pattern()))
    assert whole.mesh.vertices.tobytes() == resumed.mesh.vertices.tobytes()
    assert whole.mesh.faces.tobytes() == resumed.mesh.faces.tobytes()
    assert whole.validation_psnr_db == resumed.validation_psnr_db
    assert torch.equal(whole.shader_state["contrast"], resumed.shader_state["contrast"])


def test_a_round_that_makes_validation_worse_is_undone(
    dented: Mesh, body: Body, views: tuple, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of(body, views, shader=Pattern())

    def spoil(mesh: Mesh, *_: object) -> Mesh:
        task.shader.contrast.data.fill_(0.1)
        return Mesh(mesh.vertices * np.float32(1.3), mesh.faces)

    monkeypatch.setattr(refine_module, "optimise_vertices", spoil)
    result = refine(dented, task)
    assert result.finished
    assert result.rounds_done == 1
    assert len(result.validation_psnr_db) == 1
    assert result.mesh is dented
    assert float(task.shader.contrast) == pytest.approx(0.4)


def test_a_round_is_judged_with_the_weights_it_was_optimised_with(
    truth: Mesh, body: Body, views: tuple, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Vertices that move past a jump of the body's weights keep their own; the body's would be others there."""
    above = (body.vertices[:, 1:2] > 0.0).astype(np.float32)
    two = replace(
        body,
        joint_names=("Hips", "Spine"),
        parents=np.array([-1, 0], dtype=np.int32),
        joints_m=np.zeros((2, 3), dtype=np.float32),
        skin_weights=np.concatenate([1.0 - above, above], axis=1),
    )
    lift = rigid_transform(torch.eye(3)[None], torch.tensor([[0.0, 0.05, 0.0]]))[0]
    bent = [
        replace(
            view, canonical_to_world=torch.cat([view.canonical_to_world, (lift @ view.canonical_to_world[0])[None]])
        )
        for view in views[1]
    ]
    used: list[SkinnedTopology] = []

    def sink(mesh: Mesh, skin: SkinnedTopology, *_: object) -> Mesh:
        used.append(skin)
        return Mesh(mesh.vertices - np.array([0.0, 0.1, 0.0], dtype=np.float32), mesh.faces)

    monkeypatch.setattr(refine_module, "optimise_vertices", sink)
    config = CONFIG.model_copy(update={"rounds": 1})
    begun = refine(truth, task_of(two, ([], bent), config.model_copy(update={"rounds": 0})))
    result = refine(replace(begun, validation_psnr_db=(0.0,), finished=False), task_of(two, ([], bent), config))
    assert result.rounds_done == 1
    assert torch.equal(result.skin.weights, used[0].weights)
    assert result.validation_psnr_db[-1] == validation_psnr_db(result.mesh, result.skin, bent, shader)
    anew = validation_psnr_db(result.mesh, transfer_skin(result.mesh, two), bent, shader)
    assert abs(anew - result.validation_psnr_db[-1]) > 1e-3


def test_colours_are_learnt_first_and_the_surface_stays_meanwhile(truth: Mesh, body: Body, views: tuple) -> None:
    pale = Pattern(0.1)
    config = CONFIG.model_copy(update={"appearance_learning_rate": 0.05, "appearance_steps": 40, "steps": 1})
    config = config.model_copy(update={"learning_rate": 1e-9, "global_learning_rate": 0.0})
    result = optimise_vertices(truth, transfer_skin(truth, body), task_of(body, views, config, shader=pale), seed=0)
    assert float(pale.contrast) == pytest.approx(0.4, abs=0.03)
    np.testing.assert_allclose(result.vertices, truth.vertices, atol=1e-6)


def test_no_rounds_leaves_the_mesh(dented: Mesh, body: Body, views: tuple) -> None:
    result = refine(dented, task_of(body, views, CONFIG.model_copy(update={"rounds": 0})))
    assert result.finished
    assert result.mesh is dented


def test_face_errors_lie_where_the_mesh_is_wrong(truth: Mesh, body: Body, views: tuple) -> None:
    top = truth.vertices[:, 1] > 0.2
    bent = Mesh(np.where(top[:, None], truth.vertices * np.float32(1.15), truth.vertices), truth.faces)
    errors = accumulate_face_errors(bent, transfer_skin(bent, body), views[0], shader)
    on_top = top[truth.faces].all(axis=1)
    assert errors[on_top].mean() > 5 * errors[~on_top].mean()


def test_triangles_go_where_the_error_is(truth: Mesh) -> None:
    centres = truth.vertices[truth.faces].mean(axis=1)
    errors = np.exp(8 * centres[:, 1])
    config = CONFIG.model_copy(update={"subdivide_percentile": 90.0})
    adapted = remesh_adaptively(truth, errors, EDGE_M, config)
    assert is_closed_manifold(adapted)

    def share_above(mesh: Mesh) -> float:
        return float((mesh.vertices[mesh.faces].mean(axis=1)[:, 1] > 0.2).mean())

    assert share_above(adapted) > 1.5 * share_above(truth)
    below = adapted.vertices[adapted.faces].mean(axis=1)[:, 1] < -0.05
    assert below.sum() < (centres[:, 1] < -0.05).sum()


def test_triangles_that_cannot_be_joined_stay(truth: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    def tear(*_: object, **__: object) -> Mesh:
        raise OpenSurfaceError("a surface could not be closed: its holes border on each other")

    monkeypatch.setattr(refine_module, "remesh_isotropic", tear)
    take_warnings()
    adapted = remesh_adaptively(truth, np.arange(len(truth.faces), dtype=np.float64), EDGE_M, CONFIG)
    assert is_closed_manifold(adapted)
    assert len(adapted.faces) > len(truth.faces)  # those with much error are split all the same
    (warning,) = take_warnings()
    assert "triangles with little error were not joined" in warning


def test_face_limit_stops_subdivision(truth: Mesh) -> None:
    errors = np.arange(len(truth.faces), dtype=np.float64)
    config = CONFIG.model_copy(update={"max_faces": 100, "decimate_percentile": 0.0})
    assert len(remesh_adaptively(truth, errors, EDGE_M, config).faces) <= len(truth.faces)


def test_smooth_offsets_solve_their_equation_with_the_right_gradient(truth: Mesh) -> None:
    factorisation = factorise_smoothing_matrix(truth, 5.0)
    generator = torch.Generator().manual_seed(0)
    u = torch.rand(len(truth.vertices), 3, generator=generator, dtype=torch.float64, requires_grad=True)
    offset = FromDifferential.apply(u, factorisation)
    dense = torch.eye(len(u), dtype=torch.float64)
    for a, b in truth.edges().tolist():
        dense[a, a] += 5.0
        dense[b, b] += 5.0
        dense[a, b] -= 5.0
        dense[b, a] -= 5.0
    torch.testing.assert_close(dense @ offset, u)
    weights = torch.rand(offset.shape, generator=generator, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((offset * weights).sum(), u)
    torch.testing.assert_close(dense @ gradient, weights)


def test_crop_holds_the_person_and_its_camera_the_same_rays() -> None:
    image = np.random.default_rng(0).random((100, 80, 3)).astype(np.float32)
    mask = np.zeros((100, 80), dtype=np.float32)
    mask[20:80, 30:50] = 1.0
    camera = Camera(120.0, 121.0, 40.0, 50.0, 80, 100)
    view = crop_posed_view(image, mask, camera, torch.eye(4)[None], max_person_px=30)
    assert view.mask.shape == (view.camera.height, view.camera.width)
    assert 30 <= view.camera.height <= 45
    assert int((view.mask > 127).any(dim=1).sum()) == pytest.approx(30, abs=1)
    # a corner of the mask, through either camera, is the same direction
    rows = np.flatnonzero((view.mask.numpy() > 127).any(axis=1))
    assert (rows[0] - view.camera.cy) / view.camera.fy == pytest.approx((20 - 50) / 121.0, abs=0.6 / view.camera.fy)
    whole = crop_posed_view(image, np.zeros_like(mask), camera, torch.eye(4)[None], max_person_px=500)
    assert (whole.camera.height, whole.camera.width) == (100, 80)
    np.testing.assert_allclose(composite_target(view, torch.ones(3))[0][0, 0].numpy(), 1.0)


def test_footprint_is_depth_over_focal_length(truth: Mesh, body: Body, views: tuple) -> None:
    assert pixel_footprint_m(views[0][0], body.vertices, body.skin_weights) == pytest.approx(1.6 / 150.0, rel=0.05)
