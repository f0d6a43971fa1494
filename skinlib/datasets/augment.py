"""More heads from one: random changes under which the right weights are still known.

Each function takes a head and a generator and returns a new head; weights may be absent
where nothing is said. What becomes of the mesh decides whether a graph built for the
head still fits:

- vertices and triangles stay: `scale`, `stretch`, `rotate`, `warp`, `resemble`,
  `jitter`, `pose`, `collapse_bones`, `reorder_bones`; `mirror` only turns the
  triangles around.
- other triangles between the same vertices: `flip_edges`.
- other vertices: `cut_seams`, `drop_islands`, `reorder_vertices`.

`augment` strings them together. With the default configuration vertices keep their
places, so a graph may be built once per head.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial.transform import Rotation

from skinlib.datasets import synthetic
from skinlib.geometry import canonical_frame, islands, vertex_normals, weld
from skinlib.head import Head, HeadError, Skeleton
from skinlib.skinning import (
    forward_kinematics,
    linear_blend_skinning,
    mirror_pairs,
)

MIN_SHARED_BONES = 8
_NOT_YET = np.zeros((0, 3), np.float32)  # normals that a later step computes


@dataclass(frozen=True)
class AugmentConfig:
    """How much of each change `augment` makes; 0 or False switches one off."""

    collapse: float = 0.25  # chance that a head loses bones
    collapse_share: float = 0.1  # part of its bones that it then loses
    mirror: float = 0.5  # chance to swap left and right
    pose: float = 0.5  # chance to be posed, by the weights it has
    pose_degrees: float = 4.0  # standard deviation of a posed bone's turn
    resemble: float = 0.5  # chance to take over proportions of another training head
    warp: float = 0.8  # largest gradient of a smooth warp, below 1; drawn from 0 up
    stretch: float = 0.1  # standard deviation of the log of each axis' scale
    rotate: float = 5.0  # standard deviation of the turn of the whole head, degrees
    scale: float = 1.0  # largest factor up or down; the network knows no unit anyway
    jitter: float = 0.0005  # how far vertices move, in diagonals of the bounding box
    joint_jitter: float = 0.006  # how far joints move, likewise
    reorder_bones: bool = True  # put bones in random order
    # These change vertices or triangles: a graph has to be built anew.
    drop_islands: float = 0.0  # chance of each loose piece (eyes, hair) to go
    flip_edges: float = 0.0  # part of the flat edges to flip
    cut_seams: float = 0.0  # chance that the mesh is cut along a plane
    reorder_vertices: bool = False  # put vertices in random order

    @property
    def keeps_mesh(self) -> bool:
        """Whether vertices and triangles keep their ids, so that a graph still fits."""
        changes = self.drop_islands, self.flip_edges, self.cut_seams
        return not (any(changes) or self.reorder_vertices)

    @property
    def on_the_same_mesh(self) -> "AugmentConfig":
        """The same changes, without those of vertices and triangles."""
        return dataclasses.replace(
            self,
            drop_islands=0.0,
            flip_edges=0.0,
            cut_seams=0.0,
            reorder_vertices=False,
        )


UNDISTURBED = AugmentConfig(
    collapse=0.0,
    mirror=0.0,
    pose=0.0,
    resemble=0.0,
    warp=0.0,
    stretch=0.0,
    rotate=0.0,
    jitter=0.0,
    joint_jitter=0.0,
    reorder_bones=False,
)


def augment(
    head: Head,
    rng: np.random.Generator,
    config: AugmentConfig | None = None,
    others: Sequence[Head] = (),
) -> Head:
    """A random variation of a head; the same state of `rng` gives the same one.

    Args:
        others: heads whose proportions it may take over, see `resemble`.

    >>> head = synthetic.synthetic_head(0, vertices=700)
    >>> other = augment(head, np.random.default_rng(0))
    >>> other.vertices.shape == head.vertices.shape
    True
    """
    config = config or AugmentConfig()
    if rng.random() < config.collapse:
        head = collapse_bones(head, rng, config.collapse_share)
    if config.drop_islands:
        head = drop_islands(head, rng, config.drop_islands)
    if rng.random() < config.mirror:
        head = mirror(head)

    before, head = head, _with(head, normals=_NOT_YET)
    if rng.random() < config.pose and head.weights is not None:
        head = pose(head, rng, config.pose_degrees)
    if others and rng.random() < config.resemble:
        other = others[int(rng.integers(len(others)))]
        head = resemble(head, other, rng.random())
    if config.warp:
        head = warp(head, rng, config.warp * rng.random())
    if config.stretch:
        head = stretch(head, rng, config.stretch)
    if config.rotate:
        head = rotate(head, rng, config.rotate)
    if config.scale != 1:
        head = scale(head, rng, config.scale)
    if config.jitter or config.joint_jitter:
        head = jitter(head, rng, config.jitter, config.joint_jitter)
    # Checked, and its normals computed, once for all of these steps.
    moved = head.vertices is not before.vertices
    head = head.replace(normals=None if moved else before.normals)

    if config.flip_edges:
        head = flip_edges(head, rng, config.flip_edges)
    if rng.random() < config.cut_seams:
        head = cut_seams(head, rng)
    if config.reorder_vertices:
        head = reorder_vertices(head, rng)
    if config.reorder_bones:
        head = reorder_bones(head, rng)
    return head


def scale(head: Head, rng: np.random.Generator, largest: float = 2.0) -> Head:
    """Another unit: all lengths times a factor between 1 / `largest` and `largest`."""
    factor = np.exp(rng.uniform(-1, 1) * np.log(largest))
    skeleton = _skeleton(
        head.skeleton, head.skeleton.joints * factor, head.skeleton.tails * factor
    )
    vertices = (head.vertices * factor).astype(np.float32)
    return _with(head, vertices=vertices, skeleton=skeleton)


def stretch(head: Head, rng: np.random.Generator, amount: float = 0.08) -> Head:
    """Scale each axis of the file on its own, by exp of a normal draw of `amount`."""
    centre, factors = _centre(head), np.exp(rng.normal(0, amount, 3))
    return _move_space(head, lambda points: (points - centre) * factors + centre)


def rotate(head: Head, rng: np.random.Generator, degrees: float = 5.0) -> Head:
    """Turn the head about its middle; `degrees` is a standard deviation per axis."""
    centre, turn = _centre(head), _turns(rng, 1, degrees)[0]
    return _move_space(head, lambda points: (points - centre) @ turn.T + centre)


class Warp:
    """A smooth map of space that never folds: a sum of Gaussian bumps.

    x moves to x + sum_k a_k exp(-|x - c_k|^2 / (2 s_k^2)).
    One bump has a gradient of at most |a_k| exp(-1/2) / s_k. The offsets a_k are scaled
    so that these add up to `strength` < 1; the Jacobian I + grad u is then positive.

    Args:
        middle: (3,), around which the bumps lie, within 0.4 `size` along each axis.
        strength: 0 .. 1, a bound on the change of any distance, relative.

    Raises:
        ValueError: a strength out of range.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        middle: np.ndarray,
        size: float,
        strength: float,
        bumps: int = 8,
    ):
        if not 0 <= strength < 1:
            raise ValueError(f"strength is {strength}, it has to lie in 0 .. 1")
        self.middle = middle
        self.centres = middle + size * rng.uniform(-0.4, 0.4, (bumps, 3))
        self.widths = size * rng.uniform(0.08, 0.3, bumps)
        # A wide bump may move further than a narrow one for the same gradient.
        offsets = rng.normal(size=(bumps, 3)) * self.widths[:, None]
        steepest = np.linalg.norm(offsets, axis=1) * np.exp(-0.5) / self.widths
        self.offsets = offsets * strength / steepest.sum()

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) warped points."""
        near, centres = points - self.middle, self.centres - self.middle
        squared = (near**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1)
        squared -= 2 * near @ centres.T  # (N, K)
        return points + np.exp(-0.5 * squared / self.widths**2) @ self.offsets


def warp(head: Head, rng: np.random.Generator, strength: float = 0.3) -> Head:
    """Another face: a random `Warp` of vertices, joints and tails alike."""
    return _move_space(head, Warp(rng, _centre(head), _diagonal(head), strength))


def resemble(head: Head, other: Head, amount: float = 1.0) -> Head:
    """Another head's proportions on this mesh: joints move towards the other's.

    Bones are matched by name. The way of each joint, in a common centre and size, is
    spread over space by the smoothest linear radial basis function; a head with fewer
    than `MIN_SHARED_BONES` names in common stays as it is.

    Args:
        amount: 0 .. 1, part of the way.
    """
    place = {name: bone for bone, name in enumerate(other.skeleton.names)}
    pairs = [
        (bone, place[name])
        for bone, name in enumerate(head.skeleton.names)
        if name in place
    ]
    if len(pairs) < MIN_SHARED_BONES:
        return head
    mine, theirs = np.array(pairs).T
    mine = head.skeleton.joints[mine].astype(np.float64)
    theirs = other.skeleton.joints[theirs].astype(np.float64)
    centre, size = mine.mean(axis=0), mine.std()
    if not (size > 0 and theirs.std() > 0):
        return head
    mine = (mine - centre) / size
    theirs = (theirs - theirs.mean(axis=0)) / theirs.std()
    # Joints in one place would pull it in two directions.
    _, first = np.unique(mine.round(3), axis=0, return_index=True)
    way = RBFInterpolator(
        mine[first], (theirs - mine)[first], kernel="linear", degree=0, smoothing=0.01
    )

    def move(points):
        return points + amount * size * way((points - centre) / size)

    return _move_space(head, move)


def jitter(
    head: Head,
    rng: np.random.Generator,
    vertices: float = 0.0005,
    joints: float = 0.003,
) -> Head:
    """Roughen the surface and misplace the joints, a little.

    Vertices follow waves about as long as an edge rather than independent noise: the
    two sides of a seam, and two lips that touch, stay together.

    Args:
        vertices: root mean square move, in diagonals of the bounding box.
        joints: likewise per joint; a tail moves with its joint.
    """
    size = _diagonal(head)
    waves = 6
    direction = rng.normal(size=(waves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length = size * rng.uniform(0.015, 0.05, (waves, 1))
    phase = (head.vertices - _centre(head)) @ (2 * np.pi * direction / length).T
    offset = rng.normal(0, vertices * size * np.sqrt(2 / waves / 3), (waves, 3))
    moved = head.vertices + np.sin(phase + rng.uniform(0, 2 * np.pi, waves)) @ offset
    shift = rng.normal(0, joints * size / np.sqrt(3), head.skeleton.joints.shape)
    skeleton = _skeleton(
        head.skeleton, head.skeleton.joints + shift, head.skeleton.tails + shift
    )
    return _deformed(head, moved, skeleton)


def pose(
    head: Head, rng: np.random.Generator, degrees: float = 4.0, share: float = 0.5
) -> Head:
    """Bend the head by linear blend skinning and call the result its rest pose.

    Args:
        degrees: standard deviation of a bone's turn, per axis.
        share: the part of the bones that turn; roots never do, see `rotate`.

    Raises:
        HeadError: the head has no weights.
    """
    if head.weights is None:
        raise HeadError("weights", "there are none", "pose a head that has weights")
    count = len(head.skeleton)
    turns = _turns(rng, count, degrees)
    still = (rng.random(count) >= share) | (head.skeleton.parents < 0)
    turns[still] = np.eye(3)
    return apply_pose(head, turns)


def apply_pose(head: Head, rotations: np.ndarray) -> Head:
    """The head posed by (J, 3, 3) rotations, as a new rest pose: joints move along."""
    transforms = forward_kinematics(head.skeleton, rotations)
    turn, shift = transforms[:, :3, :3], transforms[:, :3, 3]
    joints, tails = (
        np.einsum("jab,jb->ja", turn, ends) + shift
        for ends in (head.skeleton.joints, head.skeleton.tails)
    )
    moved = linear_blend_skinning(head.vertices, head.weights, transforms)
    return _deformed(head, moved, _skeleton(head.skeleton, joints, tails))


def mirror(head: Head, rng: np.random.Generator | None = None) -> Head:
    """Swap left and right: the coordinate from ear to ear changes its sign.

    A bone takes the place, the parent and the weights of the bone on the other side
    (`mirror_pairs`), so that a left eye by name is still on the left. Twice is the
    identity. `rng` is not used.
    """
    skeleton = head.skeleton
    frame = canonical_frame(
        head.vertices, head.faces, skeleton.joints, skeleton.parents
    )
    sign = np.ones(3, np.float32)
    sign[np.abs(frame.rotation[0]).argmax()] = -1
    pairs = mirror_pairs(skeleton)
    other = skeleton.reordered(pairs)
    return _with(
        head,
        vertices=head.vertices * sign,
        normals=head.normals * sign,
        faces=np.ascontiguousarray(head.faces[:, ::-1]),
        skeleton=_with(
            other,
            joints=other.joints * sign,
            directions=other.directions * sign,
            names=skeleton.names,
        ),
        weights=None if head.weights is None else head.weights[:, pairs],
    )


def collapse_bones(head: Head, rng: np.random.Generator, share: float = 0.1) -> Head:
    """A coarser rig: about `share` of the bones dissolve into their parents."""
    drawn = rng.random(len(head.skeleton)) < share
    return merge_bones(head, drawn & (head.skeleton.parents >= 0))


def merge_bones(head: Head, merged: np.ndarray) -> Head:
    """The head without some bones; their weight and children go to their parents.

    Args:
        merged: (J,) bool.

    Raises:
        HeadError: a root is to be merged.

    >>> head = synthetic.synthetic_head(0, vertices=700, bones=8, shuffle=False)
    >>> jaw = np.array(head.skeleton.names) == "jaw"
    >>> merge_bones(head, jaw).skeleton.names
    ('neck', 'head', 'eye_L', 'eye_R', 'lid_upper_L', 'lid_upper_R', 'nose')
    """
    skeleton = head.skeleton
    roots = np.flatnonzero(merged & (skeleton.parents < 0))
    if len(roots):
        raise HeadError(
            "bone_parents",
            f"{skeleton.names[roots[0]]!r} is a root",
            "merge bones that have a parent",
        )
    if not merged.any():
        return head
    heir = np.arange(len(skeleton))
    while merged[heir].any():
        heir = np.where(merged[heir], skeleton.parents[heir], heir)
    kept = np.flatnonzero(~merged)
    place = np.cumsum(~merged) - 1
    parents = skeleton.parents[kept]
    parents = np.where(parents >= 0, place[heir[parents]], -1)
    weights = head.weights
    if weights is not None:
        sums = np.zeros((len(skeleton), len(kept)), weights.dtype)
        sums[np.arange(len(skeleton)), place[heir]] = 1
        weights = weights @ sums
    fewer = _with(
        skeleton,
        joints=skeleton.joints[kept],
        parents=parents,
        lengths=skeleton.lengths[kept],
        directions=skeleton.directions[kept],
        names=tuple(skeleton.names[bone] for bone in kept),
    )
    return _with(head, skeleton=fewer, weights=weights)


def reorder_bones(head: Head, rng: np.random.Generator) -> Head:
    """The same head with its bones, and columns of weights, in random order."""
    order = rng.permutation(len(head.skeleton))
    weights = None if head.weights is None else head.weights[:, order]
    skeleton = head.skeleton.reordered(order)
    return _with(head, skeleton=skeleton, weights=weights)


def reorder_vertices(head: Head, rng: np.random.Generator) -> Head:
    """The same head with its vertices in random order; triangles follow."""
    return _select_vertices(head, rng.permutation(len(head.vertices)), head.faces)


def drop_islands(head: Head, rng: np.random.Generator, chance: float = 0.3) -> Head:
    """Lose loose pieces (eyes, teeth, hair), each by `chance`; never the largest.

    Pieces that a seam cut apart count as one. Bones stay, even those that move nothing.
    """
    label = islands(head.faces, len(head.vertices), weld(head.vertices))
    sizes = np.bincount(label)
    lost = rng.random(len(sizes)) < chance
    lost[sizes.argmax()] = False
    if not lost.any():
        return head
    kept = ~lost[label]
    return _select_vertices(
        head, np.flatnonzero(kept), head.faces[kept[head.faces].all(axis=1)]
    )


def flip_edges(head: Head, rng: np.random.Generator, fraction: float = 0.2) -> Head:
    """Other diagonals in nearly flat quads, see `skinlib.datasets.synthetic`."""
    faces = synthetic.flip_edges(head.vertices, head.faces, rng, fraction)
    return _with(head, faces=faces)


def cut_seams(head: Head, rng: np.random.Generator) -> Head:
    """Cut the mesh along a random plane, as the borders of texture maps do.

    Vertices on the cut are doubled: the copy has the same place, normal and weights.
    """
    faces = head.faces.copy()
    if len(faces) == 0:
        return head
    plane = rng.normal(size=3)
    middle = head.vertices[faces].mean(axis=1) @ plane
    beyond = middle > np.quantile(middle, rng.uniform(0.2, 0.8))
    here, there = np.unique(faces[~beyond]), np.unique(faces[beyond])
    shared = np.intersect1d(here, there, assume_unique=True)
    copy = np.arange(len(head.vertices))
    copy[shared] = len(copy) + np.arange(len(shared))
    faces[beyond] = copy[faces[beyond]]
    ids = np.concatenate([np.arange(len(head.vertices)), shared])
    weights = head.weights
    return _with(
        head,
        vertices=head.vertices[ids],
        normals=head.normals[ids],
        faces=faces,
        weights=None if weights is None else weights[ids],
    )


def _with(record, **changes):
    """A copy with some fields changed; what a head held stays true, so no check."""
    for value in changes.values():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    return dataclasses.replace(record, **changes)


def _select_vertices(head: Head, ids: np.ndarray, faces: np.ndarray) -> Head:
    """Vertices `ids` in that order; `faces` speak of the old ids."""
    place = np.full(len(head.vertices), -1)
    place[ids] = np.arange(len(ids))
    return _with(
        head,
        vertices=head.vertices[ids],
        normals=head.normals[ids],
        faces=place[faces],
        weights=None if head.weights is None else head.weights[ids],
    )


def _move_space(head: Head, move) -> Head:
    """Vertices, joints and tails through one map of space."""
    skeleton = head.skeleton
    joints, tails = move(skeleton.joints), move(skeleton.tails)
    return _deformed(head, move(head.vertices), _skeleton(skeleton, joints, tails))


def _deformed(head: Head, vertices: np.ndarray, skeleton: Skeleton) -> Head:
    vertices = vertices.astype(np.float32)
    normals = head.normals
    if normals is not _NOT_YET:
        normals = vertex_normals(vertices, head.faces)
    return _with(head, vertices=vertices, normals=normals, skeleton=skeleton)


def _skeleton(skeleton: Skeleton, joints: np.ndarray, tails: np.ndarray) -> Skeleton:
    # A bone without a length must not get one from rounding, nor a direction.
    tails = np.where(skeleton.lengths[:, None] > 0, tails, joints)
    return Skeleton.from_heads_and_tails(
        joints.astype(np.float32),
        tails.astype(np.float32),
        skeleton.parents,
        skeleton.names,
    )


def _turns(rng: np.random.Generator, count: int, degrees: float) -> np.ndarray:
    """(count, 3, 3) random rotations."""
    vectors = np.radians(rng.normal(0, degrees, (count, 3)))
    return Rotation.from_rotvec(vectors).as_matrix()


def _centre(head: Head) -> np.ndarray:
    low, high = head.vertices.min(axis=0), head.vertices.max(axis=0)
    return (low.astype(np.float64) + high) / 2


def _diagonal(head: Head) -> float:
    """Of the bounding box; 1 when all vertices lie in one place."""
    size = np.linalg.norm(np.ptp(head.vertices.astype(np.float64), axis=0))
    return float(size) or 1.0
