"""The critic: as the source draws it, any head, and differentiable twice."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from shapes import skeleton, sphere
from torch.autograd import gradcheck, gradgradcheck
from torch.func import functional_call

from skinlib import Head
from skinlib.datasets.remesh import isotropic
from skinlib.datasets.synthetic import synthetic_head
from skinlib.graph import GraphConfig
from skinlib.losses import critic_loss, gradient_penalty
from skinlib.model import Critic, CriticConfig, MeshInput, SkeletonInput, prepare
from skinlib.model.layers import gather_max

BONES = 5
FORMS = {
    "any": CriticConfig(width=6, bone_width=4),
    "fixed": CriticConfig(width=6, bone_width=4, form="fixed", bones=BONES),
}


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


@pytest.fixture(params=FORMS)
def critic(request):
    return Critic(FORMS[request.param])


def rows(vertices: int, bones: int = BONES) -> torch.Tensor:
    """Random skin weights, (vertices, bones)."""
    return torch.randn(vertices, bones).mul(2).softmax(dim=1)


def doubled(part):
    """A network input in float64."""
    numbers = {f.name: getattr(part, f.name) for f in fields(part)}
    floats = {k: v.double() for k, v in numbers.items() if v.is_floating_point()}
    return replace(part, **floats)


def judged(critic: Critic, head: Head, weights: torch.Tensor) -> float:
    return critic(*prepare(head), weights).item()


def point_cloud(vertices: int, bones: int) -> Head:
    points = np.random.default_rng(0).normal(size=(vertices, 3))
    return Head.create(points, [], skeleton(bones))


def renumbered_nodes(mesh: MeshInput, order: torch.Tensor) -> MeshInput:
    """The mesh after node `order[i]` has become node i."""
    new = torch.argsort(order)
    rest = {f.name: getattr(mesh, f.name)[order] for f in fields(mesh)[:-1]}
    rest["neighbours"] = new[rest["neighbours"]]
    return MeshInput(**rest, node_of_vertex=new[mesh.node_of_vertex])


def renumbered_bones(bones: SkeletonInput, order: torch.Tensor) -> SkeletonInput:
    """The skeleton after bone `order[i]` has become bone i."""
    new = torch.argsort(order)
    rest = {f.name: getattr(bones, f.name)[order] for f in fields(bones)}
    rest["parents"] = torch.where(rest["parents"] < 0, -1, new[rest["parents"]])
    return SkeletonInput(**rest)


# ---------------------------------------------------------------- what it computes


def test_the_sizes_are_those_of_the_source():
    linear = [layer for layer in Critic().score if isinstance(layer, torch.nn.Linear)]
    assert [(x.in_features, x.out_features) for x in linear] == [(256, 128), (128, 1)]
    fixed = Critic(CriticConfig(form="fixed", bones=7, bone_width=16))
    # V x (F + J): 10 mesh features, 16 of the skeleton, 7 weights; twice, for an edge.
    assert fixed.surface.linear.in_features == 2 * (10 + 16 + 7)
    assert fixed.space.linear.out_features == 256


def test_a_score_by_hand():
    # Both layers pass on one number: the weight of the first bone.
    critic = Critic(CriticConfig(width=1, form="fixed", bones=2))
    with torch.no_grad():
        for parameter in critic.parameters():
            parameter.zero_()
        half = critic.surface.linear.in_features // 2
        for layer, column in ((critic.surface, half - 2), (critic.space, 0)):
            # W_a = W_b: a node hears the largest value among its neighbours.
            layer.linear.weight[0, column] = 1.0
            layer.linear.weight[0, column + layer.linear.in_features // 2] = 1.0
        critic.score[0].weight[0, 0] = 2.0
        critic.score[2].weight[0, 0] = 3.0
        critic.score[2].bias[0] = -1.0
    mesh, bones = prepare(sphere(0, 2))
    first = torch.zeros(12)
    first[4] = 0.5  # seen by its neighbours, and by theirs
    weights = torch.stack([first, 1 - first], dim=1)
    near = (mesh.mesh_neighbours == 4).any(dim=1)
    near2 = near[mesh.neighbours].any(dim=1)
    expected = 3 * 2 * 0.5 * near2.float().mean() - 1
    torch.testing.assert_close(critic(mesh, bones, weights), expected)


def test_the_score_is_a_scalar_without_bounds(critic):
    mesh, bones = prepare(sphere(1, BONES))
    weights = rows(42)
    score = critic(mesh, bones, weights)
    assert score.shape == ()
    with torch.no_grad():
        critic.score[2].weight *= 1000
        critic.score[2].bias *= 1000
    torch.testing.assert_close(critic(mesh, bones, weights), 1000 * score)


def test_on_a_head_it_is_the_same_function(critic):
    mesh, bones = prepare(sphere(1, BONES))
    judge, weights = critic.on(mesh, bones), rows(42)
    assert judge(weights) == critic(mesh, bones, weights)
    assert judge(rows(42)) != judge(weights)


# ---------------------------------------------------------------- any head


def test_the_order_of_vertices_changes_nothing(critic):
    mesh, bones = prepare(sphere(2, BONES))
    order, weights = torch.randperm(162), rows(162)
    moved = critic(renumbered_nodes(mesh, order), bones, weights[order])
    torch.testing.assert_close(moved, critic(mesh, bones, weights))


def test_the_order_of_bones_changes_nothing():
    critic = Critic(FORMS["any"])
    mesh, bones = prepare(sphere(2, BONES))
    order, weights = torch.tensor([3, 0, 4, 2, 1]), rows(162)
    moved = critic(mesh, renumbered_bones(bones, order), weights[:, order])
    torch.testing.assert_close(moved, critic(mesh, bones, weights))
    assert critic(mesh, bones, weights[:, order]) != critic(mesh, bones, weights)


@pytest.mark.parametrize("vertices, bones", [(1, 1), (1, 7), (40, 1), (4, 200)])
def test_few_vertices_without_faces_and_any_number_of_bones(vertices, bones):
    critic, head = Critic(FORMS["any"]), point_cloud(vertices, bones)
    mesh, tree = prepare(head)
    weights = rows(vertices, bones)
    penalty = gradient_penalty(critic.on(mesh, tree), weights, weights, 0.5)
    (critic(mesh, tree, weights) + penalty).backward()
    gradients = [p.grad for p in critic.parameters() if p.grad is not None]
    assert gradients and all(g.isfinite().all() for g in gradients)


def test_one_critic_judges_heads_of_different_size():
    critic = Critic(FORMS["any"])
    for subdivisions, vertices, bones in ((0, 12, 3), (2, 162, 8), (3, 642, 40)):
        head = sphere(subdivisions, bones)
        assert np.isfinite(judged(critic, head, rows(vertices, bones)))


def test_an_isolated_vertex_hears_only_itself():
    ball = sphere(1, BONES)
    alone = np.array([[5.0, 0, 0]])
    head = Head.create(
        np.concatenate([ball.vertices, alone]), ball.faces, ball.skeleton
    )
    mesh, bones = prepare(head, GraphConfig(max_detour=1.0))
    lonely = int(mesh.node_of_vertex[-1])
    assert (mesh.neighbours[lonely] == lonely).all()
    critic, weights = Critic(FORMS["any"]), rows(43)
    weights.requires_grad_()
    (gradient,) = torch.autograd.grad(critic(mesh, bones, weights), weights)
    assert gradient[lonely].abs().sum() > 0 and gradient.isfinite().all()


# ---------------------------------------------------------------- errors


@pytest.mark.parametrize(
    "options, message",
    [
        ({"form": "free"}, "form is 'free'"),
        ({"form": "fixed"}, "bones is None"),
        ({"bones": 5}, "bones is 5"),
    ],
)
def test_a_configuration_that_makes_no_sense(options, message):
    with pytest.raises(ValueError, match=message):
        CriticConfig(**options)


def test_the_fixed_form_refuses_other_numbers_of_bones():
    with pytest.raises(ValueError, match="6 bones and the critic was made for 5"):
        judged(Critic(FORMS["fixed"]), sphere(0, 6), rows(12, 6))


@pytest.mark.parametrize("shape", [(12, 4), (11, 5), (5,)])
def test_weights_of_another_shape(critic, shape):
    with pytest.raises(ValueError, match=r"nodes and bones \(12, 5\)"):
        judged(critic, sphere(0, BONES), torch.zeros(shape))


# ---------------------------------------------------------------- derivatives


@pytest.fixture
def in_float64(critic):
    mesh, bones = map(doubled, prepare(sphere(0, BONES)))
    return critic.double(), mesh, bones, rows(12).double()


def test_first_and_second_derivative_by_the_weights(in_float64):
    critic, mesh, bones, weights = in_float64
    judge = critic.on(mesh, bones)
    weights.requires_grad_()
    assert gradcheck(judge, weights)
    assert gradgradcheck(judge, weights)


def test_derivative_of_the_penalty_by_the_parameters(in_float64):
    critic, mesh, bones, real = in_float64
    fake = rows(12).double()
    names, values = zip(*critic.surface.named_parameters(prefix="surface"), strict=True)

    def penalty(*values):
        def judge(weights):
            parameters = dict(zip(names, values, strict=True))
            return functional_call(critic, parameters, (mesh, bones, weights))

        return gradient_penalty(judge, real, fake, 0.3)

    assert gradcheck(penalty, values, fast_mode=True)


def test_the_penalty_is_that_of_the_plain_maximum(in_float64, monkeypatch):
    critic, mesh, bones, real = in_float64
    fake = rows(12).double()

    def gradients():
        loss = gradient_penalty(critic.on(mesh, bones), real, fake, 0.3)
        parameters = list(critic.parameters())
        return loss, *torch.autograd.grad(loss, parameters, allow_unused=True)

    def plain(values, neighbours):
        calls.append(len(values))
        return values[neighbours].amax(dim=1)

    calls, ours = [], gradients()
    monkeypatch.setattr("skinlib.model.layers.gather_max", plain)
    theirs = gradients()
    assert len(calls) == 2
    assert sum(g is not None and bool(g.any()) for g in ours[1:]) >= 4
    for mine, other in zip(ours, theirs, strict=True):
        if mine is not None or other is not None:
            torch.testing.assert_close(mine, other)


def test_two_layers_of_gather_max_to_the_second_derivative():
    # Twice in a row, so that the second one's winners depend on the first one's.
    values = torch.randn(9, 3, dtype=torch.float64, requires_grad=True)
    table = torch.randint(9, (9, 4))

    def twice(gather):
        x = gather(gather(values.square(), table).square(), table)
        (first,) = torch.autograd.grad(x.sum(), values, create_graph=True)
        return first, torch.autograd.grad(first.square().sum(), values)[0]

    for mine, plain in zip(
        twice(gather_max), twice(lambda v, n: v[n].amax(dim=1)), strict=True
    ):
        assert mine.abs().sum() > 0
        torch.testing.assert_close(mine, plain)


# ---------------------------------------------------------------- learning


@pytest.fixture(scope="module")
def head():
    return synthetic_head(3, vertices=700)


def node_weights(head: Head, mesh: MeshInput) -> torch.Tensor:
    """(N, J) the artist's weights, a row a node."""
    weights = torch.zeros(len(mesh.positions), head.weights.shape[1])
    weights[mesh.node_of_vertex] = torch.from_numpy(np.array(head.weights))
    return weights


def noisy(weights: torch.Tensor) -> torch.Tensor:
    return 0.7 * weights + 0.3 * torch.randn_like(weights).mul(2).softmax(dim=1)


@pytest.mark.parametrize("form", ["any", "fixed"])
def test_it_learns_to_tell_painted_weights_from_noisy_ones(head, form):
    mesh, bones = prepare(head)
    real = node_weights(head, mesh)
    count = real.shape[1] if form == "fixed" else None
    critic = Critic(CriticConfig(form=form, bones=count))
    optimizer = torch.optim.Adam(critic.parameters(), lr=3e-3, betas=(0.5, 0.9))

    def apart():
        judge = critic.on(mesh, bones)
        return (judge(real) - judge(noisy(real))).item()

    assert abs(apart()) < 0.01
    for _ in range(40):
        judge, fake = critic.on(mesh, bones), noisy(real)
        loss = critic_loss(judge(real), judge(fake))
        loss = loss + 10 * gradient_penalty(judge, real, fake, torch.rand(()))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    # The penalty keeps the slope near 1: no further apart than the weights are.
    distance = (real - noisy(real)).square().sum(dim=1).mean().sqrt().item()
    assert 0.05 < apart() < 1.2 * distance
    if form == "any":  # and what it learnt holds on another head
        other = isotropic(synthetic_head(4, vertices=700))
        mesh, bones = prepare(other)
        judge, real = critic.on(mesh, bones), node_weights(other, mesh)
        assert judge(real) - judge(noisy(real)) > 0.03
