"""Confidence per vertex: does it order, is it calibrated, does it survive anything."""

import json

import numpy as np
import pytest
import torch
from shapes import axis_rotations, bumpy, moved, skeleton, sphere
from test_model import DEGENERATE, build

from skinlib import Head, HeadError
from skinlib.datasets.synthetic import synthetic_head
from skinlib.evaluate.calibration import (
    auroc,
    average_precision,
    calibration_scores,
    error_captured,
    expected_calibration_error,
)
from skinlib.io import read_head
from skinlib.model import ModelConfig, SkinningModel
from skinlib.model.confidence import (
    CALIBRATION,
    NETWORK,
    Calibration,
    doubt,
    fit_calibration,
    load_calibration,
    other_view,
    predict_with_confidence,
    predict_with_uncertainty,
    two_opinions,
    uncertainty,
)
from skinlib.paths import sample
from skinlib.training import load_model

BY_HAND = Calibration(0.2, (0.0, 0.5, 1.0), (1.0, 0.75, 0.25), (0.0, 0.1, 0.9))


@pytest.fixture(scope="module")
def head():
    return bumpy(synthetic_head(5, vertices=700, unit="m"))


# ---------------------------------------------------------------- the raw number


def test_doubt_by_hand():
    weights = np.array([[0.5, 0.5], [1.0, 0.0], [0.5, 0.5], [0.9, 0.1]])
    other = np.array([[0.0, 1.0], [0.0, 1.0], [0.5, 0.5], [0.8, 0.2]])
    # Impurities 1/2, 0, 1/2 and 0.18; opinions 1, 2, 0 and 0.2 apart.
    expected = np.sqrt([0.5, 0.0, 0.0, 0.036])
    np.testing.assert_allclose(doubt(weights, other), expected, atol=1e-12)


def test_another_order_of_vertices_and_bones_permutes_it(head):
    model, rng = build(), np.random.default_rng(0)
    order = rng.permutation(len(head.vertices))
    other = Head.create(
        head.vertices[order],
        np.argsort(order)[head.faces],
        head.skeleton.reordered(rng.permutation(len(head.skeleton))),
    )
    expected = uncertainty(model, head)
    assert np.ptp(expected) > 0.02
    np.testing.assert_allclose(uncertainty(model, other), expected[order], atol=1e-4)


def test_axes_and_unit_of_the_file_do_not_matter(head):
    model = build()
    expected = uncertainty(model, head)
    for rotation in axis_rotations()[::5]:
        other = moved(head, rotation, scale=2.0**7)
        np.testing.assert_allclose(uncertainty(model, other), expected, atol=1e-3)


def test_the_other_view_is_the_mirror_image_bent_a_little(head):
    view = other_view(head)
    assert np.array_equal(view.faces, head.faces[:, ::-1])
    assert view.skeleton.names == head.skeleton.names
    centre, width = head.skeleton.joints[:, 0].mean(), np.ptp(head.vertices[:, 0])
    left = head.vertices[:, 0] - centre > 0.2 * width
    right = head.vertices[:, 0] - centre < -0.2 * width
    across = view.vertices[:, 0] - view.skeleton.joints[:, 0].mean()
    # The left half lies where the right half was, whichever way the frame looks.
    assert across[left].mean() * across[right].mean() < 0
    assert np.array_equal(view.vertices, other_view(head).vertices)


def test_opinions_come_back_under_the_right_bones():
    # A network that knows the sample's rig agrees with itself in the mirror.
    weights, other = two_opinions(load_model("heads"), read_head(sample("adult.npz")))
    assert np.abs(weights - other).sum(axis=1).mean() < 0.1
    assert (weights.argmax(axis=1) == other.argmax(axis=1)).mean() > 0.9


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_heads_have_a_confidence(name):
    found = uncertainty(build(), DEGENERATE[name])
    assert len(found) == len(DEGENERATE[name].vertices)
    for value in (BY_HAND.confidence(found), BY_HAND.expected_error(found)):
        assert np.isfinite(value).all() and (value >= 0).all() and (value <= 2).all()


@pytest.mark.parametrize("points", [1, 12])
def test_one_bone_leaves_no_doubt(points):
    head = Head.create(sphere(0).vertices[:points], [], skeleton(1))
    weights, confidence = predict_with_confidence(build(), head, BY_HAND)
    assert (weights == 1).all() and (confidence == 1).all()
    assert (predict_with_confidence(build(), head)[1] == 1).all()


def test_the_weights_are_those_of_predict(head):
    model = build()
    for pruned in (0.01, 0.1):
        weights, found = predict_with_uncertainty(model, head, pruned)
        assert weights.dtype == np.float32
        np.testing.assert_allclose(weights, model.predict(head, pruned), atol=1e-6)
        np.testing.assert_array_equal(found, uncertainty(model, head))


def test_an_untrained_network_is_less_confident_than_a_trained_one():
    head = read_head(sample("adult.npz"))
    torch.manual_seed(0)
    trained, untrained = load_model("heads"), SkinningModel(ModelConfig()).eval()
    sure = predict_with_confidence(trained, head)[1]
    unsure = predict_with_confidence(untrained, head)[1]
    assert sure.mean() > unsure.mean() + 0.3
    assert np.percentile(sure, 90) > np.percentile(unsure, 90)


# ---------------------------------------------------------------- calibration


def test_confidence_and_expected_error_by_hand():
    found = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.4])
    shares, errors = [1, 0.875, 0.75, 0.5, 0.25, 0.25], [0, 0.05, 0.1, 0.5, 0.9, 0.9]
    np.testing.assert_allclose(BY_HAND.confidence(found), shares)
    np.testing.assert_allclose(BY_HAND.expected_error(found), errors)


def test_isotonic_by_hand():
    # The middle two are in the wrong order: they share 1/2, and a mean error of 0.3.
    found, error = np.array([0.1, 0.2, 0.3, 0.4]), np.array([0.0, 0.5, 0.1, 0.9])
    calibration = Calibration.fit([found], [error])
    assert calibration.knots == (0.0, 0.1, 0.2, 0.3, 0.4)
    assert calibration.confidences == (1.0, 1.0, 0.5, 0.5, 0.0)
    np.testing.assert_allclose(calibration.errors, [0, 0, 0.3, 0.3, 0.9])


def test_a_larger_group_weighs_more_and_no_doubt_is_certainty():
    # One of three right, then one of one: together two of four.
    found, error = np.array([0.1, 0.1, 0.1, 0.2]), np.array([1.0, 1.0, 0.0, 0.0])
    calibration = Calibration.fit([found], [error])
    assert calibration.knots == (0.0, 0.1, 0.2)
    assert calibration.confidences == (1.0, 0.5, 0.5)
    assert calibration.errors == (0.0, 0.5, 0.5)


def test_each_head_counts_the_same_and_no_order_matters():
    few, many = (np.array([0.5]), np.array([1.0])), (np.full(9, 0.5), np.zeros(9))
    calibration = Calibration.fit(*zip(few, many, strict=True))
    np.testing.assert_allclose(calibration.confidence(np.array([0.5])), [0.5])
    np.testing.assert_allclose(calibration.expected_error(np.array([0.5])), [0.5])
    turned = Calibration.fit(*zip(many, few, strict=True))
    assert turned == calibration


def test_a_fit_is_monotone_and_says_the_truth_on_fresh_vertices():
    rng = np.random.default_rng(0)

    def draw():
        found = rng.uniform(0, 1, 4000)
        # Wrong with a chance of found squared.
        return found, np.where(rng.random(4000) < found**2, 1.0, 0.0)

    calibration = Calibration.fit(*zip(draw(), draw(), draw(), strict=True))
    steps = np.linspace(0, 1.5, 1000)
    assert (np.diff(calibration.confidence(steps)) <= 0).all()
    assert (np.diff(calibration.expected_error(steps)) >= 0).all()
    found, errors = draw()
    confidence = calibration.confidence(found)
    assert expected_calibration_error(confidence, errors == 0) < 0.03
    assert expected_calibration_error(1 - found, errors == 0) > 0.1
    expected = calibration.expected_error(found)
    assert abs(expected.mean() - errors.mean()) < 0.03


def test_fit_calibration_learns_from_what_the_network_gets_wrong(head):
    model = build()
    calibration = fit_calibration(model, [head], tolerance=0.5, fitted_on="a ball")
    weights, found = predict_with_uncertainty(model, head)
    errors = np.abs(weights - head.weights).sum(axis=1)
    assert (calibration.tolerance, calibration.fitted_on) == (0.5, "a ball")
    assert abs(calibration.confidence(found).mean() - (errors <= 0.5).mean()) < 0.02
    assert abs(calibration.expected_error(found).mean() - errors.mean()) < 0.02


def test_nothing_to_fit_on(head):
    with pytest.raises(HeadError, match="heads with weights"):
        fit_calibration(build(), [])
    with pytest.raises(HeadError, match="skinned heads"):
        fit_calibration(build(), [head.replace(weights=None)])


# ---------------------------------------------------------------- files


def test_a_calibration_comes_back_from_its_file(tmp_path):
    path = BY_HAND.write(tmp_path)
    assert path == tmp_path / CALIBRATION
    assert Calibration.read(path) == BY_HAND == load_calibration(tmp_path)
    assert load_calibration(tmp_path / NETWORK) == BY_HAND


def test_the_shipped_network_has_one_and_lends_it(tmp_path, monkeypatch):
    shipped = load_calibration("heads")
    assert shipped.tolerance == 0.2 and shipped.fitted_on
    (tmp_path / NETWORK).touch()
    assert load_calibration(tmp_path) == shipped
    # A folder of heads that has the shipped network's name.
    (tmp_path / "heads").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_calibration("heads") == shipped
    for nothing in (tmp_path / "heads", "no_such_network"):
        with pytest.raises(HeadError):
            load_calibration(nothing)


GOOD = json.loads(json.dumps(BY_HAND.__dict__))
BAD = {
    "no JSON": "{",
    "no dictionary": "[1, 2]",
    "a field less": json.dumps({k: v for k, v in GOOD.items() if k != "knots"}),
    "knots that go back": json.dumps(GOOD | {"knots": [0, 0.5, 0.4]}),
    "knots that start late": json.dumps(GOOD | {"knots": [0.1, 0.5, 1.0]}),
    "another length": json.dumps(GOOD | {"knots": [0, 0.5]}),
    "no knots": json.dumps(GOOD | {"knots": [], "confidences": [], "errors": []}),
    "more doubt, more confidence": json.dumps(GOOD | {"confidences": [0.2, 0.5, 1]}),
    "confidence above 1": json.dumps(GOOD | {"confidences": [2, 0.5, 0.1]}),
    "errors that fall": json.dumps(GOOD | {"errors": [0.5, 0.1, 0.0]}),
    "NaN": json.dumps(GOOD | {"errors": [0.0, 0.1, float("nan")]}),
    "words": json.dumps(GOOD | {"knots": ["a", "b", "c"]}),
    "one number": json.dumps(GOOD | {"knots": 0.5}),
    "a tolerance of 0": json.dumps(GOOD | {"tolerance": 0}),
    "a tolerance in words": json.dumps(GOOD | {"tolerance": "small"}),
}


@pytest.mark.parametrize("name", BAD)
def test_a_damaged_file_is_named(name, tmp_path):
    path = tmp_path / CALIBRATION
    path.write_text(BAD[name])
    with pytest.raises(HeadError, match=r"calibration\.json"):
        load_calibration(tmp_path)


# ---------------------------------------------------------------- what it is worth


def test_perfect_useless_and_inverted_scores():
    errors = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
    wrong = errors > 0.2
    assert auroc(errors, wrong) == average_precision(errors, wrong) == 1
    assert auroc(np.ones(5), wrong) == 0.5
    assert average_precision(np.ones(5), wrong) == pytest.approx(2 / 5)
    assert auroc(-errors, wrong) == 0


def test_auroc_and_precision_by_hand():
    score, positive = np.array([4, 3, 3, 1]), np.array([True, False, True, False])
    # Pairs: 4 above 3 and 1; 3 ties with 3, is above 1.
    assert auroc(score, positive) == pytest.approx(3.5 / 4)
    # Recall 1/2 at precision 1, the other half at precision 2/3.
    assert average_precision(score, positive) == pytest.approx(0.5 + 0.5 * 2 / 3)


def test_calibration_error_by_hand():
    confidence = np.array([0.9, 0.9, 0.9, 0.9, 0.1, 0.1, 1.0, 0.0])
    right = np.array([1, 1, 1, 0, 0, 1, 1, 0], bool)
    # |3 - 3.6| and |1 - 0.2| of 8; the other two are exact.
    assert expected_calibration_error(confidence, right) == pytest.approx(1.4 / 8)
    assert expected_calibration_error(right.astype(float), right) == 0


def test_error_captured_by_hand():
    errors = np.array([0.0, 0.5, 0.3, 0.2])
    assert error_captured(errors, errors, 0.5) == pytest.approx(0.8)
    assert error_captured(-errors, errors, 0.5) == pytest.approx(0.2)
    # Nobody knows: as good as chance, also for parts of a vertex.
    assert error_captured(np.ones(4), errors, 0.3) == pytest.approx(0.3)
    assert error_captured(errors, np.zeros(4), 0.1) == 1


def test_scores_of_a_head():
    errors = np.repeat([0.0, 0.1, 1.0], [50, 30, 20])
    confidence = np.repeat([1.0, 0.9, 0.0], [50, 30, 20])
    scores = calibration_scores(confidence, errors)
    expected = {
        "share_wrong": 0.2,
        "ece": 0.03,
        "auroc": 1,
        "average_precision": 1,
        "spearman": 1,
        "captured_5": 5 / 23,
        "captured_10": 10 / 23,
        "captured_20": 20 / 23,
    }
    assert scores == pytest.approx(expected)


def test_scores_where_there_is_nothing_to_order():
    scores = calibration_scores(np.ones(1), np.zeros(1))
    assert set(scores) == {
        "share_wrong",
        "ece",
        "captured_5",
        "captured_10",
        "captured_20",
    }
    assert scores["ece"] == scores["share_wrong"] == 0
    for confidence, errors in (
        (np.ones(2), np.ones(3)),
        (np.ones(0), np.ones(0)),
        (np.array([np.nan]), np.ones(1)),
        (np.ones((2, 2)), np.ones((2, 2))),
    ):
        with pytest.raises(ValueError, match="confidence"):
            calibration_scores(confidence, errors)
