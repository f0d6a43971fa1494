"""Procedural heads: what holds for every seed, and what a seed may vary."""

import time

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from skinlib.datasets.synthetic import (
    HeadShape,
    flip_edges,
    synthetic_head,
    synthetic_head_and_regions,
    synthetic_heads,
)
from skinlib.geometry import face_normals, islands, mesh_edges, weld
from skinlib.graph import build_graph
from skinlib.head import HeadError
from skinlib.skinning import forward_kinematics, linear_blend_skinning

SEEDS = range(12)


def box(head):
    return np.linalg.norm(np.ptp(head.vertices.astype(float), axis=0))


def boundary_edges(faces):
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, uses = np.unique(sides, axis=0, return_counts=True)
    assert uses.max() <= 2
    return edges[uses == 1]


def surface_distance(head, start):
    """Dijkstra along mesh edges from the vertex `start`."""
    edges = mesh_edges(head.faces)
    lengths = np.linalg.norm(
        np.diff(head.vertices.astype(float)[edges], axis=1)[:, 0], axis=1
    )
    count = len(head.vertices)
    return dijkstra(
        coo_matrix((lengths, tuple(edges.T)), shape=(count, count)),
        directed=False,
        indices=start,
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_weights_are_a_partition_of_unity(seed):
    head = synthetic_head(seed)
    assert head.weights.min() >= 0
    np.testing.assert_allclose(head.weights.sum(axis=1, dtype=float), 1, atol=2e-6)
    assert 8 <= len(head.skeleton) <= 14
    # Each bone moves something, and leads somewhere.
    assert (head.weights.max(axis=0) > 0.3).all()
    assert (head.skeleton.parents < 0).sum() == 1


@pytest.mark.parametrize("seed", SEEDS)
def test_surface_is_one_skin_with_four_holes_and_two_balls(seed):
    head, regions = synthetic_head_and_regions(seed)
    count = len(head.vertices)
    label = islands(head.faces, count)
    sizes = np.sort(np.bincount(label))
    assert len(sizes) == 3
    assert sizes[0] == sizes[1] == len(regions.eyes) / 2
    assert len(np.unique(head.faces)) == count  # no stray vertex
    assert len(np.unique(weld(head.vertices))) == count  # lips touch, yet are no seam
    edges = mesh_edges(head.faces)
    # A sphere with 4 holes has Euler number -2, each ball 2.
    assert count - len(edges) + len(head.faces) == -2 + 2 + 2
    # Neighbouring triangles run along their common edge in opposite directions.
    half = head.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert len(np.unique(half, axis=0)) == len(half)
    assert (np.linalg.norm(face_normals(head.vertices, head.faces), axis=1) > 0).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_lips_touch_in_space_and_lie_far_apart_on_the_surface(seed):
    head, regions = synthetic_head_and_regions(seed)
    upper, lower = regions.upper_lip, regions.lower_lip
    assert len(upper) == len(lower) >= 14
    assert not set(upper) & set(lower)
    apart = np.linalg.norm(
        head.vertices[upper].astype(float) - head.vertices[lower], axis=1
    )
    assert apart.max() < 1e-4 * box(head)
    assert apart.min() > 1e-6 * box(head)
    # No mesh edge leads from one lip to the other ...
    side = np.zeros(len(head.vertices))
    side[upper], side[lower] = 1, -1
    assert (side[mesh_edges(head.faces)].prod(axis=1) >= 0).all()
    # ... and from the middle of the mouth the way around a corner is long.
    around = surface_distance(head, upper)[np.arange(len(upper)), lower]
    width = np.ptp(head.vertices[upper], axis=0).max()
    assert around.max() > 0.8 * width
    assert around.min() > 10 * apart.max()  # the first vertex beside a corner


@pytest.mark.parametrize("seed", SEEDS)
def test_no_graph_edge_crosses_closed_lips_or_lids(seed):
    shape = HeadShape(lid_opening=0.0)
    head, regions = synthetic_head_and_regions(seed, 1200, shape=shape)
    lids = head.vertices[regions.upper_lids].astype(float)
    apart = np.linalg.norm(lids - head.vertices[regions.lower_lids], axis=1)
    assert apart.max() < 1e-4 * box(head)
    edges = build_graph(head).vertex_edges()
    for upper, lower in (regions[:2], regions[2:4]):
        side = np.zeros(len(head.vertices))
        side[upper], side[lower] = 1, -1
        assert not (side[edges].prod(axis=1) < 0).any()


def test_open_eyes_have_lids_apart_and_eyeballs_behind_them():
    head, regions = synthetic_head_and_regions(5, 2000, shape=HeadShape(), up="y")
    upper, lower = regions.upper_lids, regions.lower_lids
    apart = np.linalg.norm(head.vertices[upper] - head.vertices[lower], axis=1)
    assert apart.max() > 0.01 * box(head)
    names = head.skeleton.names
    for side in "LR":
        eye = names.index(f"eye_{side}")
        ball = np.flatnonzero(head.weights[:, eye] == 1)
        assert set(ball) <= set(regions.eyes)
        away = head.vertices[ball] - head.skeleton.joints[eye]
        radius = np.linalg.norm(away, axis=1)
        np.testing.assert_allclose(radius, radius.mean(), rtol=1e-3)
        # The skin stays outside of the ball.
        skin = np.setdiff1d(np.arange(len(head.vertices)), regions.eyes)
        gap = np.linalg.norm(head.vertices[skin] - head.skeleton.joints[eye], axis=1)
        assert gap.min() > 1.01 * radius.mean()
    left = head.skeleton.joints[names.index("eye_L")]
    assert left[0] > 0 > head.skeleton.joints[names.index("eye_R")][0]


@pytest.mark.parametrize("seed", SEEDS)
def test_the_jaw_opens_the_mouth_and_leaves_the_skull(seed):
    head, regions = synthetic_head_and_regions(seed, up="y")
    jaw = head.skeleton.names.index("jaw")
    turns = np.tile(np.eye(3), (len(head.skeleton), 1, 1))
    turns[jaw] = Rotation.from_rotvec([np.radians(20), 0, 0]).as_matrix()
    transforms = forward_kinematics(head.skeleton, turns)
    moved = linear_blend_skinning(head.vertices, head.weights, transforms)
    opening = (moved[regions.upper_lip] - moved[regions.lower_lip])[:, 1]
    assert opening.min() > 0
    assert opening.max() > 0.05 * box(head)
    still = np.abs(moved - head.vertices).max(axis=1) < 1e-6 * box(head)
    assert 0.4 < still.mean() < 0.9


def test_weights_do_not_know_the_mesh():
    """The same person with other triangles has the same weights at the same place."""
    shape, options = (
        HeadShape(),
        {"bones": 14, "unit": "m", "up": "y", "shuffle": False},
    )
    coarse, regions = synthetic_head_and_regions(1, 1000, shape=shape, **options)
    fine, others = synthetic_head_and_regions(1, 4000, shape=shape, **options)
    np.testing.assert_array_equal(coarse.skeleton.joints, fine.skeleton.joints)
    # Lips, lids and eyes aside, space tells the place on the surface.
    skin = np.setdiff1d(np.arange(len(coarse.vertices)), np.concatenate(regions))
    where = np.setdiff1d(np.arange(len(fine.vertices)), np.concatenate(others))
    gap, near = cKDTree(fine.vertices[where]).query(coarse.vertices[skin])
    error = np.abs(fine.weights[where[near]] - coarse.weights[skin]).sum(axis=1)
    assert error[gap < 0.01 * box(coarse)].mean() < 0.05


def test_the_seed_decides_everything():
    one, two = synthetic_head(3), synthetic_head(3)
    for name in ("vertices", "normals", "faces", "weights"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert one.skeleton.names == two.skeleton.names
    heads = [synthetic_head(seed) for seed in SEEDS]
    assert len({len(head.vertices) for head in heads}) == len(heads)
    assert len({head.skeleton.names for head in heads}) == len(heads)
    assert len({len(head.skeleton) for head in heads}) >= 4
    tails = {bool((head.skeleton.lengths == 0).any()) for head in heads}
    assert tails == {True, False}


@pytest.mark.parametrize("seed", range(5))
def test_another_face_on_the_same_mesh(seed):
    head, other, third = (synthetic_head(seed, face=face) for face in (None, 1, 2))
    for face in (other, third):
        np.testing.assert_array_equal(face.faces, head.faces)
        np.testing.assert_array_equal(face.weights, head.weights)
        assert face.skeleton.names == head.skeleton.names
        size = np.linalg.norm(np.ptp(head.vertices, axis=0))
        moved = np.linalg.norm(face.vertices - head.vertices, axis=1) / size
        assert 0.003 < moved.mean() < 0.1
        # Bones move along: each eye still lies in the middle of its ball.
        for side in "LR":
            eye = face.skeleton.names.index(f"eye_{side}")
            ball = face.vertices[face.weights[:, eye] == 1]
            middle = (ball.min(axis=0) + ball.max(axis=0)) / 2
            apart = np.linalg.norm(middle - face.skeleton.joints[eye])
            assert apart < 0.01 * size
    assert not np.allclose(other.vertices, third.vertices)


def test_options_are_kept():
    head = synthetic_head(0, 900, bones=8, unit="m", up="z", shuffle=False)
    assert abs(len(head.vertices) - 900) < 90
    assert head.skeleton.names[:3] == ("neck", "head", "jaw")
    assert 0.2 < np.ptp(head.vertices[:, 2]) < 0.5  # metres, from neck to crown
    taller = synthetic_head(0, 900, bones=8, unit="cm", up="y", shuffle=False)
    np.testing.assert_allclose(
        taller.vertices[:, [0, 2, 1]] * [1, -1, 1], 100 * head.vertices, atol=1e-4
    )
    first, second = synthetic_heads(2, seed=1, vertices=600)
    assert first.name != second.name
    assert len(first.vertices) != len(second.vertices) or not np.array_equal(
        first.vertices, second.vertices
    )


@pytest.mark.parametrize(
    "options, field",
    [
        ({"vertices": 10}, "vertices"),
        ({"bones": 15}, "bones"),
        ({"unit": "mile"}, "unit"),
        ({"up": "x"}, "up"),
    ],
)
def test_options_out_of_range_are_named(options, field):
    with pytest.raises(HeadError, match=field):
        synthetic_head(0, **options)


def test_flips_keep_surface_and_neighbours():
    head = synthetic_head(2, 1000)
    flipped = flip_edges(head.vertices, head.faces, np.random.default_rng(0), 0.5)
    changed = (flipped != head.faces).any(axis=1)
    assert 0.1 < changed.mean() < 0.9
    assert len(mesh_edges(flipped)) == len(mesh_edges(head.faces))
    np.testing.assert_array_equal(boundary_edges(flipped), boundary_edges(head.faces))
    area = [
        np.linalg.norm(face_normals(head.vertices, faces), axis=1).sum()
        for faces in (head.faces, flipped)
    ]
    assert area[1] == pytest.approx(area[0], rel=0.02)
    # A square folded by 90 degrees is left alone.
    folded = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 1]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    same = flip_edges(folded, faces, np.random.default_rng(0), 1.0)
    np.testing.assert_array_equal(same, faces)


def test_a_head_takes_a_fraction_of_a_second():
    synthetic_head(0, 1500)
    start = time.process_time()
    for seed in range(5):
        synthetic_head(seed, 1500)
    assert (time.process_time() - start) / 5 < 0.2
