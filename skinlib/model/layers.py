"""The layers of both encoders: plain tensors in, plain tensors out.

Symbols: N nodes, K neighbours a node, C channels, M induced points.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

ROWS = 2048  # nodes computed at once by `by_rows`


def by_rows(function: Callable[..., Tensor], *rows: Tensor) -> Tensor:
    """`function(*rows)`, a few rows at a time when no gradient is asked for.

    Only for functions that treat each row by itself. What stays in a processor's cache
    is many times faster, so time grows no faster than the mesh.
    """
    if torch.is_grad_enabled():
        return function(*rows)
    parts = zip(*(tensor.split(ROWS) for tensor in rows), strict=True)
    return torch.cat([function(*part) for part in parts])


class _GatherMax(torch.autograd.Function):
    """`values[neighbours].amax(dim=1)` that never builds the (N, K, C) array."""

    @staticmethod
    def forward(ctx, values, neighbours):
        columns = neighbours.t().contiguous()  # (K, N)
        best = values.index_select(0, columns[0])  # (N, C)
        winner = torch.zeros_like(best, dtype=torch.uint8)
        for k in range(1, len(columns)):
            candidate = values.index_select(0, columns[k])
            # k grows, so the last neighbour to beat the best so far has the largest k.
            beats = (candidate > best).view(torch.uint8).mul_(k)
            winner = torch.maximum(winner, beats)
            best = torch.maximum(best, candidate)
        ctx.save_for_backward(winner, neighbours)
        ctx.rows = len(values)
        return best

    @staticmethod
    def backward(ctx, gradient):
        winner, neighbours = ctx.saved_tensors
        # Only the winner of each (node, channel) passed its value on: N x C sums.
        source = neighbours.gather(1, winner.long())  # (N, C)
        zeros = gradient.new_zeros(ctx.rows, gradient.shape[1])
        return zeros.scatter_add(0, source, gradient), None


def gather_max(values: Tensor, neighbours: Tensor) -> Tensor:
    """The largest value among each node's neighbours, channel by channel.

    Args:
        values: (N, C). neighbours: (N', K) int64 rows of `values`, 1 <= K <= 256.

    Returns:
        (N', C).

    Raises:
        ValueError: more than 256 neighbours, which one byte cannot count.

    >>> gather_max(torch.tensor([[1.0], [5.0], [3.0]]), torch.tensor([[0, 2], [1, 0]]))
    tensor([[3.],
            [5.]])
    """
    if not 1 <= neighbours.shape[1] <= 256:
        raise ValueError(f"{neighbours.shape[1]} neighbours a node: use 1 to 256")
    if torch.is_grad_enabled() and values.requires_grad:
        return _GatherMax.apply(values, neighbours)
    columns = neighbours.t().contiguous()
    best = values.index_select(0, columns[0])
    for column in columns[1:]:
        best = torch.maximum(best, values.index_select(0, column))
    return best


class EdgeConv(nn.Module):
    """x_i' = act(max_j W [x_i, x_j - x_i]): EdgeConv with a linear message.

    A linear map needs no edge: W [x_i, x_j - x_i] = (W_a - W_b) x_i + W_b x_j, and the
    activation grows, so it may wait until after the maximum. What is left is one matrix
    product a node and a maximum over neighbours. Equation `edgeconv` in
    docs/equations.md; source: Wang et al. 2019, Dynamic Graph CNN, equation 8.

    Args:
        inputs, outputs: channels. activation: a growing function.
    """

    def __init__(self, inputs: int, outputs: int, activation: nn.Module | None = None):
        super().__init__()
        self.linear = nn.Linear(2 * inputs, outputs)
        self.activation = activation or nn.ReLU(inplace=True)

    def forward(self, x: Tensor, neighbours: Tensor) -> Tensor:
        """(N, inputs), (N, K) -> (N, outputs)."""
        own, difference = self.linear.weight.chunk(2, dim=1)
        sent = F.linear(x, difference)

        def receive(x, neighbours):
            centre = F.linear(x, own - difference, self.linear.bias)
            return self.activation(centre.add_(gather_max(sent, neighbours)))

        return by_rows(receive, x, neighbours)


class GraphAttention(nn.Module):
    """x_i' = act(sum_j a_ij W x_j), a_ij = softmax_j LeakyReLU(s . W x_i + t . W x_j).

    j runs over the used neighbours and the node itself. Equation `gat` in
    docs/equations.md; source: Velickovic et al. 2018, Graph Attention Networks.

    Args:
        inputs, outputs: channels; `outputs` is a multiple of `heads`.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        heads: int = 4,
        activation: nn.Module | None = None,
    ):
        super().__init__()
        if outputs % heads:
            raise ValueError(f"outputs = {outputs} is no multiple of heads = {heads}")
        self.heads = heads
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.receiver = nn.Parameter(torch.randn(heads, outputs // heads) * 0.1)
        self.sender = nn.Parameter(torch.randn(heads, outputs // heads) * 0.1)
        self.activation = activation or nn.ReLU()

    def forward(self, x: Tensor, neighbours: Tensor, used: Tensor) -> Tensor:
        """(N, inputs), (N, K), (N, K) bool -> (N, outputs)."""
        count = len(x)
        own = torch.arange(count, device=x.device)[:, None]
        table = torch.cat([neighbours, own], dim=1)  # (N, K + 1)
        used = torch.cat([used, torch.ones_like(own, dtype=torch.bool)], dim=1)
        value = self.linear(x).unflatten(1, (self.heads, -1))  # (N, H, C / H)
        received = (value * self.receiver).sum(2)  # (N, H)
        sent = (value * self.sender).sum(2)
        score = F.leaky_relu(received[:, None] + sent[table], 0.2)  # (N, K + 1, H)
        score = score.masked_fill(~used[..., None], -torch.inf).softmax(dim=1)
        mixed = torch.einsum("nkh,nkhc->nhc", score, value[table])
        return self.activation(mixed.flatten(1) + self.bias)


class Attention(nn.Module):
    """Multi-head attention of A queries to B keys, both without a batch axis.

    Args:
        width: channels of queries and output. context: channels of keys and values.
    """

    def __init__(self, width: int, context: int, heads: int = 4):
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(context, 2 * width)
        self.output = nn.Linear(width, width)

    def forward(
        self, queries: Tensor, context: Tensor, log_mass: Tensor | None = None
    ) -> Tensor:
        """(A, width), (B, context) -> (A, width).

        Args:
            log_mass: (B,) added to the logits: a key that stands for more surface
                counts for more, so that a finer mesh says the same.
        """

        def split(x):
            return x.unflatten(1, (self.heads, -1)).transpose(0, 1)[None]

        key, value = self.key_value(context).chunk(2, dim=1)
        mask = None if log_mass is None else log_mass[None, None, None]
        mixed = F.scaled_dot_product_attention(
            split(self.query(queries)), split(key), split(value), attn_mask=mask
        )
        return self.output(mixed[0].transpose(0, 1).flatten(1))


class FeedForward(nn.Sequential):
    """Two linear layers around a GELU."""

    def __init__(self, width: int, factor: int = 2):
        super().__init__(
            nn.Linear(width, factor * width),
            nn.GELU(),
            nn.Linear(factor * width, width),
        )


class InducedTransformer(nn.Module):
    """A Transformer layer over N nodes through M induced points: O(N M), not O(N^2).

    The points read all nodes, then all nodes read the points. Every island meets the
    points, so eyes and teeth hear from the skin they do not touch. Equation `isab` in
    docs/equations.md; source: Lee et al. 2019, Set Transformer, equation 9.

    Args:
        width: channels C. points: how many induced points M.
    """

    def __init__(self, width: int, points: int = 32, heads: int = 4):
        super().__init__()
        self.points = nn.Parameter(torch.randn(points, width) * 0.5)
        self.gather = Attention(width, width, heads)
        self.spread = Attention(width, width, heads)
        self.feed_points = FeedForward(width)
        self.feed = FeedForward(width)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(4))

    def forward(self, x: Tensor, areas: Tensor) -> Tensor:
        """(N, C), (N,) share of the surface -> (N, C)."""
        normal = self.norms[0](x)
        mass = areas.clamp(min=1e-4).log()
        points = self.points + self.gather(self.points, normal, mass)
        points = points + self.feed_points(self.norms[1](points))
        points = self.norms[2](points)

        def receive(x, normal):
            x = x + self.spread(normal, points)
            return x + self.feed(self.norms[3](x))

        return by_rows(receive, x, normal)


def island_mean(x: Tensor, island: Tensor, areas: Tensor) -> Tensor:
    """(N, C): each node's island's area-weighted mean of x.

    >>> island_mean(torch.tensor([[1.0], [3.0], [7.0]]), torch.tensor([0, 0, 1]),
    ...             torch.tensor([1.0, 1.0, 2.0])).flatten().tolist()
    [2.0, 2.0, 7.0]
    """
    count = int(island.max()) + 1
    mass = areas.clamp(min=1e-4)[:, None]
    heavy = x * mass  # in float32, when autocast has made x smaller
    total = heavy.new_zeros(count, x.shape[1]).index_add(0, island, heavy)
    sums = mass.new_zeros(count, 1).index_add(0, island, mass)
    return (total / sums).index_select(0, island)
