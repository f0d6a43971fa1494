import numpy as np
import pytest

from skinlib.datasets.synthetic import synthetic_head
from skinlib.evaluate.groups import (
    FOLDS,
    STRICT,
    apart,
    fold,
    group_split,
    shared_topology,
    topology_groups,
)
from skinlib.head import Head, HeadError, Skeleton

BONE = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["head"])


def edit(head, rng, cut=0.03):
    """Another character from the same mesh: sculpted, reordered, a region cut away."""
    vertices = head.vertices * rng.uniform(0.8, 1.2, 3)
    keep = vertices[head.faces].mean(axis=1) @ rng.standard_normal(3)
    faces = head.faces[keep > np.quantile(keep, cut)]
    order = rng.permutation(len(vertices))
    place = np.argsort(order)
    faces = place[faces][rng.permutation(len(faces))]
    used, faces = np.unique(faces, return_inverse=True)
    return Head.create(vertices[order][used], faces.reshape(-1, 3), BONE)


def family(seed, count):
    base = synthetic_head(seed, vertices=900)
    rng = np.random.default_rng(seed)
    return [edit(base, rng) for _ in range(count)]


def test_edits_of_one_mesh_fall_into_one_group():
    heads = family(1, 3) + family(2, 2) + family(3, 1)
    assert topology_groups(heads) == [0, 0, 0, 1, 1, 2]
    assert topology_groups(heads[::-1]) == [0, 1, 1, 2, 2, 2]


def test_seams_do_not_matter():
    head = synthetic_head(4, vertices=700)
    # Every triangle on its own: the same positions three to eight times.
    soup = Head.create(
        head.vertices[head.faces].reshape(-1, 3),
        np.arange(3 * len(head.faces)).reshape(-1, 3),
        BONE,
    )
    assert shared_topology([head, soup])[0, 1] > 0.95


def test_a_cloud_of_points_is_a_group_too():
    cloud = Head.create(np.eye(3), np.zeros((0, 3), int), BONE)
    assert topology_groups([cloud, *family(1, 1)]) == [0, 1]


def test_a_split_never_cuts_a_group():
    heads = [head for seed in range(1, 6) for head in family(seed, 2)]
    groups = np.array(topology_groups(heads))
    for seed in range(4):
        training, validation = group_split(heads, 0.4, seed)
        assert sorted(training + validation) == list(range(10))
        assert len(validation) == 4
        assert not set(groups[training]) & set(groups[validation])
    assert group_split(heads, 0.4, 1) == group_split(heads, 0.4, 1)
    assert group_split(heads[:2], 0.4, 0) == ([0, 1], [])


def test_folds_hold_out_every_small_group_once():
    heads = [*family(1, 5), *(family(seed, 1)[0] for seed in range(2, 9))]
    held_out = []
    for number in range(FOLDS):
        training, judged = fold(heads, number)
        assert len(training) + len(judged) == len(heads)
        similarity = shared_topology([*training, *judged])
        assert similarity[: len(training), len(training) :].max() <= STRICT
        held_out += judged
    # The family of five is more than a quarter of the twelve: always trained on.
    assert sorted(map(id, held_out)) == sorted(map(id, heads[5:]))
    with pytest.raises(HeadError, match="fold 3"):
        fold(heads[:5], 3)


def test_heads_apart_share_no_mesh():
    heads = family(1, 2) + family(2, 1)
    assert apart(heads[1:], heads[:1]) == heads[2:]
    assert apart(heads, []) == heads
