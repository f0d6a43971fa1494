"""The data contract: what gets in, what is turned away, and with which words."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from shapes import skeleton, sphere

from skinlib import Head, HeadError, Skeleton

BONE = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["head"])
TRIANGLE = np.eye(3), [[0, 1, 2]]


def chain(parents, heads=None, tails=None, names=None):
    count = len(parents)
    heads = [[0, i, 0] for i in range(count)] if heads is None else heads
    names = [f"b{i}" for i in range(count)] if names is None else names
    return Skeleton.from_heads_and_tails(heads, tails, parents, names)


# ---------------------------------------------------------------- skeleton, by hand


def test_a_bone_without_a_tail_ends_at_its_childrens_mean():
    fork = chain([-1, 0, 0], heads=[[0, 0, 0], [1, 2, 0], [-1, 2, 0]])
    assert fork.tails.tolist() == [[0, 2, 0], [1, 2, 0], [-1, 2, 0]]
    assert fork.lengths.tolist() == [2, 0, 0]
    assert fork.directions.tolist() == [[0, 1, 0], [0, 0, 0], [0, 0, 0]]


def test_a_given_tail_is_kept_and_nan_means_none():
    tails = [[3, 4, 0], [np.nan] * 3]
    bones = chain([-1, 0], tails=tails)
    np.testing.assert_allclose(bones.tails, [[3, 4, 0], [0, 1, 0]], atol=1e-6)
    assert bones.lengths.tolist() == [5, 0]


def test_depths_and_order_when_children_come_first():
    bones = chain([2, 0, -1, 2, -1])
    assert bones.depths.tolist() == [1, 2, 0, 1, 0]
    assert bones.order.tolist() == [2, 4, 0, 3, 1]
    assert bones.children() == [[1], [], [0, 3], [], []]


def test_reordered_moves_everything_along():
    bones = chain([2, 0, -1, 2])
    permutation = np.array([3, 1, 0, 2])
    moved = bones.reordered(permutation)
    assert moved.names == ("b3", "b1", "b0", "b2")
    assert moved.parents.tolist() == [3, 2, 3, -1]
    np.testing.assert_array_equal(moved.joints, bones.joints[permutation])
    back = moved.reordered(np.argsort(permutation))
    assert back.parents.tolist() == bones.parents.tolist()
    assert back.names == bones.names


def test_two_hundred_bones_in_one_chain():
    bones = chain(range(-1, 199))
    assert bones.depths.tolist() == list(range(200))


def test_many_bones_take_no_quadratic_time():
    count = 100_000
    start = time.perf_counter()
    bones = chain(range(-1, count - 1))
    assert bones.depths.tolist() == list(range(count))
    with pytest.raises(HeadError, match="its own ancestor"):
        chain([count - 1, *range(count - 1)])
    assert time.perf_counter() - start < 10  # an hour, when every pair is looked at


# ---------------------------------------------------------------- head, by hand


def test_types_and_shapes_of_a_head():
    head = Head.create(*TRIANGLE, BONE, weights=[[1]] * 3, name="t")
    assert head.vertices.dtype == head.normals.dtype == head.weights.dtype == np.float32
    assert head.faces.dtype == np.int64
    np.testing.assert_allclose(head.normals, np.full((3, 3), 3**-0.5), atol=1e-6)


def test_normals_become_unit_and_a_zero_one_points_up():
    normals = [[0, 0, 5], [0, 0, 0], [3e-30, 4e-30, 0]]
    head = Head.create(*TRIANGLE, BONE, normals=normals)
    np.testing.assert_allclose(
        head.normals, [[0, 0, 1], [0, 0, 1], [0.6, 0.8, 0]], atol=1e-6
    )


def test_one_vertex_and_no_faces_is_a_head():
    head = Head.create([[1, 2, 3]], [], BONE)
    assert head.faces.shape == (0, 3)
    assert head.normals.tolist() == [[0, 0, 1]]


def test_weights_within_the_tolerance_are_normalised_and_exact_ones_kept():
    rows = np.float32([[0.5004, 0.5], [0.1, 0.9], [1, -1e-5]])
    weights = Head.create(*TRIANGLE, chain([-1, 0]), weights=rows).weights
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-7)
    assert weights[1].tolist() == rows[1].tolist()
    assert weights[2].tolist() == [1, 0]


@pytest.mark.parametrize("field", ["vertices", "normals", "faces", "weights"])
def test_a_head_cannot_be_changed(field):
    head = sphere(0, bones=1, weights=np.ones((12, 1)))
    with pytest.raises(ValueError, match="read-only"):
        getattr(head, field)[0] = 0
    with pytest.raises(AttributeError):
        setattr(head, field, None)


def test_a_head_does_not_change_with_the_array_it_was_made_from():
    vertices, parents = np.eye(3, dtype=np.float32), np.array([-1])
    bone = Skeleton.from_heads_and_tails(np.zeros((1, 3)), None, parents, ["head"])
    head = Head.create(vertices, TRIANGLE[1], bone)
    vertices[:], parents[:] = 7, 0
    assert head.vertices.tolist() == np.eye(3).tolist()
    assert bone.parents.tolist() == [-1]


def test_replace_checks_again_and_renews_the_normals():
    head = Head.create(*TRIANGLE, BONE, normals=[[1, 0, 0]] * 3)
    assert head.replace(name="x").normals.tolist() == [[1, 0, 0]] * 3
    flat = head.replace(vertices=[[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert flat.normals.tolist() == [[0, 0, 1]] * 3
    with pytest.raises(HeadError, match="weights"):
        head.replace(weights=[[0.5]] * 3)


# ---------------------------------------------------------------- the errors


def create(**changes):
    """A valid head of 3 vertices and 2 bones with some raw fields changed."""
    raw = {
        "vertices": np.eye(3),
        "faces": [[0, 1, 2]],
        "normals": None,
        "weights": [[0.5, 0.5]] * 3,
        "heads": [[0, 0, 0], [0, 1, 0]],
        "tails": None,
        "parents": [-1, 0],
        "names": ["head", "jaw"],
    } | changes
    bones = Skeleton.from_heads_and_tails(
        raw["heads"], raw["tails"], raw["parents"], raw["names"], file="a.npz"
    )
    return Head.create(
        raw["vertices"],
        raw["faces"],
        bones,
        raw["weights"],
        raw["normals"],
        file="a.npz",
    )


NAN, INF = float("nan"), float("inf")
BAD = [
    ({"vertices": []}, "vertices", "none"),
    ({"vertices": np.zeros((0, 3))}, "vertices", "none"),
    ({"vertices": np.zeros((3, 2))}, "vertices", r"shape \(3, 2\)"),
    ({"vertices": np.zeros(3)}, "vertices", r"shape \(3,\)"),
    ({"vertices": 5.0}, "vertices", r"shape \(\)"),
    ({"vertices": [[None] * 3]}, "vertices", "type object"),
    ({"vertices": [[0, 0, 0], [1, 2]]}, "vertices", "type object"),
    ({"vertices": [["a", "b", "c"]] * 3}, "vertices", "type <U1"),
    ({"vertices": np.eye(3) * 1j}, "vertices", "complex"),
    ({"vertices": [[0, 0, NAN]] * 3}, "vertices", "3 rows hold NaN .* row 0"),
    ({"vertices": [[0, 0, 1], [0, INF, 0], [0, 0, 0]]}, "vertices", "row 1"),
    ({"vertices": np.eye(3) * 1e16}, "vertices", "1e\\+16"),
    ({"vertices": np.eye(3) * 1e300}, "vertices", "infinity"),
    ({"faces": [[0, 1, 3]]}, "faces", "vertex id 3 with 3 vertices"),
    ({"faces": [[0, 1, -1]]}, "faces", "vertex id -1"),
    ({"faces": np.uint64([[0, 1, 2**64 - 1]])}, "faces", "vertex id"),
    ({"faces": [[0.0, 1.0, 2.0]]}, "faces", "type float64"),
    ({"faces": [[0, 1, 2, 0]]}, "faces", r"shape \(1, 4\)"),
    ({"normals": np.ones((2, 3))}, "normals", r"shape \(2, 3\)"),
    ({"normals": [[NAN, 0, 1]] * 3}, "normals", "NaN"),
    ({"weights": np.ones((3, 3)) / 3}, "weights", r"shape \(3, 3\)"),
    ({"weights": [[1, 0]] * 2}, "weights", r"shape \(2, 2\)"),
    ({"weights": [[0, 0], [1, 0], [1, 0]]}, "weights", "vertex 0 sums to 0"),
    ({"weights": [[1, 0], [1, 0], [1.5, -0.5]]}, "weights", "vertex 2 .* bone 1"),
    ({"weights": [[NAN, 1], [1, 0], [1, 0]]}, "weights", "row 0"),
    ({"weights": [[0.5, 0.6]] * 3}, "weights", "3 rows do not sum to 1"),
    ({"heads": [], "parents": [], "names": []}, "bone_heads", "no bones"),
    ({"heads": np.zeros((2, 4))}, "bone_heads", r"shape \(2, 4\)"),
    ({"heads": [[0, 0, 0], [0, NAN, 0]]}, "bone_heads", "row 1"),
    ({"heads": [[0, 0, 0], [0, -3e38, 0]]}, "bone_heads", "3e\\+38"),
    ({"tails": np.zeros((1, 3))}, "bone_tails", r"shape \(1, 3\)"),
    ({"tails": [[0, 0, INF]] * 2}, "bone_tails", "infinite"),
    ({"tails": [[0, 0, 3e38]] * 2}, "bone_tails", "3e\\+38"),
    ({"parents": [-1]}, "bone_parents", r"shape \(1,\)"),
    ({"parents": [-1, 2]}, "bone_parents", "bone 1 has parent 2 with 2 bones"),
    ({"parents": [-2, 0]}, "bone_parents", "parent -2"),
    ({"parents": [1, 0]}, "bone_parents", "bone 0 is its own ancestor"),
    ({"parents": [-1, 1]}, "bone_parents", "bone 1 is its own ancestor"),
    ({"parents": [-1.0, 0.0]}, "bone_parents", "type float64"),
    ({"names": ["head"]}, "bone_names", "1 names for 2 bones"),
    ({"names": ["head", ""]}, "bone_names", "empty"),
    ({"names": ["jaw", "jaw"]}, "bone_names", "'jaw' is used 2 times"),
]


@pytest.mark.parametrize(
    "changes, field, found", BAD, ids=[f"{b[1]}-{i}" for i, b in enumerate(BAD)]
)
def test_bad_input_is_one_clear_error(changes, field, found):
    with pytest.raises(HeadError, match=found) as caught:
        create(**changes)
    assert caught.value.field == field
    assert caught.value.file == "a.npz"
    assert str(caught.value).startswith(f"a.npz: {field}: ")
    assert caught.value.fix and str(caught.value).endswith(".")


def test_an_error_without_a_file():
    assert str(HeadError("faces", "none", "add one")) == "faces: none. Add one."


# ---------------------------------------------------------------- the whole contract

ANY = st.one_of(
    st.floats(width=32),
    st.floats(-10, 10, width=32),
    st.sampled_from([0, -0.0, 1e-45, 1e15, -3e38, INF, -INF, NAN]),
)


@st.composite
def raw_heads(draw):
    """The raw fields of a head: some good, some not, about half of each kind."""
    vertex_count, bone_count = draw(st.integers(1, 6)), draw(st.integers(1, 6))
    number = draw(st.sampled_from([ANY, st.floats(-10, 10, width=32)]))

    def table(rows, columns=3):
        return arrays(np.float32, (rows, columns), elements=number)

    parents = [draw(st.integers(-1, i - 1)) for i in range(bone_count)]
    raw = {
        "vertices": draw(table(vertex_count)),
        "faces": draw(
            arrays(
                np.int64,
                (draw(st.integers(0, 5)), 3),
                elements=st.integers(0, vertex_count - 1),
            )
        ),
        "normals": draw(st.none() | table(vertex_count)),
        "weights": None,
        "heads": draw(table(bone_count)),
        "tails": draw(st.none() | table(bone_count)),
        "parents": parents,
        "names": [f"b{i}" for i in range(bone_count)],
    }
    if draw(st.booleans()):
        weights = draw(arrays(np.float32, (vertex_count, bone_count), elements=number))
        with np.errstate(all="ignore"):
            raw["weights"] = weights / weights.sum(axis=1, keepdims=True)
    if draw(st.booleans()):
        key = draw(st.sampled_from(["parents", "names", "faces", "vertices"]))
        raw[key] = draw(
            {
                "parents": st.lists(st.integers(-3, 7), max_size=7),
                "names": st.lists(st.text(max_size=2), max_size=7),
                "faces": arrays(
                    st.sampled_from([np.int32, np.uint8, np.float32, np.uint64]),
                    st.sampled_from([(1, 3), (2, 3), (3,), (0,), (1, 4), ()]),
                ),
                "vertices": st.lists(st.lists(ANY, max_size=4), max_size=4),
            }[key]
        )
    return raw


@settings(max_examples=200, deadline=None, derandomize=True)
@given(raw_heads())
def test_a_head_is_valid_or_one_head_error(raw):
    try:
        head = create(**raw)
    except HeadError as error:
        assert error.field and error.found and error.fix
        return
    bones = head.skeleton
    count, bone_count = len(head.vertices), len(bones)
    for array in (head.vertices, head.normals, bones.joints, bones.tails):
        assert array.dtype == np.float32 and array.shape[1] == 3
        assert np.isfinite(array).all()
    np.testing.assert_allclose(np.linalg.norm(head.normals, axis=1), 1, atol=1e-5)
    assert head.faces.size == 0 or 0 <= head.faces.min() <= head.faces.max() < count
    assert np.isfinite(bones.lengths).all() and (bones.lengths >= 0).all()
    unit = np.linalg.norm(bones.directions, axis=1)
    np.testing.assert_allclose(unit[bones.lengths > 0], 1, atol=1e-5)
    assert len(set(bones.names)) == bone_count and all(bones.names)
    place = np.argsort(bones.order)
    child = bones.parents >= 0
    assert (place[bones.parents[child]] < place[child]).all()
    if head.weights is not None:
        assert head.weights.shape == (count, bone_count) and (head.weights >= 0).all()
        np.testing.assert_allclose(head.weights.sum(axis=1), 1, atol=1e-5)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.permutations(range(7)))
def test_reordering_bones_keeps_the_tree(permutation):
    bones = skeleton(7, seed=1)
    moved = bones.reordered(permutation)

    def edges(tree):
        ends = [None, *tree.names]
        return {(n, ends[p + 1]) for n, p in zip(tree.names, tree.parents, strict=True)}

    assert edges(moved) == edges(bones)
