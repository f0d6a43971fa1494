"""Clothes drafted on a body at rest.

A T-shirt, trousers and a jacket are level sets of a distance to the body, cut where a
hem would be. The distance is taken not to the skin but to the body with its hollows
filled, as far as a ball of radius `bridge` does not reach into them: cloth does not
follow a navel. (The closing of the body by that ball, in the words of morphology.) Such
a level set is nowhere closer to the skin than its own offset, and two of one `bridge`
nowhere closer to each other than their offsets differ. A skirt is drafted ring by ring.

The body has to be in metres, Z up, facing -Y, and to have the bones of the shipped one.
"""

from typing import NamedTuple

import igl
import numpy as np
from scipy.sparse import coo_matrix
from scipy.spatial import ConvexHull, cKDTree
from trimesh.intersections import slice_faces_plane
from trimesh.remesh import subdivide

from skinlib.garments.garment import Garment, boundary_loops, pin_boundary
from skinlib.geometry import islands, mesh_edges, vertex_areas, weld
from skinlib.head import Head, HeadError

CELL = 0.01  # of the grid on which distances are sampled, metres
ARM = ("upperarm01", "upperarm02", "lowerarm01", "lowerarm02", "wrist")
LEG = ("upperleg01", "upperleg02", "lowerleg01", "lowerleg02", "foot")
SIDES = (".L", ".R")
SHIRT_BRIDGE = 0.04  # of shirt and jacket: the same, so that they stay apart


def t_shirt(head: Head, vertices: int = 1900) -> Garment:
    """A T-shirt, 12 mm off the body, with nothing pinned: it hangs on the shoulders.

    Args:
        head: a body at rest.
        vertices: about how many the garment gets.

    Raises:
        HeadError: the body has no weights, or lacks a bone of the shipped one.
    """
    draft = _Draft(head)
    hem, top = draft.joint("spine05")[2] - 0.07, draft.joint("head")[2]
    surface = draft.level_set(hem, top, offset=0.012, bridge=SHIRT_BRIDGE)
    keep = np.minimum.reduce(
        [
            draft.outside_neck(surface, radius=0.095),
            surface.vertices[:, 2] - hem,
            draft.before(surface, ARM, "upperarm01", "lowerarm01", share=0.6),
        ]
    )
    return _sewn(_cut(surface, keep), vertices, "t_shirt")


def jacket(head: Head, vertices: int = 2600) -> Garment:
    """A jacket, closed in front, to wear over `t_shirt`: 10 mm outside of it.

    Long sleeves; nothing is pinned. Arguments and errors as for `t_shirt`.
    """
    draft = _Draft(head)
    hem, top = draft.joint("spine05")[2] - 0.05, draft.joint("head")[2]
    surface = draft.level_set(hem, top, offset=0.022, bridge=SHIRT_BRIDGE)
    keep = np.minimum.reduce(
        [
            draft.outside_neck(surface, radius=0.105),
            surface.vertices[:, 2] - hem,
            draft.before(surface, ARM, "lowerarm02", "wrist", share=0.8),
        ]
    )
    return _sewn(_cut(surface, keep), vertices, "jacket")


def trousers(head: Head, vertices: int = 2400) -> Garment:
    """Long trousers, 12 mm off the body, with a pinned waist.

    Arguments and errors as for `t_shirt`.
    """
    draft = _Draft(head)
    waist, ankle = draft.waist(), draft.joint("foot.L")[2]
    surface = draft.level_set(ankle, waist, offset=0.012, bridge=0.02)
    keep = np.minimum(
        waist - surface.vertices[:, 2],
        draft.before(surface, LEG, "lowerleg02", "foot", share=0.75),
    )
    return pin_boundary(_sewn(_cut(surface, keep), vertices, "trousers"))


def skirt(
    head: Head,
    length: float = 0.7,
    flare: float = 0.3,
    rings: int = 26,
    segments: int = 54,
) -> Garment:
    """A long skirt with a pinned waist: rings round the legs, 12 mm off or more.

    Each ring encloses the convex hull of the body at its height and is no narrower than
    the ring above it.

    Args:
        head: a body at rest.
        length: from waist to hem, metres.
        flare: by how much the radius grows at least on a metre of length, metres.
        rings: how many there are, 2 or more.
        segments: vertices in each, 8 or more.

    Raises:
        HeadError: the body has no weights, or lacks a bone of the shipped one; a
            measure is out of its range.
    """
    for name, value, least in (
        ("length", length, 0.05),
        ("flare", flare, 0),
        ("rings", rings, 2),
        ("segments", segments, 8),
    ):
        if not least <= value < np.inf:
            raise HeadError(name, f"it is {value:g}", f"give at least {least:g}")
    draft = _Draft(head)
    heights = np.linspace(draft.waist(), draft.waist() - length, rings)
    angles = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    ways = np.column_stack([np.cos(angles), np.sin(angles)])
    near = max(0.6 * length / (rings - 1), 0.012)  # no part of the body is left out
    torso = draft.vertices[~draft.on_limb(draft.weights, ARM)]
    centre = torso[np.abs(torso[:, 2] - heights[0]) < near, :2].mean(axis=0)
    radii = np.zeros((rings, segments))
    for ring, height in enumerate(heights):
        level = torso[np.abs(torso[:, 2] - height) < near, :2] - centre
        if len(level) > 2:
            radii[ring] = _reach(level, ways)
    radii = np.maximum.accumulate(radii, axis=0) + 0.012
    radii = np.maximum(radii, radii[0] + flare * (heights[0] - heights)[:, None])
    vertices = np.zeros((rings, segments, 3))
    vertices[..., :2] = centre + radii[..., None] * ways
    vertices[..., 2] = heights[:, None]

    ids = np.arange(rings * segments).reshape(rings, segments)
    a, b = ids[:-1], np.roll(ids[:-1], -1, axis=1)
    c, d = ids[1:], np.roll(ids[1:], -1, axis=1)
    # Diagonals take turns, or the cloth would be stiffer one way round.
    even = (np.indices(a.shape).sum(axis=0) % 2 == 0)[..., None]
    first = np.where(even, np.stack([a, c, b], -1), np.stack([a, c, d], -1))
    second = np.where(even, np.stack([b, c, d], -1), np.stack([a, d, b], -1))
    faces = np.stack([first, second], axis=2).reshape(-1, 3)
    waist = ids.ravel() < segments
    return Garment.create(vertices.reshape(-1, 3), faces, waist, "skirt")


PATTERNS = {f.__name__: f for f in (t_shirt, trousers, skirt, jacket)}


class _Surface(NamedTuple):
    vertices: np.ndarray  # (N, 3) metres
    faces: np.ndarray  # (M, 3)


class _Draft:
    """A body at rest, and what is measured on it."""

    def __init__(self, head: Head):
        if head.weights is None:
            raise HeadError("weights", "the body has none", "skin it first")
        self.vertices = head.vertices.astype(np.float64)
        self.faces, self.weights = head.faces, head.weights
        self.skeleton = head.skeleton

    def bone(self, name: str) -> int:
        """The id of a bone."""
        if name not in self.skeleton.names:
            raise HeadError(
                "bone_names",
                f"the body has no bone {name!r}",
                "draft on the shipped body, or name the bones as they are there",
            )
        return self.skeleton.names.index(name)

    def joint(self, name: str) -> np.ndarray:
        """(3,) float64: where a bone begins."""
        return self.skeleton.joints[self.bone(name)].astype(np.float64)

    def waist(self) -> float:
        """The height where trousers and skirts begin, metres."""
        return float(self.joint("spine04")[2] + 0.02)

    def level_set(
        self, low: float, high: float, offset: float, bridge: float
    ) -> _Surface:
        """All points `offset` away from the filled body, from one height to another.

        The surface reaches a little further, so that there is something to cut off.
        """
        wide = offset + bridge
        margin = wide + 3 * CELL
        start = self.vertices.min(axis=0) - margin
        stop = self.vertices.max(axis=0) + margin
        start[2], stop[2] = max(start[2], low - margin), min(stop[2], high + margin)
        axes = [np.arange(*ends, CELL) for ends in zip(start, stop, strict=True)]
        size = [len(axis) for axis in axes]
        grid = np.stack(np.meshgrid(*axes[::-1], indexing="ij")[::-1], axis=-1)
        grid = grid.reshape(-1, 3)  # x runs fastest

        inside = igl.fast_winding_number(self.vertices, self.faces, grid) > 0.5
        away = _distance(grid, _Surface(self.vertices, self.faces), margin)
        away = np.where(inside, -away, away)
        shell = _Surface(*igl.marching_cubes(away, grid, *size, wide)[:2])
        back = _distance(grid, shell, margin)
        filled = np.where(away < wide, wide - back, wide + back)
        return _Surface(*igl.marching_cubes(filled, grid, *size, offset)[:2])

    def outside_neck(self, surface: _Surface, radius: float) -> np.ndarray:
        """(N,) metres outside a tube round the neck and upwards, negative within."""
        neck = self.joint("neck01") + np.array([0, -0.015, 0.01])
        axis = self.joint("head") - neck
        away = surface.vertices - neck
        along = np.maximum(away @ axis / (axis @ axis), 0)
        return np.linalg.norm(away - along[:, None] * axis, axis=1) - radius

    def before(
        self,
        surface: _Surface,
        limb: tuple[str, ...],
        start: str,
        end: str,
        share: float,
    ) -> np.ndarray:
        """(N,) metres before a share of the way from one joint to another of a limb.

        Left and right; infinite for points that are closest to something else.
        """
        points = surface.vertices
        _, face, _ = igl.point_mesh_squared_distance(points, self.vertices, self.faces)
        weights = self.weights[self.faces[face]].mean(axis=1)
        before = np.full(len(points), np.inf)
        for side in SIDES:
            a, b = self.joint(start + side), self.joint(end + side)
            ahead = (a + share * (b - a) - points) @ (b - a) / np.linalg.norm(b - a)
            here = self.on_limb(weights, limb, (side,))
            before[here] = ahead[here]
        return before

    def on_limb(
        self, weights: np.ndarray, limb: tuple[str, ...], sides: tuple[str, ...] = SIDES
    ) -> np.ndarray:
        """(N,) bool: whose weights (N, J) lie mostly on the bones of a limb."""
        bones = [self.bone(name + side) for name in limb for side in sides]
        return weights[:, bones].sum(axis=1) > 0.5


def _distance(points: np.ndarray, surface: _Surface, limit: float) -> np.ndarray:
    """(N,) metres from points to a surface; `limit` for those further away."""
    near, _ = cKDTree(surface.vertices).query(points, distance_upper_bound=limit)
    distance = np.full(len(points), limit)
    near = np.isfinite(near)
    squared, _, _ = igl.point_mesh_squared_distance(points[near], *surface)
    distance[near] = np.sqrt(squared)
    return distance


def _reach(points: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """(S,) how far the convex hull of points (N, 2) reaches from 0 in S directions."""
    *normal, offset = ConvexHull(points).equations.T
    slope = ways @ np.array(normal)  # (S, sides)
    hits = np.full_like(slope, np.inf)
    return np.divide(-offset, slope, out=hits, where=slope > 1e-9).min(axis=1)


def _cut(surface: _Surface, keep: np.ndarray) -> _Surface:
    """The largest piece of a surface where `keep`, linear on each triangle, is > 0."""
    x, y, z = surface.vertices.T
    plane = {"plane_normal": np.array([0.0, 0, 1]), "plane_origin": np.zeros(3)}

    # A plane cuts the surface in a space whose third axis is `keep`; what it does to
    # the three coordinates takes two such spaces.
    def cut(*axes):
        space = np.column_stack([*axes, np.clip(keep, -1, 1)])
        return slice_faces_plane(space, surface.faces, **plane)

    (xy, faces, _), (yz, _, _) = cut(x, y), cut(y, z)
    vertices = np.column_stack([xy[:, :2], yz[:, 1]])
    place = weld(vertices)
    _, first = np.unique(place, return_index=True)
    a, b, c = place[faces].T
    faces = place[faces][(a != b) & (b != c) & (c != a)]
    piece = islands(faces, len(first))[faces[:, 0]]
    faces = faces[piece == np.bincount(piece).argmax()]
    used, faces = np.unique(faces, return_inverse=True)
    return _Surface(vertices[first][used], faces.reshape(-1, 3))


def _sewn(surface: _Surface, count: int, name: str, rounds: int = 60) -> Garment:
    """A garment of about `count` vertices, spread evenly over an open surface.

    Voronoi cells of the surface, relaxed by Lloyd's iteration; the dual of the cells
    is the new mesh. A cell at a hem is centred on the hem, which so stays where it is.
    """
    points, triangles = surface
    while len(points) < 16 * count:
        points, triangles = subdivide(points, triangles)
    hem = np.zeros(len(points), bool)
    hem[np.concatenate(boundary_loops(triangles))] = True
    area = vertex_areas(points, triangles)
    rng = np.random.default_rng(0)
    seeds = points[rng.choice(len(points), count, replace=False, p=area / area.sum())]
    for _ in range(rounds):
        _, cell = cKDTree(seeds).query(points)
        _, cell = np.unique(cell, return_inverse=True)
        share = np.where(np.isin(cell, cell[hem]) & ~hem, 1e-9 * area, area)
        sums = [np.bincount(cell, share * x) for x in points.T]
        seeds = np.column_stack(sums) / np.bincount(cell, share)[:, None]
    faces = _dual(cell[triangles])
    return Garment.create(_relaxed(seeds, faces, surface), faces, name=name)


def _dual(corners: np.ndarray) -> np.ndarray:
    """(F, 3): the triangles of cells, from the cells at the corners of triangles.

    Where the border of a cell is jagged, three cells meet more than once, in one sense
    and in the other: what is left is the difference.
    """
    a, b, c = corners.T
    corners = corners[(a != b) & (b != c) & (c != a)]
    a, b, c = corners.T
    turns = np.where((b - a) * (c - b) * (a - c) < 0, 1, -1)  # 1: even permutation
    faces, place = np.unique(np.sort(corners, axis=1), axis=0, return_inverse=True)
    turns = np.bincount(place.ravel(), turns)
    faces[turns < 0] = faces[turns < 0][:, ::-1]
    return faces[turns != 0]


def _relaxed(vertices, faces, surface: _Surface, rounds: int = 10) -> np.ndarray:
    """Each vertex half way to the mean of its neighbours, on the surface, repeatedly.

    Those of a hem have neighbours on it only.
    """
    hem = np.zeros(len(vertices), bool)
    loops = boundary_loops(faces)
    hem[np.concatenate(loops)] = True
    along = np.concatenate([np.column_stack([x, np.roll(x, -1)]) for x in loops])
    a, b = np.concatenate([mesh_edges(faces), mesh_edges(faces)[:, ::-1]]).T
    c, d = np.concatenate([along, along[:, ::-1]]).T
    rows = np.concatenate([a[~hem[a]], c])
    columns = np.concatenate([b[~hem[a]], d])
    size = len(vertices)
    near = coo_matrix((np.ones(len(rows)), (rows, columns)), (size, size)).tocsr()
    count = np.bincount(rows, minlength=size)[:, None]
    border = boundary_loops(surface.faces)
    border = np.concatenate([np.column_stack([x, np.roll(x, -1)]) for x in border])
    for _ in range(rounds):
        vertices = (vertices + near @ vertices / count) / 2
        for which, elements in ((hem, border), (~hem, surface.faces)):
            _, _, vertices[which] = igl.point_mesh_squared_distance(
                vertices[which], surface.vertices, elements
            )
    return vertices
