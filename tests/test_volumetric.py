import os
import sys

import numpy as np
import pytest
import trimesh

from skinlib.datasets.synthetic import synthetic_head
from skinlib.evaluate.baselines import nearest_bone
from skinlib.evaluate.volumetric import (
    blender_automatic,
    blender_weights,
    bounded_biharmonic,
    voxel_geodesic,
)
from skinlib.head import Head, HeadError, Skeleton

METHODS = [
    lambda head: voxel_geodesic(head, 24),
    lambda head: bounded_biharmonic(head, 8),
]
needs_blender = pytest.mark.skipif(
    not os.environ.get("SKINLIB_BLENDER", ""),
    reason="SKINLIB_BLENDER names no Blender, nor a Python with bpy",
)


def bar(heads=None, tails=None):
    """A bar of 10 by 2 by 2 along x, with a bone in each end."""
    heads = heads or [[0, 0, 0], [6, 0, 0]]
    tails = tails or [[4, 0, 0], [10, 0, 0]]
    mesh = trimesh.creation.box(bounds=[[0, -1, -1], [10, 1, 1]]).subdivide_to_size(1)
    bones = Skeleton.from_heads_and_tails(heads, tails, [-1, 0], ["left", "right"])
    return Head.create(mesh.vertices, mesh.faces, bones)


def with_cube(head, place, size=1):
    """A head with a small cube beside it; the cube's vertices come last."""
    cube = trimesh.creation.box([size] * 3)
    return Head.create(
        np.concatenate([head.vertices, cube.vertices + place]),
        np.concatenate([head.faces, cube.faces + len(head.vertices)]),
        head.skeleton,
    )


def check(weights, head):
    assert weights.shape == (len(head.vertices), len(head.skeleton))
    assert weights.dtype == np.float32
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_a_head_in_pieces_gets_weights(method):
    head = synthetic_head(4, vertices=600, bones=12)
    weights = method(head)
    check(weights, head)
    assert (weights.max(axis=0) > 0.05).all()


@pytest.mark.parametrize("method", METHODS)
def test_weights_do_not_ask_for_the_unit_or_the_order_of_bones(method):
    head = bar()
    weights, bones = method(head), head.skeleton
    away = Skeleton.from_heads_and_tails(
        4 * bones.joints + 8, 4 * bones.tails + 8, bones.parents, bones.names
    )
    moved = Head.create(4 * head.vertices + 8, head.faces, away)
    np.testing.assert_allclose(method(moved), weights, atol=1e-5)
    swapped = head.replace(skeleton=bones.reordered([1, 0]))
    np.testing.assert_allclose(method(swapped), weights[:, ::-1], atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_one_bone_takes_all(method):
    bone = Skeleton.from_heads_and_tails([[1, 0, 0]], [[2, 0, 0]], [-1], ["head"])
    head = bar().replace(skeleton=bone)
    np.testing.assert_allclose(method(head), 1)
    point = Head.create([[5, 0, 0]], np.zeros((0, 3), int), bone)
    assert method(point).tolist() == [[1]]


# --- geodesic voxel binding -----------------------------------------------------------


@pytest.mark.parametrize("falloff", [0, 0.2, 1])
def test_voxel_weights_in_a_convex_solid_are_the_formula(falloff):
    head = bar([[1, 0, 0], [7.3, 0.2, 0]], [[1, 0, 0], [7.3, 0.2, 0]])  # two points
    d = np.linalg.norm(head.vertices[:, None] - head.skeleton.joints, axis=2) / 10
    expected = ((1 - falloff) * d + falloff * d**2) ** -2
    expected /= expected.sum(axis=1, keepdims=True)
    weights = voxel_geodesic(head, 32, falloff)
    np.testing.assert_allclose(weights, expected, atol=1e-4)


def test_the_falloff_is_a_share():
    with pytest.raises(HeadError, match="falloff"):
        voxel_geodesic(bar(), 8, falloff=1.5)


# --- bounded biharmonic weights -------------------------------------------------------


def test_biharmonic_weights_of_a_bar():
    head = bar()
    weights = bounded_biharmonic(head, 20)
    check(weights, head)
    x = head.vertices[:, 0]
    assert weights[x < 3, 0].min() > 0.98 and weights[x > 7, 1].min() > 0.98
    np.testing.assert_allclose(weights[x == 5], 0.5, atol=0.03)
    # Along the bar the first bone loses what the second gains.
    means = [weights[np.isclose(x, step), 0].mean() for step in np.unique(x)]
    assert (np.diff(means) < 5e-3).all()


def test_bones_at_one_place_share_their_weight():
    head = bar(heads=[[5, 0, 0], [5, 0, 0]], tails=[[5, 0, 0], [5, 0, 0]])
    np.testing.assert_allclose(bounded_biharmonic(head, 8), 0.5, atol=1e-5)


def test_a_piece_without_a_bone_follows_the_nearest_that_has_one():
    head = with_cube(bar(), [10, 5, 0])
    weights = bounded_biharmonic(head, 20)
    assert weights[-8:, 1].min() > 0.98
    x = head.vertices[:-8, 0]
    assert weights[:-8][x < 3, 0].min() > 0.98 and weights[:-8][x > 7, 1].min() > 0.98


def test_a_bone_outside_the_solid_holds_on_to_its_nearest_corner():
    outside = bar(heads=[[-5, 0, 0], [15, 0, 0]], tails=[[-3, 0, 0], [20, 0, 0]])
    weights = bounded_biharmonic(outside, 16)
    x = outside.vertices[:, 0]
    assert weights[x == 0, 0].min() > 0.8 and weights[x == 10, 1].min() > 0.8


# --- Blender --------------------------------------------------------------------------


@needs_blender
def test_automatic_weights_of_a_bar():
    head = bar()
    weights = blender_automatic(head)
    check(weights, head)
    x = head.vertices[:, 0]
    assert weights[x < 2, 0].min() > 0.8 and weights[x > 8, 1].min() > 0.8
    np.testing.assert_allclose(weights[np.isclose(x, 5)], 0.5, atol=0.05)
    # Seams cut nothing, whatever the unit.
    soup = Head.create(
        0.01 * head.vertices[head.faces].reshape(-1, 3),
        np.arange(3 * len(head.faces)).reshape(-1, 3),
        Skeleton.from_heads_and_tails(
            0.01 * head.skeleton.joints,
            0.01 * head.skeleton.tails,
            [-1, 0],
            ["left", "right"],
        ),
        normals=head.normals[head.faces].reshape(-1, 3),
    )
    cut = blender_automatic(soup)
    np.testing.assert_allclose(cut, weights[head.faces].reshape(-1, 2), atol=2e-2)


@needs_blender
def test_what_blender_leaves_empty_goes_to_the_nearest_bone():
    head, end = bar(), len(bar().vertices)
    # One triangle without area, and Blender finds no solution at all.
    needle = Head.create(
        np.concatenate([head.vertices, [[10, 5, 0], [11, 5, 0], [12, 5, 0]]]),
        np.concatenate([head.faces, [[end, end + 1, end + 2]]]),
        head.skeleton,
    )
    assert not blender_weights(needle).any()
    np.testing.assert_array_equal(blender_automatic(needle), nearest_bone(needle))


@needs_blender
def test_a_bone_without_a_tail_is_a_bone():
    head = bar(tails=[[0, 0, 0], [6, 0, 0]])
    weights = blender_automatic(head)
    check(weights, head)
    assert (weights.max(axis=0) > 0.9).all()


def test_without_a_blender_there_is_one_clear_error(tmp_path):
    with pytest.raises(HeadError, match="Blender"):
        blender_automatic(bar(), blender=str(tmp_path / "no-such-blender"))
    with pytest.raises(HeadError, match="Blender"):
        blender_automatic(bar(), blender=sys.executable)  # it has no bpy


@pytest.mark.skipif(sys.platform == "win32", reason="a script in place of a program")
def test_a_blender_that_dies_or_says_nothing_is_one_clear_error(tmp_path):
    for name, line in (("python-dead", "kill -9 $$"), ("python-mute", "exit 0")):
        program = tmp_path / name
        program.write_text(f"#!/bin/sh\n{line}\n")
        program.chmod(0o755)
        with pytest.raises(HeadError, match=r"crash|without an answer"):
            blender_automatic(bar(), blender=str(program))
