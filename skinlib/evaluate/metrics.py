"""Metrics of skin weights, each under its own name and in its own unit.

Symbols: V vertices, J bones; w the artist's weights ("target"), w^ the predicted ones;
both (V, J), rows >= 0 with sum 1. Several papers use one name for different numbers;
the docstrings say whose convention a metric follows.
"""

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from skinlib.geometry import canonical_frame, mesh_edges
from skinlib.graph import seam_nodes
from skinlib.head import Head, HeadError, Skeleton
from skinlib.painting import limit_influences
from skinlib.skinning import (
    PRESET_POSES,
    descendants,
    find_bones,
    forward_kinematics,
    head_bone,
    linear_blend_skinning,
    mirror_pairs,
    mirror_vertices,
    preset_pose,
    upper_lids,
)

# A weight above this counts as an influence (RigNet and all that followed).
INFLUENCE = 1e-4
THRESHOLDS = (1e-4, 1e-3, 1e-2, 5e-2, 1e-1)
# Part of a row's largest weight below which a prediction is zeroed, and who does so.
FILTERS = {"puppeteer": 0.15, "rignet": 0.5}
INFLUENCE_LIMITS = (4, 8)
RANDOM_POSES = 4
# How far apart two sides of a seam may lie, as a part of the head's height.
SEAM_WIDTH = 0.05


def score(
    predicted: np.ndarray, target: np.ndarray, head: Head, seed: int = 0
) -> dict[str, float]:
    """Every metric of this module for one head, as a flat dict of numbers.

    Names without a prefix are of the whole head with all influences. `face_` restricts
    to `face_mask`, `at_4_` and `at_8_` limit the influences of the prediction first.
    Metrics that a rig has no bones for (a lid, a jaw) are left out.

    Args:
        predicted: (V, J). target: (V, J), usually `head.weights`. seed: of the poses.

    Raises:
        ValueError: shapes differ, or the prediction holds NaN.
    """
    if predicted.shape != target.shape or len(target) != len(head.vertices):
        raise ValueError(
            f"predicted weights {predicted.shape}, target {target.shape}, "
            f"{len(head.vertices)} vertices"
        )
    if not np.isfinite(predicted).all():
        raise ValueError("the predicted weights hold NaN or infinity")

    face = face_mask(head, target)
    limited = {f"at_{n}_": limit_influences(predicted, n) for n in INFLUENCE_LIMITS}
    scores = {}
    for prefix, weights in {"": predicted, **limited}.items():
        for part, rows in (("", slice(None)), ("face_", face)):
            if part and not face.any():
                continue
            some = agreement(weights[rows], target[rows])
            scores |= {part + prefix + name: value for name, value in some.items()}
    scores |= filtered_precision_recall(predicted, target)
    iou = per_bone_iou(predicted, target)
    scores["bone_iou_mean"] = float(np.nanmean(iou))
    scores["bone_iou_min"] = float(np.nanmin(iou))
    scores |= deformation_errors(predicted, target, head, seed)
    scores |= bleeds(predicted, target, head)
    scores["symmetry_error"] = symmetry_error(predicted, head)
    scores["symmetry_error_artist"] = symmetry_error(target, head)
    return {name: value for name, value in scores.items() if np.isfinite(value)}


def row_l1(predicted: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(V,) sum over bones of |w^ - w|: 0 is perfect, 2 is all wrong (RigNet's "L1").

    Equation `row_l1`.

    >>> row_l1(np.array([[0.5, 0.5], [1, 0]]), np.array([[1, 0], [0, 1.0]])).tolist()
    [1.0, 2.0]
    """
    return np.abs(predicted.astype(np.float64) - target).sum(axis=1)


def agreement(predicted: np.ndarray, target: np.ndarray) -> dict[str, float]:
    """Row-L1 (mean, p95, p99, max), UniRig's mean, precision, recall, dominant bone.

    `l1_mean_over_bones` is UniRig's: the mean of |w^ - w| over vertices x bones, which
    is `row_l1_mean` divided by J.
    """
    error = row_l1(predicted, target)
    p95, p99 = np.percentile(error, [95, 99])
    precision, recall = precision_recall(predicted, target)
    return {
        "row_l1_mean": float(error.mean()),
        "row_l1_p95": float(p95),
        "row_l1_p99": float(p99),
        "row_l1_max": float(error.max()),
        "l1_mean_over_bones": float(error.mean() / target.shape[1]),
        "precision": precision,
        "recall": recall,
        "dominant_bone_accuracy": dominant_bone_accuracy(predicted, target),
    }


def precision_recall(
    predicted: np.ndarray, target: np.ndarray, threshold: float = INFLUENCE
) -> tuple[float, float]:
    """Of the influences predicted, the part that is real; of the real, the part found.

    An influence is a weight above `threshold`; counted over all vertices and bones of
    a head. Each is 1 when there is nothing to count. Equation `precision_recall`.

    >>> precision_recall(np.array([[0.6, 0.2, 0.2]]), np.array([[0.5, 0.5, 0.0]]))
    (0.6666666666666666, 1.0)
    """
    found, real = predicted > threshold, target > threshold
    both = int(np.count_nonzero(found & real))
    precision = both / int(np.count_nonzero(found)) if found.any() else 1.0
    recall = both / int(np.count_nonzero(real)) if real.any() else 1.0
    return precision, recall


def filtered_precision_recall(
    predicted: np.ndarray, target: np.ndarray
) -> dict[str, float]:
    """Precision and recall after the filters that published numbers were taken with.

    * `precision_at_T`, `recall_at_T`: threshold T on both sides, for each of
      `THRESHOLDS`; 5e-2 is Anymate's.
    * `precision_puppeteer`: predicted weights below 0.15 of the row's largest are
      zeroed, then the threshold 1e-4. `precision_rignet`: the same with 0.5.
    """
    scores = {}
    for threshold in THRESHOLDS:
        precision, recall = precision_recall(predicted, target, threshold)
        scores[f"precision_at_{threshold:.0e}"] = precision
        scores[f"recall_at_{threshold:.0e}"] = recall
    for name, part in FILTERS.items():
        kept = np.where(
            predicted >= part * predicted.max(axis=1, keepdims=True), predicted, 0
        )
        precision, recall = precision_recall(kept, target)
        scores[f"precision_{name}"], scores[f"recall_{name}"] = precision, recall
    return scores


def dominant_bone_accuracy(predicted: np.ndarray, target: np.ndarray) -> float:
    """Part of the vertices whose largest predicted weight is on a right bone.

    Right is any bone that shares the artist's largest weight, so a tie has two answers.

    >>> dominant_bone_accuracy(np.array([[0.4, 0.6]]), np.array([[0.5, 0.5]]))
    1.0
    """
    chosen = predicted.argmax(axis=1)
    largest = target.max(axis=1)
    return float((target[np.arange(len(target)), chosen] >= largest - 1e-6).mean())


def per_bone_iou(predicted: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(J,) sum_v min(w^, w) / sum_v max(w^, w), the weighted form of IoU, in 0 .. 1.

    NaN for a bone that has no weight on either side. Equation `bone_iou`.

    >>> per_bone_iou(np.array([[1, 0, 0.0]]), np.array([[0.5, 0.5, 0]])).tolist()
    [0.5, 0.0, nan]
    """
    shared = np.minimum(predicted, target).sum(axis=0, dtype=np.float64)
    either = np.maximum(predicted, target).sum(axis=0, dtype=np.float64)
    return np.divide(shared, either, out=np.full(len(either), np.nan), where=either > 0)


def face_mask(head: Head, weights: np.ndarray | None = None) -> np.ndarray:
    """(V,) bool: the vertices that some bone of the face moves.

    The bones of the face are all bones below the head bone (`head_bone`). A vertex is
    in the face when their weights sum to more than 1e-4; the others follow head, neck,
    spine or clavicles alone: skull, scalp, throat, most hair. On real heads these are
    half of all vertices, and easy.

    Args:
        weights: (V, J), the artist's; `head.weights` when absent.
    """
    weights = head.weights if weights is None else weights
    bone = head_bone(head.skeleton)
    below = descendants(head.skeleton, [bone])
    below[bone] = False
    return weights[:, below].sum(axis=1) > INFLUENCE


def random_poses(
    skeleton: Skeleton,
    count: int,
    seed: int,
    degrees: tuple[float, float] = (15.0, 25.0),
) -> np.ndarray:
    """(count, J, 3, 3) rotations: each bone about a random axis by a random angle."""
    rng = np.random.default_rng(seed)
    axes = rng.standard_normal((count * len(skeleton), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turns = axes * rng.uniform(*degrees, (len(axes), 1))
    matrices = Rotation.from_rotvec(turns, degrees=True).as_matrix()
    return matrices.reshape(count, len(skeleton), 3, 3)


def deformation_errors(
    predicted: np.ndarray, target: np.ndarray, head: Head, seed: int = 0
) -> dict[str, float]:
    """Distances of posed vertices from the artist's, in % of the head's height.

    `deformation_mean` and `deformation_max` are over `RANDOM_POSES` random poses, each
    bone turned by 15 to 25 degrees relative to its parent; the same under
    `jaw_open_mean`, `blink_max`, ... for each preset pose that the rig has bones for.
    The maximum is over vertices and poses. Equation `deformation_error`.
    """
    skeleton = head.skeleton
    poses = {"deformation": random_poses(skeleton, RANDOM_POSES, seed)}
    for name in PRESET_POSES:
        try:
            poses[name] = preset_pose(head, name)[None]
        except HeadError:
            continue
    difference = predicted.astype(np.float64) - target
    percent = 100 / head_height(head)
    scores = {}
    for name, rotations in poses.items():
        # Skinning is linear in the weights: posing the difference gives the distances.
        distances = [
            np.linalg.norm(linear_blend_skinning(head.vertices, difference, t), axis=1)
            for t in forward_kinematics(skeleton, rotations)
        ]
        scores[f"{name}_mean"] = float(np.mean(distances) * percent)
        scores[f"{name}_max"] = float(np.max(distances) * percent)
    return scores


def head_height(head: Head) -> float:
    """Extent of the vertices along the head's up axis, in file units; 1 when flat."""
    skeleton = head.skeleton
    frame = canonical_frame(
        head.vertices, head.faces, skeleton.joints, skeleton.parents
    )
    return float(np.ptp(head.vertices @ frame.rotation[1])) or 1.0


def bleeds(predicted: np.ndarray, target: np.ndarray, head: Head) -> dict[str, float]:
    """Weight that crosses where it must not: lips, lids, left and right.

    `lip_bleed` is `seam_bleed` of the jaw and all bones below it: an upper lip that
    opens with the jaw, or a lower lip that stays behind. `lid_bleed` is the larger one
    of upper and lower lids, against each other and against the eyeball.
    """
    skeleton = head.skeleton
    scores = {"left_right_bleed": left_right_bleed(predicted, target, head)}
    jaw = find_bones(skeleton, "jaw")
    if jaw:
        jaw = descendants(skeleton, jaw)
        scores["lip_bleed"] = seam_bleed(predicted, target, head, jaw)
    lids, upper = find_bones(skeleton, "lid"), upper_lids(head)
    sides = [upper, [bone for bone in lids if bone not in upper]]
    found = [
        seam_bleed(predicted, target, head, descendants(skeleton, side))
        for side in sides
        if side
    ]
    if np.isfinite(found).any():
        scores["lid_bleed"] = float(np.nanmax(found))
    return scores


def seam_bleed(
    predicted: np.ndarray, target: np.ndarray, head: Head, bones: np.ndarray
) -> float:
    """Mean |m^ - m| at a seam, m being a vertex's weight on `bones`: 0 .. 1.

    The seam is where the artist's m jumps through the air: vertices with more than half
    of the head's largest m that have one with less than a tenth of it, or the other way
    round, closer than 5 % of the head's height but more than twice as far along the
    surface. NaN when there is no such place. Equation `seam_bleed`.

    Args:
        bones: (J,) bool, the bones of one side.
    """
    mass = target[:, bones].sum(axis=1)
    reach = SEAM_WIDTH * head_height(head)
    near, far = mass > 0.5 * mass.max(), mass < 0.1 * mass.max()
    seam = _across_air(head, near, far, reach) | _across_air(head, far, near, reach)
    if not seam.any():
        return float("nan")
    return float(np.abs(predicted[seam][:, bones].sum(axis=1) - mass[seam]).mean())


def left_right_bleed(predicted: np.ndarray, target: np.ndarray, head: Head) -> float:
    """Mean weight on bones of the wrong side that the artist did not give: 0 .. 1.

    Taken over vertices further than 5 % of the head's height from the mirror plane;
    the bones with a side are those that have a mirrored partner. NaN without any.
    """
    skeleton = head.skeleton
    frame = canonical_frame(
        head.vertices, head.faces, skeleton.joints, skeleton.parents
    )
    lateral = frame.rotation[0]
    paired = mirror_pairs(skeleton) != np.arange(len(skeleton))
    plane = np.median(skeleton.joints @ lateral)
    bone_side = np.sign(skeleton.joints @ lateral - plane) * paired  # (J,)
    offset = head.vertices @ lateral - plane
    aside = np.abs(offset) > SEAM_WIDTH * head_height(head)
    if not aside.any() or not bone_side.any():
        return float("nan")
    wrong = np.sign(offset[aside])[:, None] * bone_side < 0
    excess = np.maximum(predicted[aside].astype(np.float64) - target[aside], 0)
    return float((excess * wrong).sum(axis=1).mean())


def symmetry_error(weights: np.ndarray, head: Head) -> float:
    """Mean row-L1 between a vertex and its mirror image with sides exchanged: 0 .. 2.

    Over the vertices that have a mirror image (`mirror_vertices`); NaN when none has.
    Artists' own weights are not perfectly symmetric either: compare with theirs.
    Equation `symmetry_error`.
    """
    partner = mirror_vertices(head)
    found = partner >= 0
    if not found.any():
        return float("nan")
    mirrored = weights[partner[found]][:, mirror_pairs(head.skeleton)]
    return float(row_l1(weights[found], mirrored).mean())


def _across_air(
    head: Head, side: np.ndarray, other: np.ndarray, reach: float
) -> np.ndarray:
    """(V,) vertices of `side` that are near `other` in space, not on the surface."""
    if not side.any() or not other.any():
        return np.zeros(len(side), bool)
    straight, _ = cKDTree(head.vertices[other]).query(head.vertices)
    node = seam_nodes(head)
    edges = mesh_edges(head.faces)
    length = np.linalg.norm(np.diff(head.vertices[edges], axis=1)[:, 0], axis=1)
    # csgraph takes a length of 0 for no edge.
    length = np.maximum(length, 1e-9 * reach)
    count = int(node.max()) + 1
    # Seams are closed: of several edges between two nodes, any one will do.
    ends, first = np.unique(node[edges], axis=0, return_index=True)
    graph = csr_matrix((length[first], tuple(ends.T)), shape=(count, count))
    along = dijkstra(
        graph, directed=False, indices=np.unique(node[other]), min_only=True
    )[node]
    return side & (straight < reach) & (along > 2 * straight)
