"""Step 2: the skeleton encoder, a Tree-GNN from J bones to one feature vector each."""

import torch
from torch import Tensor, nn

from skinlib.model.inputs import SkeletonInput

# Joint, direction, length, offset from the parent, is it a root, is it a leaf.
BONE_FEATURES = 3 + 3 + 1 + 3 + 1 + 1
MAX_DEPTH = 16


def bone_features(skeleton: SkeletonInput) -> Tensor:
    """(J, 12): what is known of each bone by itself."""
    parents, joints = skeleton.parents, skeleton.joints
    root = parents < 0
    above = parents.clamp(min=0)
    offset = torch.where(root[:, None], 0.0, joints - joints[above])
    leaf = torch.ones_like(root)
    leaf[above[~root]] = False
    flags = torch.stack([root, leaf], dim=1).to(joints)
    length = skeleton.lengths[:, None]
    return torch.cat([joints, skeleton.directions, length, offset, flags], dim=1)


class TreeConv(nn.Module):
    """b_j' = b_j + MLP[b_j, b_parent, mean over children b_c, mean over all bones].

    A root reads zeros from above, a leaf zeros from below. Equation `treegnn` in
    docs/equations.md.

    Args:
        width: channels C.
    """

    def __init__(self, width: int):
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.message = nn.Sequential(
            nn.Linear(4 * width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )

    def forward(self, bones: Tensor, parents: Tensor) -> Tensor:
        """(J, C), (J,) -> (J, C)."""
        normal = self.norm(bones)
        child = parents >= 0
        above = parents.clamp(min=0)
        from_parent = torch.where(child[:, None], normal[above], 0.0)
        sent = child.to(normal)[:, None]
        total = torch.zeros_like(normal).index_add(0, above, normal * sent)
        number = torch.zeros_like(sent).index_add(0, above, sent)
        from_children = total / number.clamp(min=1)
        everyone = normal.mean(dim=0, keepdim=True).expand_as(normal)
        heard = torch.cat([normal, from_parent, from_children, everyone], dim=1)
        return bones + self.message(heard)


class SkeletonEncoder(nn.Module):
    """Bone features and a depth embedding, then Tree-GNN layers.

    Permuting the bones permutes the rows of the output and changes nothing else.

    Args:
        width: channels of the output, 64 to 256 in the source.
    """

    def __init__(self, width: int = 128, layers: int = 4):
        super().__init__()
        self.embed = nn.Sequential(
            nn.Linear(BONE_FEATURES, width), nn.GELU(), nn.Linear(width, width)
        )
        self.depth = nn.Embedding(MAX_DEPTH, width)
        self.layers = nn.ModuleList(TreeConv(width) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, skeleton: SkeletonInput) -> Tensor:
        """J bones -> (J, C)."""
        depth = skeleton.depths.clamp(max=MAX_DEPTH - 1)
        bones = self.embed(bone_features(skeleton)) + self.depth(depth)
        for layer in self.layers:
            bones = layer(bones, skeleton.parents)
        return self.norm(bones)
