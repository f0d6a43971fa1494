"""The layers: by hand, against torch_geometric, and to the second derivative."""

import warnings

import numpy as np
import pytest
import torch
from torch import nn
from torch.autograd import gradcheck, gradgradcheck

from skinlib.model.inputs import SkeletonInput
from skinlib.model.layers import (
    Attention,
    EdgeConv,
    GraphAttention,
    InducedTransformer,
    gather_max,
    island_mean,
)
from skinlib.model.skeleton_encoder import (
    MAX_DEPTH,
    SkeletonEncoder,
    TreeConv,
    bone_features,
)

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # torch_geometric uses torch.jit, now deprecated
    from torch_geometric.nn import EdgeConv as ReferenceEdgeConv
    from torch_geometric.nn import GATConv as ReferenceGATConv

N, K, C = 9, 4, 6


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


@pytest.fixture
def table():
    """(N, K) neighbours, all of them other nodes and none twice."""
    rows = [torch.randperm(N - 1)[:K] for _ in range(N)]
    return torch.stack([(row + 1 + i) % N for i, row in enumerate(rows)])


def edge_index(table, used=None):
    """The (2, E) sender and receiver of a table, as torch_geometric wants them."""
    used = torch.ones_like(table, dtype=torch.bool) if used is None else used
    receivers = torch.arange(len(table))[:, None].expand_as(table)
    return torch.stack([table[used], receivers[used]])


def renumbered(table, order):
    """The table after node `order[i]` has become node i."""
    return torch.argsort(order)[table[order]]


def float64(*shape):
    return torch.randn(*shape, dtype=torch.float64, requires_grad=True)


# ---------------------------------------------------------------- gather_max


def test_gather_max_by_hand():
    values = torch.tensor([[1.0, -5.0], [4.0, -6.0], [2.0, -4.0]], requires_grad=True)
    table = torch.tensor([[1, 2], [0, 0], [0, 1]])
    reached = gather_max(values, table)
    assert reached.tolist() == [[4, -4], [1, -5], [4, -5]]
    (gradient,) = torch.autograd.grad(reached.sum(), values)
    assert gradient.tolist() == [[1, 2], [2, 0], [0, 1]]


@pytest.mark.parametrize("neighbours", [1, 2, 14, 200, 256])
def test_gather_max_is_the_plain_maximum_and_its_gradient(neighbours):
    values = float64(30, 5)
    table = torch.randint(30, (20, neighbours))
    mine, plain = gather_max(values, table), values[table].amax(dim=1)
    assert torch.equal(mine, plain)
    upstream = torch.randn_like(plain)
    (mine,) = torch.autograd.grad((mine * upstream).sum(), values)
    (plain,) = torch.autograd.grad((plain * upstream).sum(), values)
    torch.testing.assert_close(mine, plain)


def test_gather_max_refuses_more_neighbours_than_a_byte_counts():
    with pytest.raises(ValueError, match="257"):
        gather_max(torch.zeros(3, 2), torch.zeros(3, 257, dtype=torch.int64))


def test_gather_max_first_and_second_derivative(table):
    values = float64(N, 3)
    assert gradcheck(gather_max, (values, table))
    assert gradgradcheck(gather_max, (values, table))
    # A gradient penalty differentiates a squared gradient.
    scale = float64(N, 3)

    def penalty(v, s):
        out = (gather_max(v * s, table) ** 2).sum()
        (gradient,) = torch.autograd.grad(out, v, create_graph=True)
        return (gradient.norm(dim=1) - 1).square().mean()

    assert gradcheck(penalty, (values, scale))


def test_gather_max_of_an_empty_graph():
    empty = torch.zeros(0, 3, requires_grad=True)
    out = gather_max(empty, torch.zeros(0, K, dtype=torch.int64))
    assert out.shape == (0, 3)
    out.sum().backward()


# ---------------------------------------------------------------- EdgeConv


def test_edge_conv_by_hand():
    layer = EdgeConv(1, 1)
    with torch.no_grad():
        layer.linear.weight[:] = torch.tensor([[2.0, 3.0]])
        layer.linear.bias[:] = -1.0
    x = torch.tensor([[1.0], [2.0], [5.0]])
    out = layer(x, torch.tensor([[1, 2], [0, 0], [0, 1]]))
    # 2 x_i + 3 max(x_j - x_i) - 1, and not below 0.
    assert out.flatten().tolist() == [2 + 12 - 1, 0, 0]


@pytest.mark.parametrize("inputs, outputs", [(3, 8), (C, C), (8, 3)])
def test_edge_conv_is_that_of_torch_geometric(table, inputs, outputs):
    ours = EdgeConv(inputs, outputs)
    theirs = ReferenceEdgeConv(nn.Sequential(ours.linear, nn.ReLU()), aggr="max")
    x = torch.randn(N, inputs, requires_grad=True)
    mine, other = ours(x, table), theirs(x, edge_index(table))
    torch.testing.assert_close(mine, other)
    upstream = torch.randn_like(mine)
    parameters = (x, ours.linear.weight, ours.linear.bias)
    for a, b in zip(
        torch.autograd.grad((mine * upstream).sum(), parameters),
        torch.autograd.grad((other * upstream).sum(), parameters),
        strict=True,
    ):
        torch.testing.assert_close(a, b)


def test_edge_conv_derivatives(table):
    layer = EdgeConv(3, 4, activation=nn.Softplus()).double()
    assert gradcheck(lambda x: layer(x, table), float64(N, 3))
    assert gradgradcheck(lambda x: layer(x, table), float64(N, 3))


def test_edge_conv_of_an_isolated_node_sees_only_itself():
    layer = EdgeConv(2, 3, activation=nn.Identity())
    x = torch.randn(1, 2)
    own = layer.linear.weight[:, :2]
    expected = x @ own.T + layer.linear.bias
    torch.testing.assert_close(layer(x, torch.zeros(1, K, dtype=torch.int64)), expected)


# ---------------------------------------------------------------- GraphAttention


def test_graph_attention_by_hand():
    layer = GraphAttention(1, 1, heads=1)
    with torch.no_grad():
        layer.linear.weight[:] = 1.0
        layer.receiver[:], layer.sender[:] = 0.0, 1.0
    x = torch.tensor([[0.0], [np.log(3.0)]], dtype=torch.float32)
    out = layer(x, torch.tensor([[1], [0]]), torch.ones(2, 1, dtype=torch.bool))
    # Scores 0 and log 3: shares 1/4 and 3/4 for both nodes.
    expected = 0.75 * np.log(3.0)
    torch.testing.assert_close(out, torch.full((2, 1), expected, dtype=torch.float32))


@pytest.mark.parametrize("heads", [1, 3])
def test_graph_attention_is_that_of_torch_geometric(table, heads):
    outputs = 2 * heads
    ours = GraphAttention(C, outputs, heads, activation=nn.Identity())
    theirs = ReferenceGATConv(C, 2, heads, add_self_loops=True, negative_slope=0.2)
    with torch.no_grad():
        theirs.lin.weight.copy_(ours.linear.weight)
        theirs.att_src.copy_(ours.sender[None])
        theirs.att_dst.copy_(ours.receiver[None])
        ours.bias.copy_(torch.randn(outputs))
        theirs.bias.copy_(ours.bias)
    used = torch.rand(N, K) < 0.7
    used[0] = False  # an isolated node
    x = torch.randn(N, C)
    expected = theirs(x, edge_index(table, used))
    torch.testing.assert_close(ours(x, table, used), expected)


def test_graph_attention_derivatives(table):
    layer = GraphAttention(3, 4, heads=2, activation=nn.Softplus()).double()
    used = torch.rand(N, K) < 0.7
    assert gradcheck(lambda x: layer(x, table, used), float64(N, 3))
    assert gradgradcheck(lambda x: layer(x, table, used), float64(N, 3))


def test_unused_neighbours_do_not_matter(table):
    layer, x = GraphAttention(C, C, heads=2), torch.randn(N, C)
    used = torch.rand(N, K) < 0.5
    other = torch.where(used, table, torch.randint(N, (N, K)))
    torch.testing.assert_close(layer(x, table, used), layer(x, other, used))


def test_graph_attention_refuses_heads_that_do_not_divide():
    with pytest.raises(ValueError, match=r"outputs = 6 .* heads = 4"):
        GraphAttention(3, 6, heads=4)


# ---------------------------------------------------------------- both graph layers


def graph_layers():
    return [
        pytest.param(EdgeConv(C, C), (), id="edgeconv"),
        pytest.param(GraphAttention(C, C, 2), (torch.rand(N, K) < 0.7,), id="gat"),
    ]


@pytest.mark.parametrize("layer, used", graph_layers())
def test_graph_layers_are_equivariant(layer, used, table):
    x, order = torch.randn(N, C), torch.randperm(N)
    expected = layer(x, table, *used)[order]
    used = [u[order] for u in used]
    torch.testing.assert_close(
        layer(x[order], renumbered(table, order), *used), expected
    )
    # The order of the neighbours within a row does not matter either.
    columns = torch.randperm(K)
    used = [u[:, columns] for u in used]
    torch.testing.assert_close(
        layer(x[order], renumbered(table, order)[:, columns], *used), expected
    )


@pytest.mark.parametrize("layer, used", graph_layers())
def test_graph_layers_take_an_empty_graph(layer, used):
    x, table = torch.zeros(0, C), torch.zeros(0, K, dtype=torch.int64)
    used = [u[:0] for u in used]
    assert layer(x, table, *used).shape == (0, C)


# ---------------------------------------------------------------- attention


def test_attention_is_that_of_torch():
    ours = Attention(8, 8, heads=2)
    theirs = nn.MultiheadAttention(8, 2)
    with torch.no_grad():
        parts = [ours.query.weight, ours.key_value.weight]
        theirs.in_proj_weight.copy_(torch.cat(parts))
        theirs.in_proj_bias.copy_(torch.cat([ours.query.bias, ours.key_value.bias]))
        theirs.out_proj.load_state_dict(ours.output.state_dict())
    queries, context = torch.randn(5, 8), torch.randn(7, 8)
    expected, _ = theirs(queries, context, context)
    torch.testing.assert_close(ours(queries, context), expected)


def test_a_key_of_twice_the_mass_counts_as_two():
    layer = Attention(8, 6)
    queries, context = torch.randn(5, 8), torch.randn(3, 6)
    mass = torch.tensor([2.0, 1.0, 3.0])
    twice = context[[0, 0, 1, 2, 2, 2]]
    torch.testing.assert_close(
        layer(queries, context, mass.log()), layer(queries, twice)
    )


def test_island_mean_by_hand_and_its_derivative():
    x = torch.tensor([[0.0, 1], [4, 1], [7, 7]])
    island, areas = torch.tensor([1, 1, 0]), torch.tensor([3.0, 1, 1])
    assert island_mean(x, island, areas).tolist() == [[1, 1], [1, 1], [7, 7]]
    weights = torch.rand(3, dtype=torch.float64)
    assert gradcheck(lambda v: island_mean(v, island, weights), float64(3, 2))


def test_an_island_without_area_has_its_plain_mean():
    x = torch.tensor([[1.0], [3.0]])
    mean = island_mean(x, torch.tensor([0, 0]), torch.zeros(2))
    assert mean.flatten().tolist() == [2, 2]


def test_induced_transformer_is_equivariant_and_blind_to_refinement():
    layer = InducedTransformer(8, points=3, heads=2)
    x, areas = torch.randn(N, 8), torch.rand(N) + 0.1
    out, order = layer(x, areas), torch.randperm(N)
    torch.testing.assert_close(layer(x[order], areas[order]), out[order])
    # A node split into two of half its area changes no other node.
    split = torch.cat([areas, areas[:1] / 2])
    split[0] /= 2
    torch.testing.assert_close(layer(torch.cat([x, x[:1]]), split)[:N], out)


def test_induced_transformer_derivatives():
    layer = InducedTransformer(4, points=2, heads=2).double()
    areas = torch.rand(5, dtype=torch.float64) + 0.1
    assert gradcheck(lambda x: layer(x, areas), float64(5, 4))


def test_every_node_hears_from_every_other():
    layer = InducedTransformer(8, points=2, heads=2)
    x = torch.randn(N, 8, requires_grad=True)
    (gradient,) = torch.autograd.grad(layer(x, torch.ones(N))[0].sum(), x)
    assert (gradient.abs().sum(dim=1) > 0).all()


# ---------------------------------------------------------------- bones

PARENTS = torch.tensor([1, 3, 3, -1, 1, -1])  # two trees, children first


def bones(parents=PARENTS):
    count = len(parents)
    depth = torch.zeros(count, dtype=torch.int64)
    above = parents.clone()
    while (above >= 0).any():
        depth += above >= 0
        above = torch.where(above >= 0, parents[above], -1)
    directions = nn.functional.normalize(torch.randn(count, 3), dim=1)
    return SkeletonInput(
        torch.randn(count, 3), directions, torch.rand(count), parents, depth
    )


def reordered(skeleton, order):
    place = torch.cat([torch.argsort(order), torch.tensor([-1])])
    return SkeletonInput(
        skeleton.joints[order],
        skeleton.directions[order],
        skeleton.lengths[order],
        place[skeleton.parents[order]],
        skeleton.depths[order],
    )


def test_bone_features_by_hand():
    skeleton = SkeletonInput(
        joints=torch.tensor([[0.0, 1, 0], [0, 3, 0]]),
        directions=torch.tensor([[0.0, 1, 0], [0, 0, 0]]),
        lengths=torch.tensor([2.0, 0]),
        parents=torch.tensor([-1, 0]),
        depths=torch.tensor([0, 1]),
    )
    assert skeleton.tails.tolist() == [[0, 3, 0], [0, 3, 0]]
    root, leaf = bone_features(skeleton).tolist()
    # Joint, direction, length, offset from the parent, root, leaf.
    assert root == [0, 1, 0, 0, 1, 0, 2, 0, 0, 0, 1, 0]
    assert leaf == [0, 3, 0, 0, 0, 0, 0, 0, 2, 0, 0, 1]


def test_tree_conv_by_hand():
    layer = TreeConv(1)
    layer.norm = nn.Identity()
    heard = []
    layer.message = nn.Module()
    layer.message.forward = lambda x: heard.append(x) or torch.zeros(len(x), 1)
    x = torch.tensor([[1.0], [2], [4], [8], [16], [32]])
    torch.testing.assert_close(layer(x, PARENTS), x)
    own, parent, children, everyone = heard[0].T.tolist()
    assert own == [1, 2, 4, 8, 16, 32]
    assert parent == [2, 8, 8, 0, 2, 0]
    assert children == [0, 8.5, 0, 3, 0, 0]
    assert everyone == [10.5] * 6


def test_tree_conv_derivatives():
    layer = TreeConv(3).double()
    assert gradcheck(lambda x: layer(x, PARENTS), float64(6, 3))
    assert gradgradcheck(lambda x: layer(x, PARENTS), float64(6, 3))


def test_bones_in_another_order_have_the_same_features():
    encoder, skeleton, order = SkeletonEncoder(8), bones(), torch.randperm(6)
    expected = encoder(skeleton)[order]
    torch.testing.assert_close(encoder(reordered(skeleton, order)), expected)


@pytest.mark.parametrize("count", [1, 2, 200])
def test_a_chain_deeper_than_the_embedding(count):
    chain = bones(torch.arange(count) - 1)
    assert chain.depths.max() == count - 1 and (count < 3 or count > MAX_DEPTH)
    encoded = SkeletonEncoder(8)(chain)
    assert encoded.shape == (count, 8) and encoded.isfinite().all()


# ---------------------------------------------------------------- kinds of numbers


def test_layers_run_in_bfloat16(table):
    x, areas, island = torch.randn(N, 8), torch.rand(N) + 0.1, torch.arange(N) % 2
    layers = (EdgeConv(8, 8), InducedTransformer(8, points=3, heads=2))
    inputs = ((table,), (areas,))
    with torch.no_grad():
        for layer, rest in zip(layers, inputs, strict=True):
            exact = layer(x, *rest)
            with torch.autocast("cpu", torch.bfloat16):
                rounded = layer(x, *rest)
            torch.testing.assert_close(rounded.float(), exact, atol=0.1, rtol=0.1)
        exact = island_mean(x, island, areas)
        with torch.autocast("cpu", torch.bfloat16):
            rounded = island_mean(x.bfloat16(), island, areas)
        torch.testing.assert_close(rounded.float(), exact, atol=0.05, rtol=0.05)
