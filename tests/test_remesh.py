import sys

import numpy as np
import pytest
from scipy.spatial import cKDTree
from trimesh.triangles import points_to_barycentric

from skinlib import Head, HeadError, Skeleton
from skinlib.datasets.remesh import (
    REMESHERS,
    another_mesh,
    coarsen,
    halve,
    isotropic,
    shuffle,
    subdivide,
    transfer_weights,
)
from skinlib.datasets.synthetic import synthetic_head
from skinlib.geometry import face_normals, islands, mesh_edges, vertex_areas
from skinlib.io import read_head
from skinlib.paths import sample

REMESH = pytest.mark.parametrize("remesh", REMESHERS.values(), ids=REMESHERS)
GAP = 2e-3


@pytest.fixture(scope="module")
def bust():
    return read_head(sample("adult.npz"))


@pytest.fixture(scope="module")
def heads(bust):
    return [bust, synthetic_head(3, 1500)]


@pytest.fixture(scope="module")
def mouth():
    return lips(GAP)


def lips(gap):
    """A wavy sheet folded at x = 1: bone 0 above the fold, bone 1 below.

    The waves are much higher than the gap, so that a new vertex in the middle of an old
    edge or cell lies on the other side of the gap.
    """
    u, v = np.meshgrid(np.linspace(0, 2, 61), np.linspace(0, 1, 31), indexing="ij")
    x = np.where(u <= 1, u, 2 - u)
    z = waves(x, v) + np.clip(1 - u, -0.1, 0.1) * 10 * gap / 2
    upper = np.clip((1.1 - u) * 5, 0, 1)
    return grid(x, v, z).replace(
        weights=np.stack([upper, 1 - upper], -1).reshape(-1, 2)
    )


def waves(x, y):
    return 0.05 * np.sin(8 * x + 4 * y)


def grid(x, y, z):
    """A mesh of the (M, N) points, two triangles for each square."""
    rows, columns = x.shape
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + columns, corner + columns + 1], axis=1),
            np.stack([corner, corner + columns + 1, corner + 1], axis=1),
        ]
    )
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return Head.create(vertices, faces, two_bones())


def two_bones():
    return Skeleton.from_heads_and_tails(
        [[0, 0, 1], [0, 0, -1]], None, [-1, 0], ["upper", "lower"]
    )


def total_area(head):
    return np.linalg.norm(face_normals(head.vertices, head.faces), axis=1).sum() / 2


def island_count(head):
    return int(islands(head.faces, len(head.vertices)).max()) + 1


@REMESH
def test_weights_stay_a_partition_of_unity(remesh, heads):
    for head in heads:
        result = remesh(head, 0)
        assert result.weights.shape == (len(result.vertices), len(head.skeleton))
        assert result.weights.min() >= 0
        np.testing.assert_allclose(result.weights.sum(axis=1), 1, atol=2e-6)
        assert result.skeleton is head.skeleton and result.name == head.name


@REMESH
def test_the_surface_stays(remesh, bust):
    result = remesh(bust, 0)
    assert total_area(result) == pytest.approx(total_area(bust), rel=0.04)
    size = np.ptp(bust.vertices, axis=0)
    np.testing.assert_allclose(np.ptp(result.vertices, axis=0), size, rtol=0.02)
    assert volume(result) == pytest.approx(volume(bust), rel=0.03)


def volume(head):
    a, b, c = head.vertices[head.faces].astype(float).transpose(1, 0, 2)
    return (a * np.cross(b, c)).sum() / 6


@REMESH
def test_islands_stay(remesh, heads):
    for head in heads:
        assert island_count(remesh(head, 0)) == island_count(head)


@REMESH
def test_a_seed_is_one_mesh_and_another_seed_another(remesh, mouth):
    once, again, other = remesh(mouth, 1), remesh(mouth, 1), remesh(mouth, 2)
    np.testing.assert_array_equal(once.vertices, again.vertices)
    np.testing.assert_array_equal(once.faces, again.faces)
    count = min(len(once.vertices), len(other.vertices))
    assert not np.array_equal(once.vertices[:count], other.vertices[:count])


@REMESH
def test_a_generator_may_be_given(remesh, mouth):
    by_seed, by_generator = remesh(mouth, 5), remesh(mouth, np.random.default_rng(5))
    np.testing.assert_array_equal(by_seed.vertices, by_generator.vertices)


@REMESH
def test_unlabelled_heads_stay_unlabelled(remesh, mouth):
    result = remesh(mouth.replace(weights=None), 0)
    assert result.weights is None
    np.testing.assert_array_equal(result.vertices, remesh(mouth, 0).vertices)


@REMESH
@pytest.mark.parametrize("normals", ["oppose", "agree"])
def test_nothing_bleeds_between_lips(remesh, mouth, normals):
    if normals == "agree":  # then only the surface tells the lips apart
        normals = np.tile(np.float32([0, 0, 1]), (len(mouth.vertices), 1))
        mouth = mouth.replace(normals=normals)
    result = remesh(mouth, 0)
    apart = result.vertices[:, 0] < 0.85  # away from the fold
    assert_lips_are_pure(result, apart)
    x, y, z = result.vertices[apart].T
    np.testing.assert_array_equal(result.weights[apart, 0] > 0.5, z > waves(x, y))


@REMESH
def test_nothing_bleeds_between_lips_that_touch(remesh):
    result = remesh(lips(0), 0)
    assert island_count(result) == 1
    assert_lips_are_pure(result, result.vertices[:, 0] < 0.85)


def assert_lips_are_pure(head, apart):
    np.testing.assert_allclose(head.weights[apart].max(axis=1), 1, atol=1e-5)
    side = head.weights[:, 0] > 0.5
    edges = mesh_edges(head.faces)
    a, b = edges[apart[edges].all(axis=1)].T
    np.testing.assert_array_equal(side[a], side[b])
    assert 0.3 < side[apart].mean() < 0.7


def test_shuffle_changes_the_order_and_nothing_else(bust):
    result = shuffle(bust, 0)
    order = np.lexsort(bust.vertices.T)
    place = np.lexsort(result.vertices.T)
    np.testing.assert_array_equal(bust.vertices[order], result.vertices[place])
    np.testing.assert_array_equal(bust.weights[order], result.weights[place])
    np.testing.assert_array_equal(bust.normals[order], result.normals[place])
    before = np.sort(face_normals(bust.vertices, bust.faces), axis=0)
    after = np.sort(face_normals(result.vertices, result.faces), axis=0)
    np.testing.assert_allclose(before, after, atol=1e-12)


def test_subdivide_by_hand():
    triangle = Head.create(
        [[0, 0, 0], [2, 0, 0], [0, 2, 0]],
        [[0, 1, 2]],
        two_bones(),
        [[1, 0], [0, 1], [0, 1]],
    )
    result = subdivide(triangle, 0)
    assert len(result.faces) == 4
    rows = zip(result.vertices.tolist(), result.weights.tolist(), strict=True)
    found = {tuple(vertex): tuple(weights) for vertex, weights in rows}
    assert found == {
        (0, 0, 0): (1, 0),
        (2, 0, 0): (0, 1),
        (0, 2, 0): (0, 1),
        (1, 0, 0): (0.5, 0.5),
        (0, 1, 0): (0.5, 0.5),
        (1, 1, 0): (0, 1),
    }


def test_subdivide_carries_the_weights_exactly(bust):
    result = subdivide(bust, 0)
    assert len(result.faces) == 4 * len(bust.faces)
    a, b = mesh_edges(bust.faces).T
    points = np.concatenate([bust.vertices, (bust.vertices[a] + bust.vertices[b]) / 2])
    means = np.concatenate([bust.weights, (bust.weights[a] + bust.weights[b]) / 2])
    distance, place = cKDTree(points).query(result.vertices)
    assert distance.max() < 1e-7
    np.testing.assert_allclose(result.weights, means[place], atol=1e-6)


def test_halve_keeps_the_share_asked_for(bust):
    for keep in (0.25, 0.5, 0.8):
        result = halve(bust, 0, keep=keep)
        assert len(result.faces) == pytest.approx(keep * len(bust.faces), rel=0.02)


def test_isotropic_spreads_vertices_evenly(bust):
    result = isotropic(bust, 0, vertices=2000)
    assert len(result.vertices) == pytest.approx(2000, rel=0.05)
    areas = vertex_areas(result.vertices, result.faces)
    before = vertex_areas(bust.vertices, bust.faces)
    assert areas.std() / areas.mean() < 0.5 < before.std() / before.mean()


@pytest.mark.parametrize("remesh", [halve, isotropic])
def test_a_cut_seam_is_closed_without_a_crack(remesh):
    x, y = np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 21), indexing="ij")
    left, right = grid(x, y, waves(x, y)), grid(x + 1, y, waves(x + 1, y))
    cut = left.replace(
        vertices=np.concatenate([left.vertices, right.vertices]),
        faces=np.concatenate([left.faces, right.faces + len(left.vertices)]),
    )
    assert island_count(cut) == 2
    assert island_count(remesh(cut, 0)) == 1


@pytest.mark.parametrize("remesh", [halve, isotropic])
def test_without_faces_one_clear_error(remesh):
    no_faces = Head.create(np.eye(3), [], two_bones())
    one_place = Head.create(np.ones((3, 3)), [[0, 1, 2]], two_bones())
    for head in (no_faces, one_place):
        with pytest.raises(HeadError, match="faces: there are none"):
            remesh(head, 0)


@REMESH
def test_the_smallest_meshes(remesh):
    triangle = Head.create(
        np.eye(3), [[0, 1, 2]], two_bones(), [[1, 0], [0, 1], [0.5, 0.5]]
    )
    result = remesh(triangle, 0)
    assert len(result.faces) >= 1
    np.testing.assert_allclose(result.weights.sum(axis=1), 1, atol=1e-6)


def test_isotropic_reaches_the_open_border():
    x, y = np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 21), indexing="ij")
    square = grid(x, y, np.zeros_like(x))
    assert total_area(isotropic(square, 0, vertices=100)) > 0.98


def test_isotropic_keeps_islands_too_small_for_their_share(bust):
    assert island_count(isotropic(bust, 0, vertices=150)) == island_count(bust)


def test_without_fast_simplification_one_clear_error(monkeypatch, mouth):
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    with pytest.raises(HeadError, match="pip install fast-simplification"):
        halve(mouth)


def test_transfer_interpolates_on_the_surface(bust):
    rng = np.random.default_rng(0)
    face = rng.choice(len(bust.faces), 300)
    share = rng.dirichlet(np.ones(3), 300)
    corners = bust.vertices[bust.faces[face]].astype(float)
    points = np.einsum("nc,ncx->nx", share, corners)
    normals = face_normals(bust.vertices, bust.faces)[face]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    expected = np.einsum("nc,ncj->nj", share, bust.weights[bust.faces[face]])
    error = np.abs(transfer_weights(bust, points, normals) - expected).sum(axis=1)
    assert np.median(error) < 1e-5 and error.mean() < 1e-3
    back = points_to_barycentric(corners, points)
    np.testing.assert_allclose(back, share, atol=1e-3)


def test_transfer_prefers_the_side_that_faces_the_same_way(mouth):
    # Each point lies beyond the other lip, nearer to that than to its own.
    upper, lower = mouth.normals[10 * 31 + 15], mouth.normals[50 * 31 + 15]
    assert upper @ lower < -0.9
    height = waves(1 / 3, 0.5)
    points = np.array([[1 / 3, 0.5, height - GAP], [1 / 3, 0.5, height + GAP]])
    weights = transfer_weights(mouth, points, np.stack([upper, lower]))
    np.testing.assert_allclose(weights, [[1, 0], [0, 1]], atol=1e-6)


def test_transfer_from_an_unlabelled_head_is_refused(mouth):
    with pytest.raises(HeadError, match="weights: there are none"):
        transfer_weights(mouth.replace(weights=None), mouth.vertices, mouth.normals)


def test_another_mesh_is_another_one_each_time():
    head = synthetic_head(3, 1500)
    meshes = [another_mesh(head, np.random.default_rng(seed)) for seed in range(6)]
    sizes = [len(mesh.vertices) for mesh in meshes]
    assert len(set(sizes)) == 6 and min(sizes) > 300 and max(sizes) < 4000
    again = another_mesh(head, np.random.default_rng(0))
    assert np.array_equal(again.vertices, meshes[0].vertices)
    cloud = Head.create(head.vertices, np.zeros((0, 3), int), head.skeleton)
    assert another_mesh(cloud, np.random.default_rng(0)) is cloud


def test_what_is_linear_comes_back_from_a_coarse_head(heads):
    for head in heads:
        coarse, back = coarsen(head, 900)
        assert 0.8 * 900 < len(coarse.vertices) < 1.6 * 900
        assert back.shape == (len(head.vertices), len(coarse.vertices))
        assert back.min() >= 0
        np.testing.assert_allclose(back.sum(axis=1), 1, atol=1e-6)
        # Positions themselves, but for the bumps that the coarse mesh has not.
        box = np.linalg.norm(np.ptp(head.vertices, axis=0))
        off = np.linalg.norm(back @ coarse.vertices - head.vertices, axis=1)
        assert off.mean() < 0.005 * box and off.max() < 0.08 * box


def test_nothing_comes_back_from_the_other_lip(mouth):
    fine = subdivide(subdivide(mouth))
    coarse, back = coarsen(fine, 1500)
    # The upper lip and the lower one are far apart along the surface, by u.
    side = transfer_weights(fine, coarse.vertices, coarse.normals)[:, 0]
    came = back @ side
    sure = np.isin(fine.weights[:, 0], (0, 1))
    assert np.abs(came[sure] - fine.weights[sure, 0]).max() < 0.25
    assert np.abs(came - fine.weights[:, 0]).mean() < 0.02
