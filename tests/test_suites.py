import dataclasses

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from skinlib import Head, HeadError, Skeleton
from skinlib.datasets.synthetic import synthetic_head
from skinlib.evaluate.metrics import score
from skinlib.geometry import canonical_frame, face_normals, islands, weld
from skinlib.headbench.suites import KINDS, SHIFT, SUITES, decimate, upsample, vary

# A hundred thousand vertices take a second each time; `upsample` is tested with fewer.
QUICK = tuple(name for name in SUITES if name != "upsampled")
# What each suite leaves as it was, to the bit.
MESH, SURFACE = ("vertices", "faces", "normals"), ("faces", "weights")
SAME = {
    "untouched": (*MESH, "weights", "skeleton"),
    **dict.fromkeys(("halved", "subdivided", "isotropic", "decimated"), ("skeleton",)),
    **dict.fromkeys(("shuffled", "unwelded", "faceted"), ("skeleton",)),
    **dict.fromkeys(("pieces_missing", "pieces_added"), ("skeleton",)),
    **dict.fromkeys(("rotated", "expression", "posed"), SURFACE),
    **dict.fromkeys(("collapsed", "reordered"), MESH),
    **dict.fromkeys(("renamed", "shifted"), (*MESH, "weights")),
}


@pytest.fixture(scope="module")
def heads():
    return [synthetic_head(3, 1400, bones=14), synthetic_head(4, 1300, bones=12)]


@pytest.fixture(scope="module")
def variants(heads):
    return {
        (name, i): vary(name, head, 5, heads)
        for name in QUICK
        for i, head in enumerate(heads)
    }


@pytest.fixture
def lone():
    """A triangle on one bone."""
    bone = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["head"])
    return Head.create(np.eye(3), [[0, 1, 2]], bone, np.ones((3, 1)))


def same(a, b):
    """Whether two arrays, or two skeletons, are equal to the bit."""
    if not isinstance(a, Skeleton):
        return np.array_equal(a, b)
    arrays = "joints", "parents", "lengths", "directions"
    equal = all(np.array_equal(getattr(a, x), getattr(b, x)) for x in arrays)
    return equal and a.names == b.names


def fields(head):
    return {x: getattr(head, x) for x in (*MESH, "weights", "skeleton")}


def row_keys(head):
    """Each vertex with its weights, as rows in an order of their own."""
    rows = np.concatenate([head.vertices, head.weights], axis=1)
    return rows[np.lexsort(rows.T)]


def area(head):
    return np.linalg.norm(face_normals(head.vertices, head.faces), axis=1).sum() / 2


def pieces(head):
    return islands(head.faces, len(head.vertices), weld(head.vertices))


# ---------------------------------------------------------------- every suite


@pytest.mark.parametrize("name", QUICK)
def test_the_target_is_a_distribution_over_the_bones_of_the_variant(name, variants):
    for i in (0, 1):
        variant = variants[name, i]
        assert variant.weights.shape == (len(variant.vertices), len(variant.skeleton))
        assert variant.weights.min() >= 0
        np.testing.assert_allclose(variant.weights.sum(axis=1), 1, atol=2e-6)


@pytest.mark.parametrize("name", QUICK)
def test_a_seed_is_one_variant(name, variants, heads):
    again = vary(name, heads[0], 5, heads)
    for field, value in fields(variants[name, 0]).items():
        assert same(value, getattr(again, field)), field
    assert again.name == heads[0].name


def test_seeds_and_heads_draw_numbers_of_their_own(heads):
    one, other = vary("reordered", heads[0], 0), vary("reordered", heads[0], 1)
    named = vary("reordered", heads[0].replace(name="else"), 0)
    assert len({head.skeleton.names for head in (one, other, named)}) == 3


@pytest.mark.parametrize("name", QUICK)
def test_a_suite_changes_what_it_claims_and_nothing_else(name, variants, heads):
    for i, head in enumerate(heads):
        variant = fields(variants[name, i])
        for field in SAME[name]:
            assert same(variant[field], getattr(head, field)), field
        if name != "untouched":
            assert not all(same(variant[x], value) for x, value in fields(head).items())


@pytest.mark.parametrize("name", QUICK)
def test_whoever_copies_the_target_makes_no_error(name, variants):
    variant = variants[name, 0]
    scores = score(variant.weights, variant.weights, variant)
    assert scores["row_l1_mean"] == scores["row_l1_max"] == 0
    assert scores["deformation_mean"] == 0 and scores["dominant_bone_accuracy"] == 1


def test_each_suite_has_a_kind_and_a_text():
    assert {suite.kind for suite in SUITES.values()} == set(KINDS)
    texts = [suite.text for suite in SUITES.values()]
    assert len(set(texts)) == len(texts) and all(texts)
    assert set(SAME) == set(QUICK)


# ---------------------------------------------------------------- remesh


def test_remeshed_counts(variants, heads):
    for i, head in enumerate(heads):
        faces = {name: len(variants[name, i].faces) / len(head.faces) for name in QUICK}
        assert faces["subdivided"] == 4 and 0.48 < faces["halved"] < 0.52
        assert 800 < len(variants["decimated", i].vertices) < 1200


def test_decimated_to_a_given_number(heads):
    coarse = decimate(heads[0], np.random.default_rng(0), 500)
    assert len(coarse.vertices) == pytest.approx(500, rel=0.2)
    assert area(coarse) == pytest.approx(area(heads[0]), rel=0.05)
    with pytest.raises(HeadError, match="not above 2000"):
        decimate(heads[0], np.random.default_rng(0), 2000)


def test_upsampled_is_the_same_surface_with_the_vertices_that_were_asked_for(heads):
    for head, count in ((heads[0], 8000), (heads[1], 3000)):
        fine = upsample(head, np.random.default_rng(0), count)
        assert count <= len(fine.vertices) < 1.01 * count
        assert area(fine) == pytest.approx(area(head), rel=1e-5)
        assert pieces(fine).max() == pieces(head).max()
        # The old vertices are still there, with their weights.
        old = {row.tobytes() for row in row_keys(head)}
        assert old <= {row.tobytes() for row in row_keys(fine)}
        # No T-junction: each edge has as many triangles as the edge it came from.
        assert border_length(fine) == pytest.approx(border_length(head), rel=1e-5)
    with pytest.raises(HeadError, match="not below 100"):
        upsample(heads[0], np.random.default_rng(0), 100)


def border_length(head):
    sides = np.sort(head.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, uses = np.unique(sides, axis=0, return_counts=True)
    a, b = head.vertices[edges[uses == 1]].astype(float).transpose(1, 0, 2)
    return np.linalg.norm(a - b, axis=1).sum()


def test_upsampled_splits_the_longest_edges_first():
    """A 3-4-5 triangle: one vertex halves the side of 5, three halve all sides."""
    bones = Skeleton.from_heads_and_tails(np.eye(2, 3), None, [-1, 0], ["a", "b"])
    points = [[0, 0, 0], [4, 0, 0], [0, 3, 0]]
    head = Head.create(points, [[0, 1, 2]], bones, [[1, 0], [0.5, 0.5], [0, 1]])
    half = upsample(head, np.random.default_rng(0), 4)
    new = np.flatnonzero((half.vertices == [2, 1.5, 0]).all(axis=1))
    assert half.weights[new].tolist() == [[0.25, 0.75]] and len(half.faces) == 2
    five = upsample(head, np.random.default_rng(0), 5)
    assert [2, 0, 0] in five.vertices.tolist() and len(five.faces) == 3
    assert (face_normals(five.vertices, five.faces)[:, 2] > 0).all()


# ---------------------------------------------------------------- order


def test_shuffled_is_the_same_vertices_in_another_order(variants, heads):
    for i, head in enumerate(heads):
        np.testing.assert_array_equal(row_keys(variants["shuffled", i]), row_keys(head))


@pytest.mark.parametrize("name", ["unwelded", "faceted"])
def test_unwelded_triangles_have_their_own_vertices(name, variants, heads):
    for i, head in enumerate(heads):
        soup, corners = variants[name, i], head.faces.ravel()
        assert soup.faces.ravel().tolist() == list(range(3 * len(head.faces)))
        np.testing.assert_array_equal(soup.vertices, head.vertices[corners])
        np.testing.assert_array_equal(soup.weights, head.weights[corners])
        smooth = np.allclose(soup.normals, head.normals[corners], atol=1e-6)
        assert smooth == (name == "unwelded")
        if name == "faceted":
            a, b, c = soup.normals.reshape(-1, 3, 3).transpose(1, 0, 2)
            assert (a == b).all() and (b == c).all()


# ---------------------------------------------------------------- pieces


def test_pieces_missing_leaves_the_face(variants, heads):
    for i, head in enumerate(heads):
        bare = variants["pieces_missing", i]
        assert pieces(head).max() == 2 and pieces(bare).max() == 0
        eyes = np.isin(head.skeleton.names, ["eye_L", "eye_R"])
        assert (bare.weights[:, eyes] == 0).all()
        assert (head.weights[:, eyes] == 1).any()


def test_the_face_is_not_the_piece_of_most_vertices(heads):
    """A helmet of more vertices than the face, moved by one bone, is what goes."""
    head = heads[0]
    helmet = head.replace(vertices=head.vertices * 2, normals=head.normals)
    rows = np.concatenate([head.vertices, helmet.vertices])
    weights = np.zeros_like(head.weights)
    weights[:, head.skeleton.names.index("head")] = 1
    both = head.replace(
        vertices=rows,
        faces=np.concatenate([head.faces, helmet.faces + len(head.vertices)]),
        weights=np.concatenate([head.weights, weights]),
    )
    bare, alone = (vary("pieces_missing", each, 0) for each in (both, head))
    np.testing.assert_array_equal(bare.vertices, alone.vertices)


def test_added_without_others_is_a_cap_with_the_skins_own_weights(heads):
    head = heads[0]
    with_cap = vary("pieces_added", head, 0)
    old = len(head.vertices)
    np.testing.assert_array_equal(with_cap.vertices[:old], head.vertices)
    np.testing.assert_array_equal(with_cap.faces[: len(head.faces)], head.faces)
    cap, weights = with_cap.vertices[old:], with_cap.weights[old:]
    assert 0.05 * old < len(cap) < 0.6 * old
    below = [
        np.flatnonzero((head.weights == row).all(axis=1)).tolist() for row in weights
    ]
    distance = np.array(
        [
            np.linalg.norm(head.vertices[ids] - point, axis=1).min()
            for ids, point in zip(below, cap, strict=True)
        ]
    )
    scale = frame_of(head).scale
    assert distance.max() < 0.031 * scale
    assert frame_of(head).apply(cap)[:, 1].min() > 0


def frame_of(head):
    joints, parents = head.skeleton.joints, head.skeleton.parents
    return canonical_frame(head.vertices, head.faces, joints, parents)


def test_a_piece_of_another_head_comes_along_with_its_weights(heads):
    """The other head is this one in another frame and bone order, wearing a cap."""
    head = heads[0]
    capped = vary("pieces_added", head, 0)
    donor = vary("reordered", vary("rotated", capped, 2), 2)
    worn = vary("pieces_added", head, 1, [donor])
    assert len(worn.vertices) == len(capped.vertices)
    diagonal = np.linalg.norm(np.ptp(head.vertices, axis=0))
    np.testing.assert_allclose(worn.vertices, capped.vertices, atol=1e-4 * diagonal)
    np.testing.assert_allclose(worn.weights, capped.weights, atol=1e-6)
    np.testing.assert_allclose(worn.normals, capped.normals, atol=1e-3)
    # Who wears a cap already is given no second one: the own scalp is what is left.
    again = vary("pieces_added", worn, 1, [donor])
    alone = vary("pieces_added", worn, 1)
    np.testing.assert_array_equal(again.vertices, alone.vertices)


def test_a_piece_on_a_bone_that_is_not_here_stays_away(heads):
    capped, alone = vary("pieces_added", heads[1], 0), vary("pieces_added", heads[0], 0)
    names = tuple({"head": "skull"}.get(name, name) for name in capped.skeleton.names)
    skeleton = dataclasses.replace(capped.skeleton, names=names)
    for donor in (capped.replace(skeleton=skeleton), vary("renamed", capped, 0)):
        added = vary("pieces_added", heads[0], 0, [donor])
        np.testing.assert_array_equal(added.vertices, alone.vertices)
    other = vary("pieces_added", heads[0], 0, [capped])
    assert len(other.vertices) != len(alone.vertices)


# ---------------------------------------------------------------- frame


def test_rotated_is_one_similarity_of_mesh_and_bones(heads):
    seen = set()
    for seed in range(8):
        head, turned = heads[0], vary("rotated", heads[0], seed)
        points, moved = (
            np.concatenate(
                [each.vertices[:50], each.skeleton.joints, each.skeleton.tails]
            ).astype(float)
            for each in (head, turned)
        )
        factor = pdist(moved) / np.where(pdist(points) > 0, pdist(points), np.nan)
        assert 0.01 * 0.999 < np.nanmin(factor) and np.nanmax(factor) < 1000 * 1.001
        assert np.nanmax(factor) == pytest.approx(np.nanmin(factor), rel=1e-2)
        factor = np.nanmedian(factor)
        # The turn is a rotation: columns of a signed permutation, determinant 1.
        turn = np.linalg.lstsq(
            points - points.mean(axis=0), moved - moved.mean(axis=0), rcond=None
        )[0].T
        np.testing.assert_allclose(turn / factor, np.round(turn / factor), atol=1e-3)
        assert np.linalg.det(turn / factor) == pytest.approx(1, abs=1e-3)
        np.testing.assert_allclose(
            turned.normals, head.normals @ (turn / factor).T, atol=2e-3
        )
        np.testing.assert_allclose(
            turned.skeleton.directions,
            head.skeleton.directions @ (turn / factor).T,
            atol=2e-3,
        )
        np.testing.assert_array_equal(weld(turned.vertices), weld(head.vertices))
        seen.add(np.round(turn / factor).astype(int).tobytes())
    assert len(seen) > 3


# ---------------------------------------------------------------- pose


def test_expression_opens_the_jaw_and_leaves_the_skull(variants, heads):
    for i, head in enumerate(heads):
        moved = np.linalg.norm(
            variants["expression", i].vertices - head.vertices, axis=1
        )
        jaw = head.weights[:, head.skeleton.names.index("jaw")]
        smile = [n for n, name in enumerate(head.skeleton.names) if "corner" in name]
        still = jaw + head.weights[:, smile].sum(axis=1) == 0
        size = frame_of(head).scale
        assert moved[jaw > 0.9].mean() > 0.02 * size
        assert moved[still].max() < 1e-5 * size


def test_posed_turns_the_head_with_its_joints(variants, heads):
    for i, head in enumerate(heads):
        posed = variants["posed", i]
        names = head.skeleton.names
        eyes = [names.index("eye_L"), names.index("eye_R")]
        before, after = (
            np.diff(each.skeleton.joints[eyes].astype(float), axis=0)[0]
            for each in (head, posed)
        )
        assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(before), rel=1e-4)
        cosine = before @ after / np.linalg.norm(before) / np.linalg.norm(after)
        assert 5 < np.degrees(np.arccos(cosine)) < 45
        # An eye is still round about its joint.
        for eye in eyes:
            rows = head.weights[:, eye] == 1
            old = np.linalg.norm(
                head.vertices[rows] - head.skeleton.joints[eye], axis=1
            )
            new = np.linalg.norm(
                posed.vertices[rows] - posed.skeleton.joints[eye], axis=1
            )
            np.testing.assert_allclose(new, old, rtol=1e-3)


# ---------------------------------------------------------------- skeleton


def test_collapsed_keeps_the_mass_of_each_row_with_an_ancestor(heads):
    head, counts = heads[0], set()
    names = head.skeleton.names
    for seed in range(12):
        fewer = vary("collapsed", head, seed)
        left = fewer.skeleton.names
        counts.add(len(left))
        assert 5 <= len(left) < len(names) and set(left) < set(names)
        heir = []
        for bone in range(len(names)):
            while names[bone] not in left:
                bone = head.skeleton.parents[bone]
            heir.append(left.index(names[bone]))
        for bone in range(len(left)):
            share = head.weights[:, [h == bone for h in heir]].sum(axis=1)
            np.testing.assert_allclose(fewer.weights[:, bone], share, atol=1e-6)
    assert min(counts) < 7 and max(counts) > 9


def test_reordered_columns_go_with_their_bones(variants, heads):
    for i, head in enumerate(heads):
        other = variants["reordered", i]
        order = [head.skeleton.names.index(name) for name in other.skeleton.names]
        assert order != sorted(order)
        np.testing.assert_array_equal(other.weights, head.weights[:, order])
        assert same(other.skeleton, head.skeleton.reordered(order))


def test_renamed_bones_say_nothing(variants, heads):
    for i, head in enumerate(heads):
        skeleton = variants["renamed", i].skeleton
        assert not set(skeleton.names) & set(head.skeleton.names)
        assert len(set(skeleton.names)) == len(head.skeleton)
        assert same(skeleton.joints, head.skeleton.joints)


def test_shifted_joints_are_two_per_cent_off(heads):
    head = heads[0]
    size = np.linalg.norm(np.ptp(head.vertices, axis=0))
    offsets = []
    for seed in range(40):
        skeleton = vary("shifted", head, seed).skeleton
        offset = skeleton.joints - head.skeleton.joints
        np.testing.assert_allclose(
            skeleton.tails - head.skeleton.tails, offset, atol=1e-5 * size
        )
        offsets.append(offset)
    distance = np.linalg.norm(np.concatenate(offsets), axis=1)
    assert np.sqrt((distance**2).mean()) == pytest.approx(SHIFT * size, rel=0.1)


# ---------------------------------------------------------------- what cannot be varied


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("decimated", "not above 1000"),
        ("pieces_missing", "no loose pieces"),
        ("expression", "like a jaw"),
        ("posed", "1 bones: no bone turns"),
        ("collapsed", "1 bones: 5 have to stay"),
        ("reordered", "no other order"),
    ],
)
def test_a_head_that_cannot_differ_is_refused(name, why, lone):
    with pytest.raises(HeadError, match=why):
        vary(name, lone, 0)


@pytest.mark.parametrize(
    "name", ["subdivided", "upsampled", "unwelded", "faceted", "pieces_missing"]
)
def test_points_alone_have_no_surface_to_change(name, lone):
    with pytest.raises(HeadError, match="faces"):
        vary(name, lone.replace(faces=np.zeros((0, 3), np.int64)), 0)


def test_unknown_suites_and_unlabelled_heads_are_refused(lone):
    with pytest.raises(HeadError, match="no 'melted'"):
        vary("melted", lone, 0)
    with pytest.raises(HeadError, match="weights"):
        vary("untouched", lone.replace(weights=None), 0)
