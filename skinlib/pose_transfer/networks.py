"""Networks that give one mesh the pose of another: DSFFNet and the two before it.

Each reads the vertices of a source, whose pose it takes, and of an identity, whose
shape it keeps: two sets of points that share neither count nor order, each centred and
scaled to [-1, 1]. Nothing but sums and maxima goes over vertices, so no order matters.

Sources: DSFFNet: the project's second text, and equations (1) to (3) of its arXiv
version of 2023. NPT: Wang et al. 2020, *Neural Pose Transfer by Spatially Adaptive
Instance Normalization*, CVPR. 3D-CoreNet: Song et al. 2021, *3D Pose Transfer with
Correspondence Learning and Mesh Refinement*, NeurIPS.

Symbols: B batch, N vertices of the identity, M of the source, C channels. Features are
(B, C, N), points (B, N, 3) at the door and (B, 3, N) behind it. Equation ids are those
of docs/equations.md.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import pairwise
from math import isfinite

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.parametrizations import spectral_norm

from skinlib.head import HeadError

COLUMNS = 16_384  # vertices computed at once when no gradient is asked for

LARGEST_PLAN = 500_000_000  # entries of an optimal transport plan: 2 GB

LEAST_EPSILON = 0.025  # a smaller one takes exp(-2 / epsilon) out of float32

EPS = 1e-5  # in the root of a variance, as in InstanceNorm1d


# --- what they share ------------------------------------------------------------------


def _check_points(
    source: Tensor,
    identity: Tensor,
    source_share: Tensor | None,
    share: Tensor | None,
) -> None:
    """Fit for a network, or `HeadError`.

    A captured or compiled step cannot look at its numbers, and is not checked for NaN.
    """
    both = {"source": (source, source_share), "identity": (identity, share)}
    for name, (points, part) in both.items():
        if points.dim() != 3 or points.shape[2] != 3:
            raise HeadError(name, f"shape {tuple(points.shape)}", "give (B, N, 3)")
        if points.shape[1] < 2:
            raise HeadError(
                name,
                f"{points.shape[1]} vertices, and fewer than two have no spread to "
                "normalise by",
                "give two or more",
            )
        if part is not None and part.shape != points.shape[:2]:
            raise HeadError(
                "share",
                f"shape {tuple(part.shape)} for the {name}'s {tuple(points.shape)}",
                "give one number for each vertex",
            )
    if len(source) != len(identity) or not len(source):
        raise HeadError(
            "source",
            f"a batch of {len(source)} for {len(identity)} identities",
            "give one source for each identity",
        )
    if torch.compiler.is_compiling() or (
        source.is_cuda and torch.cuda.is_current_stream_capturing()
    ):
        return
    for name, points in {"source": source, "identity": identity}.items():
        if not points.isfinite().all():
            bad = int((~points.isfinite()).sum())
            raise HeadError(
                name, f"{bad} coordinates are NaN or infinite", "give finite points"
            )


def _counted(share: Tensor | None, by_area: bool) -> Tensor | None:
    """What `instance_norm` counts the vertices by."""
    if by_area and share is None:
        raise HeadError(
            "share",
            "it is absent, and the network counts each vertex by its area",
            "give vertex_shares(points, faces), or set by_area=False",
        )
    return share if by_area else None


def _check_channels(name: str, channels: int, factor: int = 1) -> None:
    if channels < factor or channels % factor:
        raise HeadError(name, f"it is {channels}", f"give a multiple of {factor}")


def _by_columns(function: Callable[..., Tensor], *features: Tensor) -> Tensor:
    """`function(*features)`, some vertices at a time when no gradient is asked for.

    Only for functions that treat each vertex by itself. The memory for what is in
    between does not grow with the mesh then.
    """
    if torch.is_grad_enabled() or features[0].shape[-1] <= COLUMNS:
        return function(*features)
    parts = zip(*(x.split(COLUMNS, dim=-1) for x in features), strict=True)
    return torch.cat([function(*part) for part in parts], dim=-1)


def _affine(weight: Tensor, bias: Tensor, x: Tensor) -> Tensor:
    """(B, C, N): W x + b, for (C, I), (B or 1, C, 1) and (B, I, N)."""
    return torch.baddbmm(bias, weight.expand(len(x), -1, -1), x)


def _mixed(conv: nn.Conv1d, code: Tensor) -> tuple[Tensor, Tensor]:
    """(C, 3) and (B, C, 1 or N): what `conv` on [code; v] does to v, and its bias.

    W [z; v] + b = W_v v + (W_z z + b): a code that all vertices share is multiplied
    once, not once a vertex, and never written down N times.
    """
    weight, channels = conv.weight[..., 0], code.shape[1]
    return weight[:, channels:], _affine(
        weight[:, :channels], conv.bias[:, None].expand(len(code), -1, -1), code
    )


def instance_norm(h: Tensor, share: Tensor | None = None) -> Tensor:
    """(B, C, N): (h - mean) / std of each channel over the vertices.

    Vertices are dense where a mesh was made so, and their mean is the mesh's as much as
    the shape's. With each vertex counted by its share of the surface the mean is the
    surface's. Equation `instance_norm`.

    Args:
        h: (B, C, N). share: (B, N), sums to 1; all the same when absent.

    >>> h = torch.tensor([[[0.0, 0, 0, 4]]])  # three vertices at one place
    >>> share = torch.tensor([[1.0, 1, 1, 3]]) / 6
    >>> instance_norm(h, share).round()
    tensor([[[-1., -1., -1.,  1.]]])
    """
    if share is None:
        return F.instance_norm(h, eps=EPS)
    share = share[..., None]
    centred = h - h @ share
    return centred * (centred.square() @ share + EPS).rsqrt()


class PoseNetwork(nn.Module):
    """What all of them are given, and what they give."""

    def describe(self) -> dict:
        """The configuration, as plain values."""
        return asdict(self.config)

    def forward(
        self,
        source: Tensor,
        identity: Tensor,
        source_share: Tensor | None = None,
        share: Tensor | None = None,
    ) -> Tensor:
        """(B, N, 3) the identity in the pose of the source, in the identity's order.

        Args:
            source: (B, M, 3), identity: (B, N, 3), each in [-1, 1].
            source_share: (B, M), share: (B, N): which part of the surface is around
                each vertex, `vertex_shares`; needed if the configuration says
                `by_area`, and else not read.

        Raises:
            HeadError: fewer than two vertices, which instance normalisation cannot
                tell from their mean; NaN; shapes that do not fit; no shares, if needed;
                what one of the networks alone cannot do.
        """
        _check_points(source, identity, source_share, share)
        return self._posed(source, identity, source_share, share)


class PoseEncoder(nn.Module):
    """(B, 3, M) -> (B, width, M): three times convolution, `instance_norm`, ReLU.

    Args:
        first: channels of the first group; the second has twice as many.
        width: channels of the last.
    """

    def __init__(self, first: int, width: int):
        super().__init__()
        channels = pairwise((3, first, 2 * first, width))
        self.convs = nn.ModuleList(nn.Conv1d(a, b, 1) for a, b in channels)

    def forward(self, x: Tensor, share: Tensor | None = None) -> Tensor:
        """share: (B, M), as for `instance_norm`."""
        for conv in self.convs:
            x = instance_norm(conv(x), share).relu_()
        return x


# --- SPAdaIN and FFAdaIN --------------------------------------------------------------


class SPAdaIN(nn.Module):
    """Scale and shift each vertex by where it is on the identity.

    h' = gamma(v) (h - mean) / std + delta(v); mean and std of each channel over the
    vertices, gamma and delta linear in v

    Equation `spadain`; source: NPT.

    Args:
        channels: C. normalise: without, h is only scaled and shifted.
    """

    def __init__(self, channels: int, normalise: bool = True):
        super().__init__()
        self.normalise = normalise
        self.gamma = nn.Conv1d(3, channels, 1)
        self.delta = nn.Conv1d(3, channels, 1)

    def sides(self, code: Tensor) -> tuple[Tensor, ...]:
        """(C, 3) and (B or 1, C, 1) that make gamma of v, then two that make delta."""
        gamma, delta = self.gamma, self.delta
        return (
            *(gamma.weight[..., 0], gamma.bias[None, :, None]),
            *(delta.weight[..., 0], delta.bias[None, :, None]),
        )

    def forward(
        self,
        h: Tensor,
        points: Tensor,
        code: Tensor,
        share: Tensor | None = None,
        then: Callable[[Tensor], Tensor] = lambda x: x,
    ) -> Tensor:
        """(B, C', N): `then` of h', computed some vertices at a time.

        Args:
            h: (B, C, N). points: (B, 3, N). code: (B, Z, 1), which only FFAdaIN reads.
            share: (B, N), as for `instance_norm`.
            then: maps (B, C, n) to (B, C', n), each vertex by itself.
        """
        scale, scale_bias, shift, shift_bias = self.sides(code)

        def modulate(h, points):
            gamma = _affine(scale, scale_bias, points)
            delta = _affine(shift, shift_bias, points)
            return then(torch.addcmul(delta, gamma, h))

        h = instance_norm(h, share) if self.normalise else h
        return _by_columns(modulate, h, points)


class FFAdaIN(SPAdaIN):
    """SPAdaIN with a second side, which knows the pose.

    gamma = alpha gamma_mix([z; v]) + (1 - alpha) gamma_id(v), delta likewise with beta;
    z: the pose code

    Instance normalisation takes away every constant of a channel, and what a code that
    all vertices share adds to a channel is one: from here on the pose comes in again.
    Both sides are linear in v, and so is their sum: all of them cost one product with
    a (C, 3) matrix. Equation `ffadain`.

    Attributes:
        alpha, beta: learnt, not bounded; None without the identity's side.

    Args:
        channels: C. code: Z, length of the pose code.
        alpha_init: alpha and beta at the start. With 0 no gradient reaches the encoder
            in the first step.
        target_side: without, gamma is gamma_mix and delta is delta_mix.
    """

    def __init__(
        self,
        channels: int,
        code: int,
        alpha_init: float = 0.0,
        target_side: bool = True,
    ):
        super().__init__(channels)
        self.gamma_mix = nn.Conv1d(code + 3, channels, 1)
        self.delta_mix = nn.Conv1d(code + 3, channels, 1)
        self.alpha = self.beta = None
        if target_side:
            self.alpha = nn.Parameter(torch.tensor(float(alpha_init)))
            self.beta = nn.Parameter(torch.tensor(float(alpha_init)))
        else:
            self.gamma = self.delta = None

    def sides(self, code: Tensor) -> tuple[Tensor, ...]:
        mixed = (*_mixed(self.gamma_mix, code), *_mixed(self.delta_mix, code))
        if self.alpha is None:
            return mixed
        shares = (self.alpha, self.alpha, self.beta, self.beta)
        own = super().sides(code)
        return tuple(
            a + share * (b - a) for share, a, b in zip(shares, own, mixed, strict=True)
        )


class FFAdaINBlock(nn.Module):
    """x1 + x2 with x1 = conv(ReLU(norm(h))) and x2 = conv(ReLU(norm(x1))).

    No path leads from h past the first convolution.

    Args:
        first, second: `FFAdaIN`, or `SPAdaIN` in the first ablation.
    """

    def __init__(self, channels: int, first: SPAdaIN, second: SPAdaIN):
        super().__init__()
        self.first, self.second = first, second
        self.conv1 = nn.Conv1d(channels, channels, 1)
        self.conv2 = nn.Conv1d(channels, channels, 1)

    def forward(
        self, h: Tensor, points: Tensor, code: Tensor, share: Tensor | None = None
    ) -> Tensor:
        """(B, C, N), (B, 3, N), (B, Z, 1), (B, N) -> (B, C, N)."""
        x1 = self.first(h, points, code, share, lambda x: self.conv1(x.relu_()))
        x2 = self.second(x1, points, code, share, lambda x: self.conv2(x.relu_()))
        return x1 + x2


@dataclass(frozen=True)
class DSFFNetConfig:
    """How large DSFFNet is, and what an ablation takes out of it.

    Raises:
        HeadError: a width that is no multiple of 4, an encoder below 1, or an
            `alpha_init` that is NaN.
    """

    width: int = 1024  # of the pose code and the middle block; the others: a quarter
    encoder: int = 64  # channels of the encoder's first group
    alpha_init: float = 0.0  # of alpha and beta, as in the source
    spadain_first: bool = False  # in each block, SPAdaIN in place of the first FFAdaIN
    target_side: bool = True  # the side of FFAdaIN that reads the identity alone
    by_area: bool = True  # means over the surface; the source: over the vertices

    def __post_init__(self):
        _check_channels("width", self.width, 4)
        _check_channels("encoder", self.encoder)
        if not isfinite(self.alpha_init):
            raise HeadError("alpha_init", f"it is {self.alpha_init}", "give a number")

    @classmethod
    def narrow(cls, **changes) -> "DSFFNetConfig":
        """A fifteenth of the parameters, for a few hundred vertices on a processor."""
        return cls(**{"width": 256, "encoder": 32} | changes)


class DSFFNet(PoseNetwork):
    """The pose as one code, the identity moved by it, and the code put in six times.

    The encoder makes a code of the source, the largest value of each channel over the
    vertices. The decoder starts at the vertices of the identity; all it knows of the
    pose comes through the sides of `FFAdaIN`. The output is within [-2, 2].
    """

    def __init__(self, config: DSFFNetConfig | None = None):
        super().__init__()
        self.config = config = config or DSFFNetConfig()
        wide, thin = config.width, config.width // 4
        self.encoder = PoseEncoder(config.encoder, wide)
        self.convs = nn.ModuleList(
            nn.Conv1d(a, b, 1)
            for a, b in ((3, thin), (thin, wide), (wide, thin), (thin, 3))
        )
        self.blocks = nn.ModuleList(self._block(c) for c in (thin, wide, thin))

    def _block(self, channels: int) -> FFAdaINBlock:
        config = self.config

        def fused():
            return FFAdaIN(
                channels, config.width, config.alpha_init, config.target_side
            )

        first = SPAdaIN(channels) if config.spadain_first else fused()
        return FFAdaINBlock(channels, first, fused())

    def mixing(self) -> Tensor:
        """(L, 2) alpha and beta of each FFAdaIN, in the order of the layers.

        >>> DSFFNet(DSFFNetConfig.narrow(alpha_init=0)).mixing().tolist()[0]
        [0.0, 0.0]
        """
        pairs = [
            torch.stack([layer.alpha, layer.beta])
            for layer in self.modules()
            if isinstance(layer, FFAdaIN) and layer.alpha is not None
        ]
        return torch.stack(pairs).detach() if pairs else torch.zeros(0, 2)

    def encode(self, source: Tensor, share: Tensor | None = None) -> Tensor:
        """(B, Z, 1) the code of a pose, from (B, M, 3) and (B, M)."""
        share = _counted(share, self.config.by_area)
        return self.encoder(source.mT, share).amax(dim=2, keepdim=True)

    def _posed(self, source, identity, source_share, share):
        return self.decode(self.encode(source, source_share), identity, share)

    def decode(
        self, code: Tensor, identity: Tensor, share: Tensor | None = None
    ) -> Tensor:
        """(B, N, 3) the identity, (B, N, 3), in the pose of a code, (B, Z, 1).

        A code need not come from a mesh: any mixture of two is one.
        """
        share = _counted(share, self.config.by_area)
        points = identity.mT.contiguous()
        h = points
        for conv, block in zip(self.convs, self.blocks, strict=False):
            h = block(conv(h), points, code, share)
        return (2 * self.convs[-1](h).tanh()).mT


# --- NPT ------------------------------------------------------------------------------


class SPAdaINBlock(nn.Module):
    """Two SPAdaIN, ReLU and convolution, beside one, which goes past them.

    Args:
        normalise: False in the first block after a pooled code; see `NPT`.
    """

    def __init__(self, channels: int, normalise: bool):
        super().__init__()
        self.norms = nn.ModuleList(SPAdaIN(channels, normalise) for _ in range(3))
        self.convs = nn.ModuleList(nn.Conv1d(channels, channels, 1) for _ in range(3))

    def forward(
        self, h: Tensor, points: Tensor, code: Tensor, share: Tensor | None = None
    ) -> Tensor:
        """(B, C, N), (B, 3, N), (B, Z, 1 or N), (B, N) -> (B, C, N)."""

        def step(index, x):
            conv = self.convs[index]
            return self.norms[index](x, points, code, share, lambda x: conv(x.relu_()))

        return step(1, step(0, h)) + step(2, h)


@dataclass(frozen=True)
class NPTConfig:
    """How large NPT is, and which of its two encoders it has.

    Raises:
        HeadError: a width that is no multiple of 4, or an encoder below 1.
    """

    width: int = 1024  # of the pose code
    encoder: int = 64  # channels of the encoder's first group
    pool: bool = True  # one code a mesh; else one a vertex, and then M has to be N
    by_area: bool = False  # means over the surface; the paper: over the vertices

    def __post_init__(self):
        _check_channels("width", self.width, 4)
        _check_channels("encoder", self.encoder)

    @classmethod
    def narrow(cls, **changes) -> "NPTConfig":
        """A fifteenth of the parameters, for a few hundred vertices on a processor."""
        return cls(**{"width": 256, "encoder": 32} | changes)


class NPT(PoseNetwork):
    """The pose through the decoder, the identity from its side.

    The decoder starts at the mixed feature [z; v]. With a pooled code the first block
    does not normalise: that would take the code out again (`SPAdaIN`).

    With `pool=False` the i-th code meets the i-th vertex of the identity, whatever the
    order of either, as in the first of the paper's two networks.
    """

    def __init__(self, config: NPTConfig | None = None):
        super().__init__()
        self.config = config = config or NPTConfig()
        self.encoder = PoseEncoder(config.encoder, config.width)
        mixed = config.width + 3
        widths = (mixed, mixed, mixed // 2, mixed // 4, 3)
        self.convs = nn.ModuleList(nn.Conv1d(a, b, 1) for a, b in pairwise(widths))
        self.blocks = nn.ModuleList(
            SPAdaINBlock(channels, normalise=index > 0 or not config.pool)
            for index, channels in enumerate(widths[1:4])
        )

    def encode(self, source: Tensor, share: Tensor | None = None) -> Tensor:
        """(B, Z, 1), or (B, Z, M) where not pooled, from (B, M, 3) and (B, M)."""
        share = _counted(share, self.config.by_area)
        codes = self.encoder(source.mT, share)
        return codes.amax(dim=2, keepdim=True) if self.config.pool else codes

    def _posed(self, source, identity, source_share, share):
        if not self.config.pool and source.shape != identity.shape:
            raise HeadError(
                "source",
                f"{source.shape[1]} vertices for {identity.shape[1]} of the identity, "
                "and codes that are not pooled",
                "give as many, or set pool",
            )
        code, points = self.encode(source, source_share), identity.mT.contiguous()
        share = _counted(share, self.config.by_area)
        weight, bias = _mixed(self.convs[0], code)
        h = _affine(weight, bias, points)
        h = self.blocks[0](h, points, code, share)
        for conv, block in zip(self.convs[1:], self.blocks[1:], strict=False):
            h = block(conv(h), points, code, share)
        return (2 * self.convs[-1](h).tanh()).mT


# --- 3D-CoreNet -----------------------------------------------------------------------


def cosine_correlation(a: Tensor, b: Tensor) -> Tensor:
    """(B, N, M) cosines between the columns of (B, C, N) and (B, C, M).

    >>> a = torch.tensor([[[3.0, 0], [4, 1]]])
    >>> cosine_correlation(a, a).tolist()
    [[[1.0, 0.800000011920929], [0.800000011920929, 1.0]]]
    """
    return F.normalize(a, dim=1).mT @ F.normalize(b, dim=1)


def optimal_transport(
    correlation: Tensor, epsilon: float = 0.03, iterations: int = 5
) -> Tensor:
    """(B, N, M), rows that sum to 1: what each vertex of the identity corresponds to.

    diag(a) K diag(b) with K = exp((C - 1) / epsilon), by turns scaled so that rows and
    columns hold the same mass each (Sinkhorn), at last the rows

    Equation `optimal_transport`.

    Args:
        correlation: (B, N, M) in [-1, 1].
        epsilon: how soft; at least 0.025, or K leaves the range of float32.
        iterations: 0 for a softmax of each row.

    Raises:
        HeadError: an epsilon too small, or more than `LARGEST_PLAN` entries.

    Both rows like the first column best, but it has no more mass than the second:

    >>> likes = torch.tensor([[[1.0, 0.9], [1.0, 0.7]]])
    >>> optimal_transport(likes, 0.1, iterations=0).round(decimals=2)
    tensor([[[0.7300, 0.2700],
             [0.9500, 0.0500]]])
    >>> optimal_transport(likes, 0.1, iterations=50).round(decimals=2)
    tensor([[[0.2700, 0.7300],
             [0.7300, 0.2700]]])
    """
    if not (isfinite(epsilon) and epsilon >= LEAST_EPSILON):
        raise HeadError("epsilon", f"it is {epsilon}", f"give {LEAST_EPSILON} or more")
    _check_plan(*correlation.shape)
    kernel = ((correlation - 1) / epsilon).exp()
    rows, columns = correlation.shape[1:]
    a = kernel.new_full((len(kernel), rows, 1), 1 / rows)
    b = kernel.new_ones(len(kernel), columns, 1)
    for step in range(iterations):
        if step:
            a = 1 / rows / (kernel @ b + 1e-8)
        # The floor keeps a vertex that nothing resembles from overflowing.
        b = 1 / columns / (kernel.mT @ a + 1e-8)
    plan = kernel * b.mT
    return plan / plan.sum(dim=2, keepdim=True)


def _check_plan(batch: int, rows: int, columns: int) -> None:
    if batch * rows * columns > LARGEST_PLAN:
        raise HeadError(
            "vertices",
            f"a plan of {batch} x {rows} x {columns} entries",
            f"keep it below {LARGEST_PLAN:,}, with fewer vertices or a smaller batch",
        )


class ElaIN(nn.Module):
    """Instance normalisation that weighs its own statistics against the identity.

    h' = (1 + gamma) (h - mean) / std + delta, gamma = w gamma_id + (1 - w) std,
    delta = w delta_id + (1 - w) mean; w of each channel from the means of both

    Equation `elain`.

    Args:
        channels: C of h. side: channels of the identity's features.
    """

    def __init__(self, channels: int, side: int):
        super().__init__()
        self.align = nn.Conv1d(side, channels, 1)
        self.gamma = nn.Conv1d(channels, channels, 1)
        self.delta = nn.Conv1d(channels, channels, 1)
        self.weigh = nn.Conv1d(2 * channels, channels, 1)

    def forward(self, h: Tensor, features: Tensor) -> Tensor:
        """(B, C, N), (B, side, N) -> (B, C, N)."""
        side = self.align(features)
        mean = h.mean(dim=2, keepdim=True)
        std = (h.var(dim=2, keepdim=True, correction=0) + EPS).sqrt()
        means = torch.cat([side.mean(dim=2, keepdim=True), mean], dim=1)
        weight = self.weigh(means)
        gamma = torch.addcmul(1 + (1 - weight) * std, weight, self.gamma(side))
        delta = torch.addcmul((1 - weight) * mean, weight, self.delta(side))
        return torch.addcmul(delta, gamma, F.instance_norm(h, eps=EPS))


class ElaINBlock(nn.Module):
    """Two ElaIN, LeakyReLU and convolution, beside one, which goes past them.

    The convolutions are divided by their largest singular value (Miyato et al. 2018,
    *Spectral Normalization for Generative Adversarial Networks*, ICLR).
    """

    def __init__(self, channels: int, side: int):
        super().__init__()
        self.norms = nn.ModuleList(ElaIN(channels, side) for _ in range(3))
        self.convs = nn.ModuleList(
            spectral_norm(nn.Conv1d(channels, channels, 1, bias=bias))
            for bias in (True, True, False)
        )

    def forward(self, h: Tensor, features: Tensor) -> Tensor:
        """(B, C, N), (B, side, N) -> (B, C, N)."""

        def step(index, x):
            x = self.norms[index](x, features)
            return self.convs[index](F.leaky_relu(x, 0.2, inplace=True))

        return step(1, step(0, h)) + step(2, h)


class _FeatureBlock(nn.Module):
    """Conv, IN, PReLU, conv, IN, added to what came in; one slope for both PReLU."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv1 = nn.Conv1d(channels, channels, 1)
        self.conv2 = nn.Conv1d(channels, channels, 1)
        self.act = nn.PReLU()

    def forward(self, x: Tensor) -> Tensor:
        y = self.act(F.instance_norm(self.conv1(x), eps=EPS))
        return self.act(x + F.instance_norm(self.conv2(y), eps=EPS))


@dataclass(frozen=True)
class CoreNetConfig:
    """How large 3D-CoreNet is, and how it matches vertices.

    Raises:
        HeadError: a width that is no multiple of 16, or an epsilon below 0.025.
    """

    width: int = 1024  # of the first block; then a half, a quarter; features: a quarter
    epsilon: float = 0.03  # of the optimal transport
    iterations: int = 5

    def __post_init__(self):
        _check_channels("width", self.width, 16)
        if not (isfinite(self.epsilon) and self.epsilon >= LEAST_EPSILON):
            raise HeadError(
                "epsilon", f"it is {self.epsilon}", f"give {LEAST_EPSILON} or more"
            )

    @classmethod
    def narrow(cls, **changes) -> "CoreNetConfig":
        """A fifteenth of the parameters, for a few hundred vertices on a processor."""
        return cls(**{"width": 256} | changes)


class CoreNet(PoseNetwork):
    """Match the vertices, carry the source over, then refine: 3D-CoreNet.

    Optimal transport between features says which source vertices each vertex of the
    identity corresponds to; their mean is the warped mesh, and a decoder with `ElaIN`
    makes the identity of it. Time and memory go with N x M.

    The authors' first layer of the decoder reaches over three neighbours in the list of
    vertices, which has no meaning in shuffled meshes; here it takes one at a time.
    """

    def __init__(self, config: CoreNetConfig | None = None):
        super().__init__()
        self.config = config = config or CoreNetConfig()
        wide, side = config.width, config.width // 4
        self.features = nn.Sequential(nn.Conv1d(3, side // 4, 1))
        for channels in (side // 4, side // 2):
            self.features.append(nn.InstanceNorm1d(channels, eps=EPS))
            self.features.append(nn.LeakyReLU(0.2))
            self.features.append(nn.Conv1d(channels, 2 * channels, 1))
        self.features.append(nn.InstanceNorm1d(side, eps=EPS))
        self.refine = nn.Sequential(*(_FeatureBlock(side) for _ in range(4)))
        self.match_identity = nn.Conv1d(side, side, 1)
        self.match_source = nn.Conv1d(side, side, 1)
        widths = (wide, wide, wide // 2, side, 3)
        self.start = nn.Conv1d(3, wide, 1)
        self.convs = nn.ModuleList(nn.Conv1d(a, b, 1) for a, b in pairwise(widths))
        self.blocks = nn.ModuleList(ElaINBlock(c, side) for c in widths[1:4])

    def embed(self, points: Tensor) -> Tensor:
        """(B, width / 4, N) features of each vertex, from (B, N, 3)."""
        return self.refine(F.normalize(self.features(points.mT), dim=1))

    def correspond(self, source: Tensor, identity: Tensor) -> tuple[Tensor, Tensor]:
        """(B, N, M) plan, rows that sum to 1, and (B, side, N) identity features."""
        # Half precision is off by 0.004 in a cosine, a lot beside epsilon.
        with torch.autocast(source.device.type, enabled=False):
            features = self.embed(identity)
            correlation = cosine_correlation(
                self.match_identity(features), self.match_source(self.embed(source))
            )
            config = self.config
            plan = optimal_transport(correlation, config.epsilon, config.iterations)
        return plan, features

    def _posed(self, source, identity, source_share, share):
        _check_plan(len(source), identity.shape[1], source.shape[1])
        plan, features = self.correspond(source, identity)
        h = self.start((plan @ source).mT)
        for conv, block in zip(self.convs, self.blocks, strict=False):
            h = block(conv(h), features)
        return (2 * self.convs[-1](h).tanh()).mT


NETWORKS = {
    "dsffnet": (DSFFNet, DSFFNetConfig),
    "npt": (NPT, NPTConfig),
    "corenet": (CoreNet, CoreNetConfig),
}
"""A network and its configuration, by the name that files and the command line use."""


def parameter_kb(network: nn.Module) -> float:
    """KB of 1024 bytes that the parameters take, in float32 4 bytes each.

    >>> round(parameter_kb(NPT()))
    23652
    """
    return sum(p.numel() * p.element_size() for p in network.parameters()) / 1024
