"""Step 3: cross-attention from vertices to bones; its softmax is the skin weights."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from skinlib.model.inputs import MeshInput, SkeletonInput
from skinlib.model.layers import Attention, FeedForward

# Distance to the joint, to the segment, log of that, is the normal turned to the joint.
PAIR_FEATURES = 4


def pair_features(
    positions: Tensor, normals: Tensor, skeleton: SkeletonInput
) -> Tensor:
    """(N, J, 4): where each bone lies as seen from each node.

    The distance to the joint, the distance to the bone segment and its logarithm, and
    the cosine between the normal and the way to the joint.
    """
    joints = skeleton.joints
    axis = skeleton.lengths[:, None] * skeleton.directions  # (J, 3)
    squared = (axis**2).sum(1)
    # Not by |p|^2 + |j|^2 - 2 p.j, which is far off where a vertex meets a joint.
    exact = "donot_use_mm_for_euclid_dist"
    to_joint = torch.cdist(positions, joints, compute_mode=exact)  # (N, J)
    # The point of the bone's line nearest to the node, in bone lengths from the joint.
    along = positions @ axis.T - (joints * axis).sum(1)
    along = along / torch.where(squared > 0, squared, 1.0)
    inside = along.clamp(0, 1)
    to_segment = to_joint**2 + squared * inside * (inside - 2 * along)
    to_segment = to_segment.clamp(min=1e-8).sqrt()
    facing = normals @ joints.T - (positions * normals).sum(1, keepdim=True)
    facing = facing / to_joint.clamp(min=1e-3)
    return torch.stack([to_joint, to_segment, (to_segment + 0.02).log(), facing], dim=2)


class CrossAttention(nn.Module):
    """W = softmax_j(q_v . k_j / sqrt(C) + g(v, j)): rows are skin weights.

    Bones first look at the surface, so that a bone's key knows what lies around it. The
    bias g reads the geometry between a vertex and a bone, and both of their features.
    Equation `cross_attention` in docs/equations.md.

    Args:
        mesh_width, bone_width: channels of the two encoders.
        pair_width: hidden channels of g; 0 leaves the geometric bias out.
        chunk: pairs computed at once when no gradient is asked for; few enough to stay
            in a processor's cache, which is many times faster.
    """

    def __init__(
        self,
        mesh_width: int = 128,
        bone_width: int = 128,
        pair_width: int = 32,
        heads: int = 4,
        chunk: int = 16_384,
    ):
        super().__init__()
        self.chunk, self.pair_width = chunk, pair_width
        self.look = Attention(bone_width, mesh_width, heads)
        self.look_norm = nn.LayerNorm(bone_width)
        self.feed = FeedForward(bone_width)
        self.feed_norm = nn.LayerNorm(bone_width)
        self.bone_norm = nn.LayerNorm(bone_width)
        self.query = nn.Linear(mesh_width, mesh_width)
        self.key = nn.Linear(bone_width, mesh_width)
        if pair_width:
            self.pair = nn.Linear(PAIR_FEATURES, pair_width)
            # A linear map of the way from node to joint is one of each of its ends.
            self.pair_vertex = nn.Linear(mesh_width + 3, pair_width, bias=False)
            self.pair_bone = nn.Linear(bone_width + 3, pair_width, bias=False)
            self.pair_out = nn.Sequential(
                nn.ReLU(inplace=True),
                nn.Linear(pair_width, pair_width),
                nn.ReLU(inplace=True),
                nn.Linear(pair_width, 1),
            )

    def forward(
        self,
        vertices: Tensor,
        bones: Tensor,
        mesh: MeshInput,
        skeleton: SkeletonInput,
        nodes: Tensor | None = None,
    ) -> Tensor:
        """(N, mesh_width), (J, bone_width) -> logits (N, J).

        Args:
            nodes: ids of the nodes that are asked for; None asks for all.
        """
        mass = mesh.areas.clamp(min=1e-4).log()
        bones = bones + self.look(self.look_norm(bones), vertices, mass)
        bones = self.bone_norm(bones + self.feed(self.feed_norm(bones)))
        seen = (vertices, mesh.positions, mesh.normals)
        if nodes is not None:
            seen = tuple(part[nodes] for part in seen)
        parts, key = (self.query(seen[0]), *seen), self.key(bones)
        if torch.is_grad_enabled():
            return self._logits(*parts, key, bones, skeleton)
        rows = max(1, self.chunk // len(bones))
        split = zip(*(part.split(rows) for part in parts), strict=True)
        return torch.cat([self._logits(*p, key, bones, skeleton) for p in split])

    def _logits(self, query, vertices, positions, normals, key, bones, skeleton):
        logits = F.linear(query, key) / key.shape[1] ** 0.5
        if not self.pair_width:
            return logits
        pair = self.pair(pair_features(positions, normals, skeleton))  # (N, J, P)
        # In place: each new (N, J, P) array costs more than the sum in it.
        pair += self.pair_vertex(torch.cat([vertices, positions], dim=1))[:, None]
        pair += self.pair_bone(torch.cat([bones, skeleton.joints], dim=1))
        return logits + self.pair_out(pair).squeeze(2)
