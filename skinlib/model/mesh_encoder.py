"""Step 1: the mesh encoder, from a hybrid graph to one feature vector a vertex."""

import torch
from torch import Tensor, nn

from skinlib.graph import MESH
from skinlib.model.inputs import MeshInput
from skinlib.model.layers import (
    EdgeConv,
    GraphAttention,
    InducedTransformer,
    island_mean,
)

# Position, normal, curvature, normal deviation, log of the area, valence.
MESH_FEATURES = 3 + 3 + 1 + 1 + 1 + 1


def mesh_features(mesh: MeshInput) -> Tensor:
    """(N, 10): what is known of each node by itself.

    Position, normal, curvature and normal deviation; how finely and how regularly the
    artist meshed the place: the logarithm of the node's area, and its valence.
    """
    scalars = [
        mesh.curvature,
        mesh.deviation,
        mesh.areas.clamp(min=1e-3).log(),
        mesh.valence.clamp(-4, 8) / 2,
    ]
    scalars = torch.stack(scalars, dim=1)
    return torch.cat([mesh.positions, mesh.normals, scalars], dim=1)


class MeshEncoder(nn.Module):
    """Graph layers for the neighbourhood, induced points for the whole head.

    Each of `blocks` blocks is two graph layers, the mean of the island, and one
    Transformer layer that is linear in the number of nodes.

    Args:
        width: channels C of the output, 128 to 512 in the source.
        convolution: "edgeconv" or "gat".
    """

    def __init__(
        self,
        width: int = 128,
        blocks: int = 3,
        points: int = 32,
        heads: int = 4,
        convolution: str = "edgeconv",
    ):
        super().__init__()
        if convolution not in ("edgeconv", "gat"):
            raise ValueError(f"convolution is {convolution!r}: use edgeconv or gat")
        self.convolution = convolution
        self.embed = nn.Sequential(
            nn.Linear(MESH_FEATURES, width), nn.GELU(), nn.Linear(width, width)
        )
        self.local = nn.ModuleList(self._layer(width, heads) for _ in range(2 * blocks))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2 * blocks))
        self.pooled = nn.ModuleList(nn.Linear(width, width) for _ in range(blocks))
        self.wide = nn.ModuleList(
            InducedTransformer(width, points, heads) for _ in range(blocks)
        )
        self.norm = nn.LayerNorm(width)

    def _layer(self, width, heads):
        if self.convolution == "gat":
            return GraphAttention(width, width, heads)
        return EdgeConv(width, width)

    def forward(self, mesh: MeshInput) -> Tensor:
        """N nodes -> (N, C)."""
        # The first layer of a block hears the surface alone, the second one space too.
        heard = (
            (mesh.mesh_neighbours, mesh.kinds == MESH),
            (mesh.neighbours, mesh.used),
        )
        x = self.embed(mesh_features(mesh))
        for i, (pool, wide) in enumerate(zip(self.pooled, self.wide, strict=True)):
            for layer, table in enumerate(heard, start=2 * i):
                table = table if self.convolution == "gat" else table[:1]
                x = x + self.local[layer](self.norms[layer](x), *table)
            x = x + pool(island_mean(x, mesh.island, mesh.areas))
            x = wide(x, mesh.areas)
        return self.norm(x)
