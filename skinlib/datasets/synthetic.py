"""Procedural heads: skin weights known exactly, a new topology for every seed.

A head is a map from the sphere: theta runs from the crown down to the neck stump, phi
around it, 0 in front and positive on the person's left. Mouth and eyes are slits in
that map. Around a slit with the corners -c and +c we use elliptic coordinates,

    u + i v = c cosh(mu + i nu),    mu >= 0,  -pi < nu <= pi,

in which mu = 0 is the slit and the sign of nu tells the upper lip from the lower one:
sin(nu) is 1 in the middle of the upper lip, -1 in the middle of the lower lip and 0 at
both corners. Weights that are functions of sin(nu) are smooth on the surface and jump
where the lips touch, which is what a painted mouth does.

Weights are functions of (theta, phi), the landmarks and the bones that are there, never
of vertices or triangles: two meshes of one head have the same weights at one place.
"""

from dataclasses import dataclass, fields, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from skinlib.geometry import face_normals
from skinlib.head import Head, HeadError, Skeleton

UNITS = {"m": 0.1, "cm": 10.0}  # in decimetres, the unit of this file
UP_AXES = ("y", "z")
VERTEX_RANGE = (600, 4000)
BONE_RANGE = (8, 14)

# The part of the box's diagonal between closed lips: they touch, but they are no seam.
LIP_GAP = 3e-5
NECK_THETA = 2.6  # where the neck stump ends

# Outlines from crown to neck stump at s = theta / NECK_THETA, in decimetres.
# fmt: off
_S = (0, 0.12, 0.24, 0.36, 0.46, 0.56, 0.66, 0.73, 0.80, 0.88, 1)
_FRONT_Y = (1.15, 1.04, 0.72, 0.33, 0.02, -0.33, -0.68, -0.98, -1.10, -1.22, -1.80)
_FRONT_Z = (0.00, 0.42, 0.74, 0.86, 0.85, 0.86, 0.85, 0.80, 0.55, 0.33, 0.32)
_BACK_Y = (1.15, 1.02, 0.72, 0.36, 0.02, -0.30, -0.60, -0.82, -1.02, -1.28, -1.80)
_BACK_Z = (0.00, -0.46, -0.84, -1.02, -1.03, -0.94, -0.76, -0.65, -0.60, -0.58, -0.64)
_SIDE_Y = (1.15, 1.05, 0.76, 0.36, 0.03, -0.32, -0.62, -0.84, -1.00, -1.24, -1.80)
_SIDE_X = (0.00, 0.38, 0.64, 0.75, 0.76, 0.72, 0.66, 0.59, 0.51, 0.47, 0.56)
# fmt: on
_OUTLINES = CubicSpline(
    _S, np.transpose([_FRONT_Y, _FRONT_Z, _BACK_Y, _BACK_Z, _SIDE_Y, _SIDE_X])
)


@dataclass(frozen=True)
class HeadShape:
    """The proportions of a head; every default is the average head."""

    width: float = 1.0  # ear to ear, times the average
    height: float = 1.0  # crown to chin
    depth: float = 1.0  # nose to nape
    jaw_width: float = 1.0  # at the jaw's corners
    neck_width: float = 1.0
    chin: float = 0.06  # how far it stands out, decimetres, as all below
    brow_ridge: float = 0.03
    cheekbones: float = 0.05
    nose_length: float = 0.23  # how far its tip stands out
    nose_width: float = 0.12
    ears: float = 0.15  # how far they stand off
    lips: float = 0.07  # how full they are
    mouth_width: float = 0.40  # half of it, radians around the head
    mouth_height: float = 1.68  # theta of the mouth
    eye_spacing: float = 0.43  # phi of an eye
    eye_height: float = 1.20  # theta of the eyes
    eye_radius: float = 0.135
    lid_opening: float = 0.50  # radians that the upper lids are turned; 0 is closed

    @classmethod
    def random(cls, rng: np.random.Generator) -> "HeadShape":
        """A plausible person; in one of three the eyes are closed."""
        stretch = {"width": 0.08, "height": 0.08, "depth": 0.08}
        stretch |= {"jaw_width": 0.1, "neck_width": 0.12}
        spread = {"mouth_height": 0.04, "eye_height": 0.04, "eye_spacing": 0.03}
        values = {}
        for field in fields(cls):
            if field.name in stretch:
                low, high = 1 - stretch[field.name], 1 + stretch[field.name]
            elif field.name in spread:
                low = field.default - spread[field.name]
                high = field.default + spread[field.name]
            else:
                low, high = 0.75 * field.default, 1.25 * field.default
            values[field.name] = float(rng.uniform(low, high))
        if rng.random() < 1 / 3:
            values["lid_opening"] = 0.0
        return cls(**values)

    def sculpted(self, rng: np.random.Generator) -> "HeadShape":
        """Another plausible person, with mouth and eyes at the same places."""
        kept = {name: getattr(self, name) for name in _LANDMARK_FIELDS}
        return replace(HeadShape.random(rng), **kept)


# What the mesh is laid out by.
_LANDMARK_FIELDS = (
    "mouth_width",
    "mouth_height",
    "eye_spacing",
    "eye_height",
    "eye_radius",
)


class Regions(NamedTuple):
    """Vertex ids of the parts that touch, or that lie apart from the skin.

    `lower_lip[i]` lies under `upper_lip[i]` at the same place of the closed mouth, on
    the outer edge and just inside; the corners belong to neither. Lids likewise.
    """

    upper_lip: np.ndarray
    lower_lip: np.ndarray
    upper_lids: np.ndarray
    lower_lids: np.ndarray
    eyes: np.ndarray


def synthetic_head(
    seed: int,
    vertices: int | None = None,
    *,
    bones: int | None = None,
    unit: str | None = None,
    up: str | None = None,
    shape: HeadShape | None = None,
    face: int | None = None,
    shuffle: bool = True,
) -> Head:
    """A head with exact, smooth skin weights; what is not given is drawn by the seed.

    Args:
        seed: the same seed and options give the same head, bit by bit.
        vertices: about how many, 600 to 4000.
        bones: 8 to 14; neck, head, jaw, eyes and upper lids are always there.
        unit: `"m"` or `"cm"`.
        up: `"y"`, the face looking along +z, or `"z"`, it looking along -y. The
            person's left is +x.
        shape: the proportions.
        face: a seed of its own: another face, sculpted out of the same mesh, as a
            studio makes its next character; vertices keep their ids and weights.
        shuffle: put vertices, faces and bones in random order, so that ids tell
            nothing.

    Raises:
        HeadError: an option out of its range.

    >>> head = synthetic_head(7, vertices=1000, bones=8)
    >>> len(head.skeleton), bool(abs(len(head.vertices) - 1000) < 150)
    (8, True)
    """
    return synthetic_head_and_regions(
        seed,
        vertices,
        bones=bones,
        unit=unit,
        up=up,
        shape=shape,
        face=face,
        shuffle=shuffle,
    )[0]


def synthetic_heads(count: int, seed: int = 0, **options) -> list[Head]:
    """`count` different heads; `options` as in `synthetic_head`.

    >>> [head.name for head in synthetic_heads(2, seed=3, vertices=700)]
    ['synthetic_3_0', 'synthetic_3_1']
    """
    heads = []
    for index in range(count):
        head_seed = int(np.random.SeedSequence([seed, index]).generate_state(1)[0])
        head = synthetic_head(head_seed, **options)
        heads.append(head.replace(name=f"synthetic_{seed}_{index}"))
    return heads


def synthetic_head_and_regions(
    seed: int,
    vertices: int | None = None,
    *,
    bones: int | None = None,
    unit: str | None = None,
    up: str | None = None,
    shape: HeadShape | None = None,
    face: int | None = None,
    shuffle: bool = True,
) -> tuple[Head, Regions]:
    """`synthetic_head`, and which of its vertices are lips, lids and eyes."""
    rng = np.random.default_rng(seed)
    drawn_vertices = int(np.exp(rng.uniform(*np.log(VERTEX_RANGE))))
    drawn_bones = int(rng.integers(BONE_RANGE[0], BONE_RANGE[1] + 1))
    drawn_unit, drawn_up = rng.choice(list(UNITS)), rng.choice(UP_AXES)
    drawn_shape = HeadShape.random(rng)
    vertices = drawn_vertices if vertices is None else vertices
    bones = drawn_bones if bones is None else bones
    unit = drawn_unit if unit is None else unit
    up = drawn_up if up is None else up
    shape = drawn_shape if shape is None else shape
    _check_options(vertices, bones, unit, up)

    # One stream each: the same person may be had with other bones or other triangles.
    mesh_rng, bone_rng, place_rng, order_rng = rng.spawn(4)
    landmarks = _Landmarks.of(shape)
    eye_count = round(mesh_rng.uniform(0.015, 0.04) * vertices)
    mesh = _triangulate(landmarks, vertices - 2 * eye_count, mesh_rng)
    skin = _place(mesh, shape, landmarks)
    balls, ball_faces = _eyeballs(shape, landmarks, eye_count, mesh_rng)
    points = np.concatenate([skin, balls])
    faces = np.concatenate([mesh.faces, ball_faces + len(skin)])
    faces = flip_edges(points, faces, mesh_rng, mesh_rng.uniform(0, 0.6))
    if face is not None:
        eyes = _eye_centres(shape, landmarks).repeat(eye_count, axis=0)
        shape = shape.sculpted(np.random.default_rng(face))
        skin, away = _place(mesh, shape, landmarks), balls - eyes
        balls = _eye_centres(shape, landmarks).repeat(eye_count, axis=0) + away
        points = np.concatenate([skin, balls])

    names = _choose_bones(bones, bone_rng)
    # FBX and glTF know no tails, so some rigs have none at their leaves.
    joints, tails = _bones(shape, landmarks, names, bone_rng.random() < 0.7)
    parents = [names.index(_PARENTS[n]) if n in _PARENTS else -1 for n in names]
    weights = np.zeros((len(points), bones))
    weights[: len(skin)] = _weights(mesh, landmarks, names)
    weights[len(skin) :, names.index("eye_L")] = 1
    weights[-eye_count:] = np.roll(weights[-eye_count:], 1, axis=1)  # eye_R is next

    # The origin is in the head or at the feet.
    lift = np.array([0, place_rng.choice([0, 16]), 0])
    points, joints, tails = (
        _to_file(p + lift, UNITS[unit], up) for p in (points, joints, tails)
    )
    order, bone_order = np.arange(len(points)), np.arange(bones)
    if shuffle:
        order, bone_order = order_rng.permutation(order), order_rng.permutation(bones)
        faces = order_rng.permutation(faces)
        turn = order_rng.integers(0, 3, (len(faces), 1)) + np.arange(3)
        faces = np.take_along_axis(faces, turn % 3, axis=1)
    place = np.argsort(order)
    skeleton = Skeleton.from_heads_and_tails(joints, tails, parents, names)
    head = Head.create(
        points[order],
        place[faces],
        skeleton.reordered(bone_order),
        weights=weights[order][:, bone_order],
        name=f"synthetic_{seed}",
    )
    return head, Regions(*(place[ids] for ids in _regions(mesh, len(points))))


def _to_file(points, unit: float, up: str) -> np.ndarray:
    if up == "z":
        points = points[:, [0, 2, 1]] * [1, -1, 1]
    return points * unit


def flip_edges(
    points: np.ndarray,
    faces: np.ndarray,
    rng: np.random.Generator,
    fraction: float,
) -> np.ndarray:
    """(F, 3) faces in which some pairs of triangles share their other diagonal.

    An edge is flipped only where the two triangles form a convex, nearly flat quad, so
    the surface stays where it was. Vertices, and the number of faces, stay.

    Args:
        points: (V, 3). faces: (F, 3).
        fraction: the part of the candidate edges to flip, 0 .. 1; a triangle takes part
            in one flip at most.

    >>> square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    >>> rng = np.random.default_rng(0)
    >>> flip_edges(square, np.array([[0, 1, 2], [0, 2, 3]]), rng, 1.0).tolist()
    [[3, 0, 1], [1, 2, 3]]
    """
    faces = faces.copy()
    if fraction <= 0 or len(faces) < 2:
        return faces
    count = len(faces)
    start, end, across = (np.roll(faces, -turn, axis=1).T.ravel() for turn in range(3))
    # Twin half edges lie side by side once sorted by their undirected edge.
    key = np.minimum(start, end) * np.int64(len(points)) + np.maximum(start, end)
    by_key = np.argsort(key, kind="stable")
    ordered = key[by_key]
    same = ordered[1:] == ordered[:-1]
    lone = ~np.r_[same[1:], False] & ~np.r_[False, same[:-1]]
    first, second = by_key[:-1][same & lone], by_key[1:][same & lone]
    opposed = start[first] == end[second]  # else the two triangles face apart
    first, second = first[opposed], second[opposed]
    a, b, c, d = start[first], end[first], across[first], across[second]
    made = np.minimum(c, d) * np.int64(len(points)) + np.maximum(c, d)
    usable = (c != d) & ~np.isin(made, ordered) & _convex_and_flat(points, a, b, c, d)

    picked = np.flatnonzero(usable)
    picked = picked[np.unique(made[picked], return_index=True)[1]]  # each edge once
    picked = rng.permutation(picked)[: round(fraction * len(picked))]
    f, g = first[picked] % count, second[picked] % count
    # The first to claim a triangle has it.
    claim = np.full(count, len(picked))
    np.minimum.at(claim, f, np.arange(len(picked)))
    np.minimum.at(claim, g, np.arange(len(picked)))
    mine = (claim[f] == np.arange(len(picked))) & (claim[g] == np.arange(len(picked)))
    picked, f, g = picked[mine], f[mine], g[mine]
    a, b, c, d = a[picked], b[picked], c[picked], d[picked]
    faces[f] = np.stack([d, b, c], axis=1)
    faces[g] = np.stack([c, a, d], axis=1)
    return faces


def _convex_and_flat(points, a, b, c, d) -> np.ndarray:
    """Whether triangles abc and bad may become dbc and cad."""
    one, two, new, other = (
        face_normals(points, np.stack(corners, axis=1))
        for corners in ((a, b, c), (b, a, d), (d, b, c), (c, a, d))
    )
    lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1)
    flat = (one * two).sum(axis=1) > 0.9 * lengths
    quad = one + two
    least = 0.15 * (quad**2).sum(axis=1)  # neither triangle may become a sliver
    return flat & ((new * quad).sum(1) > least) & ((other * quad).sum(1) > least)


# --- landmarks and charts ---------------------------------------------------------


class _Slit(NamedTuple):
    """A slit in the sphere and the elliptic coordinates around it."""

    theta: float
    phi: float
    half_width: float  # c
    reach: float  # mu up to which the mesh has loops around it
    tilt: float  # how fast the line through the corners rises beyond them

    def coordinates(self, theta, phi, side=0.0):
        """mu >= 0 and nu in (-pi, pi]; `side` +1 or -1 picks a lip on the slit."""
        u, v = self.plane(theta, phi)
        v = np.where(np.asarray(side) != 0, 1e-12 * side, v)
        ellipse = np.arccosh((u + 1j * v) / self.half_width)
        return ellipse.real, ellipse.imag

    def plane(self, theta, phi):
        """u to the person's left and v upwards, about arc lengths on the sphere."""
        return (phi - self.phi) * np.sin(self.theta), (
            self.theta - theta - self._rise(phi)
        )

    def points(self, mu, nu):
        """theta, phi of elliptic coordinates."""
        w = self.half_width * np.cosh(mu + 1j * nu)
        phi = self.phi + w.real / np.sin(self.theta)
        return self.theta - w.imag - self._rise(phi), phi

    def _rise(self, phi):
        corner = self.half_width / np.sin(self.theta)
        return self.tilt * np.maximum(np.abs(phi - self.phi) - corner, 0) ** 2


class _Landmarks(NamedTuple):
    mouth: _Slit
    left_eye: _Slit
    right_eye: _Slit

    @classmethod
    def of(cls, shape: HeadShape) -> "_Landmarks":
        width = 1.4 * shape.eye_radius  # an eye opens a little wider than its ball
        eye = _Slit(shape.eye_height, shape.eye_spacing, width, 0.75, 0.0)
        # Beyond the mouth the line rises to the ears, as a jaw does.
        mouth = _Slit(shape.mouth_height, 0.0, shape.mouth_width, 0.5, 0.25)
        return cls(mouth, eye, eye._replace(phi=-eye.phi))

    @property
    def nose_theta(self) -> float:
        return 0.4 * self.left_eye.theta + 0.6 * self.mouth.theta


# --- topology ---------------------------------------------------------------------


_RINGS = (3, 1, 1)  # rows of inner lip behind the mouth and behind each eye's lids


class _Mesh(NamedTuple):
    """Where each vertex lies on the map, and the triangles."""

    theta: np.ndarray
    phi: np.ndarray
    slit: np.ndarray  # on the edge or the lining of this slit; -1 elsewhere
    side: np.ndarray  # +1 upper lip, -1 lower lip, 0 elsewhere and at the corners
    ring: np.ndarray  # 0 on the skin, 1, 2, ... inwards along the lining
    mate: np.ndarray  # the vertex across the slit; itself elsewhere
    faces: np.ndarray

    def elliptic(self, landmarks: _Landmarks, index: int):
        """mu, nu around slit `index` for all vertices."""
        side = np.where(self.slit == index, self.side, 0)
        return landmarks[index].coordinates(self.theta, self.phi, side)

    def lids(self, landmarks: _Landmarks, index: int):
        """How far the upper and the lower lid have a vertex: 1 mid-edge, 0 far away."""
        mu, nu = self.elliptic(landmarks, index)
        fade = _spot(mu / 0.7)
        upper, lower = (_smooth_step(sign * np.sin(nu), 0, 1) for sign in (1, -1))
        return upper * fade, lower * fade


def _triangulate(landmarks: _Landmarks, target: int, rng) -> _Mesh:
    """A random triangulation of the map with three slits, lined with inner lips."""
    style = rng.choice(["spiral", "scattered", "grid"])
    zoom = rng.uniform(1.1, 1.9)  # how much finer the face is than the nape
    turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    size = 0.8 * target
    for _ in range(4):  # what the slits add grows with the rest
        theta, phi, chains = _scatter(landmarks, size, style, zoom, turn, rng)
        lining = sum(_RINGS[k] * 2 * len(c) for k, c in enumerate(chains))
        size *= target / (len(theta) + lining)
    faces = _hull_faces(_direction(theta, phi))
    faces = faces[~(theta[faces] > NECK_THETA - 1e-9).all(axis=1)]
    return _open_slits(theta, phi, faces, chains)


def _scatter(landmarks, size, style, zoom, turn, rng):
    """theta, phi of about `size` points and, for each slit, the ids along it."""
    spacing = np.sqrt(4 * np.pi / size * 1.15)
    count = round(size)
    if style == "grid":
        directions = _cube_sphere(max(4, round(np.sqrt(count / 6))))
    else:
        directions = _spiral(count)
    jitter = {"spiral": 0.1, "scattered": 0.22, "grid": 0.05}[style]
    directions = directions @ turn.T
    directions += jitter * spacing * rng.uniform(-1, 1, directions.shape)
    theta, phi = _angles(_zoom_front(directions, zoom))

    rim = np.linspace(-np.pi, np.pi, round(2 * np.pi * np.sin(NECK_THETA) / spacing))
    fine = spacing / zoom
    outside = theta < NECK_THETA - 0.6 * spacing
    rows, chains = [(np.full(len(rim) - 1, NECK_THETA), rim[1:])], []
    made = len(rim) - 1
    for slit in landmarks:
        segments = round(np.pi * slit.half_width * np.cosh(slit.reach) / fine)
        segments = max(segments, 8 if slit is landmarks.mouth else 6)
        step = np.pi / segments
        nu = np.pi - step * np.arange(segments + 1)
        rows.append(slit.points(0.0, nu))
        chains.append(made + np.arange(segments + 1))
        made += segments + 1
        loops = max(2, round(slit.reach / step))
        for loop in range(1, loops + 1):
            nu = step * np.arange(2 * segments) + step * rng.uniform(0, 0.5)
            rows.append(slit.points(loop * step, nu))
            made += 2 * segments
        mu, _ = slit.coordinates(theta, phi)
        outside &= mu > (loops + 0.6) * step
    rows.append((theta[outside], phi[outside]))
    theta, phi = np.concatenate([np.stack(row) for row in rows], axis=1)
    return theta, phi, chains


def _open_slits(theta, phi, faces, chains) -> _Mesh:
    """Cut the surface along the slits and line each cut with a tube of inner lips."""
    count = len(theta)
    slit, side = np.full(count, -1), np.zeros(count, int)
    ring, mate = np.zeros(count, int), np.arange(count)
    columns = [np.stack([theta, phi, slit, side, ring, mate])]
    middle = theta[faces].mean(axis=1)
    lining = []
    made = count
    for index, chain in enumerate(chains):
        inner = chain[1:-1]
        columns[0][2, chain], columns[0][3, inner] = index, 1
        lower = chain.copy()
        lower[1:-1] = made + np.arange(len(inner))
        columns[0][5, inner] = lower[1:-1]
        made += len(inner)
        below = np.zeros((6, len(inner)))
        below[:2], below[5] = columns[0][:2, inner], inner
        below[2], below[3] = index, -1
        columns.append(below)
        # Below the cut, triangles take the lower copies. All points of a slit share
        # their theta, so the mean theta of a triangle tells its side.
        under = np.isin(faces, inner).any(axis=1) & (middle > theta[inner[0]])
        copy = np.arange(made)
        copy[inner] = lower[1:-1]
        faces[under] = copy[faces[under]]

        outer = np.r_[chain, lower[-2:0:-1]]  # once around: upper edge, lower edge back
        for row in range(1, _RINGS[index] + 1):
            deeper = made + np.arange(len(outer))
            made += len(outer)
            new = np.concatenate(columns, axis=1)[:, outer]
            new[4] = row
            new[5] = deeper[-np.arange(len(deeper))]
            columns.append(new)
            ahead, deeper_ahead = np.roll(outer, -1), np.roll(deeper, -1)
            lining.append(np.stack([ahead, outer, deeper], axis=1))
            lining.append(np.stack([ahead, deeper, deeper_ahead], axis=1))
            outer = deeper
    theta, phi, *labels = np.concatenate(columns, axis=1)
    faces = np.concatenate([faces, *lining])
    return _Mesh(theta, phi, *(label.astype(int) for label in labels), faces)


def _direction(theta, phi) -> np.ndarray:
    """(..., 3) unit vectors; +y is the crown, +z the front, +x the person's left."""
    flat = np.sin(theta)
    return np.stack([flat * np.sin(phi), np.cos(theta), flat * np.cos(phi)], axis=-1)


def _angles(directions):
    x, y, z = directions.T
    return np.arctan2(np.hypot(x, z), y), np.arctan2(x, z)


def _spiral(count: int) -> np.ndarray:
    """About evenly spread directions (Fibonacci lattice)."""
    y = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    return _direction(np.arccos(y), turn)


def _cube_sphere(side: int) -> np.ndarray:
    """Six square grids, so that the triangles come in quads as artists' do."""
    line = np.tan(np.pi / 4 * ((2 * np.arange(side) + 1) / side - 1))
    u, v = (grid.ravel() for grid in np.meshgrid(line, line))
    one = np.ones_like(u)
    square = np.stack([u, v, one], axis=1)
    cube = np.concatenate(
        [np.roll(sign * square, axis, axis=1) for axis in range(3) for sign in (1, -1)]
    )
    return cube / np.linalg.norm(cube, axis=1, keepdims=True)


def _zoom_front(directions, zoom) -> np.ndarray:
    """Pull directions to the front without shearing them (a Moebius map)."""
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    x, y, z = directions.T
    flat = np.stack([x, y]) / np.maximum(1 + z, 1e-9) / zoom
    squared = (flat**2).sum(axis=0)
    return np.stack([*(2 * flat), 1 - squared], axis=1) / (1 + squared)[:, None]


def _hull_faces(directions) -> np.ndarray:
    """Delaunay triangles of points on the sphere, facing outwards."""
    faces = ConvexHull(directions).simplices.astype(np.int64)
    a, b, c = directions[faces].transpose(1, 0, 2)
    inwards = (np.cross(b - a, c - a) * (a + b + c)).sum(axis=1) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return faces


# --- shape ------------------------------------------------------------------------


def _smooth_step(value, start, end):
    t = np.clip((value - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)


def _bump(*scaled):
    """exp(-r^2) of coordinates in units of the bump's width."""
    return np.exp(-sum(np.square(c) for c in scaled))


def _spot(*scaled):
    """`_bump` that ends at r = 2, as painted weights end: (1 - r^2 / 4)^4."""
    return np.maximum(1 - sum(np.square(c) for c in scaled) / 4, 0) ** 4


def _skin(shape: HeadShape, landmarks: _Landmarks, theta, phi, side=0.0) -> np.ndarray:
    """(..., 3) points of the surface, before the lids are wrapped around the eyes."""
    s = theta / NECK_THETA
    front_y, front_z, back_y, back_z, side_y, side_x = np.moveaxis(_OUTLINES(s), -1, 0)
    cos, sin = np.cos(phi), np.sin(phi)
    ahead, aside = np.where(cos > 0, cos, 0) ** 2, sin**2
    behind = np.where(cos < 0, cos, 0) ** 2
    y = front_y * ahead + back_y * behind + side_y * aside
    z = np.where(cos > 0, front_z, -back_z) * cos - 0.05 * aside * np.sin(theta) ** 2
    x = side_x * sin

    jaw, neck = _bump((s - 0.68) / 0.12), _smooth_step(s, 0.76, 0.88)
    x = x * (1 + (shape.jaw_width - 1) * jaw) * (1 + (shape.neck_width - 1) * neck)
    face = np.clip(cos, 0, 1)

    # The face, painted on as offsets forwards; each where its landmark is.
    mouth, eye = landmarks.mouth, landmarks.left_eye
    eye_x, mouth_y = 0.76 * np.sin(eye.phi), _height(mouth.theta)
    eye_y, nose_y = _height(eye.theta), _height(landmarks.nose_theta)
    off_x = np.abs(x)
    z = z + face * (
        -0.10 * _bump((off_x - eye_x) / 0.2, (y - eye_y) / 0.15)
        + shape.brow_ridge * _bump((off_x - 0.25) / 0.3, (y - eye_y - 0.24) / 0.1)
        + shape.cheekbones * _bump((off_x - 0.42) / 0.2, (y - nose_y) / 0.2)
        + shape.chin * _bump(x / 0.22, (y + 0.98) / 0.14)
        + 0.06 * _bump(x / 0.38, (y - mouth_y) / 0.25)
    )
    rise = np.where(
        y > nose_y,
        _smooth_step(y, eye_y + 0.12, nose_y),
        _smooth_step(y, nose_y - 0.12, nose_y),
    )
    narrow = shape.nose_width * (0.55 + 0.45 * rise)
    wings = _bump((off_x - shape.nose_width) / 0.06, (y - nose_y + 0.02) / 0.07)
    z = z + face * (shape.nose_length * rise * _bump(x / narrow) + 0.08 * wings)

    mu, nu = mouth.coordinates(theta, phi, side)
    swell = mu / 0.3 * np.exp(1 - mu / 0.3) * np.sin(nu) ** 2
    z = z + face * shape.lips * swell

    ear = _bump(((y + 0.05) / 0.24) ** 2, ((z + 0.10) / 0.16) ** 2, neck)
    x = x + np.sign(x) * shape.ears * ear
    z = z - 0.6 * shape.ears * ear
    return np.stack([x * shape.width, y * shape.height, z * shape.depth], axis=-1)


def _height(theta) -> float:
    return float(_OUTLINES(theta / NECK_THETA)[0])


def _eye_centres(shape, landmarks) -> np.ndarray:
    """(2, 3) left, right."""
    eyes = [landmarks.left_eye, landmarks.right_eye]
    lids = [_skin(shape, landmarks, eye.theta, eye.phi) for eye in eyes]
    return np.stack(lids) - np.array([0, 0, 0.75 * shape.eye_radius])


def _place(mesh: _Mesh, shape: HeadShape, landmarks: _Landmarks) -> np.ndarray:
    """(V, 3) positions of the skin and its lining."""
    mouth_side = np.where(mesh.slit == 0, mesh.side, 0)
    points = _skin(shape, landmarks, mesh.theta, mesh.phi, mouth_side)
    box = np.linalg.norm(np.ptp(points, axis=0))

    # The lining of the mouth: the lips touch on the edge and one row in, then part.
    lining = (mesh.slit == 0) & (mesh.ring > 0)
    _, nu = mesh.elliptic(landmarks, 0)
    row = mesh.ring[lining]
    points[lining, 0] *= np.array([1, 1, 0.95, 0.85])[row]
    points[lining, 1] += np.array([0, 0, 0.10, 0.14])[row] * np.sin(nu[lining])
    points[lining, 2] -= np.array([0, 0.06, 0.20, 0.42])[row] * shape.depth

    # Lids lie on a ball a little larger than the eye and turn around its centre.
    for index, centre in enumerate(_eye_centres(shape, landmarks), start=1):
        radius = 1.12 * shape.eye_radius
        offset = points - centre
        distance = np.linalg.norm(offset, axis=1, keepdims=True)
        soft = 0.1 * radius
        pushed = radius + soft * np.logaddexp(0, (distance - radius) / soft)
        # The lining ends on the eye, so that nobody looks past it into the skull.
        pushed[(mesh.slit == index) & (mesh.ring > 0)] = 1.03 * shape.eye_radius
        near = (distance < 3 * radius) & (offset[:, 2:] > -radius)
        offset = np.where(near, offset * pushed / distance, offset)
        upper, lower = mesh.lids(landmarks, index)
        angle = shape.lid_opening * (0.25 * lower - upper)
        turn = Rotation.from_rotvec(angle[:, None] * np.array([1.0, 0, 0]))
        points = turn.apply(offset) + centre

    points[:, 1] += LIP_GAP / 2 * box * mesh.side
    return points


# --- skeleton and weights ---------------------------------------------------------

_PARENTS = {
    "head": "neck",
    "jaw": "head",
    "eye_L": "head",
    "eye_R": "head",
    "lid_upper_L": "head",
    "lid_upper_R": "head",
    "lid_lower_L": "head",
    "lid_lower_R": "head",
    "brow_L": "head",
    "brow_R": "head",
    "nose": "head",
    "lip_upper": "head",
    "lip_lower": "jaw",
    "mouth_corner_L": "head",
    "mouth_corner_R": "head",
}
_ALWAYS = ("neck", "head", "jaw", "eye_L", "eye_R", "lid_upper_L", "lid_upper_R")
_PAIRS = (
    ("lid_lower_L", "lid_lower_R"),
    ("brow_L", "brow_R"),
    ("lip_upper", "lip_lower"),
    ("mouth_corner_L", "mouth_corner_R"),
)


def _choose_bones(count: int, rng) -> list[str]:
    pairs, odd = divmod(count - len(_ALWAYS), 2)
    chosen = [_PAIRS[k] for k in np.sort(rng.permutation(len(_PAIRS))[:pairs])]
    return [*_ALWAYS, *(["nose"] if odd else []), *(b for pair in chosen for b in pair)]


def _weights(mesh: _Mesh, landmarks: _Landmarks, names: list[str]) -> np.ndarray:
    """(V, J) weights: each bone takes a smooth part of what the ones before it have."""
    theta, phi, s = mesh.theta, mesh.phi, mesh.theta / NECK_THETA
    mouth, eye = landmarks.mouth, landmarks.left_eye
    mu, nu = mesh.elliptic(landmarks, 0)
    up = np.sin(nu)
    weights = np.zeros((len(theta), len(names)))
    weights[:, 0] = 1

    def take(bone: str, part: np.ndarray) -> None:
        if bone in names:
            weights[:] *= 1 - part[:, None]
            weights[:, names.index(bone)] += part

    take("head", 1 - _smooth_step(s, 0.76, 0.95))
    below = 0.5 - 0.5 * np.tanh(1.5 * up) / np.tanh(1.5)
    u, v = mouth.plane(theta, phi)
    for value, start, end in ((v, 0.0, 0.4), (abs(phi), 0.9, 1.7), (s, 0.77, 0.89)):
        below *= 1 - _smooth_step(value, start, end)  # to the eyes, ears and throat
    take("jaw", below)
    take("lip_upper", 0.7 * np.maximum(up, 0) ** 2 * _spot(mu / 0.5))
    take("lip_lower", 0.7 * np.maximum(-up, 0) ** 2 * _spot(mu / 0.5))
    take("nose", 0.7 * _spot(phi / 0.16, (theta - landmarks.nose_theta) / 0.13))
    brow = (theta - eye.theta + 0.27) / 0.13
    for index, side, sign in ((1, "_L", 1), (2, "_R", -1)):
        off = u - sign * mouth.half_width
        take("mouth_corner" + side, 0.6 * _spot(off / 0.15, v / 0.15))
        take("brow" + side, 0.85 * _spot((phi - sign * eye.phi) / 0.28, brow))
        upper, lower = mesh.lids(landmarks, index)
        take("lid_upper" + side, upper)
        take("lid_lower" + side, lower)
    return weights


def _bones(shape, landmarks, names, leaf_tails: bool):
    """(J, 3) joints and tails, decimetres; a leaf may have no tail (NaN)."""
    mouth, eye = landmarks.mouth, landmarks.left_eye
    skin = partial(_skin, shape, landmarks)
    scale = np.array([shape.width, shape.height, shape.depth])
    inwards = np.array([0, 0, -0.12])
    neck, skull = np.array([0, -1.75, -0.2]) * scale, np.array([0, -0.75, -0.2]) * scale
    ends = {
        "neck": (neck, skull),
        "head": (skull, skin(0.0, 0.0)),
        "jaw": (np.array([0, -0.15, -0.05]) * scale, skin(0.73 * NECK_THETA, 0.0)),
        "nose": (
            skin(eye.theta, 0.0) + inwards,
            skin(landmarks.nose_theta, 0.0),
        ),
        "lip_upper": (
            skin(mouth.theta, 0.0) + inwards,
            skin(mouth.theta - 0.05, 0.0),
        ),
        "lip_lower": (
            skin(mouth.theta, 0.0) + inwards,
            skin(mouth.theta + 0.05, 0.0),
        ),
    }
    radius = 1.12 * shape.eye_radius
    centres = _eye_centres(shape, landmarks)
    for side, sign, centre in (("L", 1, centres[0]), ("R", -1, centres[1])):
        corner = skin(mouth.theta, sign * mouth.half_width / np.sin(mouth.theta))
        brow = skin(eye.theta - 0.27, sign * eye.phi)
        ends["eye_" + side] = (centre, centre + np.array([0, 0, shape.eye_radius]))
        for lid, angle in (("lid_upper_", -1), ("lid_lower_", 0.25)):
            turn = angle * shape.lid_opening
            edge = radius * np.array([0, -np.sin(turn), np.cos(turn)])
            ends[lid + side] = (centre, centre + edge)
        ends["mouth_corner_" + side] = (corner + inwards, corner)
        ends["brow_" + side] = (brow + inwards, brow)
    heads, tails = np.array([ends[name] for name in names]).transpose(1, 0, 2)
    if not leaf_tails:
        parents = {_PARENTS.get(name) for name in names}
        tails[[name not in parents for name in names]] = np.nan
    return heads, tails


# --- assembly ---------------------------------------------------------------------


def _eyeballs(shape, landmarks, count, rng):
    """(2 n, 3) points and (F, 3) faces of two balls of `count` vertices each."""
    points, faces = [], []
    for index, centre in enumerate(_eye_centres(shape, landmarks)):
        ball = _spiral(count) @ Rotation.from_quat(rng.normal(size=4)).as_matrix().T
        points.append(centre + shape.eye_radius * ball)
        faces.append(_hull_faces(ball) + index * count)
    return np.concatenate(points), np.concatenate(faces)


def _regions(mesh: _Mesh, count: int) -> Regions:
    """`count` is the number of all vertices, eyes included."""
    touching = (mesh.side == 1) & (mesh.ring <= 1)
    lip, lid = np.flatnonzero(touching & (mesh.slit == 0)), touching & (mesh.slit > 0)
    lid = np.flatnonzero(lid)
    eyes = np.arange(len(mesh.theta), count)
    return Regions(lip, mesh.mate[lip], lid, mesh.mate[lid], eyes)


def _check_options(vertices, bones, unit, up) -> None:
    for name, value, (low, high) in (
        ("vertices", vertices, VERTEX_RANGE),
        ("bones", bones, BONE_RANGE),
    ):
        if not low <= value <= high:
            raise HeadError(name, f"{value}", f"ask for {low} to {high}")
    for name, value, known in (("unit", unit, UNITS), ("up", up, UP_AXES)):
        if value not in known:
            raise HeadError(name, f"{value!r}", f"use one of {', '.join(known)}")
