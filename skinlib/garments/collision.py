"""Which point of the body each point of a garment lies over."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from skinlib.head import Head
from skinlib.skinning import linear_blend_skinning

REACH = 0.25
"""Metres: body vertices further from the garment at rest are no obstacle."""


class Collider(nn.Module):
    """The part of a body that a garment can touch, posed in batches.

    Attributes:
        points: (C, 3) rest positions. weights: (C, J). faces: (F, 3) ids of points.
        vertices: (C,) their ids in the body.
    """

    def __init__(self, head: Head, vertices: np.ndarray):
        """Take the body's vertices with the ids `vertices` (C,)."""
        super().__init__()
        place = np.full(len(head.vertices), -1)
        place[vertices] = np.arange(len(vertices))
        faces = place[head.faces]
        faces = faces[(faces >= 0).all(axis=1)]
        self.vertices = vertices
        self.register_buffer("points", torch.tensor(head.vertices[vertices]))
        self.register_buffer("weights", torch.tensor(head.weights[vertices]))
        self.register_buffer("faces", torch.tensor(faces))

    def pose(
        self, transforms: Tensor, offsets: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Posed points and their unit normals, (B, C, 3) each.

        Args:
            transforms: (B, J, 4, 4). offsets: (B, C, 3), what the body's shape adds.
        """
        points = self.points if offsets is None else self.points + offsets
        posed = linear_blend_skinning(points, self.weights, transforms)
        return posed, vertex_normals(posed, self.faces)


def near(head: Head, points: np.ndarray, reach: float = REACH) -> np.ndarray:
    """(C,) ids of the body's vertices within `reach` metres of the points (V, 3).

    All of them when none is: an obstacle cannot be nothing.
    """
    distance, _ = cKDTree(points).query(head.vertices)
    return np.flatnonzero((distance < reach) | (distance.min() >= reach))


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """(B, V, 3) unit normals, of faces weighted by their areas.

    Args:
        vertices: (B, V, 3). faces: (F, 3).
    """
    a, b, c = vertices[:, faces].unbind(2)
    # Twice the area long, so that large faces count more.
    normals = torch.linalg.cross(b - a, c - a)
    sums = torch.zeros_like(vertices)
    for corner in range(3):
        sums = sums.index_add(1, faces[:, corner], normals)
    return nn.functional.normalize(sums, dim=-1, eps=1e-12)


def nearest(points: Tensor, body: Tensor) -> Tensor:
    """(B, V) ids of the body vertices (B, C, 3) nearest to the points (B, V, 3).

    By k-d tree, one a pose, built anew: 1 ms and 2,000 points take another. What is
    not finite gets some id: the energies tell.
    """
    points, bodies = (np.nan_to_num(x.detach().cpu().numpy()) for x in (points, body))

    def search(pair):
        tree = cKDTree(pair[1], balanced_tree=False, compact_nodes=False)
        return tree.query(pair[0])[1]

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        found = np.stack(list(pool.map(search, zip(points, bodies, strict=True))))
    return torch.from_numpy(found).to(body.device)


def take(values: Tensor, ids: Tensor) -> Tensor:
    """(B, V, 3): rows `ids` (B, V) of `values` (B, C, 3)."""
    return values.gather(1, ids[..., None].expand(-1, -1, 3))
