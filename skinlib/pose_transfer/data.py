"""Pairs of meshes to learn pose transfer from, drawn on demand; nothing is stored.

An item is a source (somebody in a pose), an identity (somebody else in a pose of his
own) and the truth: that identity in the source's pose. The vertices of the source and
those of the identity are in random order, each mesh is moved and scaled into the cube
from -1 to 1 by itself, as in NPT (Wang et al., CVPR 2020) and DSFFNet.

Who takes part is a list of skinned heads on one mesh: the shipped body in other shapes,
Anny's bodies, or either on another mesh. Poses are those of `skinlib.garments.motion`;
the same rotations for all, by linear blend skinning.

Symbols: I identities, T poses, B items, M vertices of the source, N of the identity.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from skinlib.garments.binding import closest_point_values
from skinlib.garments.body import Body, anny_rig
from skinlib.garments.motion import Motion
from skinlib.geometry import mesh_edges
from skinlib.head import Head, HeadError
from skinlib.skinning import linear_blend_skinning

Array = TypeVar("Array", np.ndarray, Tensor)

TOPOLOGIES = (
    "notoes",
    "notoes_collapse10pc",
    "notoes_collapse5pc",
    "notoes_collapse3pc",
    "soma",
)
"""Meshes of Anny's bodies: 12,272, 1,229, 615 and 369 vertices of one family, and one
of another, with 18,056."""

# How far outside the surface of another mesh a vertex may be, relative to its size.
OFF_SURFACE = 0.05


# --- who takes part -----------------------------------------------------------------


def drawn_bodies(
    body: Body, count: int, seed: int = 0, spread: float = 1.0
) -> list[Head]:
    """Bodies at rest in random shapes: each amount uniform from -spread to spread.

    Identity i depends on the seed and on i alone.

    Args:
        count: 1 or more. seed: 0 or more. spread: 0 to 1.

    Raises:
        HeadError: no count, a negative seed, a spread outside 0 to 1, or a body without
            shapes, which has only one identity.
    """
    _countable("identities", count, seed)
    if not 0 <= spread <= 1:
        raise HeadError("spread", f"it is {spread:g}", "give 0 to 1")
    if not body.shape_names:
        raise HeadError(
            "shapes", "the body has none", "use a body with shapes, as the shipped one"
        )
    heads = []
    for number in range(count):
        rng = np.random.default_rng((seed, number))
        amounts = rng.uniform(-spread, spread, len(body.shape_names)).tolist()
        shaped = body.shaped(dict(zip(body.shape_names, amounts, strict=True)))
        heads.append(shaped.replace(name=f"body_{seed}_{number}"))
    return heads


def anny_bodies(
    count: int,
    seed: int = 0,
    topology: str = "notoes_collapse10pc",
    age: tuple[float, float] = (18.0, 70.0),
) -> list[Head]:
    """Identities of Anny's own distribution, at rest, in metres, Z up, facing -Y.

    Identity i depends on `seed + i` alone, and is the same body on each topology. The
    bones are those of the shipped body. The first call of a topology builds Anny, which
    takes minutes once and seconds later.

    Args:
        count: 1 or more. seed: 0 or more. topology: one of `TOPOLOGIES`.
        age: years, drawn uniformly.

    Raises:
        HeadError: the package `anny` is not installed, or no such topology or count.
    """
    _countable("identities", count, seed)
    if topology not in TOPOLOGIES:
        raise HeadError(
            "topology", f"there is no {topology!r}", f"use {', '.join(TOPOLOGIES)}"
        )
    rig = anny_rig(topology)
    model = rig.model
    from anny.shape_distribution import SimpleShapeDistribution

    ends = torch.tensor(age, dtype=model.dtype)
    years = torch.distributions.Uniform(*ends)
    distribution = SimpleShapeDistribution(model, years)
    phenotypes = []
    with torch.random.fork_rng(devices=[]):  # it draws from the global generator
        for number in range(seed, seed + count):
            torch.manual_seed(number)
            phenotypes.append(distribution.sample(1)[1])
    batch = {key: torch.cat([one[key] for one in phenotypes]) for key in phenotypes[0]}
    with torch.inference_mode():
        rest = model(None, phenotype_kwargs=batch)
    vertices, joints = rest["rest_vertices"].numpy(), rest["rest_bone_heads"].numpy()
    faces = model.get_triangular_faces().numpy()
    return [
        Head.create(
            vertices[i],
            faces,
            rig.skeleton(joints[i]),
            weights=rig.weights,
            name=f"anny_{seed + i}",
        )
        for i in range(count)
    ]


def on_mesh(heads: Sequence[Head], reference: Head, mesh: Head) -> list[Head]:
    """The same identities on another mesh of the same surface, with their weights.

    Each vertex of `mesh` becomes the point of a triangle of `reference`; positions and
    weights of all heads are interpolated there.

    Args:
        heads: on the mesh of `reference`. reference: one of them, or their mean.
        mesh: lies on the surface of `reference`, as what `skinlib.datasets.remesh`
            makes of it does.

    Raises:
        HeadError: a head on another mesh than the reference, or without weights, or a
            mesh that is not on its surface.
    """
    for head in heads:
        _weighted(head)
        if not np.array_equal(head.faces, reference.faces):
            raise HeadError(
                "faces",
                f"{head.name or 'a head'} is not on the mesh of the reference",
                "give identities that share the triangles of the reference",
            )
    values = np.concatenate([x for h in heads for x in (h.vertices, h.weights)], axis=1)
    carried = _carried(values, reference, mesh)
    bones = len(reference.skeleton)
    parts = carried.reshape(len(carried), len(heads), 3 + bones).transpose(1, 0, 2)
    return [
        head.replace(
            vertices=part[:, :3],
            faces=mesh.faces,
            weights=part[:, 3:] / part[:, 3:].sum(axis=1, keepdims=True),
        )
        for head, part in zip(heads, parts, strict=True)
    ]


def body_on_mesh(body: Body, mesh: Head) -> Body:
    """The same body, with its weights and shapes, on another mesh of its surface.

    Raises:
        HeadError: the mesh is not on the body's surface.
    """
    head = body.head
    shapes = body.shape_vertices.transpose(1, 0, 2).reshape(len(head.vertices), -1)
    shapes = _carried(shapes, head, mesh).reshape(len(mesh.vertices), -1, 3)
    return replace(
        body,
        head=on_mesh([head], head, mesh)[0],
        shape_vertices=shapes.transpose(1, 0, 2).astype(np.float32),
    )


def _carried(values: np.ndarray, reference: Head, mesh: Head) -> np.ndarray:
    """(W, C) the values (V, C) of the reference where the vertices of the mesh are."""
    size = float(np.ptp(reference.vertices, axis=0).max())
    here = closest_point_values(mesh.vertices, reference, reference.vertices)
    off = float(np.abs(here - mesh.vertices).max())
    if off > OFF_SURFACE * size:
        raise HeadError(
            "mesh",
            f"a vertex is {off:.3g} away from the surface of the reference",
            "make the mesh from the reference, in its place, size and pose",
        )
    return closest_point_values(mesh.vertices, reference, values)


def _countable(what: str, count: int, seed: int) -> None:
    if count < 1 or seed < 0:
        raise HeadError(
            what,
            f"{count} with seed {seed}",
            "ask for 1 or more, with a seed of 0 or more",
        )


def _weighted(head: Head) -> None:
    if head.weights is None:
        name = head.name or "a head"
        raise HeadError("weights", f"{name} has none", "skin it first")


# --- the box ------------------------------------------------------------------------


def normalised(points: Array) -> tuple[Array, Array, Array]:
    """Points moved and scaled into the cube from -1 to 1; `restored` undoes both.

    The middle of the bounding box goes to the origin, and half of its longest side to
    1. Each mesh has a scale of its own: how tall somebody is gets lost.

    Args:
        points: (..., N, 3), numpy or torch.

    Returns:
        (..., N, 3) points, (..., 1, 3) centre, (..., 1, 1) scale.

    Raises:
        HeadError: no points, NaN or infinity, or all at one place.

    >>> points, centre, scale = normalised(np.array([[0.0, 0, 0], [2, 4, 0]]))
    >>> points.tolist(), centre.tolist(), scale.tolist()
    ([[-0.5, -1.0, 0.0], [0.5, 1.0, 0.0]], [[1.0, 2.0, 0.0]], [[2.0]])
    """
    if points.ndim < 2 or points.shape[-1] != 3 or points.shape[-2] == 0:
        raise HeadError(
            "points", f"an array of shape {tuple(points.shape)}", "give (N, 3), N > 0"
        )
    if isinstance(points, Tensor):
        low, high = points.amin(-2, keepdim=True), points.amax(-2, keepdim=True)
        scale = (high - low).amax(-1, keepdim=True) / 2
        finite = bool(scale.isfinite().all())
    else:
        low, high = points.min(-2, keepdims=True), points.max(-2, keepdims=True)
        with np.errstate(invalid="ignore", over="ignore"):
            scale = (high - low).max(-1, keepdims=True) / 2
        finite = bool(np.isfinite(scale).all())
    if not finite:
        raise HeadError(
            "points", "they hold NaN or infinity", "export the mesh with finite values"
        )
    if not (scale > 0).all():
        raise HeadError(
            "points",
            "all of them are at one place",
            "give a mesh of two or more vertices and of some size",
        )
    centre = low + (high - low) / 2
    return (points - centre) / scale, centre, scale


def vertex_shares(points: Tensor, faces: Tensor) -> Tensor:
    """(B, N) which part of the surface is around each vertex; they sum to 1.

    The normals of the triangles around it, as long as their areas, are added, and the
    length of the sum counts: where the surface is flat, its area. Noise adds to areas,
    but not to this sum, which the rim of the ring alone decides. Without any area, all
    vertices have the same. Equation `vertex_shares`.

    Args:
        points: (B, N, 3), in any unit. faces: (F, 3) int64, wound alike.

    >>> points = torch.tensor([[[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [0, -1, 0]]])
    >>> vertex_shares(points, torch.tensor([[0, 1, 2], [0, 3, 1]])) * 9
    tensor([[3., 3., 2., 1.]])
    """
    a, b, c = (points[:, faces[:, corner]] for corner in range(3))
    normals = torch.linalg.cross(b - a, c - a).repeat_interleave(3, dim=1)
    sums = torch.zeros_like(points).index_add_(1, faces.flatten(), normals)
    shares = sums.norm(dim=2)
    whole = shares.sum(dim=1, keepdim=True)
    return torch.where(whole > 0, shares / whole, 1 / points.shape[1])


def restored(points: Array, centre: Array, scale: Array) -> Array:
    """Normalised points in their own unit and place: the way back of `normalised`."""
    return points * scale + centre


def size_by_edges(points: Array, reference: Array, edges: np.ndarray) -> float:
    """By how much to scale `points` so that their edges are as long as the reference's.

    A network's result has no size of its own, while a pose keeps most edges: the ratio
    of lengths that fits best, by least squares.

    Args:
        points: (N, 3). reference: (N, 3), in metres. edges: (E, 2).

    Raises:
        HeadError: there is no edge, or `points` are all at one place.

    >>> line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    >>> size_by_edges(line, 3 * line[:, [1, 0, 2]], np.array([[0, 1], [1, 2]]))
    3.0
    """
    a, b = (np.asarray(p, np.float64) for p in (points, reference))
    now, wanted = (
        np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1) for p in (a, b)
    )
    if not (now**2).sum() > 0:
        raise HeadError(
            "edges", "none has a length", "give a mesh with triangles of some size"
        )
    return float((now * wanted).sum() / (now**2).sum())


# --- pairs --------------------------------------------------------------------------


class Cast:
    """I identities on meshes of N vertices, and what their bones do in T poses.

    Args:
        heads: with weights, with the bones of the motion, and with as many vertices and
            the same triangles.
        motion: the poses; or for bones that do more than turn, (T, J, 4, 4) transforms
            of each head.

    Attributes:
        rest: (I, N, 3). weights: (I, N, J), or (1, N, J) where all have the same.
        transforms: (I, T + 1, J, 4, 4); the last is the rest pose.
        faces: (F, 3) int64. edges: (E, 2) int64.
        heights: (I,) the longest side of each body's box at rest: how tall it stands.

    Raises:
        HeadError: no heads, one without weights or on another mesh, of no size, or with
            bones that are not those of the motion.
    """

    def __init__(
        self,
        heads: Sequence[Head],
        motion: Motion | Sequence[np.ndarray],
        device: torch.device | str = "cpu",
    ):
        if not heads:
            raise HeadError("identities", "there are none", "give one or more")
        first = heads[0]
        for head in heads:
            _weighted(head)
            if head.vertices.shape != first.vertices.shape or not np.array_equal(
                head.faces, first.faces
            ):
                raise HeadError(
                    "identities",
                    f"{head.name!r} is on another mesh than {first.name!r}",
                    "make one cast for each mesh",
                )
        if isinstance(motion, Motion):
            motion = [motion.transforms(head.skeleton) for head in heads]
        shapes = {(*moves.shape[1:],) for moves in motion}
        counts = {len(moves) for moves in motion}
        wanted = (len(first.skeleton), 4, 4)
        if shapes != {wanted} or len(counts) != 1 or len(motion) != len(heads):
            raise HeadError(
                "transforms",
                f"{len(motion)} arrays for {len(heads)} heads, of shapes "
                f"{sorted({moves.shape for moves in motion})}",
                f"give one of shape (T, {', '.join(map(str, wanted))}) for each head",
            )
        rest = np.stack([head.vertices for head in heads])
        self.rest = torch.tensor(rest, device=device)
        self.heights = normalised(self.rest)[2][:, 0, 0] * 2
        weights = [head.weights for head in heads]
        if all(np.array_equal(weights[0], other) for other in weights[1:]):
            weights = weights[:1]
        self.weights = torch.tensor(np.stack(weights), device=device)
        still = np.broadcast_to(np.eye(4, dtype=np.float32), (1, *wanted))
        moves = np.stack([np.concatenate([moves, still]) for moves in motion])
        self.transforms = torch.tensor(moves.astype(np.float32), device=device)
        self.faces = torch.tensor(first.faces, device=device)
        self.edges = torch.tensor(mesh_edges(first.faces), device=device)

    def __len__(self) -> int:
        return len(self.rest)

    @property
    def poses(self) -> int:
        """T, how many poses there are, the rest pose left out."""
        return self.transforms.shape[1] - 1

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.rest.device

    def posed(self, who: ArrayLike, pose: ArrayLike) -> Tensor:
        """(B, N, 3) the identities `who` in the poses `pose`, in metres; -1 is rest."""
        who, pose = (torch.as_tensor(ids, device=self.device) for ids in (who, pose))
        weights = self.weights[0] if len(self.weights) == 1 else self.weights[who]
        return linear_blend_skinning(
            self.rest[who], weights, self.transforms[who, pose]
        )


class Pairs(NamedTuple):
    """B items, or one without the leading dimension; points are normalised.

    Attributes:
        source: (B, M, 3). identity: (B, N, 3). truth: (B, N, 3), in the identity's
            order.
        faces: (B, F, 3) and edges: (B, E, 2) of identity and truth, in that order.
        centre: (B, 1, 3) and scale: (B, 1, 1) of the truth in metres, for `restored`.
        height: (B,) of the standing identity in the truth's normalised unit.
        source_share: (B, M) and share: (B, N) of source and identity, `vertex_shares`.
        source_order: (B, M) and order: (B, N), which vertex of the mesh each one is.
        who: (B, 4) the source's identity and pose, the target's identity and its pose;
            -1 for the rest pose.
    """

    source: Tensor
    identity: Tensor
    truth: Tensor
    faces: Tensor
    edges: Tensor
    centre: Tensor
    scale: Tensor
    height: Tensor
    source_share: Tensor
    share: Tensor
    source_order: Tensor
    order: Tensor
    who: Tensor

    @property
    def inputs(self) -> tuple[Tensor, ...]:
        """What a network is given: points of both, and their shares of the surface."""
        return self.source, self.identity, self.source_share, self.share


class PosePairs(torch.utils.data.Dataset):
    """`count` items, drawn when they are asked for; each depends on seed and number.

    So training goes on where it stopped by the number of the item alone. `batch` makes
    many items at once, on the device of the casts.

    Args:
        sources, targets: with the same poses; they may be one, or on different meshes.
        count: items, as many as one likes.
        seed: 0 or more.
        poses: numbers of those that the source may take, such as the seen ones; all
            when absent. The identity's own pose is drawn from the same.
        identity_pose: "random", as in NPT and DSFFNet, or "rest".
        noise: the source's points are moved by U(-noise, noise) of the longest side of
            its box along each axis, before it is normalised.
        shuffle: whether vertices come in random order, as two meshes that share nothing
            have them.
        in_order: whether the truths go through all identities, and then through the
            poses, instead of being drawn: for I x T items that miss none.

    Raises:
        HeadError: casts with different numbers of poses or on two devices, a pose that
            they do not have, no count, a negative seed or noise.
    """

    def __init__(
        self,
        sources: Cast,
        targets: Cast,
        count: int,
        seed: int = 0,
        poses: Iterable[int] | None = None,
        identity_pose: Literal["random", "rest"] = "random",
        noise: float = 0.0,
        shuffle: bool = True,
        in_order: bool = False,
    ):
        _countable("items", count, seed)
        if sources.poses != targets.poses or sources.device != targets.device:
            raise HeadError(
                "poses",
                f"the sources have {sources.poses} on {sources.device}, the targets "
                f"{targets.poses} on {targets.device}",
                "make both casts with one motion, on one device",
            )
        self.poses = np.array(range(sources.poses) if poses is None else [*poses])
        if (
            not len(self.poses)
            or not ((0 <= self.poses) & (self.poses < sources.poses)).all()
        ):
            raise HeadError(
                "poses",
                f"{len(self.poses)} are chosen, not all of them among {sources.poses}",
                f"give numbers from 0 to {sources.poses - 1}",
            )
        if not (0 <= noise < np.inf):
            raise HeadError("noise", f"it is {noise:g}", "give 0 or more")
        self.sources, self.targets = sources, targets
        self.count, self.seed, self.identity_pose = count, seed, identity_pose
        self.noise, self.shuffle, self.in_order = noise, shuffle, in_order

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, item: int) -> Pairs:
        if not -self.count <= item < self.count:
            raise IndexError(f"item {item} of {self.count}")
        return Pairs(*(field[0] for field in self.batch([item % self.count])))

    def batch(self, items: Iterable[int]) -> Pairs:
        """The items with these numbers, 0 or more, in one piece."""
        drawn = [self._drawn(int(item)) for item in items]
        who, source_order, order, offset = (
            np.stack(x) for x in zip(*drawn, strict=True)
        )
        device = self.sources.device
        source_order, order = (
            torch.as_tensor(x, device=device) for x in (source_order, order)
        )
        somebody, pose, other, own_pose = who.T.copy()
        source = self.sources.posed(somebody, pose)
        identity = self.targets.posed(other, own_pose)
        if self.noise:
            sides = source.amax(1) - source.amin(1)
            amount = self.noise * sides.amax(1)[:, None, None]
            source = source + amount * torch.as_tensor(offset, device=device)
        source_share = vertex_shares(source, self.sources.faces)
        share = vertex_shares(identity, self.targets.faces)
        source, identity = _taken(source, source_order), _taken(identity, order)
        truth = _taken(self.targets.posed(other, pose), order)
        truth, centre, scale = normalised(truth)
        place = order.argsort(dim=1)
        faces, edges = (
            place[:, ids.reshape(-1)].reshape(len(place), *ids.shape)
            for ids in (self.targets.faces, self.targets.edges)
        )
        who = torch.as_tensor(who, device=device)
        return Pairs(
            normalised(source)[0],
            normalised(identity)[0],
            truth,
            faces,
            edges,
            centre,
            scale,
            self.targets.heights[who[:, 2]] / scale[:, 0, 0],
            source_share.gather(1, source_order),
            share.gather(1, order),
            source_order,
            order,
            who,
        )

    def _drawn(self, item: int) -> tuple[np.ndarray, ...]:
        """Who and in which poses (4,), the two orders, and the noise (M, 3)."""
        rng = np.random.default_rng((self.seed, item))
        who = np.array(
            [
                rng.integers(len(self.sources)),
                rng.choice(self.poses),
                rng.integers(len(self.targets)),
                rng.choice(self.poses),
            ]
        )
        if self.in_order:
            pose, who[2] = divmod(item, len(self.targets))
            who[1] = self.poses[pose % len(self.poses)]
        if self.identity_pose == "rest":
            who[3] = -1
        sizes = self.sources.rest.shape[1], self.targets.rest.shape[1]
        make = rng.permutation if self.shuffle else np.arange
        orders = [make(size) for size in sizes]
        offset = np.zeros((0, 3), np.float32)
        if self.noise:
            offset = rng.uniform(-1, 1, (sizes[0], 3)).astype(np.float32)
        return who, *orders, offset


def _taken(points: Tensor, order: Tensor) -> Tensor:
    return points.gather(1, order[..., None].expand(-1, -1, 3))
