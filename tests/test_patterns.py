"""Clothes drafted on the shipped body fit: clear of the skin, whole, with openings."""

from functools import cache

import igl
import numpy as np
import pytest

from skinlib.garments.binding import layers_apart
from skinlib.garments.body import read_body
from skinlib.garments.garment import Garment, boundary_loops, read_garment
from skinlib.garments.patterns import (
    PATTERNS,
    _cut,
    _dual,
    _reach,
    _Surface,
    skirt,
    t_shirt,
)
from skinlib.geometry import face_normals, islands, mesh_edges
from skinlib.head import HeadError, Skeleton
from skinlib.paths import sample

OPENINGS = {"t_shirt": 4, "trousers": 3, "skirt": 2, "jacket": 4}
BODY = read_body().head


@cache
def shipped(name: str) -> Garment:
    return read_garment(sample(f"{name}.npz"))


def clearance(points) -> np.ndarray:
    points = np.asarray(points, np.float64)
    return igl.signed_distance(points, BODY.vertices.astype(np.float64), BODY.faces)[0]


@pytest.mark.parametrize("name", PATTERNS)
def test_a_shipped_garment_clears_the_skin(name):
    garment = shipped(name)
    assert clearance(garment.vertices).min() > 0.006
    assert clearance(garment.vertices[garment.faces].mean(axis=1)).min() > 0.004


@pytest.mark.parametrize("name", PATTERNS)
def test_a_shipped_garment_is_one_piece_with_its_openings(name):
    garment = shipped(name)
    assert len(np.unique(islands(garment.faces, len(garment.vertices)))) == 1
    assert len(boundary_loops(garment.faces)) == OPENINGS[name]


@pytest.mark.parametrize("name", PATTERNS)
def test_a_shipped_garment_faces_outwards(name):
    garment = shipped(name)
    normals = face_normals(garment.vertices, garment.faces)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middle = garment.vertices[garment.faces].mean(axis=1)
    further = clearance(middle + 0.004 * normals) > clearance(middle)
    assert further.mean() > 0.999


@pytest.mark.parametrize("name", PATTERNS)
def test_a_shipped_garment_has_even_triangles_and_no_fold(name):
    garment = shipped(name)
    a, b = mesh_edges(garment.faces).T
    lengths = np.linalg.norm(garment.vertices[a] - garment.vertices[b], axis=1)
    assert lengths.max() < 2.5 * lengths.mean()
    assert lengths.min() > 0.3 * lengths.mean()
    normals = face_normals(garment.vertices, garment.faces)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    pairs, _ = igl.triangle_triangle_adjacency(garment.faces)
    face, side = np.nonzero(pairs >= 0)
    assert (normals[face] * normals[pairs[face, side]]).sum(axis=1).min() > 0


@pytest.mark.parametrize("name", PATTERNS)
def test_a_shipped_garment_is_the_same_left_and_right(name):
    garment = shipped(name)
    vertices = garment.vertices.astype(np.float64)
    squared, _, _ = igl.point_mesh_squared_distance(
        vertices * [-1, 1, 1], vertices, garment.faces
    )
    assert np.sqrt(squared).max() < 0.01


@pytest.mark.parametrize("name", ["trousers", "skirt"])
def test_the_waist_is_pinned(name):
    garment = shipped(name)
    height = garment.vertices[:, 2]
    assert garment.pinned.sum() > 30
    assert np.allclose(height[garment.pinned], height.max(), atol=1e-3)


def test_shirt_and_jacket_are_not_pinned_and_do_not_touch():
    shirt, coat = shipped("t_shirt"), shipped("jacket")
    assert not shirt.pinned.any() and not coat.pinned.any()
    assert layers_apart(shirt, coat) == 0
    squared, _, _ = igl.point_mesh_squared_distance(
        coat.vertices.astype(np.float64),
        shirt.vertices.astype(np.float64),
        shirt.faces,
    )
    assert np.sqrt(squared).min() > 0.006


def test_a_draft_is_the_same_each_time_and_fits_another_body():
    again = t_shirt(BODY)
    assert np.abs(again.vertices - shipped("t_shirt").vertices).max() < 1e-4
    heavy = read_body().shaped({"weight": 0.8})
    garment = t_shirt(heavy, vertices=700)
    assert 650 < len(garment.vertices) < 750
    distance = igl.signed_distance(
        garment.vertices.astype(np.float64), heavy.vertices.astype(float), heavy.faces
    )[0]
    assert distance.min() > 0.006
    assert len(boundary_loops(garment.faces)) == OPENINGS["t_shirt"]


def test_the_skirt_has_the_measures_asked_for():
    garment = skirt(BODY, length=0.5, flare=0.6, rings=11, segments=30)
    rings = garment.vertices.reshape(11, 30, 3)
    assert np.ptp(garment.vertices[:, 2]) == pytest.approx(0.5, abs=1e-6)
    assert np.ptp(rings[4, :, 2]) == 0
    centre = rings[0].mean(axis=0)[:2]
    radii = np.linalg.norm(rings[..., :2] - centre, axis=2).mean(axis=1)
    assert radii[-1] - radii[0] == pytest.approx(0.6 * 0.5, abs=0.01)
    assert (np.diff(radii) > 0).all()
    assert garment.pinned.tolist() == [True] * 30 + [False] * 300


@pytest.mark.parametrize(
    "measure", [{"length": 0}, {"flare": -1}, {"rings": 1}, {"segments": 2}]
)
def test_a_skirt_of_impossible_measures_is_refused(measure):
    with pytest.raises(HeadError, match=f"{next(iter(measure))}: it is"):
        skirt(BODY, **measure)


def test_a_body_without_the_bones_or_weights_is_refused():
    skeleton = BODY.skeleton
    names = [name.replace("spine", "back") for name in skeleton.names]
    renamed = Skeleton.from_heads_and_tails(
        skeleton.joints, None, skeleton.parents, names
    )
    with pytest.raises(HeadError, match="no bone 'spine05'"):
        t_shirt(BODY.replace(skeleton=renamed))
    with pytest.raises(HeadError, match="Skin it first"):
        skirt(BODY.replace(weights=None))


def test_a_cut_is_where_the_field_is_zero():
    """A square of two triangles, cut at x = 0.25 and kept to the right."""
    square = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    cut = _cut(_Surface(square, faces), square[:, 0] - 0.25)
    assert cut.vertices[:, 0].min() == pytest.approx(0.25)
    area = np.linalg.norm(face_normals(*cut), axis=1).sum() / 2
    assert area == pytest.approx(0.75)
    assert (face_normals(*cut)[:, 2] > 0).all()


def test_the_hull_of_a_square_reaches_its_side_and_its_corner():
    square = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [0.2, 0.1]], float)
    ways = np.array([[1, 0], [0, -1], [np.sqrt(0.5), np.sqrt(0.5)]])
    assert _reach(square, ways) == pytest.approx([1, 1, np.sqrt(2)])


def test_cells_that_meet_in_both_senses_cancel():
    corners = np.array([[2, 1, 0], [0, 1, 2], [5, 5, 4], [4, 3, 7], [3, 7, 4]])
    assert _dual(np.array([[2, 1, 0], [0, 1, 2]])).tolist() == []
    once = _dual(corners[2:])
    assert len(once) == 1
    assert once.tolist() in ([[3, 7, 4]], [[7, 4, 3]], [[4, 3, 7]])
