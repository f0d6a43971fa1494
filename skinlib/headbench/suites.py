"""Suites: the ways in which a head differs from the one that an artist painted.

Each makes a variant of a head whose right weights are known, because the artist's went
along. So any method can be judged on it that turns a head into (V, J) weights.

- `untouched`: the head as it came.
- `remesh`: other vertices on the same surface.
- `order`: the same triangles, listed in another way.
- `pieces`: loose pieces (eyes, teeth, hair, a hat) taken off or put on.
- `frame`: other axes, another unit, another place.
- `pose`: a rest pose that is none; joints move along.
- `skeleton`: the same surface on another rig.
"""

import dataclasses
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from trimesh.registration import procrustes

from skinlib.datasets import augment, remesh
from skinlib.geometry import canonical_frame, islands, mesh_edges, weld
from skinlib.head import Head, HeadError, Skeleton
from skinlib.skinning import find_bones, preset_pose

KINDS = ("untouched", "remesh", "order", "pieces", "frame", "pose", "skeleton")
BONES = (5, 60)  # the fewest and the most that `collapsed` leaves
SHIFT = 0.02  # how far `shifted` moves a joint, in diagonals of the bounding box
# Pose, part of the face that it moves, how much of it: jaw half open and a smile.
EXPRESSION = (("jaw_open", "jaw", 0.5), ("smile", "mouth corner", 1.0))
INFLUENCE = 1e-3  # below this a weight says nothing about what moves a piece
ADDED = 0.05  # pieces put on have at least this part of the head's vertices
CAP = 0.7  # the cap of hair begins at this part of the head's height
LIFT = 0.03  # and lies so far above the skin, in the head's scale


@dataclass(frozen=True)
class Suite:
    """One way in which a head differs.

    Attributes:
        kind: one of `KINDS`.
        make: from a head with weights, a generator and the other heads, its variant.
        text: what is different, in a line for people.
    """

    kind: str
    make: Callable[[Head, np.random.Generator, Sequence[Head]], Head]
    text: str


def vary(name: str, head: Head, seed: int, others: Sequence[Head] = ()) -> Head:
    """The variant of a head in one suite; the same arguments give the same one.

    Args:
        name: a key of `SUITES`.
        seed: 0 or more. Suites and heads (by name) each have numbers of their own.
        others: heads that `pieces_added` may take pieces from.

    Returns:
        A head of the same name; its weights are what a method should say about it.

    Raises:
        HeadError: no such suite, a head without weights, or one that cannot differ in
            this way: it has no loose piece to lose, or one bone and no other order.

    >>> from skinlib.datasets.synthetic import synthetic_head
    >>> head = synthetic_head(0, vertices=700)
    >>> soup = vary("unwelded", head, seed=0)
    >>> len(soup.vertices) == 3 * len(head.faces)
    True
    """
    if name not in SUITES:
        raise HeadError(
            "suite", f"there is no {name!r}", f"choose among {', '.join(SUITES)}"
        )
    if head.weights is None:
        raise HeadError("weights", "there are none", "vary a head that has weights")
    if SUITES[name].kind == "remesh":
        _needs_faces(head)
    draws = [seed, zlib.crc32(name.encode()), zlib.crc32(head.name.encode())]
    variant = SUITES[name].make(head, np.random.default_rng(draws), others)
    # Checked again: some of the changes trust what they are given.
    return variant.replace(name=head.name)


# ---- remesh


def decimate(head: Head, rng: np.random.Generator, vertices: int = 1000) -> Head:
    """About `vertices` are left, by quadric edge collapse; within 5 % if it can be.

    Raises:
        HeadError: the head has no more than that, or no faces.
    """
    if len(head.vertices) <= vertices:
        raise HeadError(
            "vertices",
            f"there are {len(head.vertices)}, which is not above {vertices}",
            "decimate a finer head",
        )
    keep, coarse = 1.0, head
    # Closed seams and open borders spoil the proportion, so look and correct.
    for _ in range(4):
        keep = min(keep * vertices / len(coarse.vertices), 0.999)
        coarse = remesh.halve(head, rng, keep)
        if abs(len(coarse.vertices) / vertices - 1) < 0.05:
            break
    return coarse


def upsample(head: Head, rng: np.random.Generator, vertices: int = 100_000) -> Head:
    """At least `vertices`, and few more: edges get a vertex in their middle.

    All edges do as long as there is room, then the longest. Each new vertex has the
    mean weights of its edge's ends; the surface is the same to the last point.

    Raises:
        HeadError: the head has that many already, or no faces.
    """
    _needs_faces(head)
    if len(head.vertices) >= vertices:
        raise HeadError(
            "vertices",
            f"there are {len(head.vertices)}, which is not below {vertices}",
            "upsample a coarser head",
        )
    while len(head.vertices) + len(mesh_edges(head.faces)) <= vertices:
        head = remesh.subdivide(head, rng)
    missing = vertices - len(head.vertices)
    return remesh.shuffle(_split_longest(head, missing), rng) if missing else head


def _split_longest(head: Head, count: int) -> Head:
    """The longest edges, `count` and those as long, halved; no T-junctions."""
    edges = mesh_edges(head.faces)
    ends = head.vertices[edges].astype(np.float64)
    length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    # The two sides of a seam are as long as each other: split both.
    shortest = np.sort(length)[-count] * (1 - 1e-6)
    edges, length = edges[length >= shortest], length[length >= shortest]
    old, size = len(head.vertices), len(head.vertices) + len(edges)
    key = edges[:, 0] * size + edges[:, 1]  # sorted, as `mesh_edges` sorts

    faces = head.faces
    for _ in range(2):  # a face with three such edges is cut, then both its halves
        a, b = np.sort([faces, np.roll(faces, -1, axis=1)], axis=0)  # (F, 3) sides
        place = np.searchsorted(key, a * size + b).clip(max=len(key) - 1)
        found = key[place] == a * size + b
        side = np.where(found, length[place], -1).argmax(axis=1)
        cut = found.any(axis=1)
        turn = (side[cut, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[cut], turn, axis=1).T
        middle = old + place[cut, side[cut]]
        halves = [np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)]
        faces = np.concatenate([faces[~cut], *halves])
    return head.replace(
        faces=faces,
        **{
            name: np.concatenate([values, values[edges].mean(axis=1)])
            for name, values in _vertex_values(head).items()
        },
    )


# ---- order


def _unwelded(head: Head) -> Head:
    """Each triangle with three vertices of its own; normals and weights as before."""
    _needs_faces(head)
    corners = head.faces.ravel()
    faces = np.arange(len(corners)).reshape(-1, 3)
    return head.replace(faces=faces, **_vertex_values(head, corners))


# ---- pieces


def _without_pieces(head: Head) -> Head:
    """The face alone: eyes, teeth, hair and hats are gone, their bones are not."""
    _needs_faces(head)
    piece, face = _pieces(head)
    if piece.max() == 0:
        raise HeadError(
            "faces",
            "there are no loose pieces",
            "give a head whose eyes, teeth or hair are pieces of their own",
        )
    return _part(head, piece == face)


def _with_pieces(head: Head, rng: np.random.Generator, others: Sequence[Head]) -> Head:
    """Loose pieces of another head, or a cap of hair where none has any that fits."""
    for i in rng.permutation(len(others)):
        added = _pieces_for(head, others[i])
        if added is not None and len(added.vertices) >= ADDED * len(head.vertices):
            return _joined(head, added)
    return _joined(head, _cap(head))


def _pieces_for(head: Head, other: Head) -> Head | None:
    """The loose pieces of `other` that `head` can wear, on the skeleton of `head`.

    They come along by the similarity that fits the joints of bones with common names
    best, and those bones keep their weights. A piece stays behind that some other bone
    moves, or that lies where this head has one already, such as an eye.
    """
    mine, theirs = head.skeleton, other.skeleton
    common = np.flatnonzero(np.isin(theirs.names, mine.names))
    same = np.array_equal(head.vertices, other.vertices)
    if other.weights is None or same or len(common) < augment.MIN_SHARED_BONES:
        return None
    bone = np.array([mine.names.index(theirs.names[j]) for j in common])
    fit, _, _ = procrustes(theirs.joints[common], mine.joints[bone], reflection=False)
    turn, shift = fit[:3, :3], fit[:3, 3]
    vertices, normals = other.vertices @ turn.T + shift, other.normals @ turn.T
    weights = np.zeros((len(vertices), len(mine)), np.float32)
    weights[:, bone] = other.weights[:, common]
    known = weights.sum(axis=1) > 1 - 1e-5

    worn = [_place(head.vertices, head.weights, rows) for rows in _loose(head)]
    kept = np.zeros(len(vertices), bool)
    for rows in _loose(other):
        place = _place(vertices, weights, rows)
        kept |= rows & (known[rows].all() and not any(_meet(place, it) for it in worn))
    if not kept.any():
        return None
    faces = (np.cumsum(kept) - 1)[other.faces[kept[other.faces].all(axis=1)]]
    return Head.create(vertices[kept], faces, mine, weights[kept], normals[kept])


def _cap(head: Head) -> Head:
    """The top of the skin once more, a little further out, like a cap of hair."""
    piece, face = _pieces(head)
    joints, parents = head.skeleton.joints, head.skeleton.parents
    frame = canonical_frame(head.vertices, head.faces, joints, parents)
    height = frame.apply(head.vertices)[:, 1]
    low, high = height[piece == face].min(), height[piece == face].max()
    top = (piece == face) & (height >= low + CAP * (high - low))
    used = np.unique(head.faces[top[head.faces].all(axis=1)])
    if len(used) == 0:
        raise HeadError(
            "faces", "there are none on top of the head", "give a head with a scalp"
        )
    cap = _part(head, np.isin(np.arange(len(top)), used))
    return cap.replace(
        vertices=cap.vertices + LIFT * frame.scale * cap.normals, normals=cap.normals
    )


def _pieces(head: Head) -> tuple[np.ndarray, int]:
    """(V,) the connected piece of each vertex, and which of them is the face.

    The face is what most bones move: a helmet may well have more vertices.
    """
    piece = islands(head.faces, len(head.vertices), weld(head.vertices))
    moved = np.zeros((piece.max() + 1, len(head.skeleton)), bool)
    vertex, bone = np.nonzero(head.weights > INFLUENCE)
    moved[piece[vertex], bone] = True
    return piece, int(np.lexsort((np.bincount(piece), moved.sum(axis=1)))[-1])


def _loose(head: Head) -> list[np.ndarray]:
    """(V,) bool for each piece but the face: its vertices."""
    piece, face = _pieces(head)
    return [piece == i for i in range(piece.max() + 1) if i != face]


def _place(vertices, weights, rows) -> tuple[int, np.ndarray, float]:
    """The bone that moves a piece most, the middle of its box, the box's diagonal."""
    low, high = vertices[rows].min(axis=0), vertices[rows].max(axis=0)
    bone = int(weights[rows].sum(axis=0).argmax())
    return bone, (low + high) / 2, float(np.linalg.norm(high - low))


def _meet(a, b) -> bool:
    """Whether two pieces are the same thing: one bone, and nearly one place."""
    distance = float(np.linalg.norm(a[1] - b[1]))
    return a[0] == b[0] and distance < min(a[2], b[2]) / 2


def _part(head: Head, kept: np.ndarray) -> Head:
    """The vertices in `kept`, (V,) bool, and the triangles between them."""
    faces = (np.cumsum(kept) - 1)[head.faces[kept[head.faces].all(axis=1)]]
    return head.replace(faces=faces, **_vertex_values(head, kept))


def _joined(head: Head, added: Head) -> Head:
    """Two meshes on one skeleton."""
    values, more = _vertex_values(head), _vertex_values(added)
    return head.replace(
        faces=np.concatenate([head.faces, added.faces + len(head.vertices)]),
        **{name: np.concatenate([values[name], more[name]]) for name in values},
    )


# ---- frame


def _rotated(head: Head, rng: np.random.Generator) -> Head:
    """One of the 24 axis frames, a unit of 0.01 to 1000, somewhere else."""
    turn = Rotation.create_group("O").as_matrix().round()[rng.integers(24)]
    axes, signs = np.abs(turn).argmax(axis=1), turn.sum(axis=1)
    factor = 10 ** rng.uniform(-2, 3)
    shift = rng.uniform(-1, 1, 3) * factor * _diagonal(head)

    # Entry by entry: what lay at one place does so afterwards, to the bit.
    def move(points):
        return points[:, axes] * (signs * factor) + shift

    skeleton = head.skeleton
    return head.replace(
        vertices=move(head.vertices),
        normals=head.normals[:, axes] * signs,
        skeleton=Skeleton.from_heads_and_tails(
            move(skeleton.joints),
            move(skeleton.tails),
            skeleton.parents,
            skeleton.names,
        ),
    )


# ---- pose


def _expression(head: Head) -> Head:
    motions = np.eye(4)
    for pose, part, amount in EXPRESSION:
        if find_bones(head.skeleton, part):
            motions = motions @ preset_pose(head, pose, amount)
    if motions.ndim == 2:
        raise HeadError(
            "bone_names",
            "no bone is named like a jaw or a corner of the mouth",
            "give a head whose face can move",
        )
    return augment.apply_pose(head, motions)


def _posed(head: Head, rng: np.random.Generator) -> Head:
    """The head turned by 15 to 30 degrees; half the bones by some 4 degrees, too."""
    if (head.skeleton.parents < 0).all():
        raise _too_few_bones(head, "no bone turns against another")
    amount = rng.uniform(0.5, 1) * rng.choice([-1, 1])
    turned = augment.apply_pose(head, preset_pose(head, "head_turn", amount))
    return augment.pose(turned, rng)


# ---- skeleton


def _collapsed(head: Head, rng: np.random.Generator) -> Head:
    """5 to 60 bones are left, few as likely as many by factors; at least one goes."""
    count = len(head.skeleton)
    below = np.flatnonzero(head.skeleton.parents >= 0)
    fewest, most = max(BONES[0], count - len(below)), min(BONES[1], count - 1)
    if most < fewest:
        raise _too_few_bones(head, f"{fewest} have to stay")
    left = round(np.exp(rng.uniform(np.log(fewest), np.log(most))))
    merged = np.zeros(count, bool)
    merged[rng.choice(below, count - left, replace=False)] = True
    return augment.merge_bones(head, merged)


def _renamed(head: Head, rng: np.random.Generator) -> Head:
    names = tuple(f"bone_{i}" for i in rng.permutation(len(head.skeleton)))
    return head.replace(skeleton=dataclasses.replace(head.skeleton, names=names))


def _reordered(head: Head, rng: np.random.Generator) -> Head:
    if len(head.skeleton) < 2:
        raise _too_few_bones(head, "there is no other order")
    return augment.reorder_bones(head, rng)


def _shifted(head: Head, rng: np.random.Generator) -> Head:
    """Each joint, with its tail, on its own; the root mean square is `SHIFT`."""
    moved = augment.jitter(head, rng, vertices=0, joints=SHIFT)
    return head.replace(skeleton=moved.skeleton)


# ---- shared


def _vertex_values(head: Head, rows=slice(None)) -> dict[str, np.ndarray]:
    """The arrays of a head that have a row for each vertex, those of `rows`."""
    names = "vertices", "normals", "weights"
    return {name: getattr(head, name)[rows] for name in names}


def _diagonal(head: Head) -> float:
    return float(np.linalg.norm(np.ptp(head.vertices.astype(np.float64), axis=0)))


def _needs_faces(head: Head) -> None:
    if len(head.faces) == 0:
        raise HeadError("faces", "there are none", "give a head with a surface")


def _too_few_bones(head: Head, why: str) -> HeadError:
    return HeadError(
        "bone_parents", f"{len(head.skeleton)} bones: {why}", "give a richer skeleton"
    )


SUITES: dict[str, Suite] = {
    "untouched": Suite(
        "untouched", lambda head, rng, others: head, "the head as it came"
    ),
    "halved": Suite(
        "remesh",
        lambda head, rng, others: remesh.halve(head, rng),
        "half the triangles, by quadric edge collapse",
    ),
    "subdivided": Suite(
        "remesh",
        lambda head, rng, others: remesh.subdivide(head, rng),
        "four triangles for each",
    ),
    "isotropic": Suite(
        "remesh",
        lambda head, rng, others: remesh.isotropic(head, rng),
        "as many vertices, spread evenly over the surface",
    ),
    "decimated": Suite(
        "remesh",
        lambda head, rng, others: decimate(head, rng),
        "1,000 vertices left, by quadric edge collapse",
    ),
    "upsampled": Suite(
        "remesh",
        lambda head, rng, others: upsample(head, rng),
        "100,000 vertices, edges split in their middle",
    ),
    "shuffled": Suite(
        "order",
        lambda head, rng, others: remesh.shuffle(head, rng),
        "vertices, triangles and their corners in random order",
    ),
    "unwelded": Suite(
        "order",
        lambda head, rng, others: _unwelded(head),
        "each triangle with three vertices of its own",
    ),
    "faceted": Suite(
        "order",
        lambda head, rng, others: _unwelded(head).replace(normals=None),
        "unwelded, with the triangles' own normals",
    ),
    "pieces_missing": Suite(
        "pieces",
        lambda head, rng, others: _without_pieces(head),
        "eyes, teeth, hair and all else that is loose is gone",
    ),
    "pieces_added": Suite(
        "pieces", _with_pieces, "hair, hat or what else is loose on another head put on"
    ),
    "rotated": Suite(
        "frame",
        lambda head, rng, others: _rotated(head, rng),
        "one of the 24 axis frames, another unit (0.01 to 1000), another place",
    ),
    "expression": Suite(
        "pose",
        lambda head, rng, others: _expression(head),
        "the jaw half open and a smile, in the rest pose",
    ),
    "posed": Suite(
        "pose",
        lambda head, rng, others: _posed(head, rng),
        "the head turned 15 to 30 degrees and small turns of bones, in the rest pose",
    ),
    "collapsed": Suite(
        "skeleton",
        lambda head, rng, others: _collapsed(head, rng),
        "random bones dissolved into their parents; 5 to 60 are left",
    ),
    "renamed": Suite(
        "skeleton",
        lambda head, rng, others: _renamed(head, rng),
        "bones called bone_0, bone_1, ... at random",
    ),
    "reordered": Suite(
        "skeleton",
        lambda head, rng, others: _reordered(head, rng),
        "bones in random order",
    ),
    "shifted": Suite(
        "skeleton",
        lambda head, rng, others: _shifted(head, rng),
        "each joint 2 % of the head's size off",
    ),
}
