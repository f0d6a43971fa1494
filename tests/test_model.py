"""The network as a whole: any mesh, any skeleton, any order, any axes."""

from dataclasses import fields

import numpy as np
import pytest
import torch
from shapes import axis_rotations, bumpy, moved, skeleton, sphere, unwelded

from skinlib import Head, Skeleton
from skinlib.datasets.synthetic import synthetic_head
from skinlib.graph import GraphConfig, build_graph
from skinlib.model import ModelConfig, SkinningModel, prepare, skinning_model
from skinlib.model.confidence import predict_with_confidence
from skinlib.model.cross_attention import CrossAttention, pair_features
from skinlib.model.inputs import MeshInput, SkeletonInput, bone_frame, content_hash
from skinlib.model.mesh_encoder import MeshEncoder, mesh_features

SMALL = {"mesh_width": 16, "bone_width": 8, "blocks": 2, "points": 4, "pair_width": 8}
VARIANTS = {
    "edgeconv": SMALL,
    "gat": SMALL | {"convolution": "gat"},
    "no_bias": SMALL | {"pair_width": 0},
}


def build(**options) -> SkinningModel:
    torch.manual_seed(0)
    model = SkinningModel(ModelConfig(**(SMALL | options))).eval()
    # Sharper than at the start, so that a wrong vertex or bone is seen.
    with torch.no_grad():
        for parameter in model.cross_attention.parameters():
            parameter *= 2
    return model


@pytest.fixture(params=VARIANTS, scope="module")
def model(request):
    return build(**VARIANTS[request.param])


@pytest.fixture(scope="module")
def head():
    return bumpy(synthetic_head(5, vertices=700, unit="m"))


def check(weights: np.ndarray, head: Head) -> None:
    assert weights.shape == (len(head.vertices), len(head.skeleton))
    assert weights.dtype == np.float32
    assert np.isfinite(weights).all() and (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)


def point_cloud(vertices: int, bones: int) -> Head:
    points = np.random.default_rng(0).normal(size=(vertices, 3))
    return Head.create(points, [], skeleton(bones))


# ---------------------------------------------------------------- any size


@pytest.mark.parametrize("bones", [1, 2, 200])
@pytest.mark.parametrize("vertices", [1, 4])
def test_a_few_vertices_and_any_number_of_bones(model, vertices, bones):
    head = point_cloud(vertices, bones)
    check(model.predict(head), head)


@pytest.mark.parametrize("subdivisions, bones", [(0, 3), (2, 60), (5, 200)])
def test_spheres_up_to_ten_thousand_vertices(subdivisions, bones):
    head = sphere(subdivisions, bones)
    check(build().predict(head), head)


def test_twenty_thousand_vertices(model):
    head = point_cloud(20_000, 3)
    check(model.predict(head), head)


def test_rows_of_the_forward_pass_sum_to_one_and_one_bone_takes_all(model, head):
    weights = model(*prepare(head))
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(len(head.vertices)))
    assert (model.predict(sphere(1, bones=1)) == 1).all()


# ---------------------------------------------------------------- any order


def test_another_order_of_bones_permutes_the_columns(model, head):
    order = np.random.default_rng(0).permutation(len(head.skeleton))
    other = Head.create(head.vertices, head.faces, head.skeleton.reordered(order))
    expected = model.predict(head, prune=0.0)[:, order]
    assert np.ptp(expected, axis=0).max() > 0.1
    np.testing.assert_allclose(model.predict(other, prune=0.0), expected, atol=1e-5)


def test_another_order_of_vertices_permutes_the_rows(model, head):
    order = np.random.default_rng(1).permutation(len(head.vertices))
    other = Head.create(
        head.vertices[order], np.argsort(order)[head.faces], head.skeleton
    )
    expected = model.predict(head, prune=0.0)[order]
    np.testing.assert_allclose(model.predict(other, prune=0.0), expected, atol=1e-4)


def test_names_and_weights_are_not_read(model, head):
    names = [f"x{i}" for i in range(len(head.skeleton))]
    bones = Skeleton.from_heads_and_tails(
        head.skeleton.joints, head.skeleton.tails, head.skeleton.parents, names
    )
    other = head.replace(skeleton=bones, weights=None, name="other")
    np.testing.assert_allclose(model.predict(other), model.predict(head), atol=1e-6)


# ---------------------------------------------------------------- any axes and unit


def test_axes_unit_and_origin_do_not_matter(head):
    model = build()
    expected = model.predict(head, prune=0.0)
    for rotation in axis_rotations():
        other = model.predict(moved(head, rotation), prune=0.0)
        np.testing.assert_allclose(other, expected, atol=1e-4)
    # Powers of two are exact; of other moves float32 rounding decides an edge or two.
    for scale in (2.0**-10, 2.0**20):
        other = model.predict(moved(head, scale=scale), prune=0.0)
        np.testing.assert_allclose(other, expected, atol=1e-4)
    for other in (
        moved(head, scale=100.0),
        moved(head, scale=1e-3),
        moved(head, shift=(0.3, -0.1, 0.2)),
    ):
        change = np.abs(model.predict(other, prune=0.0) - expected)
        assert change.mean() < 1e-3 and change.max() < 0.1


# ---------------------------------------------------------------- seams


def test_vertices_of_a_seam_share_a_row_and_a_cut_changes_nothing(model, head):
    apart, old = unwelded(head)
    weights = model.predict(apart, prune=0.0)
    nodes = build_graph(apart).node_of_vertex
    for node in range(0, nodes.max() + 1, 50):
        rows = weights[nodes == node]
        assert len(rows) > 1 and (rows == rows[0]).all()
    expected = model.predict(head, prune=0.0)[old]
    np.testing.assert_allclose(weights, expected, atol=1e-4)


# ---------------------------------------------------------------- degenerate input


def bones_at(heads, tails=None, parents=None) -> Skeleton:
    count = len(heads)
    parents = range(-1, count - 1) if parents is None else parents
    names = [str(i) for i in range(count)]
    return Skeleton.from_heads_and_tails(heads, tails, list(parents), names)


BALL = sphere(1)
ONE_POINT = np.ones((6, 3))
DEGENERATE = {
    "all vertices at one point": Head.create(ONE_POINT, [[0, 1, 2]], skeleton(3)),
    "one point, no faces": Head.create(ONE_POINT * 0.1, [], skeleton(3)),
    "one point far away": Head.create(ONE_POINT * 1e14, [], skeleton(3)),
    "everything at one point": Head.create(
        np.zeros((3, 3)), [[0, 1, 2]], bones_at(np.zeros((3, 3)))
    ),
    "zero-area faces": Head.create(
        np.outer(np.arange(6.0), [1, 2, 3]), [[0, 1, 2], [3, 3, 4]], skeleton(3)
    ),
    "flat": Head.create(BALL.vertices * [1, 1, 0], BALL.faces, skeleton(4)),
    "tiny": Head.create(BALL.vertices * 1e-30, BALL.faces, skeleton(4)),
    "below float32's normal range": Head.create(
        BALL.vertices * 1e-40, BALL.faces, skeleton(4)
    ),
    "huge": Head.create(BALL.vertices * 9e14, BALL.faces, skeleton(4)),
    "bones far outside": BALL.replace(skeleton=bones_at([[1e3] * 3, [9e14] * 3])),
    "bones far apart": BALL.replace(
        skeleton=bones_at([[-9e14] * 3, [9e14] * 3, [0, 0, 9e14]])
    ),
    "bones at one point": BALL.replace(skeleton=bones_at(np.zeros((5, 3)))),
    "zero-length bones": BALL.replace(
        skeleton=bones_at(np.eye(3), np.eye(3), [-1, -1, -1])
    ),
    "a bone on a vertex": BALL.replace(skeleton=bones_at(BALL.vertices[:4])),
    "an isolated vertex far away": Head.create(
        np.concatenate([BALL.vertices, [[1e12, 0, 0]]]), BALL.faces, skeleton(4)
    ),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_heads_have_weights_too(model, name):
    head = DEGENERATE[name]
    check(model.predict(head), head)
    for part in prepare(head):
        for field in fields(part):
            assert torch.isfinite(getattr(part, field.name)).all(), field.name


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_heads_have_finite_gradients(name):
    model, head = build(), DEGENERATE[name]
    loss = model.node_logits(*prepare(head)).softmax(1).square().sum()
    for gradient in torch.autograd.grad(loss, list(model.parameters())):
        assert torch.isfinite(gradient).all()


# ---------------------------------------------------------------- inputs and cache


def test_the_input_of_a_sphere_by_hand():
    head = moved(sphere(2, bones=4), scale=5.0, shift=(10, 0, 0))
    mesh, bones = prepare(head)
    radius = mesh.positions.norm(dim=1)
    np.testing.assert_allclose(radius, 1, atol=0.03)
    np.testing.assert_allclose(
        (mesh.positions * mesh.normals).sum(1), radius, atol=0.01
    )
    # The curvature 1 / radius of a unit sphere, over the unit of 10.
    np.testing.assert_allclose(mesh.curvature, np.tanh(0.1), atol=0.01)
    assert mesh.areas.mean() == pytest.approx(1)
    assert mesh.deviation.min() >= 0 and mesh.deviation.max() < 0.1
    assert mesh.valence.sum() == -12  # an icosphere: twelve nodes with 5 edges
    assert mesh_features(mesh).shape == (162, 10)
    expected = np.linalg.norm(head.skeleton.joints - [10, 0, 0], axis=1) / 5
    np.testing.assert_allclose(bones.joints.norm(dim=1), expected, rtol=0.05)
    assert (bones.depths == torch.from_numpy(head.skeleton.depths)).all()


def test_the_frame_is_sized_by_the_bones_when_they_can_tell():
    # Median joint (0, 0, 1); distances from it 2, 1, 0, 1, 2.
    spots = [[0, 0, -1], [0, 0, 0], [0, 0, 1], [0, 1, 1], [2, 0, 1]]
    for size, by_bones in ((1.0, True), (2.0, True), (50.0, False), (0.02, False)):
        ball = moved(sphere(2, bones=1), scale=size, shift=(0, 0, 0.1 * size))
        frame = bone_frame(ball.replace(skeleton=bones_at(spots)))
        centre, scale = ([0, 0, 1], 2) if by_bones else ([0, 0, 0.1 * size], size)
        np.testing.assert_allclose(frame.centre, centre, atol=1e-6)
        assert frame.scale == pytest.approx(scale, rel=1e-3)
    few = sphere(2).replace(skeleton=bones_at(spots[:4]))
    np.testing.assert_allclose(bone_frame(few).centre, 0, atol=1e-6)


def equal(one, other) -> bool:
    return all(
        torch.equal(getattr(a, f.name), getattr(b, f.name))
        for a, b in zip(one, other, strict=True)
        for f in fields(a)
    )


def test_the_cache_returns_what_was_computed(head, tmp_path):
    plain = prepare(head)
    first, second = (prepare(head, cache=tmp_path / "a" / "b") for _ in range(2))
    assert [type(part) for part in second] == [MeshInput, SkeletonInput]
    assert equal(plain, first) and equal(plain, second)
    assert len(list(tmp_path.rglob("*.safetensors"))) == 1
    assert not [p for p in tmp_path.rglob("*") if p.suffix not in ("", ".safetensors")]
    model = build()
    cached = model.predict(head, cache=tmp_path / "a" / "b")
    np.testing.assert_array_equal(cached, model.predict(head))


def test_the_cache_is_used(head, tmp_path, monkeypatch):
    prepare(head, cache=tmp_path)
    monkeypatch.setattr("skinlib.model.inputs.build_graph", None)
    prepare(head.replace(name="another name", weights=None), cache=tmp_path)
    with pytest.raises(TypeError):
        prepare(head.replace(vertices=head.vertices * 2), cache=tmp_path)


def test_the_content_hash_changes_with_anything_that_is_read(head):
    config, bones = GraphConfig(), head.skeleton
    shifted = bones_at(bones.joints + 1, bones.tails + 1, bones.parents)
    longer = bones_at(bones.joints, bones.tails * 1.01, bones.parents)
    root = bones_at(bones.joints, bones.tails, np.full(len(bones), -1))
    flipped = head.faces[:, ::-1]
    heads = [
        head,
        head.replace(vertices=head.vertices + 1, normals=head.normals),
        head.replace(faces=flipped, normals=head.normals),
        head.replace(normals=-head.normals),
        head.replace(faces=head.faces[:-1], normals=head.normals),
        *(
            head.replace(skeleton=tree, weights=None)
            for tree in (shifted, longer, root)
        ),
    ]
    names = {content_hash(h, config) for h in heads}
    names.add(content_hash(head, GraphConfig(nearest=3)))
    assert len(names) == len(heads) + 1
    assert content_hash(head.replace(name="x", weights=None), config) in names


def test_a_damaged_cache_file_is_made_again(head, tmp_path):
    expected = prepare(head, cache=tmp_path)
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:100])
    assert equal(prepare(head, cache=tmp_path), expected)
    assert equal(prepare(head, cache=tmp_path), expected)


# ---------------------------------------------------------------- the parts


def test_pair_features_by_hand():
    bones = SkeletonInput(
        joints=torch.tensor([[0.0, 0, 0], [0, 0, 3]]),
        directions=torch.tensor([[1.0, 0, 0], [0, 0, 0]]),
        lengths=torch.tensor([2.0, 0]),
        parents=torch.tensor([-1, 0]),
        depths=torch.tensor([0, 1]),
    )
    positions, normals = torch.tensor([[1.0, 0, 1]]), torch.tensor([[0.0, 0, -1]])
    long, point = pair_features(positions, normals, bones)[0]
    root2, root5 = 2**0.5, 5**0.5
    expected = [root2, 1, np.log(1.02), 1 / root2]
    torch.testing.assert_close(long, torch.tensor(expected, dtype=torch.float32))
    expected = [root5, root5, np.log(root5 + 0.02), -2 / root5]
    torch.testing.assert_close(point, torch.tensor(expected, dtype=torch.float32))


def test_cross_attention_in_chunks_is_the_same(head):
    mesh, bones = prepare(head)
    torch.manual_seed(0)
    layer = CrossAttention(8, 6, pair_width=4, heads=2, chunk=50)
    vertices = torch.randn(len(mesh.positions), 8)
    features = torch.randn(len(head.skeleton), 6)
    whole = layer(vertices, features, mesh, bones)
    with torch.no_grad():
        chunked = layer(vertices, features, mesh, bones)
    torch.testing.assert_close(chunked, whole)


def test_logits_of_some_nodes_are_rows_of_all(model, head):
    mesh, bones = prepare(head)
    nodes = torch.randperm(len(mesh.positions))[:50]
    some, everyone = (
        model.node_logits(mesh, bones, nodes),
        model.node_logits(mesh, bones),
    )
    torch.testing.assert_close(some, everyone[nodes])


def test_without_the_geometric_bias_only_features_speak():
    model = build(pair_width=0)
    assert not [n for n, _ in model.named_parameters() if ".pair" in n]
    layer = model.cross_attention
    mesh, bones = prepare(sphere(1))
    vertices, features = torch.randn(42, 16), torch.randn(5, 8)
    far = SkeletonInput(
        bones.joints + 1, bones.directions, bones.lengths, bones.parents, bones.depths
    )
    torch.testing.assert_close(
        layer(vertices, features, mesh, far), layer(vertices, features, mesh, bones)
    )


def test_prune_drops_small_weights_and_keeps_the_largest(head):
    model = build()
    whole = model.predict(head, prune=0.0)
    pruned = model.predict(head, prune=0.05)
    check(pruned, head)
    kept = whole >= 0.05
    expected = np.where(kept, whole, 0) / np.where(kept, whole, 0).sum(1, keepdims=True)
    np.testing.assert_allclose(pruned, expected, atol=1e-5)
    # A row whose weights are all small still has its largest.
    model = build(pair_width=0)
    many = sphere(1, bones=200)
    with torch.no_grad():
        model.cross_attention.query.weight.zero_()
        model.cross_attention.query.bias.zero_()
    check(model.predict(many, prune=0.5), many)


def test_an_unknown_convolution_is_refused():
    with pytest.raises(ValueError, match="edgeconv or gat"):
        MeshEncoder(8, convolution="dense")


def test_the_same_seed_makes_the_same_model_and_prediction():
    one, other = build(), build()
    head = sphere(2)
    np.testing.assert_array_equal(one.predict(head), other.predict(head))
    assert ModelConfig(**SMALL).graph == GraphConfig()
    described = one.describe()
    assert described["mesh_width"] == 16 and described["graph"]["nearest"] == 8


def test_a_very_fine_head_is_skinned_on_a_coarse_copy(monkeypatch):
    model, head = build(), synthetic_head(4, 3000)
    exact = model.predict(head, prune=0)
    monkeypatch.setattr(skinning_model, "FINE", 2000)
    monkeypatch.setattr(skinning_model, "COARSE", 1500)
    seen = []
    monkeypatch.setattr(
        model, "forward", lambda *args, of=model.forward: seen.append(args) or of(*args)
    )
    coarse = model.predict(head, prune=0)
    assert len(seen[0][0].node_of_vertex) < 2000
    check(coarse, head)
    assert np.abs(coarse - exact).sum(axis=1).mean() < 0.3
    weights, sure = predict_with_confidence(model, head)
    assert weights.shape == exact.shape and sure.shape == (len(exact),)
