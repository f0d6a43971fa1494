"""Geometry: values by hand, on spheres and planes, and the frame of a head."""

import numpy as np
import pytest
from shapes import axis_rotations, moved, skeleton, sphere, unwelded

from skinlib import Head, Skeleton
from skinlib.datasets.synthetic import synthetic_head
from skinlib.geometry import (
    canonical_frame,
    curvature,
    face_normals,
    islands,
    mesh_edges,
    normal_deviation,
    point_segment_distance,
    safe_normalize,
    vertex_areas,
    vertex_normals,
    weld,
)

# Two triangles of a 2 x 1 rectangle in the plane z = 0.
CORNERS = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]], float)
RECTANGLE = np.array([[0, 1, 2], [0, 2, 3]])
NO_FACES = np.zeros((0, 3), np.int64)


def test_safe_normalize_by_hand():
    rows = np.array([[3, 4, 0], [0, 0, 0], [1e300, 1e300, 0], [0, 0, -5e-324]])
    unit = safe_normalize(rows, fallback=(0, 0, 1))
    half = 0.5**0.5
    np.testing.assert_allclose(
        unit, [[0.6, 0.8, 0], [0, 0, 1], [half, half, 0], [0, 0, -1]]
    )


def test_face_normals_have_twice_the_area():
    assert face_normals(CORNERS, RECTANGLE).tolist() == [[0, 0, 2], [0, 0, 2]]


def test_vertex_areas_share_each_face_among_its_corners():
    np.testing.assert_allclose(
        vertex_areas(CORNERS, RECTANGLE), np.array([2, 1, 2, 1]) / 3
    )
    assert vertex_areas(CORNERS, NO_FACES).tolist() == [0] * 4


def test_vertex_normals_weigh_faces_by_area():
    # A roof: one face of area 1 towards +z, one of area 1/2 towards +y.
    points = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0]], float)
    faces = np.array([[0, 1, 2], [0, 3, 4]])
    expected = np.array([0, 1, 2]) / 5**0.5
    np.testing.assert_allclose(vertex_normals(points, faces)[0], expected, atol=1e-6)


@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
def test_normals_of_a_sphere_do_not_depend_on_its_size(size):
    ball = sphere(2)
    normals = vertex_normals(ball.vertices.astype(float) * size, ball.faces)
    assert (normals * ball.vertices).sum(axis=1).min() > 0.999


def test_normals_without_faces_and_of_flat_faces_point_up():
    flat = np.array([[0, 1, 1]])
    for faces in (NO_FACES, flat):
        assert vertex_normals(CORNERS, faces).tolist() == [[0, 0, 1]] * 4


def test_mesh_edges_by_hand():
    edges = mesh_edges(RECTANGLE[:, ::-1])
    assert edges.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]
    assert mesh_edges(NO_FACES).shape == (0, 2)
    # A face that repeats a vertex has one edge, not a loop.
    assert mesh_edges(np.array([[4, 4, 1]])).tolist() == [[1, 4]]


def test_a_closed_mesh_keeps_eulers_formula():
    ball = sphere(2)
    assert len(ball.vertices) - len(mesh_edges(ball.faces)) + len(ball.faces) == 2


def test_weld_joins_equal_positions_and_keeps_the_order():
    points = np.array([[5, 0, 0], [1, 0, 0], [5, 0, 0], [1, 1e-3, 0], [1, 1e-7, 0]])
    assert weld(points).tolist() == [0, 1, 0, 2, 1]
    assert weld(np.zeros((3, 3))).tolist() == [0, 0, 0]
    assert weld(points * 1e-9).tolist() == [0, 1, 0, 2, 1]


def test_weld_undoes_unwelding():
    apart, old = unwelded(sphere(2))
    ids = weld(apart.vertices)
    assert ids.max() + 1 == 162
    assert (np.unique(np.stack([ids, old]), axis=1).shape[1]) == 162


def test_islands_by_hand():
    faces = np.array([[0, 1, 2], [4, 5, 3]])
    labels = islands(faces, 7)
    assert labels.tolist() == [0, 0, 0, 1, 1, 1, 2]
    seam = np.array([0, 1, 2, 2, 3, 4, 5])
    assert islands(faces, 7, seam).tolist() == [0, 0, 0, 0, 0, 0, 1]
    assert islands(NO_FACES, 2).tolist() == [0, 1]


def test_distance_to_a_segment_by_hand():
    heads, tails = np.zeros((2, 3)), np.array([[2.0, 0, 0], [0, 0, 0]])
    points = np.array([[1.0, 3, 0], [5, 4, 0], [-3, 0, 4], [0.5, 0, 0]])
    np.testing.assert_allclose(
        point_segment_distance(points, heads, tails),
        [[3, 10**0.5], [5, 41**0.5], [5, 5], [0, 0.5]],
    )


@pytest.mark.parametrize("radius", [0.1, 1.0, 25.0])
def test_curvature_of_a_sphere_is_one_over_its_radius(radius):
    ball = sphere(2)
    unit = ball.vertices.astype(float)
    edges = mesh_edges(ball.faces)
    np.testing.assert_allclose(
        curvature(unit * radius, unit, edges), 1 / radius, rtol=1e-4
    )
    np.testing.assert_allclose(
        curvature(unit * radius, -unit, edges), -1 / radius, rtol=1e-4
    )


def test_curvature_of_a_plane_and_of_coincident_vertices_is_zero():
    up = np.tile([0.0, 0, 1], (4, 1))
    edges = mesh_edges(RECTANGLE)
    assert curvature(CORNERS, up, edges).tolist() == [0] * 4
    assert curvature(np.zeros((4, 3)), up, edges).tolist() == [0] * 4
    assert curvature(CORNERS, up, np.zeros((0, 2), int)).tolist() == [0] * 4


def test_normal_deviation_by_hand():
    normals = np.array([[0, 0, 1], [0, 0, 1], [0, 0, -1], [1, 0, 0]], float)
    edges = np.array([[0, 1], [0, 2], [1, 2]])
    assert normal_deviation(normals, edges).tolist() == [1, 1, 2, 0]


# ---------------------------------------------------------------- the frame of a head


def frame_of(head):
    bones = head.skeleton
    return canonical_frame(head.vertices, head.faces, bones.joints, bones.parents)


def in_frame(head):
    frame = frame_of(head)
    return frame.apply(head.vertices), frame.apply(head.skeleton.joints)


@pytest.mark.parametrize("seed", range(3))
def test_the_frame_undoes_any_turn_size_and_place(seed):
    head = synthetic_head(seed, vertices=700)
    vertices, joints = in_frame(head)
    rng = np.random.default_rng(seed)
    for rotation in axis_rotations():
        size = head.vertices.std()
        other = moved(head, rotation, 10 ** rng.uniform(-3, 3), rng.normal(size=3))
        assert size > 0
        turned_vertices, turned_joints = in_frame(other)
        np.testing.assert_allclose(turned_vertices, vertices, atol=2e-3)
        np.testing.assert_allclose(turned_joints, joints, atol=2e-3)


@pytest.mark.parametrize("seed", range(6))
def test_the_frame_of_a_synthetic_head_looks_forward(seed):
    y_up = frame_of(synthetic_head(seed, vertices=700, up="y"))
    assert y_up.rotation.tolist() == np.eye(3).tolist()
    z_up = frame_of(synthetic_head(seed, vertices=700, up="z"))
    assert z_up.rotation.tolist() == [[1, 0, 0], [0, 0, 1], [0, -1, 0]]


def test_a_frame_is_a_rotation_whose_points_have_unit_radius():
    head = synthetic_head(1, vertices=700)
    frame = frame_of(head)
    np.testing.assert_allclose(frame.rotation @ frame.rotation.T, np.eye(3))
    assert np.linalg.det(frame.rotation) == pytest.approx(1)
    areas = vertex_areas(head.vertices, head.faces)
    mass, points = areas / areas.sum(), frame.apply(head.vertices)
    np.testing.assert_allclose(mass @ points, 0, atol=1e-6)
    assert mass @ (points**2).sum(axis=1) == pytest.approx(1)
    turned = frame.rotate(head.normals)
    np.testing.assert_allclose(turned @ frame.rotation, head.normals, atol=1e-6)


def test_a_finer_mesh_has_the_same_frame():
    import trimesh

    head = synthetic_head(2, vertices=700)
    vertices, faces = trimesh.remesh.subdivide(head.vertices, head.faces)
    # Refining one half only must not pull the centre over.
    right = head.vertices[head.faces].mean(axis=1)[:, 0] > 0
    uneven, uneven_faces = trimesh.remesh.subdivide(head.vertices, head.faces[right])
    uneven_faces = np.concatenate([head.faces[~right], uneven_faces + len(vertices)])
    uneven = np.concatenate([vertices, uneven])
    old = frame_of(head)
    for points, ids in ((vertices, faces), (uneven, uneven_faces)):
        new = frame_of(Head.create(points, ids, head.skeleton))
        assert new.rotation.tolist() == old.rotation.tolist()
        np.testing.assert_allclose(new.centre, old.centre, atol=1e-3 * old.scale)
        assert new.scale == pytest.approx(old.scale, rel=1e-2)


def test_the_frame_does_not_depend_on_the_order_of_bones_or_vertices():
    head = synthetic_head(3, vertices=700)
    rng = np.random.default_rng(0)
    bones = head.skeleton.reordered(rng.permutation(len(head.skeleton)))
    order = rng.permutation(len(head.vertices))
    faces = np.argsort(order)[head.faces]
    other = Head.create(head.vertices[order], faces, bones)
    old, new = frame_of(head), frame_of(other)
    assert new.rotation.tolist() == old.rotation.tolist()
    np.testing.assert_allclose(new.centre, old.centre, rtol=1e-9)
    assert new.scale == pytest.approx(old.scale)


@pytest.mark.parametrize("point", [[0, 0, 0], [0.1, 0.2, 0.3], [1e14, 1, -3]])
@pytest.mark.parametrize("bones", [1, 2, 7])
def test_a_frame_of_nothing_but_one_point_is_finite(point, bones):
    head = Head.create(np.tile(point, (5, 1)), NO_FACES, skeleton(bones))
    frame = frame_of(head)
    assert frame.scale > 0 and np.isfinite(frame.scale)
    np.testing.assert_allclose(np.abs(frame.rotation).sum(axis=0), 1)
    spread = np.abs(frame.apply(head.skeleton.joints)).max()
    assert spread < 10


def test_bones_in_one_point_still_have_a_frame():
    one = Skeleton.from_heads_and_tails(
        np.zeros((4, 3)), None, [-1, 0, 1, 2], list("abcd")
    )
    ball = sphere(1)
    frame = canonical_frame(ball.vertices, ball.faces, one.joints, one.parents)
    assert np.isfinite(frame.apply(ball.vertices)).all()
