"""Which point of the body each point of a garment lies over."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from skinlib.head import Head
from skinlib.skinning import linear_blend_skinning

REACH, NEAR = 0.25, 0.1
"""Metres: body vertices further from a loose garment at rest are no obstacle; and of a
tight one, unless they come near in a pose."""


class Collider(nn.Module):
    """The part of a body that a garment can touch, posed in batches.

    Attributes:
        points: (C, 3) rest positions. weights: (C, J). faces: (F, 3) ids of points.
        vertices: (C,) their ids in the body.
        kept: (K,) which of them are an obstacle; the others are there for the normals.
    """

    def __init__(self, head: Head, vertices: np.ndarray, spacing: float = 0.0):
        """Take the body's vertices with the ids `vertices` (C,).

        Args:
            spacing: metres; of vertices that are closer, one is enough of an obstacle.
        """
        super().__init__()
        place = np.full(len(head.vertices), -1)
        place[vertices] = np.arange(len(vertices))
        faces = place[head.faces]
        faces = faces[(faces >= 0).all(axis=1)]
        self.vertices = vertices
        self.register_buffer("points", torch.tensor(head.vertices[vertices]))
        self.register_buffer("weights", torch.tensor(head.weights[vertices]))
        self.register_buffer("faces", torch.tensor(faces))
        kept = thinned(head.vertices[vertices], spacing)
        self.register_buffer("kept", torch.tensor(kept))

    def pose(
        self, transforms: Tensor, offsets: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Posed points of the obstacle and their unit normals, (B, K, 3) each.

        Args:
            transforms: (B, J, 4, 4). offsets: (B, C, 3), what the body's shape adds.
        """
        points = self.points if offsets is None else self.points + offsets
        posed = linear_blend_skinning(points, self.weights, transforms)
        normals = vertex_normals(posed, self.faces)
        return posed.index_select(1, self.kept), normals.index_select(1, self.kept)


def near(head: Head, points: np.ndarray, reach: float = REACH) -> np.ndarray:
    """(C,) ids of the body's vertices within `reach` metres of the points (V, 3).

    All of them when none is: an obstacle cannot be nothing.
    """
    distance, _ = cKDTree(points).query(head.vertices)
    return np.flatnonzero((distance < reach) | (distance.min() >= reach))


def thinned(points: np.ndarray, spacing: float) -> np.ndarray:
    """(K,) ids of points (C, 3), none of which is closer than `spacing` to another.

    The first one of a cluster stays.

    >>> thinned(np.array([[0, 0, 0], [1, 0, 0], [1.5, 0, 0], [9, 0, 0]]), 1.2).tolist()
    [0, 2, 3]
    """
    if not spacing:
        return np.arange(len(points))
    around = cKDTree(points).query_ball_point(points, spacing)
    left = np.ones(len(points), bool)
    for i, others in enumerate(around):
        if left[i]:
            left[others] = False
            left[i] = True
    return np.flatnonzero(left)


def reached(
    head: Head,
    points: np.ndarray,
    weights: np.ndarray,
    transforms: np.ndarray,
    reach: float,
) -> np.ndarray:
    """(C,) ids of the body's vertices that come near cloth in one of T poses.

    At rest a hand is far from a shirt; when somebody reaches across the chest it is an
    obstacle as any other.

    Args:
        points: (V, 3) the cloth at rest. weights: (V, J), which skin it meanwhile.
        transforms: (T, J, 4, 4). reach: metres.
    """
    distance = np.full(len(head.vertices), np.inf)
    for transform in transforms:
        cloth = linear_blend_skinning(points, weights, transform)
        body = linear_blend_skinning(head.vertices, head.weights, transform)
        tree = cKDTree(cloth, balanced_tree=False, compact_nodes=False)
        # What has been near already need not be asked again.
        open_ones = np.flatnonzero(distance >= reach)
        found, _ = tree.query(body[open_ones], distance_upper_bound=reach)
        distance[open_ones] = found
    return np.flatnonzero(distance < reach)


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """(B, V, 3) unit normals, of faces weighted by their areas.

    Args:
        vertices: (B, V, 3). faces: (F, 3).
    """
    # A vertex of all poses is one row of memory, and x, y, z are runs: the quickest.
    points = vertices.permute(1, 2, 0).contiguous()  # (V, 3, B)
    a, b, c = (points.index_select(0, corner) for corner in faces.unbind(1))
    (ux, uy, uz), (vx, vy, vz) = (b - a).unbind(1), (c - a).unbind(1)
    # Twice the area long, so that large faces count more.
    cross = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    normals = torch.stack(cross, dim=1)  # (F, 3, B)
    sums = torch.zeros_like(points)
    for corner in range(3):
        sums = sums.index_add(0, faces[:, corner], normals)
    x, y, z = sums.unbind(1)
    length = (x * x + y * y + z * z + 1e-24).sqrt()  # written out: a norm is slow here
    return (sums / length[:, None]).permute(2, 0, 1)


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
