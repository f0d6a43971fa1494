"""How far skinned cloth is from the truth, without skinning it.

Rest shape and weights never change, so every vertex is a fixed linear function of the
bones' matrices, and the sum of the squared errors a quadratic one. A training step that
needs nothing else of the vertices can do without them.

Symbols: V vertices, E edges, C bones, T frames.
"""

import numpy as np
import torch
from scipy.sparse import coo_matrix, eye_array, vstack
from torch import Tensor, nn

from skinlib.geometry import mesh_edges


class SkinningError(nn.Module):
    """Mean squared error of vertices, and of the vectors along edges, per frame.

    e = 1/V sum_i |v_i - g_i|^2 + k/E sum_e |(v_a - v_b) - (g_a - g_b)|^2

    Equation `hybrid_skinning`, its loss. With A X the scaled vertices and edges in a
    frame, X (4C, 3) the bones' matrices, G the true ones and A = Q R,

    e = |A X - G|^2 = |R X - Q^T G|^2 + |G|^2 - |Q^T G|^2.

    R has 4C rows instead of V + E; the last two terms are what no bones could mend.

    Attributes:
        reduced: (4C, 4C) R. goals: (T, 4C, 3) Q^T G. beyond: (T,) m^2, the last terms.

    Args:
        rest: (V, 3). weights: (V, C). faces: (F, 3).
        truth: (T, V, 3), in the frame in which the bones' matrices are.
        edges: k, 0 or more.
    """

    reduced: Tensor
    goals: Tensor
    beyond: Tensor

    def __init__(
        self,
        rest: np.ndarray,
        weights: np.ndarray,
        faces: np.ndarray,
        truth: np.ndarray,
        edges: float = 0.0,
    ):
        super().__init__()
        scaled = _vertices_and_edges(len(rest), faces, edges)
        homogeneous = np.concatenate([rest, np.ones((len(rest), 1))], axis=1)
        basis = weights[:, :, None].astype(np.float64) * homogeneous[:, None]
        q, r = np.linalg.qr(scaled @ basis.reshape(len(rest), -1))
        back = scaled.T @ q  # (V, 4C): Q^T G = back^T g
        goals, beyond = [], []
        for frame in truth:
            goals.append(back.T @ frame)
            whole = np.square(scaled @ frame).sum()
            beyond.append(max(whole - np.square(goals[-1]).sum(), 0))
        tensors = {"reduced": r, "goals": np.stack(goals), "beyond": np.stack(beyond)}
        for name, array in tensors.items():
            self.register_buffer(name, torch.tensor(array, dtype=torch.float32))

    def forward(self, transforms: Tensor, frames: Tensor) -> Tensor:
        """(...) m^2 for each of the frames, differentiable.

        Args:
            transforms: (..., C, 4, 4) from rest. frames: (...) their numbers.
        """
        columns = (
            transforms[..., :3, :].swapaxes(-1, -2).flatten(-3, -2)
        )  # (..., 4C, 3)
        off = self.reduced @ columns - self.goals[frames]
        return off.square().sum((-2, -1)) + self.beyond[frames]


def _vertices_and_edges(count: int, faces: np.ndarray, edges: float):
    """Sparse (V + E, V): the vertices over sqrt(V), the edges times sqrt(k / E)."""
    vertices = eye_array(count) / count**0.5
    a, b = mesh_edges(faces).T
    if not edges or not len(a):
        return vertices.tocsr()
    rows = np.arange(len(a))
    length = (edges / len(a)) ** 0.5
    values = np.repeat([length, -length], len(a))
    places = np.concatenate([rows, rows]), np.concatenate([a, b])
    along = coo_matrix((values, places), (len(a), count))
    return vstack([vertices, along]).tocsr()
