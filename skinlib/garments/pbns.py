"""PBNS: a network from pose to the shape of a garment before its bones move it.

Source: Bertiche, Madadi, Escalera 2021, *PBNS: Physically Based Neural Simulation for
Unsupervised Garment Pose Space Deformation*, ACM TOG 40(6).
"""

from dataclasses import asdict, dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from skinlib.skinning import linear_blend_skinning


@dataclass(frozen=True)
class PBNSConfig:
    """How large the network is, and what it may change."""

    hidden: int = 64  # width of the layers; the source: 32
    embedding: int = 64  # |X|, the number of columns of D: blend shapes; the source: 32
    layers: int = 4
    slope: float = 0.1  # of hidden units that are off; the source: 0, a ReLU
    rounding: float = 0.05  # of the corner of the last ReLU; the source: 0
    learn_weights: bool = True  # blend weights, too; the source: for loose garments


def _unit(slope: float) -> nn.Module:
    return nn.LeakyReLU(slope) if slope else nn.ReLU()


class PBNS(nn.Module):
    """The garment in a pose. Equation `pbns_skinning`, Equation `pbns_psd`.

    A pose becomes an embedding X by a perceptron, X mixes the columns of D into offsets
    of the rest positions, and the bones move what results. D starts at 0: the untrained
    network is linear blend skinning. With the source's units most columns never learn:
    a ReLU that is off in every pose passes nothing on. So hidden units leak, and the
    last ones are softplus: a ReLU with a round corner, more than 0 in every pose.

    Attributes:
        template: (V, 3) garment at rest.
        weights: (V, J) blend weights at the start; those that are 0 stay 0.
        bones: (A,) ids of the bones whose rotations it reads.
        shapes: (K, V, 3) what 1 of each shape of the body adds to the template; K = 0
            for a garment made for one body.
        columns: (|X|, 3 V) the matrix D.
    """

    BUFFERS = ("template", "weights", "bones", "shapes")

    def __init__(
        self,
        template: np.ndarray,
        weights: np.ndarray,
        bones: np.ndarray,
        shapes: np.ndarray,
        config: PBNSConfig | None = None,
    ):
        super().__init__()
        self.config = config or PBNSConfig()
        buffers = (template, weights, bones, shapes)
        for name, array in zip(self.BUFFERS, buffers, strict=True):
            self.register_buffer(name, torch.tensor(array))
        # Three numbers a bone, which way is up, and with shapes how wide it is cut.
        inputs = 3 * len(bones) + 3 + (len(shapes) + 1 if len(shapes) else 0)
        widths = [inputs, *[self.config.hidden] * (self.config.layers - 1)]
        widths.append(self.config.embedding)
        self.embed = nn.Sequential()
        for a, b in pairwise(widths):
            self.embed.append(nn.Linear(a, b)).append(_unit(self.config.slope))
        if self.config.rounding:
            self.embed[-1] = nn.Softplus(beta=1 / self.config.rounding)
        self.columns = nn.Parameter(
            torch.zeros(self.config.embedding, 3 * len(template))
        )
        change = torch.zeros(weights.shape) if self.config.learn_weights else None
        self.weight_change = None if change is None else nn.Parameter(change)

    def describe(self) -> dict:
        """The configuration, as plain numbers."""
        return asdict(self.config)

    @property
    def blend_weights(self) -> Tensor:
        """(V, J), rows >= 0 with sum 1."""
        if self.weight_change is None:
            return self.weights
        return (self.weights.log() + self.weight_change).softmax(-1)

    def baked(self) -> "PBNS":
        """The same garment, its learnt blend weights fixed: quicker to play."""
        config = replace(self.config, learn_weights=False)
        buffers = [getattr(self, name).cpu().numpy() for name in self.BUFFERS]
        network = PBNS(*buffers, config)
        values = self.state_dict() | {"weights": self.blend_weights.detach()}
        values.pop("weight_change", None)
        network.load_state_dict(values)
        return network.eval()

    def inputs(
        self,
        rotations: np.ndarray,
        shape: np.ndarray | None = None,
        ease: np.ndarray | None = None,
    ) -> Tensor:
        """(B, I) what the network reads of a pose: the same however the body faces.

        Args:
            rotations: (B, J, 3) rotation vectors as in a `Motion`; bone 0 is the root.
            shape: (B, K) amounts of the body's shapes; zeros when left out.
            ease: (B,) by how much the cloth is cut wider, 0.1 for 10 %.
        """
        count = len(rotations)
        # Gravity as the root feels it, in place of where the root looks.
        up = Rotation.from_rotvec(rotations[:, 0]).inv().apply([0, 0, 1])
        parts = [rotations[:, self.bones.cpu().numpy()].reshape(count, -1), up]
        if len(self.shapes):
            shape = np.zeros((count, len(self.shapes))) if shape is None else shape
            ease = np.zeros(count) if ease is None else ease
            parts += [shape, 10 * ease[:, None]]
        joined = np.concatenate(parts, axis=1).astype(np.float32)
        return torch.from_numpy(joined).to(self.template.device)

    def offsets(self, inputs: Tensor) -> Tensor:
        """(B, V, 3) offsets at rest: dT = X D."""
        return (self.embed(inputs) @ self.columns).unflatten(-1, (-1, 3))

    def forward(
        self, inputs: Tensor, transforms: Tensor, shape: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Posed vertices and their offsets at rest, (B, V, 3) each.

        Args:
            inputs: (B, I) from `inputs`. transforms: (B, J, 4, 4) of the bones.
            shape: (B, K), the one that is in the inputs, too.
        """
        offsets = self.offsets(inputs)
        rest = self.graded(shape) + offsets
        return linear_blend_skinning(rest, self.blend_weights, transforms), offsets

    def graded(self, shape: Tensor | None) -> Tensor:
        """(V, 3) or (B, V, 3): the garment at rest, cut for a body of another shape."""
        if shape is None or not len(self.shapes):
            return self.template
        return self.template + torch.tensordot(shape, self.shapes, 1)
