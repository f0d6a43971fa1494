"""Measures of pose transfer: values by hand, symmetries, errors."""

import math

import numpy as np
import pytest

from skinlib.head import HeadError
from skinlib.pose_transfer.metrics import (
    Scores,
    chamfer,
    earth_mover,
    edge_error,
    mean_scores,
    pmd,
    score,
    vertex_error,
)

TRIANGLE = np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]])
EDGES = np.array([[0, 1], [1, 2], [0, 2]])
MEASURES = (pmd, chamfer, earth_mover)


def cloud(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3))


def test_pmd_is_a_third_of_the_mean_squared_distance():
    moved = TRIANGLE + np.array([[1, 2, 2], [0, 0, 0], [0, 0, 3]])
    assert pmd(moved, TRIANGLE) == pytest.approx((9 + 0 + 9) / 9)


def test_chamfer_by_hand():
    # From the two: 1 and 0 squared, mean 1/2; from the one: 0.
    assert chamfer(TRIANGLE[:2] / 3, TRIANGLE[:1]) == pytest.approx(0.5)


def test_earth_mover_takes_the_best_matching_and_no_squares():
    a = np.array([[0.0, 0, 0], [1, 0, 0]])
    b = np.array([[1.1, 0, 0], [0, 3, 0]])
    # Nearest first would match 0 with the far one all the same: 0.1 and 3.
    assert earth_mover(a, b) == pytest.approx((0.1 + 3) / 2)
    # Here greed errs: 1 takes 2, and 0 is left with 10.
    line = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[2.0, 0, 0], [10, 0, 0]])
    assert earth_mover(*line) == pytest.approx((2 + 9) / 2)


def test_edge_error_by_hand():
    longer = TRIANGLE * [2, 1, 1]
    # Lengths 3, 5, 4 have become 6, sqrt(36 + 16), 4.
    expected = 100 * (1 + (math.sqrt(52) / 5 - 1) + 0) / 3
    assert edge_error(longer, TRIANGLE, EDGES) == pytest.approx(expected)


def test_an_edge_of_no_length_is_left_out():
    folded = TRIANGLE.copy()
    folded[1] = folded[0]
    assert edge_error(folded, folded, EDGES) == 0
    with pytest.raises(HeadError, match="edges: none has a length"):
        edge_error(TRIANGLE, 0 * TRIANGLE, EDGES)
    with pytest.raises(HeadError, match="edges"):
        edge_error(TRIANGLE, TRIANGLE, EDGES[:0])


def test_vertex_error_is_relative_to_the_height():
    moved = TRIANGLE + np.array([0, 0.3, 0.4])
    assert vertex_error(moved, TRIANGLE, 2) == pytest.approx(25)
    assert vertex_error(10 * moved, 10 * TRIANGLE, 20) == pytest.approx(25)


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("count", [5, 2000])
def test_nothing_is_far_from_itself_and_both_ways_are_alike(measure, count):
    a, b = cloud(count), cloud(count, 1)
    assert measure(a, a) == 0
    assert measure(a, b) == pytest.approx(measure(b, a))
    assert measure(a, b) > 0


@pytest.mark.parametrize("measure", MEASURES)
def test_a_rigid_motion_of_both_changes_nothing(measure):
    turn = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    a, b = cloud(50), cloud(50, 1)
    assert measure(a @ turn + 3, b @ turn + 3) == pytest.approx(measure(a, b))


@pytest.mark.parametrize("measure, power", [(pmd, 2), (chamfer, 2), (earth_mover, 1)])
def test_the_unit_counts_squared_or_once(measure, power):
    a, b = cloud(50), cloud(50, 1)
    assert measure(3 * a, 3 * b) == pytest.approx(3**power * measure(a, b))


@pytest.mark.parametrize("measure", [chamfer, earth_mover])
def test_sets_have_no_order(measure):
    a, b = cloud(60), cloud(60, 1)
    other = np.random.default_rng(2).permutation(60)
    assert measure(a, b[other]) == pytest.approx(measure(a, b))


def test_meshes_of_different_sizes():
    small, large = cloud(300), cloud(3000, 1)
    assert chamfer(small, large) == pytest.approx(chamfer(large, small))
    assert earth_mover(small, large) == pytest.approx(earth_mover(large, small))
    with pytest.raises(HeadError, match="300 of them, 3000 in truth"):
        pmd(small, large)


def test_a_translation_moves_the_earth_by_its_length():
    points = cloud(1500)
    assert earth_mover(points, points + np.array([0, 0.3, 0.4])) <= 0.5 + 1e-9
    assert earth_mover(points, points + np.array([0, 30, 40])) == pytest.approx(
        50, rel=1e-3
    )


@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 3)), np.zeros((4, 2)), np.zeros(3), np.array([[0, np.nan, 0]])],
)
@pytest.mark.parametrize("measure", MEASURES)
def test_no_points_and_nan_are_errors(measure, points):
    with pytest.raises(HeadError, match="points"):
        measure(points, TRIANGLE)
    with pytest.raises(HeadError, match="points"):
        measure(TRIANGLE, points)


@pytest.mark.parametrize("height", [0.0, -1.0, math.nan, math.inf])
def test_a_height_is_above_zero(height):
    with pytest.raises(HeadError, match="height"):
        vertex_error(TRIANGLE, TRIANGLE, height)


def test_one_point_or_more_is_matched():
    with pytest.raises(HeadError, match="points: there are 0"):
        earth_mover(TRIANGLE, TRIANGLE, points=0)


def test_all_in_one_line_with_the_powers_of_the_papers():
    one = score(TRIANGLE + np.array([0, 0, 0.03]), TRIANGLE, EDGES, 4.0)
    assert one.pmd == pytest.approx(3e-4)
    assert one.line() == (
        "PMD 3.00 e-4, CD 18.00 e-4, EMD 30.00 e-3, edges 0.00 %, "
        "vertices 0.75 % of height"
    )
    zero = score(TRIANGLE, TRIANGLE, EDGES, 4.0)
    assert mean_scores([one, zero]).earth_mover == pytest.approx(0.015)
    with pytest.raises(HeadError, match="scores"):
        mean_scores([])
    assert zero == Scores(0, 0, 0, 0, 0)
