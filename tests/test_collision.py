"""Which point of the body a point of a garment lies over, and where it looks."""

import numpy as np
import pytest
import torch
from test_body import SIDES, bends, sleeve, small_body

from skinlib import geometry
from skinlib.garments.collision import (
    Collider,
    near,
    nearest,
    reached,
    take,
    thinned,
    vertex_normals,
)
from skinlib.skinning import linear_blend_skinning


@pytest.fixture(scope="module")
def head():
    return small_body().head


@pytest.fixture(scope="module")
def whole(head) -> Collider:
    return Collider(head, np.arange(len(head.vertices)))


def clouds(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """(3, 40, 3) points and (3, 90, 3) of a body."""
    rng = np.random.default_rng(seed)
    points, body = rng.normal(size=(3, 40, 3)), rng.normal(size=(3, 90, 3))
    return torch.tensor(points).float(), torch.tensor(body).float()


def transforms(head) -> torch.Tensor:
    return torch.from_numpy(bends(4).transforms(head.skeleton))


# --- the nearest vertex ---------------------------------------------------------------


@pytest.mark.parametrize("threads", [1, 3])
def test_nearest_is_what_all_distances_say(threads):
    points, body = clouds()
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        found = nearest(points, body)
    finally:
        torch.set_num_threads(before)
    assert found.shape == (3, 40) and found.dtype == torch.int64
    assert torch.equal(found, torch.cdist(points, body).argmin(dim=2))


def test_nearest_of_points_that_are_learnt():
    points, body = clouds()
    assert torch.equal(
        nearest(points.requires_grad_(), body.requires_grad_()),
        nearest(points.detach(), body.detach()),
    )


def test_nearest_of_what_is_not_finite_is_some_vertex():
    points, body = clouds()
    points[0, 3], points[1, 4, 1], body[2, 5] = (
        float("nan"),
        -float("inf"),
        float("nan"),
    )
    found = nearest(points, body)
    assert found.min() >= 0 and found.max() < 90
    assert torch.equal(found[0, :3], nearest(*clouds())[0, :3])


def test_take_picks_rows_of_its_own_pose():
    values = torch.arange(12.0).reshape(2, 2, 3)
    taken = take(values, torch.tensor([[1, 1, 0], [0, 1, 0]]))
    assert taken[0].tolist() == [[3, 4, 5], [3, 4, 5], [0, 1, 2]]
    assert taken[1].tolist() == [[6, 7, 8], [9, 10, 11], [6, 7, 8]]


# --- normals --------------------------------------------------------------------------


def test_normals_are_those_of_the_rest_of_the_package(head):
    rng = np.random.default_rng(0)
    bumpy = head.vertices + rng.normal(scale=0.01, size=(2, *head.vertices.shape))
    found = vertex_normals(torch.tensor(bumpy), torch.tensor(head.faces))
    for pose, normals in zip(bumpy, found, strict=True):
        expected = geometry.vertex_normals(pose, head.faces)
        np.testing.assert_allclose(normals, expected, atol=1e-5)


def test_normals_have_derivatives_even_where_there_is_no_face():
    corners = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]]])
    corners.requires_grad_()
    normals = vertex_normals(corners, torch.tensor([[0, 1, 2]]))
    assert normals[0].tolist() == [[0, 0, 1]] * 3 + [[0, 0, 0]]
    (normals[..., 0].sum() + normals[..., 1].sum()).backward()
    # Lifting the corner at (1, 0) by dz turns the normal by -dz in x, at 3 vertices.
    assert corners.grad[0, 1].tolist() == pytest.approx([0, 0, -3])
    assert corners.grad[0, 3].tolist() == [0, 0, 0]


# --- the body that is posed -----------------------------------------------------------


def test_near_is_what_the_reach_says(head):
    # The next rings are 50 mm away, the next vertices of the ring 26 mm.
    point = np.array([[0.1, 0, 0.5]], np.float32)
    found = near(head, point, reach=0.051)
    assert sorted(head.vertices[found, 2].round(2).tolist()) == pytest.approx(
        [0.45, 0.5, 0.5, 0.5, 0.55]
    )
    distance = np.linalg.norm(head.vertices - point, axis=1)
    assert np.array_equal(found, np.flatnonzero(distance < 0.051))
    below = near(head, sleeve(0.11).vertices, reach=0.1)
    rings = np.unique((100 * head.vertices[below, 2]).round().astype(int))
    assert rings.tolist() == list(range(15, 90, 5))  # the sleeve: 20 to 80 cm
    assert len(near(head, point + 9)) == len(head.vertices)  # better than nothing


def test_a_collider_keeps_the_faces_whose_corners_it_has(head, whole):
    assert np.array_equal(whole.faces, head.faces)
    ring = np.arange(5 * SIDES, 8 * SIDES)
    part = Collider(head, ring)
    assert len(part.faces) == 2 * 2 * SIDES
    assert torch.equal(part.points, whole.points[ring])
    assert torch.equal(part.weights, whole.weights[ring])
    kept = {tuple(face) for face in ring[part.faces].tolist()}
    assert kept == {tuple(f) for f in head.faces.tolist() if np.isin(f, ring).all()}


def test_reached_is_what_comes_near_in_some_pose(head):
    """The post and a point beside it, on a bone of its own that is carried along."""
    bones = np.tile(np.eye(4, dtype=np.float32), (2, 3, 1, 1))
    bones[1, 0, 2, 3] = 0.3  # in the second pose bone 0 is 30 cm higher
    still = head.replace(weights=np.eye(3)[np.ones(len(head.vertices), int)])
    point, moves = np.array([[0.12, 0, 0.2]], np.float32), np.eye(3)[:1]
    heights = [
        np.unique(still.vertices[reached(still, point, moves, bones[:n], 0.04), 2])
        for n in (1, 2)
    ]
    assert heights[0] == pytest.approx([0.2])
    assert heights[1] == pytest.approx([0.2, 0.5])
    assert len(reached(still, point + 9, moves, bones, 0.04)) == 0


def test_a_thinned_cloud_covers_what_it_was():
    points = np.random.default_rng(0).uniform(size=(300, 3))
    kept = thinned(points, 0.2)
    apart = np.linalg.norm(points[kept][:, None] - points[kept], axis=-1)
    assert apart[~np.eye(len(kept), dtype=bool)].min() > 0.2
    covered = np.linalg.norm(points[:, None] - points[kept], axis=-1).min(axis=1)
    assert covered.max() <= 0.2 and 10 < len(kept) < 200
    assert np.array_equal(thinned(points, 0.0), np.arange(300))


def test_a_thinned_collider_has_the_normals_of_the_whole_one(head, whole):
    bones = transforms(head)
    thin = Collider(head, np.arange(len(head.vertices)), spacing=0.03)
    assert 100 < len(thin.kept) < 300  # 26 mm from side to side: every second
    for all_of_it, some in zip(whole.pose(bones), thin.pose(bones), strict=True):
        assert torch.equal(all_of_it[:, thin.kept], some)


def test_a_collider_is_posed_by_its_weights(head, whole):
    bones = transforms(head)
    points, normals = whole.pose(bones)
    assert points.shape == normals.shape == (4, len(head.vertices), 3)
    for pose in range(4):
        expected = linear_blend_skinning(
            head.vertices, head.weights, bones[pose].numpy()
        )
        assert np.abs(points[pose].numpy() - expected).max() < 1e-5
        outwards = geometry.vertex_normals(expected, head.faces)
        assert np.abs(normals[pose].numpy() - outwards).max() < 1e-3


def test_at_rest_normals_look_away_from_the_axis(head, whole):
    points, normals = whole.pose(torch.eye(4).repeat(1, 3, 1, 1))
    sides = slice(SIDES, len(head.vertices) - 2 - SIDES)
    away = points[0, sides] / 0.1 * torch.tensor([1, 1, 0])
    assert (normals[0, sides] - away).abs().max() < 1e-3
    assert normals[0, -2:].tolist() == [[0, 0, -1], [0, 0, 1]]


def test_a_batch_is_its_poses_one_by_one(head, whole):
    bones = transforms(head)
    points, normals = whole.pose(bones)
    for pose in range(4):
        alone = whole.pose(bones[pose : pose + 1])
        assert (alone[0][0] - points[pose]).abs().max() < 1e-6
        assert (alone[1][0] - normals[pose]).abs().max() < 1e-5


def test_offsets_are_added_at_rest(head, whole):
    bones = transforms(head)
    wider = torch.rand(4, len(head.vertices), 3, generator=torch.manual_seed(0)) / 50
    points, _ = whole.pose(bones, wider)
    for pose in range(4):
        rest = head.vertices + wider[pose].numpy()
        expected = linear_blend_skinning(rest, head.weights, bones[pose].numpy())
        assert np.abs(points[pose].numpy() - expected).max() < 1e-5
