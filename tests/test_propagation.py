"""Label propagation: which rows are carried from painted heads to others."""

from dataclasses import replace

import numpy as np
import pytest

from skinlib.datasets.augment import AugmentConfig, reorder_bones, reorder_vertices
from skinlib.datasets.synthetic import synthetic_head
from skinlib.geometry import neighbourhood_kinds
from skinlib.head import Head, Skeleton
from skinlib.training import Trainer
from skinlib.training.propagation import Propagation
from tests.test_training import CONFIG_OF_TESTS

SEED = 5


@pytest.fixture(scope="module")
def painted():
    return synthetic_head(SEED, 1500)


@pytest.fixture(scope="module")
def sculpted():
    """The same mesh and rig as `painted`, and another face."""
    return synthetic_head(SEED, 1500, face=1)


def error(weights, head):
    return np.abs(weights - head.weights).sum(axis=1)


def test_kinds_do_not_depend_on_places_order_or_seams(painted):
    rng = np.random.default_rng(0)
    kinds = neighbourhood_kinds(painted.vertices, painted.faces)
    moved = painted.replace(vertices=painted.vertices * np.float32([1, 2, 3]))
    assert (neighbourhood_kinds(moved.vertices, moved.faces) == kinds).all()
    other = reorder_vertices(painted, rng)
    again = neighbourhood_kinds(other.vertices, other.faces)
    assert (np.sort(again) == np.sort(kinds)).all()
    # Every triangle with corners of its own: the mesh is all seams.
    loose = neighbourhood_kinds(
        painted.vertices[painted.faces.ravel()],
        np.arange(painted.faces.size).reshape(-1, 3),
    )
    assert (loose == kinds[painted.faces.ravel()]).all()


def test_more_rings_tell_more_vertices_apart(painted):
    counts = [
        len(np.unique(neighbourhood_kinds(painted.vertices, painted.faces, rings)))
        for rings in (0, 1, 2, 3)
    ]
    assert counts == sorted(counts) and counts[0] < 20 < counts[-1]
    valence = neighbourhood_kinds(painted.vertices, painted.faces, 0)
    assert valence.max() < 30


def test_the_same_mesh_sculpted_anew_is_known(painted, sculpted):
    weights, known = Propagation([painted]).rows(sculpted.replace(weights=None))
    assert known.mean() > 0.5
    assert error(weights, sculpted)[known].mean() < 0.02
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)
    # The rest is a template copy: worse, but no nonsense.
    assert error(weights, sculpted)[~known].mean() < 0.3


def test_order_of_vertices_and_bones_and_unit_do_not_matter(painted):
    rng = np.random.default_rng(0)
    other = reorder_bones(reorder_vertices(painted, rng), rng)
    skeleton = replace(
        other.skeleton,
        joints=other.skeleton.joints * 100,
        lengths=other.skeleton.lengths * 100,
    )
    other = other.replace(vertices=other.vertices * 100, skeleton=skeleton)
    weights, known = Propagation([painted]).rows(other.replace(weights=None))
    assert known.all()
    # Weights are functions of the place, and the eyes are as symmetric as can be.
    assert (error(weights, other) < 1e-4).mean() > 0.99


def test_another_mesh_is_hardly_known(painted):
    other = synthetic_head(SEED + 1, 1500)
    _, known = Propagation([painted]).rows(other.replace(weights=None))
    assert not known.any()


def test_the_nearest_of_several_painted_heads_decides(painted, sculpted):
    blurred = 0.98 * sculpted.weights + 0.02 * np.roll(sculpted.weights, 1, axis=1)
    weights, known = Propagation([sculpted.replace(weights=blurred), painted]).rows(
        painted
    )
    assert known.mean() > 0.5
    assert (error(weights, painted)[known] < 1e-4).all()


def test_where_artists_disagree_nothing_is_known(painted, sculpted):
    jaw = sculpted.skeleton.names.index("jaw")
    eye = sculpted.skeleton.names.index("eye_L")
    swapped = sculpted.weights.copy()
    swapped[:, [jaw, eye]] = swapped[:, [eye, jaw]]
    stranger = sculpted.replace(weights=swapped)
    _, alone = Propagation([painted]).rows(painted)
    _, known = Propagation([painted, stranger]).rows(painted)
    moved = painted.weights[:, [jaw, eye]].max(axis=1) > 0.2
    assert alone[moved].mean() > 0.9 and not known[moved].any()
    assert known[~moved].mean() > 0.5


def test_rows_on_bones_that_are_not_there_are_not_known(painted):
    jaw = painted.skeleton.names.index("jaw")
    names = list(painted.skeleton.names)
    names[jaw] = "mandible"
    other = painted.replace(skeleton=replace(painted.skeleton, names=tuple(names)))
    weights, known = Propagation([painted]).rows(other.replace(weights=None))
    assert not known[painted.weights[:, jaw] > 0.02].any()
    assert known[painted.weights[:, jaw] == 0].all()
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("faces", [[[0, 1, 2]], []])
def test_a_head_of_three_vertices(painted, faces):
    bones = Skeleton.from_heads_and_tails(
        [[0, 0, 0], [0, 1, 0]], None, [-1, 0], ["head", "jaw"]
    )
    faces = np.array(faces, np.int64).reshape(-1, 3)
    head = Head.create(np.eye(3), faces, bones)
    weights, known = Propagation([painted]).rows(head)
    assert weights.shape == (3, 2) and not known.any()
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)


def test_only_known_rows_of_unlabelled_heads_are_learnt(painted, sculpted, tmp_path):
    config = replace(CONFIG_OF_TESTS, unlabelled_share=1.0)
    bare = [
        sculpted.replace(weights=None),
        synthetic_head(SEED + 1).replace(weights=None),
    ]
    trainer = Trainer(config, [painted], tmp_path, bare, validation=[])
    # Of the second one nothing is known, so it is not drawn.
    known = trainer.carried[0][1]
    assert trainer.useful == [0]
    assert trainer.describe_unlabelled().startswith("1 of 2 unlabelled heads share ")
    for draw in range(3):
        head, graph, labelled, mask = trainer._draw(draw, np.random.default_rng(draw))
        assert not labelled and head.name == sculpted.name
        assert (mask[graph.node_of_vertex] == known).mean() > 0.99
        assert error(head.weights, sculpted)[known].mean() < 0.02
    assert np.isfinite(trainer.step()["supervised"])


def test_without_propagation_nothing_is_known(painted, sculpted, tmp_path):
    bare = [sculpted.replace(weights=None)]
    config = replace(CONFIG_OF_TESTS, propagate=False, unlabelled_share=1.0)
    trainer = Trainer(config, [painted], tmp_path / "a", bare, validation=[])
    assert trainer.useful == [] and not trainer.mixed
    assert "nothing else" in trainer.describe_unlabelled()
    config = replace(config, pseudo=1.0)
    trainer = Trainer(config, [painted], tmp_path / "b", bare, validation=[])
    assert trainer.useful == [0] and trainer.mixed
    assert trainer.describe_unlabelled() == ""
    assert not trainer._draw(0, np.random.default_rng(0))[3].any()


def test_unlabelled_heads_keep_their_mesh(painted, sculpted, tmp_path):
    changes = AugmentConfig(drop_islands=0.5, cut_seams=1.0, reorder_vertices=True)
    config = replace(CONFIG_OF_TESTS, unlabelled_share=1.0, augment=changes)
    bare = [sculpted.replace(weights=None)]
    trainer = Trainer(config, [painted], tmp_path, bare, validation=[])
    assert np.isfinite(trainer.step()["supervised"])
    assert changes.on_the_same_mesh.keeps_mesh
    assert changes.on_the_same_mesh.warp == changes.warp
