"""Pairs for pose transfer: what an item holds, and that it is drawn as it says."""

import numpy as np
import pytest
import torch
from test_body import small_body
from test_energies import grid

from skinlib.datasets.remesh import halve, shuffle, subdivide
from skinlib.garments.body import Body, read_body
from skinlib.garments.motion import Motion, random_poses
from skinlib.geometry import vertex_areas
from skinlib.head import Head, HeadError
from skinlib.pose_transfer.data import (
    Cast,
    PosePairs,
    anny_bodies,
    body_on_mesh,
    drawn_bodies,
    normalised,
    on_mesh,
    restored,
    size_by_edges,
    vertex_shares,
)
from skinlib.skinning import linear_blend_skinning

BODY = small_body()


def post_poses(count: int, seed: int = 0) -> Motion:
    turns = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3, 3))
    return Motion.create(turns, BODY.head.skeleton.names)


MOTION = post_poses(6)
POSTS = drawn_bodies(BODY, 4)
POST_CAST = Cast(POSTS, MOTION)


@pytest.fixture(scope="module")
def coarse() -> Body:
    body = read_body()
    return body_on_mesh(body, halve(body.head, 0, keep=369 / len(body.head.vertices)))


@pytest.fixture(scope="module")
def people(coarse) -> Cast:
    return Cast(drawn_bodies(coarse, 3), random_poses(coarse.head.skeleton, 8, 0))


# ---------------------------------------------------------------- who takes part


def test_an_identity_depends_on_the_seed_and_its_number_alone():
    for few, more in zip(
        drawn_bodies(BODY, 2, 7), drawn_bodies(BODY, 5, 7), strict=False
    ):
        np.testing.assert_array_equal(few.vertices, more.vertices)
    a, b = drawn_bodies(BODY, 1, 7)[0], drawn_bodies(BODY, 1, 8)[0]
    assert np.abs(a.vertices - b.vertices).max() > 1e-3


def test_shapes_stay_within_their_spread():
    still = drawn_bodies(BODY, 1, spread=0)[0]
    np.testing.assert_allclose(still.vertices, BODY.head.vertices, atol=1e-7)
    heights = [np.ptp(post.vertices[:, 2]) for post in drawn_bodies(BODY, 40, 1, 0.5)]
    assert 0.95 <= min(heights) < 0.97 and 1.03 < max(heights) <= 1.05


@pytest.mark.parametrize(
    "count, seed, spread, field",
    [(0, 0, 1, "identities"), (1, -1, 1, "identities"), (1, 0, 1.5, "spread")],
)
def test_impossible_identities(count, seed, spread, field):
    with pytest.raises(HeadError, match=field):
        drawn_bodies(BODY, count, seed, spread)


def test_a_body_without_shapes_is_one_identity():
    none = np.zeros((0, 1, 3), np.float32)
    with pytest.raises(HeadError, match="shapes: the body has none"):
        drawn_bodies(Body(BODY.head, (), none, none), 2)


def test_another_mesh_has_the_same_surface_and_weights(coarse):
    body = read_body()
    assert 350 < len(coarse.head.vertices) < 400
    shape = {"weight": 0.8, "height": -0.5}
    fine, small = body.shaped(shape), coarse.shaped(shape)
    again = on_mesh([fine], body.head, coarse.head)[0]
    np.testing.assert_allclose(small.vertices, again.vertices, atol=2e-4)
    np.testing.assert_allclose(small.weights, again.weights, atol=1e-5)
    np.testing.assert_allclose(small.skeleton.joints, fine.skeleton.joints, atol=1e-6)
    # Posed, the coarse body stays at the skin of the fine one.
    moves = random_poses(body.head.skeleton, 1, 0).transforms(fine.skeleton)[0]
    a = linear_blend_skinning(fine.vertices, fine.weights, moves)
    b = linear_blend_skinning(small.vertices, small.weights, moves)
    import igl

    squared, _, _ = igl.point_mesh_squared_distance(
        b.astype(np.float64), a.astype(np.float64), fine.faces
    )
    assert np.sqrt(squared).max() < 0.01


def test_a_subdivided_mesh_is_skinned_as_its_edges_are():
    mesh = subdivide(BODY.head, 0)
    wide = BODY.shaped({"wide": 1.0})
    fine = on_mesh([wide], BODY.head, mesh)[0]
    np.testing.assert_allclose(fine.weights, mesh.weights, atol=1e-5)
    radius = np.linalg.norm(fine.vertices[:, :2], axis=1).max()
    assert radius == pytest.approx(0.12, abs=1e-6)


def test_a_mesh_lies_on_its_reference():
    moved = BODY.head.replace(vertices=BODY.head.vertices + np.float32([0, 0, 0.5]))
    with pytest.raises(HeadError, match=r"mesh: a vertex is 0\.5 away"):
        on_mesh(POSTS, BODY.head, moved)
    with pytest.raises(HeadError, match="not on the mesh of the reference"):
        on_mesh([shuffle(BODY.head)], BODY.head, BODY.head)
    with pytest.raises(HeadError, match="weights"):
        on_mesh([BODY.head.replace(weights=None)], BODY.head, BODY.head)


@pytest.mark.slow
def test_anny_is_the_same_person_on_each_mesh():
    coarse, other = (
        anny_bodies(2, 3, topology) for topology in ("notoes_collapse3pc", "soma")
    )
    assert [len(x[0].vertices) for x in (coarse, other)] == [369, 18056]
    for a, b in zip(coarse, other, strict=True):
        np.testing.assert_allclose(a.skeleton.joints, b.skeleton.joints, atol=1e-3)
        sizes = np.ptp(a.vertices, axis=0), np.ptp(b.vertices, axis=0)
        np.testing.assert_allclose(*sizes, rtol=0.05)
    alone = anny_bodies(1, 4, "notoes_collapse3pc")[0]
    np.testing.assert_allclose(alone.vertices, coarse[1].vertices, atol=1e-6)


def test_anny_has_no_such_mesh():
    with pytest.raises(HeadError, match="there is no 'cube'"):
        anny_bodies(1, topology="cube")


# ---------------------------------------------------------------- the box


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_the_box_by_hand_and_back(kind):
    points = kind(np.array([[1.0, 0, 5], [3.0, 8, 5], [2.0, 2, 6]]))
    small, centre, scale = normalised(points)
    assert np.asarray(scale).tolist() == [[4.0]]
    assert np.asarray(centre).tolist() == [[2.0, 4.0, 5.5]]
    assert np.asarray(small)[1].tolist() == [0.25, 1.0, -0.125]
    np.testing.assert_allclose(restored(small, centre, scale), points)


def test_size_and_place_do_not_matter():
    points = np.random.default_rng(0).normal(size=(2, 50, 3))
    moved = points * [[[2.0]], [[300.0]]] + [1, -2, 30]
    np.testing.assert_allclose(normalised(moved)[0], normalised(points)[0], atol=1e-12)


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
@pytest.mark.parametrize(
    "points, found",
    [
        (np.full((4, 3), 7.0), "at one place"),
        (np.zeros((1, 3)), "at one place"),
        (np.zeros((0, 3)), "of shape"),
        (np.zeros((4, 2)), "of shape"),
        (np.array([[0, 0, 0], [1, np.nan, 0]]), "NaN"),
        (np.array([[0, 0, 0], [1, np.inf, 0]]), "NaN or infinity"),
    ],
)
def test_what_has_no_box(kind, points, found):
    with pytest.raises(HeadError, match=found):
        normalised(kind(points))


def test_the_size_of_a_result_comes_from_its_edges():
    cast = POST_CAST
    edges = cast.edges.numpy()
    rest, posed = (cast.posed([1], [pose])[0].numpy() for pose in (-1, 3))
    small, _, scale = normalised(posed)
    assert size_by_edges(small, rest, edges) == pytest.approx(scale.item(), rel=0.02)
    with pytest.raises(HeadError, match="edges"):
        size_by_edges(small, rest, edges[:0])


# ---------------------------------------------------------------- pairs


def test_a_cast_poses_as_linear_blend_skinning_does(people, coarse):
    heads = drawn_bodies(coarse, 3)
    motion = random_poses(coarse.head.skeleton, 8, 0)
    posed = people.posed([2, 0, 1], [5, 7, -1])
    for got, who, pose in zip(posed, (2, 0), (5, 7), strict=False):
        head = heads[who]
        moves = motion.transforms(head.skeleton)[pose]
        wanted = linear_blend_skinning(head.vertices, head.weights, moves)
        np.testing.assert_allclose(got, wanted, atol=1e-5)
    np.testing.assert_allclose(posed[2], heads[1].vertices, atol=1e-6)
    assert len(people.weights) == 1  # they share them


def test_an_item_is_what_it_says(people):
    pairs = PosePairs(people, people, 50, seed=3)
    for item in (0, 17, 49):
        pair = pairs[item]
        somebody, pose, other, own_pose = pair.who.tolist()
        source = people.posed([somebody], [pose])[0][pair.source_order]
        identity = people.posed([other], [own_pose])[0][pair.order]
        truth = people.posed([other], [pose])[0][pair.order]
        np.testing.assert_allclose(pair.source, normalised(source)[0], atol=1e-6)
        np.testing.assert_allclose(pair.identity, normalised(identity)[0], atol=1e-6)
        back = restored(pair.truth, pair.centre, pair.scale)
        np.testing.assert_allclose(back, truth, atol=1e-6)
        for mesh in pair[:3]:
            assert mesh.abs().max() == pytest.approx(1)
        sizes = torch.stack([(mesh.amax(0) - mesh.amin(0)).max() for mesh in pair[:3]])
        np.testing.assert_allclose(sizes, 2, rtol=1e-5)


def test_faces_and_edges_follow_the_shuffled_vertices(people):
    pair = PosePairs(people, people, 5)[2]
    np.testing.assert_array_equal(pair.order[pair.faces], people.faces)
    np.testing.assert_array_equal(pair.order[pair.edges], people.edges)
    order = pair.order.numpy()
    assert sorted(order) == list(range(len(order))) and (np.diff(order) != 1).any()
    assert not np.array_equal(order, pair.source_order)


def test_without_shuffling_all_keeps_its_place(people):
    pair = PosePairs(people, people, 5, shuffle=False)[2]
    np.testing.assert_array_equal(pair.order, np.arange(len(pair.order)))
    np.testing.assert_array_equal(pair.faces, people.faces)


def test_the_height_is_that_of_the_standing_body():
    pair = PosePairs(POST_CAST, POST_CAST, 9)[4]
    standing = np.ptp(POSTS[pair.who[2]].vertices[:, 2])
    assert (pair.height * pair.scale).item() == pytest.approx(standing, rel=1e-5)


def test_an_item_depends_on_seed_and_number_alone():
    pairs = PosePairs(POST_CAST, POST_CAST, 20, seed=5)
    many = pairs.batch(range(12, 18))
    longer = PosePairs(POST_CAST, POST_CAST, 10**9, seed=5)
    for number, item in enumerate(range(12, 18)):
        for field, one, other in zip(many, pairs[item], longer[item], strict=True):
            torch.testing.assert_close(field[number], one, rtol=0, atol=1e-6)
            torch.testing.assert_close(other, one, rtol=0, atol=1e-6)
    other = PosePairs(POST_CAST, POST_CAST, 20, seed=6)
    assert not torch.equal(pairs[0].order, other[0].order)
    assert torch.equal(pairs[-1].order, pairs[19].order)
    with pytest.raises(IndexError):
        pairs[20]
    assert len(list(torch.utils.data.DataLoader(pairs, batch_size=8))) == 3


def test_everybody_and_every_pose_is_drawn_but_only_those_allowed():
    pairs = PosePairs(POST_CAST, POST_CAST, 200, poses=[1, 4])
    who = pairs.batch(range(200)).who.numpy()
    assert [set(column) for column in who.T] == [{0, 1, 2, 3}, {1, 4}] * 2
    assert (who[:, 0] != who[:, 2]).any()


def test_in_order_no_truth_is_missed():
    pairs = PosePairs(POST_CAST, POST_CAST, 8, poses=[1, 4], in_order=True)
    truths = pairs.batch(range(8)).who[:, 1:3].tolist()
    assert truths == [[pose, who] for pose in (1, 4) for who in range(4)]


def test_the_identity_may_stand_at_rest():
    pair = PosePairs(POST_CAST, POST_CAST, 5, identity_pose="rest")[1]
    assert pair.who[3] == -1
    rest = normalised(POST_CAST.rest[pair.who[2]])[0][pair.order]
    np.testing.assert_allclose(pair.identity, rest, atol=1e-6)


@pytest.mark.parametrize("noise", [0.01, 0.05])
def test_noise_moves_the_source_by_a_share_of_its_box(noise):
    clean, noisy = (
        PosePairs(POST_CAST, POST_CAST, 5, noise=amount).batch(range(5))
        for amount in (0.0, noise)
    )
    assert torch.equal(clean.source_order, noisy.source_order)
    torch.testing.assert_close(clean.truth, noisy.truth)
    torch.testing.assert_close(clean.identity, noisy.identity)
    for before, after in zip(clean.source.numpy(), noisy.source.numpy(), strict=True):
        # The noise moves the sides of the box besides.
        grown = ((before - before.mean(0)) * (after - after.mean(0))).sum()
        grown /= ((before - before.mean(0)) ** 2).sum()
        assert abs(grown - 1) < 2.1 * noise
        moved = after / grown - before
        moved = (moved - moved.mean(axis=0)) / 2  # of the box, whose side is 2
        assert moved.std() == pytest.approx(noise / np.sqrt(3), rel=0.1)
        assert np.abs(moved).max() < 1.2 * noise


def plane() -> tuple[torch.Tensor, torch.Tensor]:
    """(1, 25, 3) and (F, 3): a square in 4 x 4 cells."""
    vertices, faces = grid(4)
    vertices = np.pad(vertices, ((0, 0), (0, 3 - vertices.shape[1])))
    return torch.tensor(vertices, dtype=torch.float32)[None], torch.tensor(faces)


def test_shares_are_areas_where_it_is_flat():
    vertices, faces = plane()
    shares = vertex_shares(vertices, faces)
    assert shares.sum().item() == pytest.approx(1, abs=1e-6)
    expected = vertex_areas(vertices[0].numpy(), faces.numpy())
    np.testing.assert_allclose(shares[0], expected / expected.sum(), atol=1e-6)


def test_noise_on_a_vertex_does_not_change_its_share():
    """Its rim alone decides; the area of the triangles around it grows."""
    vertices, faces = plane()
    middle, moved = 12, vertices.clone()
    moved[0, middle] += torch.tensor([0.02, -0.01, 0.2])
    both = [vertex_shares(v, faces)[0] for v in (vertices, moved)]
    share, other = (shares[middle] / shares[0] for shares in both)
    assert other.item() == pytest.approx(share.item(), rel=1e-5)
    areas = [vertex_areas(v[0].numpy(), faces.numpy()) for v in (vertices, moved)]
    assert areas[1][middle] > 1.1 * areas[0][middle]


def test_shares_of_what_has_no_area():
    line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]])
    shares = vertex_shares(line, torch.tensor([[0, 1, 2]]))
    torch.testing.assert_close(shares, torch.full((1, 3), 1 / 3))
    none = vertex_shares(line, torch.zeros((0, 3), dtype=torch.int64))
    torch.testing.assert_close(none, torch.full((1, 3), 1 / 3))


def test_pairs_tell_the_shares_in_their_order():
    many = PosePairs(POST_CAST, POST_CAST, 4).batch(range(4))
    own = vertex_shares(many.identity, POST_CAST.faces)
    for i in range(4):
        inverse = many.order[i].argsort()
        mesh = many.identity[i][inverse][None]
        expected = vertex_shares(mesh, POST_CAST.faces)[0]
        torch.testing.assert_close(many.share[i][inverse], expected)
        back = many.source[i][many.source_order[i].argsort()][None]
        expected = vertex_shares(back, POST_CAST.faces)[0]
        torch.testing.assert_close(many.source_share[i], expected[many.source_order[i]])
    assert not torch.allclose(own, many.share)  # the triangles are those of the mesh
    assert all(a is b for a, b in zip(many.inputs, many[:2], strict=False))


def test_source_and_identity_on_different_meshes():
    fine = subdivide(BODY.head, 0)
    sources = Cast(on_mesh(POSTS[:2], BODY.head, fine), MOTION)
    many = PosePairs(sources, POST_CAST, 30).batch(range(30))
    assert many.source.shape == (30, len(fine.vertices), 3)
    assert many.identity.shape == (30, len(BODY.head.vertices), 3)
    assert many.faces.shape == (30, len(BODY.head.faces), 3)
    assert set(many.who[:, 0].tolist()) == {0, 1}
    assert set(many.who[:, 2].tolist()) == {0, 1, 2, 3}


def test_bones_may_do_more_than_turn():
    moves = np.tile(np.eye(4, dtype=np.float32), (2, 3, 1, 1))
    moves[1, :, 2, 3] = 2
    cast = Cast(POSTS, [moves] * 4)
    raised = cast.posed([1], [1]) - cast.posed([1], [0])
    np.testing.assert_allclose(raised[0], [[0, 0, 2]] * raised.shape[1], atol=1e-5)
    with pytest.raises(HeadError, match="transforms: 3 arrays for 4 heads"):
        Cast(POSTS, [moves] * 3)
    with pytest.raises(HeadError, match="transforms"):
        Cast(POSTS, [moves[:, :2]] * 4)


def test_weights_of_their_own():
    rng = np.random.default_rng(0)
    others = [
        post.replace(weights=rng.dirichlet(np.ones(3), len(post.vertices)))
        for post in POSTS
    ]
    cast = Cast(others, MOTION)
    moves = MOTION.transforms(others[2].skeleton)[1]
    wanted = linear_blend_skinning(others[2].vertices, others[2].weights, moves)
    np.testing.assert_allclose(cast.posed([0, 2], [0, 1])[1], wanted, atol=1e-5)


def test_who_cannot_be_in_a_cast():
    with pytest.raises(HeadError, match="identities: there are none"):
        Cast([], MOTION)
    with pytest.raises(HeadError, match="weights"):
        Cast([BODY.head.replace(weights=None)], MOTION)
    with pytest.raises(HeadError, match="on another mesh"):
        Cast([BODY.head, shuffle(BODY.head)], MOTION)
    with pytest.raises(HeadError, match="bone_names"):
        Cast(POSTS, Motion.create(np.zeros((1, 2, 3)), ["hips", "spine"]))
    point = Head.create(
        [[0, 0, 0]], np.zeros((0, 3), int), BODY.head.skeleton, weights=[[1, 0, 0]]
    )
    with pytest.raises(HeadError, match="at one place"):
        Cast([point], MOTION)


@pytest.mark.parametrize(
    "changes, found",
    [
        ({"count": 0}, "items: 0"),
        ({"seed": -1}, "seed -1"),
        ({"poses": [6]}, "poses: 1 are chosen"),
        ({"poses": []}, "poses: 0 are chosen"),
        ({"noise": -0.1}, "noise"),
        ({"noise": float("nan")}, "noise"),
        ({"sources": Cast(POSTS, post_poses(5))}, "the sources have 5"),
    ],
)
def test_impossible_pairs(changes, found):
    fields = {"sources": POST_CAST, "targets": POST_CAST, "count": 3} | changes
    with pytest.raises(HeadError, match=found):
        PosePairs(**fields)
