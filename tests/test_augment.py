"""Augmentations: the weights stay right, and each does what its name says."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skinlib.datasets import augment as module
from skinlib.datasets.augment import (
    UNDISTURBED,
    AugmentConfig,
    Warp,
    apply_pose,
    augment,
    cut_seams,
    drop_islands,
    jitter,
    merge_bones,
    mirror,
    pose,
    reorder_bones,
    reorder_vertices,
    resemble,
    scale,
    stretch,
    warp,
)
from skinlib.datasets.synthetic import synthetic_head, synthetic_head_and_regions
from skinlib.geometry import islands, vertex_normals, weld
from skinlib.head import Head, HeadError, Skeleton

STEPS = (
    "scale stretch rotate warp jitter pose mirror collapse_bones reorder_bones "
    "reorder_vertices drop_islands flip_edges cut_seams"
).split()
NEW_MESH = ("reorder_vertices", "drop_islands", "flip_edges", "cut_seams")
ALL = AugmentConfig(
    collapse=1,
    mirror=1,
    pose=1,
    scale=3,
    drop_islands=0.5,
    flip_edges=0.3,
    cut_seams=1,
    reorder_vertices=True,
)


@pytest.fixture(scope="module")
def head():
    return synthetic_head(4, 900, bones=12, unit="cm", up="y")


def box(head):
    return np.linalg.norm(np.ptp(head.vertices.astype(float), axis=0))


def assert_same(one, two, atol=0.0):
    for name in ("vertices", "normals", "weights"):
        np.testing.assert_allclose(getattr(one, name), getattr(two, name), atol=atol)
    np.testing.assert_array_equal(one.faces, two.faces)
    assert_same_bones(one.skeleton, two.skeleton, atol)


def assert_same_bones(one, two, atol=0.0):
    assert one.names == two.names
    np.testing.assert_array_equal(one.parents, two.parents)
    for name in ("joints", "lengths", "directions"):
        np.testing.assert_allclose(getattr(one, name), getattr(two, name), atol=atol)


def assert_valid(head):
    """All that the contract promises, checked by building the head anew."""
    again = head.replace(normals=head.normals)
    assert_same(head, again, atol=1e-6)
    np.testing.assert_allclose(head.weights.sum(axis=1, dtype=float), 1, atol=2e-6)
    for owner in (head, head.skeleton):
        for field in dataclasses.fields(owner):
            value = getattr(owner, field.name)
            if isinstance(value, np.ndarray):
                assert not value.flags.writeable, field.name
                assert (
                    value.dtype
                    == getattr(
                        again if owner is head else again.skeleton, field.name
                    ).dtype
                )


@pytest.mark.parametrize("step", STEPS)
def test_every_step_returns_a_valid_head_decided_by_the_seed(head, step):
    call = getattr(module, step)
    one = call(head, np.random.default_rng(5))
    assert_valid(one)
    assert_same(one, call(head, np.random.default_rng(5)))
    if step not in NEW_MESH:
        assert len(one.vertices) == len(head.vertices)
        np.testing.assert_array_equal(
            np.sort(one.faces, axis=1), np.sort(head.faces, axis=1)
        )
    if step not in ("collapse_bones", "reorder_bones"):
        assert one.skeleton.names == head.skeleton.names


@pytest.mark.parametrize("step", [name for name in STEPS if name != "pose"])
def test_unlabelled_heads_may_be_changed_too(head, step):
    unlabelled = head.replace(weights=None)
    changed = getattr(module, step)(unlabelled, np.random.default_rng(1))
    labelled = getattr(module, step)(head, np.random.default_rng(1))
    assert changed.weights is None
    np.testing.assert_array_equal(changed.vertices, labelled.vertices)


def test_an_unlabelled_head_cannot_be_posed(head):
    with pytest.raises(HeadError, match="weights"):
        pose(head.replace(weights=None), np.random.default_rng(0))


@pytest.mark.parametrize("config", [AugmentConfig(), ALL, UNDISTURBED])
@pytest.mark.parametrize("seed", range(6))
def test_augment_is_valid_and_decided_by_the_seed(config, seed):
    head, others = synthetic_head(seed, 700), [synthetic_head(seed + 6, 700)]
    one = augment(head, np.random.default_rng(seed), config, others)
    assert_valid(one)
    assert_same(one, augment(head, np.random.default_rng(seed), config, others))
    # One pass over the normals has to be as good as one after every step.
    if config.keeps_mesh:
        fresh = vertex_normals(one.vertices, one.faces)
        np.testing.assert_allclose(one.normals, fresh, atol=1e-5)
        np.testing.assert_array_equal(
            np.sort(one.faces, axis=1), np.sort(head.faces, axis=1)
        )
    assert augment(head.replace(weights=None), np.random.default_rng(0)).weights is None


def test_resemble_takes_over_the_proportions_of_another_head(head):
    other = synthetic_head(8, 700, bones=12, unit="m", up="y")
    assert set(other.skeleton.names) == set(head.skeleton.names)
    order = [other.skeleton.names.index(name) for name in head.skeleton.names]

    def shape(joints):
        joints = joints.astype(float) - joints.mean(axis=0)
        return joints / joints.std()

    goal = shape(other.skeleton.joints[order])
    gaps = [
        np.abs(shape(resemble(head, other, amount).skeleton.joints) - goal).mean()
        for amount in (0, 0.5, 1)
    ]
    assert gaps[0] > 2 * gaps[2] and gaps[0] > gaps[1] > gaps[2]
    changed = resemble(head, other)
    assert_valid(changed)
    np.testing.assert_array_equal(changed.weights, head.weights)
    assert 0.7 < box(changed) / box(head) < 1.4  # still in its own unit
    assert_same(resemble(head, head), head, atol=1e-4)


def test_resemble_leaves_a_head_alone_that_shares_no_names(head):
    names = tuple(f"bone {i}" for i in range(len(head.skeleton)))
    stranger = head.replace(
        skeleton=dataclasses.replace(head.skeleton, names=names),
        vertices=head.vertices * 2,
    )
    assert resemble(head, stranger) is head


def test_augment_with_everything_off_changes_nothing(head):
    assert UNDISTURBED.keeps_mesh and AugmentConfig().keeps_mesh and not ALL.keeps_mesh
    assert_same(augment(head, np.random.default_rng(0), UNDISTURBED), head)


def test_scale_is_exact(head):
    scaled = scale(head, np.random.default_rng(0), 4.0)
    factor = box(scaled) / box(head)
    assert 0.25 <= factor <= 4 and abs(factor - 1) > 0.01
    np.testing.assert_allclose(scaled.vertices, head.vertices * factor, rtol=1e-5)
    np.testing.assert_allclose(
        scaled.skeleton.lengths, head.skeleton.lengths * factor, rtol=1e-4
    )
    np.testing.assert_array_equal(scaled.normals, head.normals)


def test_stretch_moves_bones_with_the_surface(head):
    """Vertices and joints go through the same affine map."""
    stretched = stretch(head, np.random.default_rng(0), 0.1)
    bare = np.c_[head.vertices.astype(float), np.ones(len(head.vertices))]
    affine = np.linalg.lstsq(bare, stretched.vertices.astype(float), rcond=None)[0]
    for name in ("joints", "tails"):
        ends = getattr(head.skeleton, name)
        np.testing.assert_allclose(
            np.c_[ends, np.ones(len(ends))] @ affine,
            getattr(stretched.skeleton, name),
            atol=1e-4 * box(head),
        )


def test_jitter_is_small_and_keeps_touching_vertices_together():
    head, regions = synthetic_head_and_regions(3, 900)
    cut = cut_seams(head, np.random.default_rng(1))
    shaken = jitter(cut, np.random.default_rng(0), 0.001, 0.004)
    move = np.linalg.norm(shaken.vertices - cut.vertices, axis=1) / box(head)
    assert 0.0001 < np.sqrt((move**2).mean()) < 0.003
    ends = shaken.skeleton.joints - cut.skeleton.joints
    assert 0.001 < np.sqrt((ends**2).sum(axis=1).mean()) / box(head) < 0.01
    np.testing.assert_allclose(
        shaken.skeleton.lengths, cut.skeleton.lengths, atol=1e-5 * box(head)
    )
    before, after = weld(cut.vertices, 1e-5), weld(shaken.vertices, 1e-5)
    assert len(np.unique(before)) == pytest.approx(len(np.unique(after)), abs=3)
    gap = shaken.vertices[regions.upper_lip] - shaken.vertices[regions.lower_lip]
    assert np.linalg.norm(gap, axis=1).max() < 1e-4 * box(head)


def test_mirror_twice_is_the_identity(head):
    once = mirror(head)
    assert_same(mirror(once), head, atol=1e-6)
    assert not np.allclose(once.vertices, head.vertices)


@pytest.mark.parametrize("up", ["y", "z"])
def test_mirror_swaps_sides_by_geometry(up):
    head = synthetic_head(4, 900, bones=12, up=up)
    once, names = mirror(head), head.skeleton.names
    np.testing.assert_array_equal(once.vertices[:, 0], -head.vertices[:, 0])
    np.testing.assert_array_equal(once.vertices[:, 1:], head.vertices[:, 1:])
    left, right = names.index("eye_L"), names.index("eye_R")
    # The bone called left is still at the left, and moves what is there now.
    assert once.skeleton.names == names
    assert once.skeleton.joints[left, 0] > 0
    np.testing.assert_array_equal(once.weights[:, left], head.weights[:, right])
    jaw = names.index("jaw")
    np.testing.assert_array_equal(once.weights[:, jaw], head.weights[:, jaw])
    np.testing.assert_array_equal(once.skeleton.parents, head.skeleton.parents)
    # Triangles are turned around, so the skin still faces outwards.
    np.testing.assert_allclose(
        vertex_normals(once.vertices, once.faces), once.normals, atol=1e-5
    )


def test_pose_by_no_turn_is_the_identity(head):
    still = apply_pose(head, np.tile(np.eye(3), (len(head.skeleton), 1, 1)))
    assert_same(still, head, atol=1e-4 * box(head))
    assert_same(pose(head, np.random.default_rng(0), degrees=0.0), still)


def test_pose_of_the_neck_turns_everything_above(head):
    """A turn of one bone moves joints, tails and rigid vertices by the same motion."""
    names = list(head.skeleton.names)
    turns = np.tile(np.eye(3), (len(names), 1, 1))
    quarter = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    turns[names.index("head")] = quarter
    posed = apply_pose(head, turns)
    pivot = head.skeleton.joints[names.index("head")]
    move = lambda p: (p - pivot) @ quarter.T + pivot  # noqa: E731
    above = np.array(names) != "neck"
    for name in ("joints", "tails"):
        np.testing.assert_allclose(
            getattr(posed.skeleton, name)[above],
            move(getattr(head.skeleton, name)[above]),
            atol=1e-4 * box(head),
        )
    free = head.weights[:, names.index("neck")] == 0
    np.testing.assert_allclose(
        posed.vertices[free], move(head.vertices[free]), atol=1e-4 * box(head)
    )
    np.testing.assert_array_equal(posed.weights, head.weights)


def test_roots_are_not_posed(head):
    posed = pose(head, np.random.default_rng(0), degrees=20, share=1.0)
    neck = head.skeleton.names.index("neck")
    rigid = head.weights[:, neck] == 1
    assert rigid.any()
    np.testing.assert_allclose(
        posed.vertices[rigid], head.vertices[rigid], atol=1e-5 * box(head)
    )
    assert np.abs(posed.vertices - head.vertices).max() > 0.01 * box(head)


@pytest.mark.parametrize("seed", range(5))
def test_a_warp_never_folds(seed):
    field = Warp(np.random.default_rng(seed), np.array([0, 16, 0]), 4.0, 0.95)
    line = np.linspace(-2, 2, 12)
    grid = np.stack(np.meshgrid(line, line + 16, line), axis=-1).reshape(-1, 3)
    step = 1e-5
    columns = [
        (field(grid + step * axis) - field(grid - step * axis)) / (2 * step)
        for axis in np.eye(3)
    ]
    jacobian = np.stack(columns, axis=-1)
    assert np.linalg.det(jacobian).min() > 0
    change = np.linalg.norm(jacobian - np.eye(3), ord=2, axis=(1, 2)).max()
    assert 0.05 < change <= 0.95
    far = np.array([[100.0, 16, 0]])
    np.testing.assert_array_equal(field(far), far)


def test_a_warp_moves_bones_with_the_surface(head):
    warped = warp(head, np.random.default_rng(2), 0.9)
    assert np.abs(warped.vertices - head.vertices).max() > 0.005 * box(head)
    # A joint placed on a vertex stays on it.
    field = Warp(np.random.default_rng(2), *middle_and_size(head), 0.9)
    np.testing.assert_allclose(
        warped.skeleton.joints, field(head.skeleton.joints), atol=1e-4
    )
    np.testing.assert_allclose(warped.vertices, field(head.vertices), atol=1e-4)


def middle_and_size(head):
    vertices = head.vertices.astype(np.float64)
    return (vertices.min(axis=0) + vertices.max(axis=0)) / 2, float(box(head))


@pytest.mark.parametrize("strength", [-0.1, 1.0])
def test_a_warp_that_could_fold_is_refused(head, strength):
    with pytest.raises(ValueError, match="strength"):
        warp(head, np.random.default_rng(0), strength)


def test_bones_without_a_length_stay_without():
    heads = (synthetic_head(seed, 600) for seed in range(20))
    head = next(h for h in heads if (h.skeleton.lengths == 0).any())
    for seed in range(10):
        other = augment(
            head, np.random.default_rng(seed), AugmentConfig(collapse=0, mirror=0)
        )
        where = [head.skeleton.names.index(name) for name in other.skeleton.names]
        without = head.skeleton.lengths[where] == 0
        np.testing.assert_array_equal(other.skeleton.lengths == 0, without)
        assert (other.skeleton.directions[without] == 0).all()


def test_merged_bones_leave_weight_and_children_to_the_nearest_ancestor():
    head = synthetic_head(1, 700, bones=14, shuffle=False)
    names = np.array(head.skeleton.names)
    gone = np.isin(names, ["head", "jaw"])
    fewer = merge_bones(head, gone)
    assert fewer.skeleton.names == tuple(names[~gone])
    assert (fewer.skeleton.parents == np.r_[-1, np.zeros(len(names) - 3)]).all()
    before = {name: head.weights[:, i] for i, name in enumerate(names)}
    summed = before["neck"] + before["head"] + before["jaw"]
    np.testing.assert_allclose(fewer.weights[:, 0], summed, atol=1e-6)
    for place, name in enumerate(fewer.skeleton.names[1:], start=1):
        np.testing.assert_array_equal(fewer.weights[:, place], before[name])


def test_a_root_is_never_merged(head):
    with pytest.raises(HeadError, match="neck"):
        merge_bones(head, np.ones(len(head.skeleton), bool))
    alone = module.collapse_bones(head, np.random.default_rng(0), 1.0)
    assert alone.skeleton.names == ("neck",)
    np.testing.assert_allclose(alone.weights, 1, atol=1e-6)


def test_reordered_bones_are_the_same_bones(head):
    other = reorder_bones(head, np.random.default_rng(0))
    assert other.skeleton.names != head.skeleton.names
    back = [other.skeleton.names.index(name) for name in head.skeleton.names]
    assert_same_bones(other.skeleton.reordered(back), head.skeleton)
    np.testing.assert_array_equal(other.weights[:, back], head.weights)


def test_reordered_vertices_are_the_same_corners(head):
    other = reorder_vertices(head, np.random.default_rng(0))
    assert not np.array_equal(other.vertices, head.vertices)
    for name in ("vertices", "normals", "weights"):
        np.testing.assert_array_equal(
            getattr(other, name)[other.faces], getattr(head, name)[head.faces]
        )


def test_islands_go_and_the_skin_stays():
    head, regions = synthetic_head_and_regions(0, 900)
    rest = drop_islands(head, np.random.default_rng(0), 1.0)
    assert len(rest.vertices) == len(head.vertices) - len(regions.eyes)
    assert len(np.unique(islands(rest.faces, len(rest.vertices)))) == 1
    skin = np.setdiff1d(np.arange(len(head.vertices)), regions.eyes)
    np.testing.assert_array_equal(rest.vertices, head.vertices[skin])
    assert drop_islands(head, np.random.default_rng(0), 0.0) is head


def test_a_seam_doubles_vertices_and_moves_nothing(head):
    cut = cut_seams(head, np.random.default_rng(0))
    assert len(cut.vertices) > len(head.vertices)
    for name in ("vertices", "normals", "weights"):
        np.testing.assert_array_equal(
            getattr(cut, name)[cut.faces], getattr(head, name)[head.faces]
        )
    assert len(np.unique(weld(cut.vertices))) == len(np.unique(weld(head.vertices)))
    assert (
        islands(cut.faces, len(cut.vertices)).max()
        > islands(head.faces, len(head.vertices)).max()
    )


def test_a_head_whose_vertices_lie_in_one_place():
    bones = Skeleton.from_heads_and_tails(np.eye(2, 3), None, [-1, 0], "ab")
    point = Head.create(np.ones((3, 3)), [[0, 1, 2]], bones, np.eye(2)[[0, 1, 0]])
    for seed in range(20):
        augment(point, np.random.default_rng(seed), AugmentConfig())  # no NaN
