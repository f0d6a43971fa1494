"""Weights of a garment from the body under it, and whether it fits at all."""

import numpy as np
import pytest

from skinlib.garments.binding import (
    check_fit,
    closest_point_weights,
    layers_apart,
    smooth,
)
from skinlib.garments.body import read_body
from skinlib.garments.garment import Garment, read_garment
from skinlib.head import Head, HeadError, Skeleton
from skinlib.paths import sample

BODY = read_body().head
SHIRT = read_garment(sample("t_shirt.npz"))


def moved(garment: Garment, scale=1.0, by=(0, 0, 0), axes=(0, 1, 2)) -> Garment:
    vertices = garment.vertices[:, list(axes)] * scale + np.float32(by)
    return Garment.create(vertices, garment.faces, garment.pinned, garment.name)


def flat_sheet(height: float) -> Garment:
    """A square of side 1 in four triangles, as high as asked."""
    corners = [[0, 0, height], [1, 0, height], [1, 1, height], [0, 1, height]]
    corners.append([0.5, 0.5, height])
    faces = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    return Garment.create(np.array(corners, float), faces, name=f"sheet {height:g}")


def test_the_weights_of_a_point_above_a_triangle_by_hand():
    """Barycentric coordinates there are the share of each corner's own bone."""
    skeleton = Skeleton.from_heads_and_tails(np.eye(3), None, [-1, 0, 0], list("abc"))
    corners = [[0, 0, 0], [4, 0, 0], [0, 4, 0]]
    head = Head.create(corners, [[0, 1, 2]], skeleton, weights=np.eye(3))
    points = [[1, 2, 0.5], [0, 0, 1], [2, 2, 3], [-1, -2, 0]]
    garment = Garment.create(points, [[0, 1, 2], [2, 1, 3], [3, 0, 2]])
    expected = [[0.25, 0.25, 0.5], [1, 0, 0], [0, 0.5, 0.5], [1, 0, 0]]
    assert np.allclose(closest_point_weights(garment, head), expected, atol=1e-6)


def test_the_weights_of_the_shirt_are_those_of_the_limbs_below():
    weights = closest_point_weights(SHIRT, BODY)
    assert weights.shape == (len(SHIRT.vertices), len(BODY.skeleton))
    assert weights.dtype == np.float32 and (weights >= 0).all()
    assert np.allclose(weights.sum(axis=1), 1, atol=1e-6)
    names = np.array(BODY.skeleton.names)
    left = names[weights[SHIRT.vertices[:, 0] > 0.26].argmax(axis=1)]
    assert set(left) <= {"upperarm01.L", "upperarm02.L"}


def test_the_skin_itself_gets_its_own_weights():
    open_body = BODY.faces[BODY.vertices[BODY.faces][:, :, 2].min(axis=1) > 0.3]
    used, faces = np.unique(open_body, return_inverse=True)
    skin = Garment.create(BODY.vertices[used], faces.reshape(-1, 3))
    weights = closest_point_weights(skin, BODY)
    assert np.abs(weights - BODY.weights[used]).max() < 1e-3


def test_smoothing_keeps_rows_and_what_is_even_and_ends_even():
    weights = closest_point_weights(SHIRT, BODY)
    smoothed = smooth(weights, SHIRT.faces, 10)
    assert np.allclose(smoothed.sum(axis=1), 1, atol=1e-5)
    assert np.array_equal(smooth(weights, SHIRT.faces, 0), weights)
    even = np.full((len(weights), 2), 0.5)
    assert np.allclose(smooth(even, SHIRT.faces, 100), 0.5)
    a, b = SHIRT.faces[:, :2].T
    jumps = [np.abs(w[a] - w[b]).sum(axis=1).max() for w in (weights, smoothed)]
    assert jumps[1] < jumps[0] / 2


def test_smoothing_leaves_a_loose_vertex_and_counts_up():
    weights = np.array([[1.0, 0], [0, 1], [0, 1], [0.3, 0.7]])
    assert smooth(weights, np.array([[0, 1, 2]]), 1).tolist() == [
        [0, 1],
        [0.5, 0.5],
        [0.5, 0.5],
        [pytest.approx(0.3), pytest.approx(0.7)],
    ]
    with pytest.raises(HeadError, match="iterations"):
        smooth(weights, np.array([[0, 1, 2]]), -1)


def test_a_garment_that_fits_gets_its_distances():
    distance = check_fit(SHIRT, BODY)
    assert distance.shape == (len(SHIRT.vertices),)
    assert 0.006 < distance.min() and np.median(distance) == pytest.approx(0.012, 0.1)


@pytest.mark.parametrize(
    "change",
    [{"scale": 100.0}, {"scale": 0.01, "by": (3, 0, 0)}, {"by": (0, 0, 5)}],
    ids=["centimetres", "elsewhere", "high up"],
)
def test_a_garment_far_from_the_body_is_refused(change):
    with pytest.raises(HeadError, match=r"away from the body.*metres, Z up"):
        check_fit(moved(SHIRT, **change), BODY)


def test_a_garment_inside_the_body_is_refused():
    with pytest.raises(HeadError, match=r"\d+% .* inside the body, the deepest \d+ mm"):
        check_fit(moved(SHIRT, scale=0.8, by=(0, 0, 0.09)), BODY)


def test_a_garment_of_a_millimetre_is_refused():
    """At the origin, between the legs, it is neither far away nor inside."""
    with pytest.raises(
        HeadError, match=r"the garment measures 0\.000\d+ x .*its scale"
    ):
        check_fit(moved(SHIRT, scale=0.001), BODY)


def test_a_garment_inside_out_is_refused():
    turned = Garment.create(SHIRT.vertices, SHIRT.faces[:, ::-1])
    with pytest.raises(HeadError, match=r"\d+% of the garment shows its outside"):
        check_fit(turned, BODY)


def test_layers_that_intersect_or_are_swapped_are_refused():
    assert layers_apart(flat_sheet(0), flat_sheet(0.1)) == 0
    with pytest.raises(HeadError, match=r"1 of 5 vertices of sheet 0 .*outwards"):
        layers_apart(flat_sheet(0.1), flat_sheet(0))


def test_what_lies_beyond_the_hem_is_not_inside():
    beside = moved(flat_sheet(-0.1), by=(1.5, 0, 0))
    assert layers_apart(flat_sheet(0), beside) == 0


def test_a_body_without_weights_is_refused():
    with pytest.raises(HeadError, match="Skin it first"):
        closest_point_weights(SHIRT, BODY.replace(weights=None))
