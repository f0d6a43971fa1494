"""The critics: how much do these skin weights look like painted ones?"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from skinlib.model.cross_attention import PAIR_FEATURES, pair_features
from skinlib.model.inputs import MeshInput, SkeletonInput
from skinlib.model.layers import EdgeConv
from skinlib.model.mesh_encoder import MESH_FEATURES, mesh_features
from skinlib.model.skeleton_encoder import SkeletonEncoder

POOLED = 256  # channels of the whole head, as the source writes


@dataclass(frozen=True)
class CriticConfig:
    """What a critic reads and how large it is; D_s and D_u are two of the same."""

    width: int = 32  # channels after the first graph convolution
    form: str = "any"  # "any" number and order of bones, or the source's "fixed" one
    bones: int | None = None  # J of the fixed form
    bone_width: int = 16  # channels of a bone feature
    neighbours: int = 8  # how many each node hears, mesh edges first

    def __post_init__(self):
        if self.form not in ("any", "fixed"):
            raise ValueError(f"form is {self.form!r}: use any or fixed")
        if (self.form == "fixed") != (self.bones is not None):
            raise ValueError(
                f"form is {self.form!r} and bones is {self.bones}: the fixed form, and "
                "only that one, needs the number of bones"
            )


class Critic(nn.Module):
    """A score of skin weights on a head: two graph convolutions, a mean, two layers.

    A node reads the features of the mesh, the mean of the bone features, and its
    weights. In the fixed form these are J columns as they are. In the form for any J
    they are what the weights expect: of the bone features, of the geometry between
    node and bone, and of the weight itself. No sigmoid, so the score has no bounds.
    Equation `critic` in docs/equations.md.

    Raises:
        ValueError: weights of another shape than (nodes, bones), or, in the fixed
            form, another number of bones than the configuration's.
    """

    def __init__(self, config: CriticConfig | None = None):
        super().__init__()
        self.config = config = config or CriticConfig()
        self.bones = SkeletonEncoder(config.bone_width, layers=1)
        columns = config.bones or config.bone_width + PAIR_FEATURES + 1
        columns += MESH_FEATURES + config.bone_width
        self.surface = EdgeConv(columns, config.width, nn.LeakyReLU(0.2))
        self.space = EdgeConv(config.width, POOLED, nn.LeakyReLU(0.2))
        self.score = nn.Sequential(
            nn.Linear(POOLED, 128), nn.LeakyReLU(0.2), nn.Linear(128, 1)
        )

    def forward(
        self, mesh: MeshInput, skeleton: SkeletonInput, weights: Tensor
    ) -> Tensor:
        """N nodes, J bones, (N, J) -> ()."""
        return self.on(mesh, skeleton)(weights)

    def on(
        self, mesh: MeshInput, skeleton: SkeletonInput
    ) -> Callable[[Tensor], Tensor]:
        """The critic of one head, a function of (N, J) weights alone.

        What does not depend on the weights is computed once.
        """
        shape = len(mesh.positions), len(skeleton.joints)
        fixed = self.config.form == "fixed"
        if fixed and shape[1] != self.config.bones:
            raise ValueError(
                f"the skeleton has {shape[1]} bones and the critic was made for "
                f"{self.config.bones}: use form='any' for heads with different bones"
            )
        bones = self.bones(skeleton)  # (J, B)
        pooled = bones.mean(dim=0).expand(shape[0], -1)
        known = torch.cat([mesh_features(mesh), pooled], dim=1)
        heard = slice(self.config.neighbours)
        on_surface, in_space = mesh.mesh_neighbours[:, heard], mesh.neighbours[:, heard]
        pairs = None
        if not fixed:
            pairs = pair_features(mesh.positions, mesh.normals, skeleton)  # (N, J, 4)

        def judge(weights: Tensor) -> Tensor:
            if weights.shape != shape:
                raise ValueError(
                    f"weights are {tuple(weights.shape)}, nodes and bones {shape}: "
                    "give one row a node, weights[vertex_of_node]"
                )
            if fixed:
                columns = [known, weights]
            else:
                expected = torch.einsum("nj,njf->nf", weights, pairs)
                square = weights.square().sum(dim=1, keepdim=True)
                columns = [known, weights @ bones, expected, square]
            x = self.surface(torch.cat(columns, dim=1), on_surface)
            x = self.space(x, in_space)  # (N, 256)
            return self.score(x.mean(dim=0)).squeeze()

        return judge
