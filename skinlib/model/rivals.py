"""Two published ideas for skin weights, to train on the same heads and to compare with.

Both were written anew from the papers. They read the inputs of `SkinningModel` and are
trained, saved and loaded as it is. Both have about as many parameters as it has.
"""

from dataclasses import dataclass, field

import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from skinlib.graph import GraphConfig
from skinlib.model.cross_attention import pair_features
from skinlib.model.inputs import MeshInput, SkeletonInput
from skinlib.model.layers import (
    Attention,
    EdgeConv,
    FeedForward,
    InducedTransformer,
    by_rows,
    gather_max,
)
from skinlib.model.skinning_model import SkinningModel

FLOOR = -20.0  # logit of a bone that gets nothing: 2e-9 of the weight, finite slopes
LINK_FEATURES = 3 + 3 + 1 + 1  # two ends, closeness, is the bone a leaf
CLOSE = 0.05  # in head radii, the distance at which closeness is 1/2
TIE = 1e-4  # in head radii, what decides between bones at the same distance


@dataclass(frozen=True)
class RigNetConfig:
    """The sizes of `RigNetSkinning`."""

    near: int = 5  # bones that share a vertex' weight, as in the paper
    width: int = 224  # channels of a graph convolution
    pooled: int = 448  # channels of the whole head
    hidden: int = 384  # channels of the last layers
    hops: int = 3  # how far the geodesic ball reaches, in edges
    graph: GraphConfig = field(default_factory=GraphConfig)  # how the graph is built


class RigNetSkinning(SkinningModel):
    """The skinning network of RigNet: each vertex picks among its nearest bones.

    A vertex reads its position and, nearest first, the `near` bones: both ends,
    closeness, and whether the bone is a leaf. Three graph convolutions over mesh edges
    and a geodesic ball, and a maximum over the whole head, give one logit for each of
    these bones. All others get nothing, whatever the artist gave them.

    Source: Xu et al. 2020, RigNet: neural rigging for articulated characters. As there,
    links go from a joint to each of its children, and weight goes to the joint. Changed
    in its favour: the K nearest are joints, each with its nearest link, not links, of
    which one joint may own all (with K = 5 and Rocketbox heads, 13 % of the artists'
    weight is out of reach of the nearest links, 1 % out of reach of the joints). For
    the size: half to a quarter of the channels, one linear layer in each EdgeConv. For
    batches of one head: LayerNorm for batch norm. Also: a ball of `hops` edges instead
    of a radius; 0.05 / (0.05 + d) for 1 / d, which has no bounds; and d is the straight
    distance: training moves mesh and bones in each step, and ways through voxels take
    seconds a head (for inference alone they took 2 % off the error). Joints that
    coincide differ by their order alone.
    """

    config: RigNetConfig

    def __init__(self, config: RigNetConfig | None = None):
        nn.Module.__init__(self)  # the use of SkinningModel, without its parts
        self.config = config = config or RigNetConfig()
        width, pooled, hidden = config.width, config.pooled, config.hidden
        self.embed = nn.Sequential(
            nn.Linear(3 + LINK_FEATURES * config.near, 128),
            nn.ReLU(),
            nn.Linear(128, 64),
            nn.LayerNorm(64),
            nn.ReLU(),
        )
        self.graphs = nn.ModuleList(
            TwoGraphs(inputs, width, config.hops) for inputs in (64, width, width)
        )
        self.whole = nn.Sequential(
            nn.Linear(width, width), nn.ReLU(), nn.Linear(width, pooled)
        )
        # One linear layer of the vertex and of the whole head, in two parts.
        self.own = nn.Linear(width, hidden)
        self.common = nn.Linear(pooled, hidden, bias=False)
        self.pick = nn.Sequential(
            nn.LayerNorm(hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden // 2),
            nn.ReLU(),
            nn.Linear(hidden // 2, config.near),
        )

    def node_logits(
        self, mesh: MeshInput, skeleton: SkeletonInput, nodes: Tensor | None = None
    ) -> Tensor:
        """(N, J) logits of the graph's nodes, or of some; `FLOOR` for far bones."""
        bones, links = near_bones(mesh.positions, skeleton, self.config.near)
        missing = self.config.near - bones.shape[1]
        links = nn.functional.pad(links, (0, 0, 0, missing)).flatten(1)
        x = self.embed(torch.cat([mesh.positions, links], dim=1))
        x = self.graphs[0](x, mesh)
        common = self.common(by_rows(self.whole, x).amax(dim=0))
        for layer in self.graphs[1:]:
            x = layer(x, mesh)
        if nodes is not None:
            x, bones = x[nodes], bones[nodes]
        logits = by_rows(lambda x: self.pick(self.own(x) + common), x)
        logits = logits[:, : bones.shape[1]].log_softmax(dim=1)
        every = logits.new_full((len(x), len(skeleton.joints)), FLOOR)
        return every.scatter(1, bones, logits)


@torch.no_grad()
def near_bones(
    positions: Tensor, skeleton: SkeletonInput, count: int
) -> tuple[Tensor, Tensor]:
    """(N, K) ids of each node's nearest bones, nearest first, and (N, K, 8) features.

    K is `count`, or J when that is less. The features are those of the bone's nearest
    link: the two ends, 0.05 / (0.05 + distance), and 1 for a leaf.
    """
    parents, joints = skeleton.parents, skeleton.joints
    children = torch.nonzero(parents >= 0).flatten()
    leaves = torch.ones(len(joints), dtype=torch.bool, device=joints.device)
    leaves[parents[children]] = False
    owner = torch.cat([parents[children], torch.nonzero(leaves).flatten()])  # (L,)
    start = joints[owner]
    end = torch.cat([joints[children], skeleton.tails[leaves]])
    leaf = leaves[owner].to(joints)[:, None]
    axis = end - start
    squared = (axis**2).sum(dim=1)

    def rows(positions):
        way = positions[:, None] - start  # (N, L, 3)
        along = (way * axis).sum(dim=2) / torch.where(squared > 0, squared, 1.0)
        distance = (way - along.clamp(0, 1)[:, :, None] * axis).norm(dim=2)
        # Links meet in joints, and a head has two sides, so distances are often equal.
        # Rounding is not to choose then: the shorter link, the bone further from the
        # root, and at last the place of the joint do.
        order = distance + TIE * squared.sqrt()
        bone = order.new_full((len(way), len(joints)), torch.inf)
        bone = bone.scatter_reduce(1, owner.expand_as(order), order, "amin")
        bone = bone - TIE * (skeleton.depths + joints.sum(dim=1))
        ids = bone.topk(min(count, len(joints)), largest=False).indices  # (N, K)
        others = owner != ids[:, :, None]  # (N, K, L)
        link = order[:, None].masked_fill(others, torch.inf).argmin(dim=2)
        close = CLOSE / (CLOSE + distance.gather(1, link))[:, :, None]
        return ids, torch.cat([start[link], end[link], close, leaf[link]], dim=2)

    ids, features = zip(*(rows(part) for part in positions.split(1024)), strict=True)
    return torch.cat(ids), torch.cat(features)


class TwoGraphs(nn.Module):
    """RigNet's graph convolution: EdgeConv on mesh edges beside one on a geodesic ball.

    Args:
        inputs, outputs: channels; `outputs` is even.
        hops: radius of the ball, in edges.
    """

    def __init__(self, inputs: int, outputs: int, hops: int):
        super().__init__()
        self.hops = hops
        self.mesh = EdgeConv(inputs, outputs // 2)
        self.ball_own = nn.Linear(inputs, outputs // 2)
        self.ball_sent = nn.Linear(inputs, outputs // 2, bias=False)
        self.mix = nn.Sequential(
            nn.LayerNorm(outputs), nn.Linear(outputs, outputs), nn.ReLU()
        )

    def forward(self, x: Tensor, mesh: MeshInput) -> Tensor:
        """N nodes, (N, inputs) -> (N, outputs)."""
        sent = self.ball_sent(x)
        # The maximum over a ball is a maximum over neighbours, again and again.
        for _ in range(self.hops):
            sent = torch.maximum(sent, gather_max(sent, mesh.neighbours))
        ball = torch.relu(self.ball_own(x) + sent)
        near = self.mesh(x, mesh.mesh_neighbours)
        return by_rows(lambda *x: self.mix(torch.cat(x, dim=1)), near, ball)


@dataclass(frozen=True)
class PointTransformerConfig:
    """The sizes of `PointTransformer`."""

    width: int = 96  # channels of a point and of a bone
    blocks: int = 3  # of the point encoder
    near: int = 12  # nearest points that a point hears, itself among them
    patch: int = 64  # points that attend to each other
    points: int = 32  # induced points, for the whole head
    bone_layers: int = 1  # of the bones' transformer
    frequencies: int = 4  # of the sines that encode a position; the last is 2^(n-1)
    heads: int = 4  # attention heads inside the encoders
    scores: int = 8  # attention heads between points and bones
    hidden: int = 32  # channels of the layer that turns scores into a logit
    graph: GraphConfig = field(default_factory=GraphConfig)  # only its seams are used


class PointTransformer(SkinningModel):
    """UniRig's skinning: a point transformer, and attention from points to bones.

    Vertices are points with normals; of the faces no more is read than each vertex'
    share of the surface, which stands for the even sampling of the source. A block of
    the encoder hears the nearest points, then attends within patches of a space-filling
    curve, then to the whole head through induced points. Bones, as heads and tails,
    attend to each other and to the points. Scores of several attention heads and the
    distance between point and bone become one logit.

    Sources: Zhang et al. 2025, One model to rig them all (UniRig); Wu et al. 2024,
    Point Transformer V3. Changed: the sparse convolution over voxels, which carries
    positions, is an EdgeConv over nearest points; induced points stand for the pooling
    of the U-Net; the points are the vertices, so nothing is copied back to them; the
    distance is the straight one instead of that through voxels.
    """

    config: PointTransformerConfig

    def __init__(self, config: PointTransformerConfig | None = None):
        nn.Module.__init__(self)  # the use of SkinningModel, without its parts
        self.config = config = config or PointTransformerConfig()
        width, heads = config.width, config.heads
        point = 3 * (1 + 2 * config.frequencies)

        def embed(inputs):
            return nn.Sequential(
                nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width)
            )

        self.embed, self.embed_bone = embed(point + 3), embed(2 * point)
        self.local = nn.ModuleList(EdgeConv(width, width) for _ in range(config.blocks))
        self.patches = nn.ModuleList(
            PatchAttention(width, config.patch, heads) for _ in range(config.blocks)
        )
        self.wide = nn.ModuleList(
            InducedTransformer(width, config.points, heads)
            for _ in range(config.blocks)
        )
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(config.blocks))
        self.norm = nn.LayerNorm(width)
        self.bones = nn.ModuleList(
            BoneLayer(width, heads) for _ in range(config.bone_layers)
        )
        self.bone_norm = nn.LayerNorm(width)
        self.query, self.key = nn.Linear(width, width), nn.Linear(width, width)
        self.logit = nn.Sequential(
            nn.Linear(config.scores + 2, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, 1),
        )

    def node_logits(
        self, mesh: MeshInput, skeleton: SkeletonInput, nodes: Tensor | None = None
    ) -> Tensor:
        """(N, J) logits of the points, or of some."""
        positions, normals = mesh.positions, mesh.normals
        x = self._encode(positions)
        x = by_rows(self.embed, torch.cat([x, normals], dim=1))
        near = nearest_points(positions, self.config.near)
        layers = zip(self.local, self.norms, self.patches, self.wide, strict=True)
        for i, (local, norm, patches, wide) in enumerate(layers):
            x = x + local(norm(x), near)
            x = patches(x, curve_order(positions, i))
            x = wide(x, mesh.areas)
        x = self.norm(x)

        ends = (skeleton.joints, skeleton.tails)
        bones = self.embed_bone(torch.cat([self._encode(p) for p in ends], dim=1))
        mass = mesh.areas.clamp(min=1e-4).log()
        for layer in self.bones:
            bones = layer(bones, x, mass)
        key = self._split(self.key(self.bone_norm(bones)))  # (J, H, C / H)
        if nodes is not None:
            x, positions, normals = x[nodes], positions[nodes], normals[nodes]

        def rows(x, positions, normals):
            query = self._split(self.query(x))
            scores = torch.einsum("nhc,jhc->njh", query, key) / key.shape[2] ** 0.5
            distance = pair_features(positions, normals, skeleton)[..., 1:3]
            return self.logit(torch.cat([scores, distance], dim=2)).squeeze(2)

        return by_rows(rows, x, positions, normals)

    def _split(self, x):
        return x.unflatten(1, (self.config.scores, -1))

    def _encode(self, positions):
        """(N, 3) -> (N, 3 (1 + 2 frequencies)): positions, sines and cosines."""
        scale = 2.0 ** torch.arange(self.config.frequencies, device=positions.device)
        angle = (positions[:, :, None] * scale).flatten(1)
        return torch.cat([positions, angle.sin(), angle.cos()], dim=1)


class BoneLayer(nn.Module):
    """A Transformer layer: bones attend to each other, then to the points.

    Args:
        width: channels C of both.
    """

    def __init__(self, width: int, heads: int = 4):
        super().__init__()
        self.each_other = Attention(width, width, heads)
        self.look = Attention(width, width, heads)
        self.feed = FeedForward(width)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(3))

    def forward(self, bones: Tensor, points: Tensor, log_mass: Tensor) -> Tensor:
        """(J, C), (N, C), (N,) logarithm of each point's surface -> (J, C)."""
        normal = self.norms[0](bones)
        bones = bones + self.each_other(normal, normal)
        bones = bones + self.look(self.norms[1](bones), points, log_mass)
        return bones + self.feed(self.norms[2](bones))


class PatchAttention(nn.Module):
    """A Transformer layer in which points attend to their own stretch of a curve.

    Linear in the number of points. Source: Wu et al. 2024, Point Transformer V3.

    Args:
        width: channels C. patch: points on a stretch.
    """

    def __init__(self, width: int, patch: int = 64, heads: int = 4):
        super().__init__()
        self.patch, self.heads = patch, heads
        self.inputs = nn.Linear(width, 3 * width)
        self.output = nn.Linear(width, width)
        self.feed = FeedForward(width)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))

    def forward(self, x: Tensor, order: Tensor) -> Tensor:
        """(N, C), (N,) ids of the points along the curve -> (N, C)."""
        count = len(x)
        parts = -(-count // self.patch)
        # Stretches of almost the same length; a short one ends with a point twice.
        first = torch.arange(parts, device=x.device) * count // parts
        size = -(-count // parts)
        places = first[:, None] + torch.arange(size, device=x.device)  # (P, S)
        after = torch.cat([first[1:], first.new_tensor([count])])[:, None]
        used = places < after
        table = order[places.clamp(max=count - 1)]
        inputs = self.inputs(self.norms[0](x))[table]  # (P, S, 3 C)
        inputs = inputs.unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        mixed = scaled_dot_product_attention(*inputs, attn_mask=used[:, None, None])
        mixed = mixed.transpose(1, 2).flatten(2)[used]  # (N, C) along the curve
        x = x + self.output(torch.zeros_like(x).index_copy(0, order, mixed))
        return x + by_rows(lambda x: self.feed(self.norms[1](x)), x)


def curve_order(positions: Tensor, variant: int = 0) -> Tensor:
    """(N,) ids of points along a Z-order curve, on which neighbours stay together.

    Args:
        positions: (N, 3) in head radii. variant: shifts the grid and turns the axes,
            so that stretches of the curve end elsewhere.
    """
    shifted = positions.double().roll(variant, dims=1) + 0.37 * variant
    cells = ((shifted + 8) * 2**12).long().clamp(0, 2**16 - 1)
    code = torch.zeros_like(cells[:, 0])
    for bit in range(16):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return code.argsort(stable=True)


def nearest_points(positions: Tensor, count: int) -> Tensor:
    """(N, K) int64 ids of the nearest points, itself among them; K <= `count`."""
    points = positions.cpu().numpy()
    _, near = cKDTree(points).query(points, k=range(1, min(count, len(points)) + 1))
    return torch.from_numpy(near).to(positions.device)
