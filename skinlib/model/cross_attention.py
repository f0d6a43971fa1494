"""Step 3: cross-attention from vertices to bones; its softmax is the skin weights."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from skinlib.model.inputs import MeshInput, SkeletonInput
from skinlib.model.layers import Attention, FeedForward

# Offset to the joint, distance to the joint, to the segment, log of that, is the normal
# turned to the joint.
PAIR_FEATURES = 3 + 1 + 1 + 1 + 1


def pair_features(
    positions: Tensor, normals: Tensor, skeleton: SkeletonInput
) -> Tensor:
    """(N, J, 7): where each bone lies as seen from each node.

    The offset to the joint (3), the distance to it, the distance to the bone segment
    and its logarithm, and the cosine between the normal and the way to the joint.
    """
    offset = skeleton.joints[None] - positions[:, None]  # (N, J, 3)
    axis = skeleton.lengths[:, None] * skeleton.directions  # (J, 3)
    squared = (axis**2).sum(1)
    along = -(offset * axis).sum(2) / torch.where(squared > 0, squared, 1.0)
    nearest = offset + along.clamp(0, 1)[..., None] * axis
    to_segment = nearest.norm(dim=2)
    to_joint = offset.norm(dim=2)
    facing = (offset * normals[:, None]).sum(2) / to_joint.clamp(min=1e-6)
    scalars = [to_joint, to_segment, (to_segment + 0.02).log(), facing]
    return torch.cat([offset, torch.stack(scalars, dim=2)], dim=2)


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
        chunk: int = 32_768,
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
            self.pair_vertex = nn.Linear(mesh_width, pair_width, bias=False)
            self.pair_bone = nn.Linear(bone_width, pair_width, bias=False)
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
        pair += self.pair_vertex(vertices)[:, None]
        pair += self.pair_bone(bones)
        return logits + self.pair_out(pair).squeeze(2)
