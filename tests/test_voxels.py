import numpy as np
import pytest
import trimesh

from skinlib.datasets.synthetic import synthetic_head
from skinlib.geometry import point_segment_distance
from skinlib.head import Head, HeadError, Skeleton
from skinlib.voxels import solid_voxels, voxel_bone_distances


def box(low, high):
    """A closed box with a vertex every quarter or so."""
    whole = trimesh.creation.box(bounds=[low, high])
    return whole.subdivide_to_size(0.4)


def head_of(pieces, joints, tails=None):
    """Boxes as one mesh, which they may overlap in, with one bone a joint."""
    mesh = trimesh.util.concatenate(pieces)
    names = [f"bone{i}" for i in range(len(joints))]
    bones = Skeleton.from_heads_and_tails(joints, tails, [-1] * len(joints), names)
    return Head.create(mesh.vertices, mesh.faces, bones)


def straight(head):
    bones = head.skeleton
    return point_segment_distance(head.vertices, bones.joints, bones.tails)


def u_shape(joints):
    left, base, right = (
        ([0, 0, 0], [1, 4, 1]),
        ([0, 0, 0], [5, 1, 1]),
        ([4, 0, 0], [5, 4, 1]),
    )
    return head_of([box(*left), box(*base), box(*right)], joints)


# --- the solid ------------------------------------------------------------------------


def test_a_box_is_filled():
    solid = solid_voxels(head_of([box([0, 0, 0], [4, 2, 1])], [[0, 0, 0]]), 32)
    assert solid.size == pytest.approx(4 / 32)
    # Its surface passes through the voxels at the border: half of each is outside.
    inner, outer = 31 * 15 * 7, 33 * 17 * 9
    assert inner <= solid.filled.sum() <= outer
    # The border is empty.
    assert solid.filled.sum() == solid.filled[1:-1, 1:-1, 1:-1].sum()
    middle = np.rint(solid.to_grid(np.array([[2, 1, 0.5]]))).astype(int)[0]
    assert solid.filled[tuple(middle)]


def test_an_open_or_inside_out_head_is_as_solid():
    closed = head_of([box([0, 0, 0], [2, 2, 2])], [[1, 1, 1]])
    centres = closed.vertices[closed.faces].mean(axis=1)
    hole = (centres[:, 1] < 1e-6) & (np.abs(centres[:, [0, 2]] - 1).max(axis=1) < 0.6)
    assert hole.any()
    opened = closed.replace(faces=closed.faces[~hole])
    flipped = closed.replace(faces=closed.faces[:, ::-1])
    whole = solid_voxels(closed, 32).filled
    assert (solid_voxels(flipped, 32).filled == whole).all()
    missing = whole.sum() - solid_voxels(opened, 32).filled.sum()
    assert 0 <= missing < 0.03 * whole.sum()


def test_pieces_inside_others_leave_no_cavity():
    shells = [box([0, 0, 0], [2, 2, 2]), box([0.8, 0.8, 0.8], [1.2, 1.2, 1.2])]
    nested = solid_voxels(head_of(shells, [[0, 0, 0]]), 32).filled
    alone = solid_voxels(head_of(shells[:1], [[0, 0, 0]]), 32).filled
    assert (nested == alone).all()


def test_every_vertex_lies_in_the_solid():
    head = synthetic_head(3, vertices=600, bones=12)
    solid = solid_voxels(head, 24)
    assert solid.contains(solid.to_grid(head.vertices)).all()
    assert not solid.contains(np.array([[-50.0, 0, 0]]))[0]


# --- distances by hand ----------------------------------------------------------------


def test_in_a_convex_solid_the_shortest_way_is_straight():
    joints, tails = [[0.5, 0.5, 0.5], [1, 1, 0.5]], [[0.5, 0.5, 0.5], [3, 1, 0.5]]
    head = head_of([box([0, 0, 0], [4, 2, 1])], joints, tails)
    np.testing.assert_allclose(
        voxel_bone_distances(head, 32), straight(head), atol=1e-5
    )


def test_in_a_u_the_way_goes_around_both_corners():
    head = u_shape([[0.5, 3.5, 0.5]])
    distance = voxel_bone_distances(head)[:, 0]
    x, y, _ = head.vertices.T
    across = (x == 5) & (y == 4)
    corners = np.hypot(0.5, 2.5) + 3 + np.hypot(1, 3)  # in the plane z = 0.5
    expected = np.hypot(corners, head.vertices[across, 2] - 0.5)
    np.testing.assert_allclose(distance[across], expected, rtol=0.04)
    assert (distance[across] > 1.7 * straight(head)[across, 0]).all()
    near = x < 1
    np.testing.assert_allclose(distance[near], straight(head)[near, 0], atol=0.1)


def test_a_thin_gap_is_not_stepped_over():
    """Two thick arms with a slit of three voxels between them."""
    arms = [([0, 0, 0], [2.35, 4, 1]), ([2.65, 0, 0], [5, 4, 1])]
    pieces = [box(*bounds) for bounds in [*arms, ([0, 0, 0], [5, 1, 1])]]
    head = head_of(pieces, [[0.5, 3.8, 0.5]])
    distance, euclid = voxel_bone_distances(head, 50)[:, 0], straight(head)[:, 0]
    behind = (head.vertices[:, 0] == 5) & (head.vertices[:, 1] > 3)
    assert (distance[behind] > euclid[behind] + 1).all()


def test_the_way_around_is_no_longer_at_a_finer_grid():
    head = u_shape([[0.5, 3.5, 0.5]])
    coarse, fine = (voxel_bone_distances(head, n)[:, 0] for n in (20, 60))
    np.testing.assert_allclose(coarse, fine, atol=2 * 5 / 20)


def test_a_bone_outside_reaches_in_along_lines_that_enter_once():
    between, far = [2.5, 3, 0.5], [-30, 2, 0.5]
    head = u_shape([between, far])
    distance, euclid = voxel_bone_distances(head), straight(head)
    x, y, _ = head.vertices.T
    sides = ((x == 1) | (x == 4)) & (y > 1.5)  # they face the first bone
    np.testing.assert_allclose(distance[sides, 0], euclid[sides, 0], atol=1e-4)
    np.testing.assert_allclose(distance[x == 0, 1], euclid[x == 0, 1], atol=1e-4)
    # Behind the gap one has to go down and up again.
    hidden = (x == 5) & (y == 4)
    assert (distance[hidden, 1] > euclid[hidden, 1] + 1.5).all()
    assert np.isfinite(distance).all()


def test_pieces_that_do_not_touch_are_bridged_by_the_nearest():
    pieces = [box([3 * i, 0, 0], [3 * i + 1, 1, 1]) for i in range(3)]
    head = head_of(pieces, [[0.5, 0.5, 0.5]])
    distance, euclid = voxel_bone_distances(head, 56)[:, 0], straight(head)[:, 0]
    voxel = 7 / 56
    assert (distance > euclid - 1e-5).all()
    # Over the bridges, and to the side at each end, by 13 % too long at the worst.
    assert (distance < 1.13 * (euclid + 3 * np.sqrt(2) + 2 * voxel)).all()
    x = head.vertices[:, 0]
    assert distance[x == 3].min() == pytest.approx(2.5, abs=0.5)
    assert distance[x == 6].min() > 5


# --- any head -------------------------------------------------------------------------


def test_no_way_is_shorter_than_the_straight_line():
    head = synthetic_head(1, vertices=600, bones=12)
    distance = voxel_bone_distances(head, 32)
    assert distance.shape == (len(head.vertices), 12)
    assert distance.dtype == np.float64
    size = float(np.ptp(head.vertices, axis=0).max())
    assert (distance > straight(head) - 1e-5 * size).all()
    assert distance.max() < 3 * size


def test_distances_move_scale_and_reorder_with_the_head():
    head = synthetic_head(2, vertices=600, bones=12)
    distance = voxel_bone_distances(head, 24)
    bones = head.skeleton

    def changed(move, bone_order=slice(None)):
        moved = Skeleton.from_heads_and_tails(
            move(bones.joints), move(bones.tails), bones.parents, bones.names
        )
        return Head.create(move(head.vertices), head.faces, moved)

    bigger = voxel_bone_distances(changed(lambda x: 100 * x + [300, -20, 7]), 24)
    voxel = float(np.ptp(head.vertices, axis=0).max()) / 24
    error = np.abs(bigger / 100 - distance)
    assert np.median(error) < 1e-4 * voxel and error.max() < voxel

    order = np.random.default_rng(0).permutation(12)
    reordered = head.replace(skeleton=bones.reordered(order), weights=None)
    np.testing.assert_array_equal(
        voxel_bone_distances(reordered, 24), distance[:, order]
    )


def test_points_planes_and_single_vertices():
    one = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["head"])
    point = Head.create([[0, 0, 0]], np.zeros((0, 3), int), one)
    assert voxel_bone_distances(point).tolist() == [[0]]
    away = Head.create([[3, 4, 0]], np.zeros((0, 3), int), one)
    np.testing.assert_allclose(voxel_bone_distances(away), [[5]])
    flat = Head.create([[0, 0, 0], [4, 0, 0], [0, 3, 0]], [[0, 1, 2]], one)
    np.testing.assert_allclose(
        voxel_bone_distances(flat, 16), [[0], [4], [3]], atol=1e-6
    )
    cloud = np.random.default_rng(0).normal(size=(200, 3))
    loose = Head.create(cloud, np.zeros((0, 3), int), one)
    distance = voxel_bone_distances(loose, 16)
    assert np.isfinite(distance).all()
    assert (distance[:, 0] > np.linalg.norm(cloud, axis=1) - 1e-5).all()


def test_a_grid_has_voxels():
    with pytest.raises(HeadError, match="resolution"):
        voxel_bone_distances(u_shape([[0, 0, 0]]), 0)
