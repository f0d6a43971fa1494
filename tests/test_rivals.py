"""The rivals: any mesh, any skeleton, any order; they can be trained and saved."""

import itertools
import json
from dataclasses import asdict, fields, replace

import numpy as np
import pytest
import torch
from shapes import bumpy, skeleton, sphere

from skinlib import Head, HeadError, Skeleton
from skinlib.datasets.augment import UNDISTURBED
from skinlib.datasets.synthetic import synthetic_head, synthetic_heads
from skinlib.evaluate.baselines import nearest_bone
from skinlib.evaluate.metrics import row_l1
from skinlib.graph import GraphConfig
from skinlib.model import ModelConfig, SkinningModel, prepare
from skinlib.model.inputs import SkeletonInput
from skinlib.model.rivals import (
    CLOSE,
    FLOOR,
    PatchAttention,
    PointTransformer,
    PointTransformerConfig,
    RigNetConfig,
    RigNetSkinning,
    TwoGraphs,
    curve_order,
    near_bones,
    nearest_points,
)
from skinlib.training import (
    WEIGHTS,
    TrainConfig,
    Trainer,
    load_model,
    save_model,
    train,
)
from skinlib.training.checkpoint import read_tensors, write_tensors

SMALL = {
    "rignet": (RigNetSkinning, RigNetConfig(width=32, pooled=32, hidden=32)),
    "point_transformer": (
        PointTransformer,
        PointTransformerConfig(width=32, blocks=2, points=4, patch=16, scores=4),
    ),
}


def build(name: str) -> SkinningModel:
    network, config = SMALL[name]
    torch.manual_seed(0)
    return network(config).eval()


@pytest.fixture(params=SMALL)
def model(request):
    return build(request.param)


@pytest.fixture(scope="module")
def head():
    return bumpy(synthetic_head(5, vertices=700, unit="m"))


# ---------------------------------------------------------------- both


def test_both_have_about_as_many_parameters_as_ours():
    networks = SkinningModel(), RigNetSkinning(), PointTransformer()
    sizes = [sum(p.numel() for p in n.parameters()) for n in networks]
    np.testing.assert_allclose(sizes, sizes[0], rtol=0.05)


@pytest.mark.parametrize("bones", [1, 2, 200])
@pytest.mark.parametrize("vertices", [1, 4, 40])
def test_any_number_of_vertices_and_bones_without_faces(model, vertices, bones):
    points = np.random.default_rng(0).normal(size=(vertices, 3))
    weights = model.predict(Head.create(points, [], skeleton(bones)))
    assert weights.shape == (vertices, bones) and (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)


def test_another_order_of_bones_permutes_the_columns(model):
    # The lids and eyes of a synthetic head coincide: only their order is different.
    head = bumpy(sphere(3, bones=12))
    order = np.random.default_rng(0).permutation(len(head.skeleton))
    other = Head.create(head.vertices, head.faces, head.skeleton.reordered(order))
    expected = model.predict(head, prune=0.0)[:, order]
    assert np.ptp(expected, axis=0).max() > 0.01
    np.testing.assert_allclose(model.predict(other, prune=0.0), expected, atol=1e-4)


def test_another_order_of_vertices_permutes_the_rows(model, head):
    order = np.random.default_rng(1).permutation(len(head.vertices))
    other = Head.create(
        head.vertices[order], np.argsort(order)[head.faces], head.skeleton
    )
    expected = model.predict(head, prune=0.0)[order]
    np.testing.assert_allclose(model.predict(other, prune=0.0), expected, atol=1e-4)


def test_some_nodes_have_the_logits_they_have_among_all(model, head):
    inputs, nodes = prepare(head), torch.tensor([7, 3, 500])
    every = model.node_logits(*inputs)
    torch.testing.assert_close(model.node_logits(*inputs, nodes), every[nodes])


def test_rows_computed_in_parts_are_the_same(model):
    inputs = prepare(synthetic_head(0, vertices=3000))
    with torch.no_grad():
        parts = model.node_logits(*inputs)
    torch.testing.assert_close(parts, model.node_logits(*inputs), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    "odd",
    [
        Head.create(np.ones((6, 3)), [[0, 1, 2]], skeleton(3)),
        Head.create([[0, 0, 0]], [], skeleton(1)),
        sphere(1).replace(
            skeleton=Skeleton.from_heads_and_tails(
                np.zeros((7, 3)), None, [-1] * 7, [str(i) for i in range(7)]
            )
        ),
        sphere(1).replace(
            skeleton=Skeleton.from_heads_and_tails(
                sphere(1).vertices[:4], None, [-1, 0, 0, 0], ["a", "b", "c", "d"]
            )
        ),
    ],
    ids=["all at one point", "one vertex, one bone", "bones at one point", "on bones"],
)
def test_gradients_are_finite(model, odd):
    logits = model.node_logits(*prepare(odd))
    target = torch.full_like(logits, 1 / logits.shape[1])
    loss = -(target * logits.log_softmax(dim=1)).sum()
    gradients = torch.autograd.grad(
        loss, list(model.parameters()), materialize_grads=True
    )
    assert all(torch.isfinite(gradient).all() for gradient in gradients)


def test_every_parameter_learns(model, head):
    loss = model.node_logits(*prepare(head)).log_softmax(dim=1).square().mean()
    names = [name for name, _ in model.named_parameters()]
    gradients = torch.autograd.grad(loss, list(model.parameters()))
    # A softmax cannot tell what is added to all of a row.
    shared = {"logit.2.bias", "patches.0.inputs.bias", "patches.1.inputs.bias"}
    idle = {n for n, g in zip(names, gradients, strict=True) if not g.abs().max() > 0}
    assert idle <= shared


# ---------------------------------------------------------------- RigNet


def three_bones() -> SkeletonInput:
    """A root at the origin with one child 2 to the right, and a root 5 up."""
    return SkeletonInput(
        joints=torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 5, 0]]),
        directions=torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 0, 0]]),
        lengths=torch.tensor([9.0, 1, 0]),
        parents=torch.tensor([-1, 0, -1]),
        depths=torch.tensor([0, 1, 0]),
    )


def test_near_bones_by_hand():
    positions = torch.tensor([[1.0, 1, 0], [2.5, 0, 2]])
    ids, features = near_bones(positions, three_bones(), 2)
    # The first is 1 from the link to the child, sqrt 2 from the child's own segment.
    assert ids.tolist() == [[0, 1], [1, 0]]
    link, tail = [0, 0, 0, 2, 0, 0], [2, 0, 0, 3, 0, 0]

    def close(distance):
        return CLOSE / (CLOSE + distance)

    expected = [
        [[*link, close(1), 0], [*tail, close(2**0.5), 1]],
        [[*tail, close(2), 1], [*link, close(4.25**0.5), 0]],
    ]
    torch.testing.assert_close(features, torch.tensor(expected))
    ids, features = near_bones(positions, three_bones(), 5)
    assert ids.shape == (2, 3) and features.shape == (2, 3, 8)


def test_rignet_gives_weight_to_the_nearest_bones_and_to_no_other(head):
    mesh, bones = prepare(head)
    weights = build("rignet")(mesh, bones)
    near, _ = near_bones(mesh.positions, bones, 5)
    there = torch.zeros(len(near), len(bones.joints)).scatter(1, near, 1.0)
    there = there[mesh.node_of_vertex]
    assert len(bones.joints) > 5 and (weights * (1 - there)).max() < 1e-8
    assert ((weights > 1e-6).sum(dim=1) == 5).all()


def test_a_bone_that_is_too_far_costs_something_finite(head):
    logits = build("rignet").node_logits(*prepare(head))
    worst = logits.log_softmax(dim=1).min().item()
    assert worst == pytest.approx(FLOOR, abs=1e-4)


def test_the_geodesic_ball_reaches_as_many_edges_as_it_has_hops():
    node = torch.arange(9)
    ring = torch.stack([(node + 1) % 9, (node - 1) % 9], dim=1)
    mesh, _ = prepare(Head.create(np.eye(9)[:, :3], [], skeleton(1)))
    mesh = replace(mesh, neighbours=ring, kinds=torch.zeros_like(ring))
    torch.manual_seed(0)
    layer = TwoGraphs(1, 8, hops=3)
    before = layer(torch.zeros(9, 1), mesh)
    for changed in range(9):
        reached = torch.zeros(9, dtype=torch.bool)
        for value in (10.0, -10.0):
            x = torch.zeros(9, 1)
            x[changed] = value
            reached |= (layer(x, mesh) != before).any(dim=1)
        apart = (torch.arange(9) - changed).abs()
        assert torch.equal(reached, torch.minimum(apart, 9 - apart) <= 3)


# ---------------------------------------------------------------- points


def test_the_curve_by_hand():
    cell = 2.0**-12
    corners = [[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    points = (torch.tensor(corners, dtype=torch.float32) + 0.5) * cell
    mixed = torch.tensor([3, 0, 7, 5, 1, 6, 2, 4])
    assert mixed[curve_order(points[mixed])].tolist() == list(range(8))
    assert curve_order(points * 1e6).tolist() != []


def test_nearest_points_by_hand():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    assert nearest_points(points, 2).tolist() == [[0, 1], [1, 0], [2, 1]]
    assert nearest_points(points, 12).shape == (3, 3)
    assert nearest_points(points[:1], 12).tolist() == [[0]]


@pytest.mark.parametrize("count", [1, 3, 4, 5, 11])
def test_points_attend_to_their_own_patch_alone(count):
    torch.manual_seed(0)
    layer = PatchAttention(8, patch=4, heads=2)
    x, order = torch.randn(count, 8), torch.randperm(count)
    parts = -(-count // 4)
    first = [part * count // parts for part in range(parts)] + [count]
    whole = layer(x, order)
    for begin, end in itertools.pairwise(first):
        ids = order[begin:end]
        alone = PatchAttention(8, patch=count, heads=2)
        alone.load_state_dict(layer.state_dict())
        torch.testing.assert_close(whole[ids], alone(x[ids], torch.arange(len(ids))))


def test_the_point_transformer_knows_no_edges(head):
    model, (mesh, bones) = build("point_transformer"), prepare(head)
    fewer, _ = prepare(head, GraphConfig(neighbours=1, nearest=1))
    assert mesh.neighbours.shape != fewer.neighbours.shape
    expected = model.node_logits(mesh, bones)
    torch.testing.assert_close(model.node_logits(fewer, bones), expected)


# ---------------------------------------------------------------- training


@pytest.fixture(scope="module")
def heads():
    return synthetic_heads(2, seed=1, vertices=600, bones=8)


@pytest.mark.parametrize("name", SMALL)
def test_it_learns_two_heads(name, heads, tmp_path):
    config = TrainConfig(
        steps=150,
        batch=1,
        warmup=10,
        threads=1,
        validations=1,
        ema=0.9,
        judged_nodes=256,
        augment=UNDISTURBED,
    )
    model = train(config, heads, tmp_path, validation=[], start=build(name))
    assert type(model) is SMALL[name][0]

    def error(skin):
        return np.mean([row_l1(skin(head), head.weights).mean() for head in heads])

    assert error(model.predict) < 0.4 * error(nearest_bone)


def test_save_and_load_round_trip(model, head, tmp_path):
    save_model(model, tmp_path, {})
    stored = json.loads((tmp_path / "config.json").read_text())
    assert SMALL[stored["network"]][0] is type(model)
    loaded = load_model(tmp_path)
    assert type(loaded) is type(model) and loaded.config == model.config
    np.testing.assert_array_equal(loaded.predict(head), model.predict(head))


def test_a_checkpoint_without_a_name_is_of_our_own_network(tmp_path):
    save_model(SkinningModel(ModelConfig(mesh_width=8, bone_width=8)), tmp_path, {})
    tensors, metadata = read_tensors(tmp_path / WEIGHTS)
    config = json.loads(metadata["config"])
    assert config.pop("network") == "skinlib"
    write_tensors(tmp_path / WEIGHTS, tensors, {"config": json.dumps(config)})
    assert type(load_model(tmp_path)) is SkinningModel
    config["network"] = "another"
    write_tensors(tmp_path / WEIGHTS, tensors, {"config": json.dumps(config)})
    with pytest.raises(HeadError, match="no skinlib model"):
        load_model(tmp_path)


def test_a_run_of_our_own_network_is_named_as_before(heads, tmp_path):
    config = TrainConfig(model=ModelConfig(mesh_width=8, bone_width=8))
    run = Trainer(config, heads, tmp_path, validation=[])._identity()
    assert run["model"] == json.loads(json.dumps(asdict(config.model)))
    settings = {field.name for field in fields(config)}
    settings -= {"threads", "device", "save_seconds"}
    assert set(run) == settings | {"labelled", "unlabelled", "validation"}


def test_a_run_goes_on_with_its_own_network_alone(heads, tmp_path):
    def trainer(name):
        start = build(name)
        config = TrainConfig(steps=4, threads=1, validations=1)
        return Trainer(config, heads, tmp_path, validation=[], start=start)

    first = trainer("rignet")
    first.step()
    first.save()
    again = trainer("rignet")
    assert again.steps_done == 1
    pairs = zip(first.model.parameters(), again.model.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    with pytest.raises(HeadError, match="model"):
        trainer("point_transformer")
