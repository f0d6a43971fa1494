"""What skin weights are for: posing a head; and which bones and vertices are which.

Symbols: V vertices, J bones; p_j joint positions, w_vj skin weights, T_j transforms.
`linear_blend_skinning` and `forward_kinematics` take numpy arrays or torch tensors and
return the same kind; leading batch dimensions of the pose are kept.
"""

import re
from typing import TypeVar

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from skinlib.geometry import Frame, canonical_frame, islands
from skinlib.graph import seam_nodes
from skinlib.head import Head, HeadError, Skeleton

Array = TypeVar("Array", np.ndarray, torch.Tensor)

PRESET_POSES = ("jaw_open", "blink", "head_turn", "smile")

# Joints closer to their mirror image than this part of the skeleton's longest side
# are a pair; a hand-placed rig is off by one or two per cent.
PAIR_TOLERANCE = 0.05
# The same for vertices, relative to the diagonal of the head's bounding box.
VERTEX_TOLERANCE = 0.01


def linear_blend_skinning(vertices: Array, weights: Array, transforms: Array) -> Array:
    """Posed vertices: x_v = sum_j w_vj (T_j [p_v; 1]). Equation `lbs`.

    Args:
        vertices: (V, 3) rest positions. weights: (V, J), rows with sum 1.
        transforms: (..., J, 4, 4), from rest to posed position, for instance from
            `forward_kinematics`.

    Returns:
        (..., V, 3) posed positions.

    A vertex half on a bone that stays and half on one that moves by 2:

    >>> move = np.stack([np.eye(4), np.eye(4)])
    >>> move[1, 0, 3] = 2
    >>> linear_blend_skinning(np.zeros((1, 3)), np.array([[0.5, 0.5]]), move).tolist()
    [[1.0, 0.0, 0.0]]
    """
    flat = transforms[..., :3, :].reshape(*transforms.shape[:-2], 12)  # (..., J, 12)
    blended = weights @ flat  # (..., V, 12)
    blended = blended.reshape(*blended.shape[:-1], 3, 4)
    return (blended[..., :3] @ vertices[..., None])[..., 0] + blended[..., 3]


def forward_kinematics(
    skeleton: Skeleton, rotations: Array, translations: Array | None = None
) -> Array:
    """Transforms of all bones when each turns about its own joint.

    T_j = T_parent(j) [R_j | p_j + t_j - R_j p_j], so posed = T_j rest, and children
    follow their parents. Axes are those of the file, at every bone. Equation `fk`.

    Args:
        rotations: (..., J, 3, 3); or (..., J, 4, 4) rigid motions in axes centred at
            the joint, as `preset_pose` returns them.
        translations: (..., J, 3) t_j, how far each joint moves besides; 0 when absent.

    Returns:
        (..., J, 4, 4) transforms for `linear_blend_skinning`.

    >>> arm = Skeleton.from_heads_and_tails(
    ...     [[0, 0, 0], [1, 0, 0]], None, [-1, 0], ["upper", "lower"])
    >>> quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    >>> forward_kinematics(arm, np.stack([quarter, np.eye(3)]))[1] @ [1, 0, 0, 1]
    array([0., 1., 0., 1.])
    """
    if rotations.shape[-3] != len(skeleton):
        raise ValueError(
            f"rotations of shape {tuple(rotations.shape)} for {len(skeleton)} bones"
        )
    if rotations.shape[-1] == 4:
        moved = rotations[..., :3, 3]
        translations = moved if translations is None else moved + translations
        rotations = rotations[..., :3, :3]
    if isinstance(rotations, torch.Tensor):
        xp, like = torch, {"dtype": rotations.dtype, "device": rotations.device}
        joints = torch.tensor(skeleton.joints, **like)
        bottom = torch.tensor([[0, 0, 0, 1]], **like)
    else:
        xp, joints = np, skeleton.joints
        bottom = np.array([[0, 0, 0, 1]], np.result_type(rotations, np.float32))

    offsets = joints - (rotations @ joints[..., None])[..., 0]  # (..., J, 3)
    if translations is not None:
        offsets = offsets + translations
    turned: list = [None] * len(skeleton)
    moved = list(turned)
    for bone in skeleton.order.tolist():
        parent = skeleton.parents[bone]
        turned[bone], moved[bone] = rotations[..., bone, :, :], offsets[..., bone, :]
        if parent >= 0:
            turned[bone] = turned[parent] @ turned[bone]
            moved[bone] = (
                moved[parent] + (turned[parent] @ moved[bone][..., None])[..., 0]
            )
    top = xp.concatenate([xp.stack(turned, -3), xp.stack(moved, -2)[..., None]], -1)
    bottom = xp.broadcast_to(bottom, (*top.shape[:-2], 1, 4))
    return xp.concatenate([top, bottom], -2)


def mirror_pairs(skeleton: Skeleton) -> np.ndarray:
    """(J,) the bone on the other side of each bone; itself for one in the middle.

    Found by geometry: a bone's mirror image lies within 5 % of the skeleton's longest
    side. Depth in the hierarchy and left/right in the names only decide between bones
    that lie at the same place.

    >>> eyes = Skeleton.from_heads_and_tails(
    ...     [[0, 0, 0], [3, 9, 5], [-3, 9, 5]], None, [-1, 0, 0], ["head", "a", "b"])
    >>> mirror_pairs(eyes).tolist()
    [0, 2, 1]
    """
    return _mirror(skeleton)[2]


def mirror_vertices(head: Head) -> np.ndarray:
    """(V,) the vertex at each one's mirror image; -1 for none.

    The nearest one to it, within 1 % of the box's diagonal, on the same piece of the
    surface or on that piece's mirror image, and with a normal that agrees, so that
    upper lip and lower lip are never mixed.
    """
    axis, plane, _ = _mirror(head.skeleton)
    flip = np.ones(3)
    flip[axis] = -1
    points = head.vertices.astype(np.float64)
    image = points * flip
    image[:, axis] += 2 * plane
    tolerance = VERTEX_TOLERANCE * np.linalg.norm(np.ptp(points, axis=0))
    neighbours = min(8, len(points))
    distance, near = cKDTree(points).query(image, neighbours)
    distance, near = distance.reshape(-1, neighbours), near.reshape(-1, neighbours)

    piece = islands(head.faces, len(points), seam_nodes(head))
    # The mirror image of a piece is the piece that most of its vertices land on.
    votes = np.zeros((piece.max() + 1, piece.max() + 1), np.int64)
    hit = distance[:, 0] <= tolerance
    np.add.at(votes, (piece[hit], piece[near[hit, 0]]), 1)
    agree = np.einsum("vx,vkx->vk", head.normals * flip, head.normals[near])
    allowed = (distance <= tolerance) & (agree > 0)
    allowed &= piece[near] == votes.argmax(axis=1)[piece][:, None]
    cost = np.where(allowed, distance / (tolerance or 1) + 1 - agree, np.inf)
    best = cost.argmin(axis=1)
    rows = np.arange(len(points))
    return np.where(np.isfinite(cost[rows, best]), near[rows, best], -1)


def preset_pose(head: Head, name: str, amount: float = 1.0) -> np.ndarray:
    """(J, 4, 4) motions of a named pose, for `forward_kinematics`.

    Each is a rotation and a shift in axes centred at the bone's joint. Bones are found
    by name (Rocketbox, MakeHuman and anny, Bento, Maya's habits, our synthetic heads);
    axes, sides and sizes by geometry. Lids turn about the eye's centre, mouth corners
    are shifted, as these joints often lie in the skin that they move.

    Args:
        name: one of `PRESET_POSES`.
        amount: 0 rest, 1 the whole pose: jaw 20 degrees, head 30 degrees, lids shut.

    Raises:
        HeadError: no bone of this skeleton has a name that the pose is known by.
        ValueError: no such pose.
    """
    if name not in PRESET_POSES:
        raise ValueError(f"no pose {name!r}; there are {', '.join(PRESET_POSES)}")
    skeleton = head.skeleton
    frame = _frame(head)
    left, up, forward = frame.rotation
    motions = np.tile(np.eye(4), (len(skeleton), 1, 1))

    if name == "jaw_open":
        for bone in _bones_for(name, skeleton, "jaw"):
            motions[bone, :3, :3] = _turn(left, 20 * amount)
    elif name == "head_turn":
        motions[head_bone(skeleton), :3, :3] = _turn(up, 30 * amount)
    elif name == "blink":
        upper = upper_lids(head)
        for bone in _bones_for(name, skeleton, "lid"):
            turn = _turn(left, (35 if bone in upper else -10) * amount)
            arm = _eye_centre(skeleton, bone) - skeleton.joints[bone]
            motions[bone, :3, :3] = turn
            motions[bone, :3, 3] = arm - turn @ arm
    else:
        plane = np.median(skeleton.joints @ left)
        lift = 0.08 * up - 0.04 * forward
        shares = dict.fromkeys(find_bones(skeleton, "cheek"), 0.4)
        shares |= dict.fromkeys(_bones_for(name, skeleton, "mouth corner"), 1.0)
        for bone, share in shares.items():
            side = np.sign(_middle(skeleton, bone) @ left - plane)
            shift = lift + 0.06 * side * left
            motions[bone, :3, 3] = share * amount * frame.scale * shift
    return motions


# How riggers name the bones of a face, in lower case.
_HINTS = {
    "jaw": r"jaw|mandible",
    "head": r"(^|[^a-z])m?head([^a-z]|$)",
    "lid": r"blink|lid|orbicularis",
    "eye": r"(?<!under)eye(?!.*(brow|lid|lash|blink|corner|bag|alt|target|aim|look))",
    "mouth corner": r"(mouth|lip).*corner|corner.*(mouth|lip)|oris0[37]\.|smile",
    "cheek": r"cheek|caninus|zygomatic|levator|risorius",
}
_UPPER = re.compile(r"up|top")
_LOWER = re.compile(r"low|bot")


def find_bones(skeleton: Skeleton, part: str) -> list[int]:
    """Bones of a part of the face, found by name; those below another are left out.

    Args:
        part: "jaw", "head", "lid", "eye", "mouth corner" or "cheek".

    >>> rig = Skeleton.from_heads_and_tails(np.eye(3), None, [-1, 0, 1],
    ...                                     ["Head", "MJaw", "jaw_end"])
    >>> find_bones(rig, "jaw")
    [1]
    """
    hint = re.compile(_HINTS[part])
    names = enumerate(skeleton.names)
    return _topmost(skeleton, [j for j, name in names if hint.search(name.lower())])


def head_bone(skeleton: Skeleton) -> int:
    """The bone that carries the face: by name, else the one with most children."""
    named = find_bones(skeleton, "head")
    return named[0] if named else int(np.argmax([*map(len, skeleton.children())]))


def descendants(skeleton: Skeleton, bones: list[int]) -> np.ndarray:
    """(J,) bool: the bones themselves and every bone below them."""
    below = np.isin(np.arange(len(skeleton)), bones)
    for bone in skeleton.order:
        parent = skeleton.parents[bone]
        below[bone] |= parent >= 0 and below[parent]
    return below


def upper_lids(head: Head) -> list[int]:
    """The bones that close the eye from above, among the "lid" bones."""
    up = _frame(head).rotation[1]
    skeleton = head.skeleton
    chosen = []
    for bone in find_bones(skeleton, "lid"):
        name = skeleton.names[bone].lower()
        height = (_middle(skeleton, bone) - _eye_centre(skeleton, bone)) @ up
        if _UPPER.search(name) or (height > 0 and not _LOWER.search(name)):
            chosen.append(bone)
    return chosen


def _frame(head: Head) -> Frame:
    skeleton = head.skeleton
    return canonical_frame(head.vertices, head.faces, skeleton.joints, skeleton.parents)


def _middle(skeleton: Skeleton, bone: int) -> np.ndarray:
    return (skeleton.joints[bone] + skeleton.tails[bone]) / 2


def _topmost(skeleton: Skeleton, bones: list[int]) -> list[int]:
    """The bones that have no ancestor among them: the others follow."""
    chosen = set(bones)
    top = []
    for bone in bones:
        ancestor = skeleton.parents[bone]
        while ancestor >= 0 and ancestor not in chosen:
            ancestor = skeleton.parents[ancestor]
        if ancestor < 0:
            top.append(bone)
    return top


def _turn(axis: np.ndarray, degrees: float) -> np.ndarray:
    return Rotation.from_rotvec(axis * degrees, degrees=True).as_matrix()


def _bones_for(pose: str, skeleton: Skeleton, part: str) -> list[int]:
    bones = find_bones(skeleton, part)
    if not bones:
        raise HeadError(
            "bone_names",
            f"no bone is named like a {part}, which {pose!r} moves",
            "give the bones their usual names, or pose them by forward_kinematics",
        )
    return bones


def _eye_centre(skeleton: Skeleton, lid: int) -> np.ndarray:
    """The joint of the eye nearest to a lid; the lid's own in a rig without eyes."""
    joints = skeleton.joints.astype(np.float64)
    eyes = find_bones(skeleton, "eye") or [lid]
    distance = np.linalg.norm(joints[eyes] - _middle(skeleton, lid), axis=1)
    return joints[eyes[int(distance.argmin())]]


def _mirror(skeleton: Skeleton) -> tuple[int, float, np.ndarray]:
    """The lateral axis (0, 1 or 2), where the mirror plane cuts it, and the pairs."""
    joints = skeleton.joints.astype(np.float64)
    spread = np.ptp(joints, axis=0)
    best = None
    # Artists model along the file's axes. Bones in the plane itself prove little.
    for axis in np.argsort(spread, kind="stable").tolist():
        plane = float(np.median(joints[:, axis]))
        pairs = _pairs(skeleton, axis, plane, spread.max())
        image = joints.copy()
        image[:, axis] = 2 * plane - image[:, axis]
        off = np.linalg.norm(image - joints[pairs], axis=1)
        fits = off <= PAIR_TOLERANCE * spread.max()
        other = pairs != np.arange(len(pairs))
        score = (fits & other).sum() + 0.5 * (fits & ~other).sum()
        if best is None or score > best[0]:
            best = score, axis, plane, pairs
    return best[1:]


def _pairs(skeleton: Skeleton, axis: int, plane: float, size: float) -> np.ndarray:
    """Mutually nearest bones under the reflection; itself where there is none."""
    size = size or 1.0
    flip = np.ones(3)
    flip[axis] = -1
    shift = 2 * plane * (1 - flip) / 2
    heads = skeleton.joints.astype(np.float64)
    bones = skeleton.lengths[:, None] * skeleton.directions
    cost = np.linalg.norm((heads * flip + shift)[:, None] - heads, axis=2)
    far = cost > PAIR_TOLERANCE * size
    cost = cost + 0.5 * np.linalg.norm((bones * flip)[:, None] - bones, axis=2)
    depth = skeleton.depths
    other = [_other_side(name) for name in skeleton.names]
    unlike = np.array([[name != o for name in skeleton.names] for o in other])
    cost += 1e-3 * size * ((depth[:, None] != depth) + unlike)
    cost[far] = np.inf
    nearest = cost.argmin(axis=1)
    itself = np.arange(len(nearest))
    mutual = (nearest[nearest] == itself) & np.isfinite(cost[itself, nearest])
    return np.where(mutual, nearest, itself)


_SIDE = re.compile(
    r"left|right|Left|Right|LEFT|RIGHT|(?<![A-Za-z])[lrLR](?![a-z])|^[LR](?=[A-Z])"
)
_SWAP = {
    "left": "right", "Left": "Right", "LEFT": "RIGHT", "l": "r", "L": "R"
}  # fmt: skip
_SWAP |= {b: a for a, b in _SWAP.items()}


def _other_side(name: str) -> str:
    """`LEyeBlinkTop` -> `REyeBlinkTop`, `eye.L` -> `eye.R`, `jaw` -> `jaw`."""
    return _SIDE.sub(lambda side: _SWAP[side.group()], name)
