"""What riggers use today, as functions from a head to (V, J) float32 skin weights.

Three need nothing but the head: nearest bone, inverse distance, bone heat. Four copy
from a template, another head that an artist has painted. All return rows >= 0 with sum
1, in the bones of the head that is skinned, for meshes in any number of pieces.

Needs the package `libigl` for closest points, ray casting and the cotangent Laplacian.
"""

from collections.abc import Sequence

import igl
import numpy as np
from scipy import sparse
from scipy.interpolate import RBFInterpolator
from scipy.optimize import linear_sum_assignment
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from trimesh.triangles import points_to_barycentric

from skinlib.geometry import (
    canonical_frame,
    face_normals,
    islands,
    point_segment_distance,
    safe_normalize,
    vertex_areas,
)
from skinlib.graph import seam_nodes
from skinlib.head import Head, HeadError
from skinlib.skinning import find_bones

# Rows of distances computed at a time: bounds memory on meshes of a million vertices.
CHUNK = 1 << 16
# Joints further apart than this, relative to the head's size, are not the same joint.
FAR = 0.5


def nearest_bone(head: Head) -> np.ndarray:
    """All weight on the bone whose segment is nearest."""
    weights = np.zeros((len(head.vertices), len(head.skeleton)), np.float32)
    nearest = _bone_distances(head).argmin(axis=1)
    weights[np.arange(len(weights)), nearest] = 1
    return weights


def inverse_distance(head: Head, power: float = 4.0) -> np.ndarray:
    """Shepard's weights: w_vj ~ d(v, bone j)^-power."""
    distance = _bone_distances(head)
    nearest = np.maximum(distance.min(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    # Relative to the nearest bone, so that no power overflows.
    return _rows((nearest / np.maximum(distance, nearest)) ** power)


def bone_heat(head: Head) -> np.ndarray:
    """Heat equilibrium (Pinocchio; Baran and Popovic 2007): (-D + H) w_j = H p_j.

    D is the cotangent Laplacian; p_j is 1 where bone j is the nearest, 1/k where k
    bones are; H = 1 / d^2, d the distance to the nearest bone, or 0 where the mesh
    hides that bone from the vertex. Seams are closed first. A piece of the mesh that
    sees no bone, where the equation has no solution, follows the bone nearest to it as
    a whole.
    """
    node = seam_nodes(head)
    count = int(node.max()) + 1
    first = np.zeros(count, np.int64)
    first[node[::-1]] = np.arange(len(node))[::-1]
    scale = float(np.ptp(head.vertices, axis=0).max()) or 1.0
    points = head.vertices[first].astype(np.float64) / scale
    faces = _with_area(points, node[head.faces])
    bones = head.skeleton
    distance = _bone_distances(head)[first] / scale  # (N, J)
    nearest = distance.argmin(axis=1)

    visible = _visible(
        points, faces, bones.joints[nearest] / scale, bones.tails[nearest] / scale
    )
    heat = np.where(visible, 1 / np.maximum(distance.min(axis=1), 1e-4) ** 2, 0)
    piece = islands(faces, count)
    seen = np.bincount(piece, visible)[piece] > 0

    source = heat * vertex_areas(points, faces)
    source[seen & (source <= 0) & visible] = 1e-12  # a vertex of no face stands alone
    p = distance <= distance.min(axis=1, keepdims=True) * (1 + 1e-4)
    p = p / p.sum(axis=1, keepdims=True)
    system = sparse.diags(source + np.where(seen, 0, 1))
    if len(faces):
        system = system - igl.cotmatrix(points, faces)
    weights = _factor(system).solve(source[:, None] * p)

    blind = ~seen
    if blind.any():
        sums = sparse.csr_matrix((np.ones(count), (piece, np.arange(count)))) @ distance
        weights[blind] = np.eye(len(bones))[sums.argmin(axis=1)[piece[blind]]]
    return _rows(_filled(weights, nearest)[node])


def template_copy(head: Head, template: Head) -> np.ndarray:
    """Weights of the closest point on the template, moved and scaled to the head."""
    bones = match_bones(template, head)
    vertices = _align(template, head, bones)(template.vertices)
    return _copy(head, template, vertices, bones)


def warped_template_copy(head: Head, template: Head) -> np.ndarray:
    """`template_copy` after a thin-plate warp that takes joints to joints.

    The warp is the polyharmonic spline with kernel r, the thin plate of three
    dimensions (Duchon 1977).
    """
    bones = match_bones(template, head)
    return _copy(head, template, _warp(template, head, bones), bones)


def similar_template_copy(head: Head, templates: Sequence[Head]) -> np.ndarray:
    """`warped_template_copy` from the head whose skeleton is most like this one."""
    return warped_template_copy(head, most_similar(head, templates))


def robust_transfer(
    head: Head,
    template: Head,
    max_distance: float = 0.05,
    max_angle: float = 35.0,
) -> np.ndarray:
    """Copy where the match is sure, inpaint the rest (Abdrashitov et al. 2023).

    A vertex is matched when the closest point on the template, warped as in
    `warped_template_copy`, lies within `max_distance` of the box's diagonal and its
    normal within `max_angle` degrees. The other weights minimise the Laplacian energy
    w' (-L + L M^-1 L) w with the matched ones fixed. A piece of the mesh without any
    match takes the closest point.
    """
    bones = match_bones(template, head)
    vertices = _warp(template, head, bones)
    copied = _copy(head, template, vertices, bones)
    triangle, _, closest = _closest(head.vertices, vertices, template.faces)
    distance = np.linalg.norm(closest - head.vertices, axis=1)
    near = distance <= max_distance * np.linalg.norm(np.ptp(head.vertices, axis=0))
    if len(template.faces):
        facing = safe_normalize(face_normals(vertices, template.faces))[triangle]
        near &= (facing * head.normals).sum(axis=1) >= np.cos(np.radians(max_angle))
    return _rows(_inpaint(head, copied, near))


def most_similar(head: Head, templates: Sequence[Head]) -> Head:
    """The template whose joints fit best after moving and scaling.

    Raises:
        HeadError: there are no templates.
    """
    if not templates:
        raise HeadError(
            "templates", "there are none", "give at least one head with weights"
        )
    return min(templates, key=lambda template: skeleton_distance(template, head))


def skeleton_distance(template: Head, head: Head) -> float:
    """Root mean square distance of matched joints, relative to the head's size.

    Each bone without a partner counts as a joint a tenth of that size off.
    """
    bones = match_bones(template, head)
    pairs = np.flatnonzero(bones.paired)
    moved = _align(template, head, bones)(template.skeleton.joints[pairs])
    gap = moved - head.skeleton.joints[bones.target[pairs]]
    squared = (gap**2).sum() / _frame(head).scale ** 2
    alone = len(template.skeleton) + len(head.skeleton) - 2 * len(pairs)
    mean = (squared + alone * 0.1**2) / (len(pairs) + alone)
    return float(np.sqrt(mean))


class BoneMatch:
    """Where a template's bones go.

    Attributes:
        target: (J_template,) the head's bone that takes each bone's weight.
        paired: (J_template,) bool, whether that is the same bone, one to one.
    """

    def __init__(self, target: np.ndarray, paired: np.ndarray):
        self.target, self.paired = target, paired


def match_bones(template: Head, head: Head) -> BoneMatch:
    """Match a template's bones to the head's: by name, or else by place.

    Names count when at least half of the smaller rig's bones have one in common
    (capitals and a prefix such as `rig:` do not matter); a bone without a namesake
    gives its weight to its nearest ancestor that has one. Otherwise head and jaw, where
    the names tell them, go to head and jaw, and the other joints are matched one to
    one, as near as possible; a bone left over gives its weight to the nearest joint.
    """
    theirs, ours = template.skeleton, head.skeleton
    gap = _in_common_frame(template, head)
    nearest = gap.argmin(axis=1)
    place = {_plain(name): bone for bone, name in enumerate(ours.names)}
    target = np.array([place.get(_plain(name), -1) for name in theirs.names])
    paired = target >= 0
    if 2 * paired.sum() >= min(len(theirs), len(ours)):
        for bone in theirs.order:
            if not paired[bone]:
                parent = theirs.parents[bone]
                target[bone] = target[parent] if parent >= 0 else nearest[bone]
        return BoneMatch(target, paired)

    for _ in range(3):
        for part in ("head", "jaw"):
            a, b = find_bones(theirs, part)[:1], find_bones(ours, part)[:1]
            if a and b:
                gap[a], gap[:, b] = FAR, FAR
                gap[a, b] = 0
        rows, columns = linear_sum_assignment(gap)
        fits = gap[rows, columns] < FAR
        target, paired = nearest.copy(), np.zeros(len(theirs), bool)
        target[rows[fits]], paired[rows[fits]] = columns[fits], True
        match = BoneMatch(target, paired)
        # The joints matched so far bring the others closer to theirs.
        moved = _align(template, head, match)(theirs.joints)
        gap = np.linalg.norm(moved[:, None] - ours.joints, axis=2) / _frame(head).scale
        nearest = gap.argmin(axis=1)
    return match


def _plain(name: str) -> str:
    return name.lower().rsplit(":", 1)[-1]


def _frame(head: Head):
    skeleton = head.skeleton
    return canonical_frame(head.vertices, head.faces, skeleton.joints, skeleton.parents)


def _in_common_frame(template: Head, head: Head) -> np.ndarray:
    """(J_template, J) distances between joints, each in its own head's frame."""
    a = _frame(template).apply(template.skeleton.joints)
    b = _frame(head).apply(head.skeleton.joints)
    return np.linalg.norm(a[:, None] - b[None], axis=2)


def _align(template: Head, head: Head, bones: BoneMatch):
    """The function that moves, turns and scales template coordinates to the head's.

    The turn is between the two frames; scale and place fit the paired joints best.
    """
    a, b = _frame(template), _frame(head)
    rotation = b.rotation.T @ a.rotation
    pairs = np.flatnonzero(bones.paired)
    source = template.skeleton.joints[pairs].astype(np.float64) @ rotation.T
    target = head.skeleton.joints[bones.target[pairs]].astype(np.float64)
    scale, centre, place = b.scale / a.scale, rotation @ a.centre, b.centre
    if len(pairs) >= 3:
        centre, place = source.mean(axis=0), target.mean(axis=0)
        spread = ((source - centre) ** 2).sum()
        fitted = ((source - centre) * (target - place)).sum() / (spread or 1)
        scale = fitted if fitted > 0 else scale

    def align(points: np.ndarray) -> np.ndarray:
        return (points.astype(np.float64) @ rotation.T - centre) * scale + place

    return align


def _warp(template: Head, head: Head, bones: BoneMatch) -> np.ndarray:
    """(V_template, 3) the template's vertices, warped so that joints meet joints."""
    align = _align(template, head, bones)
    vertices = align(template.vertices)
    pairs = np.flatnonzero(bones.paired)
    if len(pairs) == 0:
        return vertices
    joints = align(template.skeleton.joints[pairs])
    wanted = head.skeleton.joints[bones.target[pairs]].astype(np.float64)
    size = _frame(head).scale
    # Joints at one place cannot be told apart: the spline needs each place once.
    _, once = np.unique(np.round(joints / size, 4), axis=0, return_index=True)
    joints, wanted = joints[once] / size, wanted[once] / size
    # Four joints that span space fix the affine part; fewer only a shift.
    spans = np.linalg.matrix_rank(joints - joints.mean(axis=0), tol=1e-2) == 3
    spline = RBFInterpolator(
        joints, wanted - joints, kernel="linear", degree=1 if spans else 0
    )
    return vertices + spline(vertices / size) * size


def _copy(
    head: Head, template: Head, vertices: np.ndarray, bones: BoneMatch
) -> np.ndarray:
    """Weights of the closest point on the template's surface at `vertices`."""
    if template.weights is None:
        raise HeadError(
            "weights",
            f"the template {template.name!r} has none",
            "copy from a head that an artist has painted",
        )
    triangle, share, _ = _closest(head.vertices, vertices, template.faces)
    columns = sparse.csr_matrix(
        (np.ones(len(bones.target)), (np.arange(len(bones.target)), bones.target)),
        shape=(len(bones.target), len(head.skeleton)),
    )
    weights = template.weights @ columns  # (V_template, J)
    corners = template.faces[triangle] if len(template.faces) else triangle[:, None]
    return _rows(np.einsum("vc,vcj->vj", share, weights[corners]))


def _closest(points, vertices, faces):
    """(V,) triangle, (V, 3) barycentric and (V, 3) position of the closest points.

    Without faces: the closest vertex, with one coordinate.
    """
    points = points.astype(np.float64)
    if len(faces) == 0:
        _, nearest = cKDTree(vertices).query(points)
        return nearest, np.ones((len(points), 1)), vertices[nearest]
    _, triangle, closest = igl.point_mesh_squared_distance(points, vertices, faces)
    corners = vertices[faces[triangle]]
    share = points_to_barycentric(corners, closest, method="cross")
    # A triangle without area has no such coordinates: take its nearest corner.
    flat = ~np.isfinite(share).all(axis=1)
    near = np.linalg.norm(corners[flat] - closest[flat][:, None], axis=2).argmin(axis=1)
    share[flat] = np.eye(3)[near]
    return triangle, np.clip(share, 0, 1), closest


def _inpaint(head: Head, weights: np.ndarray, known: np.ndarray) -> np.ndarray:
    """`weights` where `known`; elsewhere the smoothest continuation of them."""
    node = seam_nodes(head)
    count = int(node.max()) + 1
    order = np.argsort(known, kind="stable")  # known vertices are written last
    first = np.zeros(count, np.int64)
    first[node[order]] = order
    values, known = weights[first].astype(np.float64), known[first]
    scale = float(np.ptp(head.vertices, axis=0).max()) or 1.0
    points = head.vertices[first].astype(np.float64) / scale
    faces = _with_area(points, node[head.faces])
    piece = islands(faces, count)
    known = known | (np.bincount(piece, known)[piece] == 0)
    if known.all() or len(faces) == 0:
        return values[node]

    laplacian = igl.cotmatrix(points, faces)
    mass = np.maximum(vertex_areas(points, faces), 1e-12)
    energy = (-laplacian + laplacian @ sparse.diags(1 / mass) @ laplacian).tocsr()
    free = ~known
    right = -energy[free][:, known] @ values[known]
    values[free] = _factor(energy[free][:, free]).solve(right)
    nearest = weights[first].argmax(axis=1)
    return _filled(values, nearest)[node]


def _factor(matrix):
    """LU of a symmetric positive matrix: symmetric pivots keep it sparse."""
    return splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0,
        options={"SymmetricMode": True},
    )


def _visible(points, faces, heads, tails) -> np.ndarray:
    """(N,) whether the straight line to the nearest point of a bone is free."""
    if len(faces) == 0:
        return np.ones(len(points), bool)
    axis = (tails - heads).astype(np.float64)
    squared = (axis**2).sum(axis=1)
    along = ((points - heads) * axis).sum(axis=1) / np.where(squared > 0, squared, 1)
    origin = heads + np.clip(along, 0, 1)[:, None] * axis
    tree = igl.AABB()
    tree.init(points, faces)
    hit, time, _ = tree.intersect_ray_first(points, faces, origin, points - origin)
    # The ray has length 1 at the vertex itself; a nearer hit hides the bone.
    return (hit < 0) | (time > 1 - 1e-3)


def _with_area(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces whose cotangents are finite."""
    return faces[np.linalg.norm(face_normals(points, faces), axis=1) > 1e-12]


def _bone_distances(head: Head) -> np.ndarray:
    """(V, J) distances to bone segments, computed a chunk of vertices at a time."""
    bones = head.skeleton
    tails = bones.tails
    chunks = [
        point_segment_distance(head.vertices[i : i + CHUNK], bones.joints, tails)
        for i in range(0, len(head.vertices), CHUNK)
    ]
    return np.concatenate(chunks)


def _filled(weights: np.ndarray, nearest: np.ndarray) -> np.ndarray:
    """Clipped to >= 0; a row left without weight goes to its nearest bone."""
    weights = np.clip(np.nan_to_num(weights), 0, None)
    empty = np.flatnonzero(weights.sum(axis=1) < 1e-6)
    weights[empty, nearest[empty]] = 1
    return weights


def _rows(weights: np.ndarray) -> np.ndarray:
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
