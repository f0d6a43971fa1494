import sys
from types import SimpleNamespace

import numpy as np
import pytest

from skinlib import HeadError
from skinlib.datasets import anny
from skinlib.datasets.anny import AnnyConfig, anny_heads
from skinlib.io import read_head
from skinlib.paths import sample

LABELS = SimpleNamespace(
    phenotype_labels=(
        "gender age muscle weight height proportions cupsize firmness "
        "african asian caucasian"
    ).split(),
    local_change_labels=[
        "l-ear-scale-incr",
        "r-ear-scale-incr",
        "torso-trans-up",
        *(f"nose-{i}-incr" for i in range(50)),
    ],
    facial_action_labels=(
        "jawOpen mouthClose jawLeft jawRight eyeBlinkLeft eyeBlinkRight"
    ).split(),
)


def draw(seed, **config):
    return anny._identity(LABELS, seed, AnnyConfig(**config))


def test_an_identity_is_its_seed():
    for once, again, other in zip(draw(3), draw(3), draw(4), strict=True):
        np.testing.assert_array_equal(once, again)
        assert not np.array_equal(once, other) or not once.any()


def test_values_are_in_the_range_of_the_model():
    for seed in range(50):
        phenotype, shape, actions = draw(seed, age=(0.4, 0.5), shape_spread=2.0)
        assert 0.4 <= phenotype[1] <= 0.5
        assert phenotype.min() >= 0 and phenotype.max() <= 1
        assert phenotype[-3:].sum() == pytest.approx(1)
        assert np.abs(shape).max() <= 1
        assert actions.min() >= 0 and actions.max() <= 1


def test_the_body_stays_and_the_sides_of_a_face_resemble_each_other():
    drawn = [draw(seed, shape_share=1.0)[1] for seed in range(20)]
    left, right, torso = np.array(drawn)[:, :3].T
    np.testing.assert_array_equal(torso, 0)
    assert (left * right > 0).all() and (left != right).any()
    assert (np.abs(left - right) <= 0.25 * np.abs(left)).all()


def test_opposite_actions_are_drawn_on_their_own():
    pairs = [anny.SIDE.sub("", label) for label in LABELS.facial_action_labels]
    assert pairs[:4] == ["jawOpen", "mouthClose", "jawLeft", "jawRight"]
    assert pairs[4:] == ["eyeBlink", "eyeBlink"]


def test_without_expressions_the_face_is_neutral():
    assert not any(draw(seed, expression_share=0.0)[2].any() for seed in range(20))


def test_lips_close_only_as_far_as_the_jaw_opens():
    actions = np.array([draw(seed, expression_share=1.0)[2] for seed in range(300)])
    assert actions[:, 1].any()
    assert (actions[:, 1] <= actions[:, 0]).all()


def test_parents_skip_the_bones_that_are_left_out():
    parents = np.array([-1, 0, 1, 2, 0])
    kept = np.array([0, 3, 4])
    assert anny._nearest_kept(parents, kept).tolist() == [-1, 0, 0]


def test_without_anny_one_clear_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "anny", None)
    anny._model.cache_clear()
    anny._crop.cache_clear()
    with pytest.raises(HeadError, match="pip install anny"):
        anny_heads(1)


@pytest.mark.parametrize(
    "name", ["adult.npz", "child.npz", "elder.npz", "remeshed.npz"]
)
def test_sample_busts_are_labelled(name):
    head = read_head(sample(name))
    assert len(head.skeleton) == 64
    assert (head.weights > 0).any(axis=0).sum() == 36
    np.testing.assert_allclose(head.weights.sum(axis=1), 1, atol=1e-6)
    roots = np.flatnonzero(head.skeleton.parents < 0)
    assert [head.skeleton.names[root] for root in roots] == ["spine01"]
    # Z up, the face towards -Y, the character's left at +X.
    joint = dict(zip(head.skeleton.names, head.skeleton.joints, strict=True))
    assert joint["head"][2] > joint["neck01"][2]
    assert joint["eye.L"][1] < joint["head"][1]
    assert joint["eye.L"][0] > 0 > joint["eye.R"][0]


def test_the_sample_glb_is_the_sample_npz_turned_to_y_up():
    npz, glb = read_head(sample("adult.npz")), read_head(sample("adult.glb"))
    x, y, z = npz.vertices.T
    np.testing.assert_allclose(glb.vertices, np.stack([x, z, -y], axis=1), atol=1e-6)
    np.testing.assert_allclose(glb.weights, npz.weights, atol=1e-6)


def test_the_unskinned_sample_has_bones_and_no_weights():
    head = read_head(sample("unskinned.glb"))
    assert head.weights is None and len(head.skeleton) == 64


@pytest.mark.slow
def test_heads_from_the_body_model():
    pytest.importorskip("anny")
    three = anny_heads(3, seed=10)
    alone = anny_heads(1, seed=12)[0]
    np.testing.assert_allclose(three[2].vertices, alone.vertices, atol=1e-7)
    for head in three:
        assert len(head.vertices) == 4406 and len(head.faces) == 8748
        assert len(head.skeleton) == 63
        np.testing.assert_array_equal(head.weights, three[0].weights)
    assert np.abs(three[0].vertices - three[1].vertices).max() > 0.01

    deforming = anny_heads(1, 12, AnnyConfig(helper_bones=False))[0]
    assert len(deforming.skeleton) == 35
    assert (deforming.weights > 0).any(axis=0).all()
    columns = [alone.skeleton.names.index(n) for n in deforming.skeleton.names]
    np.testing.assert_array_equal(alone.weights[:, columns], deforming.weights)

    bust = anny_heads(1, 12, AnnyConfig(bust=True))[0]
    assert len(bust.vertices) == 4864 and len(bust.skeleton) == 64
