"""How well a garment moves: is it outside the body, as long as it was cut, unfolded.

Share and depth inside are measured with the true distance to the posed body, which
training never sees: there the nearest vertex has to do. Elongation, bend and collision
are named as in GAPS (WACV 2024).

Which side of the cloth looks out is asked twice. `turned` asks the skin, and only that
which moves with the cloth: in an armpit, or under a hand, other skin is nearer, and
there the cloth rightly shows its outside to it. The underside of a hanging fold counts.
`flipped` asks the cloth: a triangle that looks back against those around it is turned
over, whatever the body does.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import igl
import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from tqdm.auto import tqdm

from skinlib import geometry
from skinlib.garments.binding import behind, closest_point_values, signed_distance
from skinlib.garments.energies import face_normals
from skinlib.garments.motion import Motion
from skinlib.garments.outfit import Outfit
from skinlib.garments.pbns import PBNSConfig
from skinlib.skinning import linear_blend_skinning

DEEP, CLOSE = 0.005, 0.02  # metres
TOGETHER = 0.5  # of their weights two faces share when they move together


@dataclass(frozen=True)
class Measures:
    """Means over all frames, but for the deepest; lengths in mm, shares in percent."""

    elongation: float  # mean |l - l0| / l0 over edges
    stretch: float  # mean |l - l0|
    bend: float  # mean 1 - cos of the angles between neighbouring faces
    turned: float  # faces within 2 cm of their own skin with the outside towards it
    flipped: float  # faces that look back against the cloth around them
    inside: float  # vertices inside the body
    deep: float  # vertices deeper than 5 mm inside the body
    deepest: float  # the deepest vertex of all frames
    through: float = 0.0  # vertices of a garment inside one that lies below it

    def line(self) -> str:
        """All numbers in one line."""
        return ", ".join(f"{name} {value:.3f}" for name, value in asdict(self).items())


def joined(motions: Sequence[Motion]) -> Motion:
    """One motion after the other, to be measured together."""
    return Motion.create(
        np.concatenate([motion.rotations for motion in motions]),
        motions[0].bone_names,
        np.concatenate([motion.translations for motion in motions]),
    )


def skinned(
    outfit: Outfit, motion: Motion, shape: Mapping[str, float] | None = None
) -> np.ndarray:
    """(T, V, 3) the garments with the weights of the closest points of the body."""
    fixed = PBNSConfig(learn_weights=False)
    untrained = outfit.network(fixed, smoothing=0, shapes=bool(shape), seed=0)
    return outfit.pose(untrained, motion, shape)


def measure(
    outfit: Outfit,
    motion: Motion,
    posed: np.ndarray,
    shape: Mapping[str, float] | None = None,
) -> Measures:
    """Judge the posed vertices (T, V, 3) of an outfit.

    Args:
        shape: of the body, for which the garments were cut, too.
    """
    body, cloth = outfit.body, outfit.cloth
    amounts = body.coefficients(shape or {})
    transforms = body.transforms(motion, amounts)
    head = body.shaped(shape or {})
    bodies = linear_blend_skinning(head.vertices, head.weights, transforms)
    rest = outfit.graded(shape or {})

    edges = cloth.edges.numpy()
    l0 = _lengths(rest[None], edges)
    off = np.abs(_lengths(posed, edges) - l0)
    normals = face_normals(torch.from_numpy(posed), cloth.faces).numpy()
    first, second = cloth.hinges.numpy().T
    bend = 1 - (normals[:, first] * normals[:, second]).sum(-1)
    corners = posed[:, outfit.faces].mean(axis=2)
    moved_by = _moved_by(outfit)
    turned = [
        inside_out(*frame, head.faces, *moved_by).mean()
        for frame in zip(corners, normals, bodies, strict=True)
    ]
    flipped = turned_over(normals, rest, outfit.faces)
    pairs = list(zip(posed, bodies, strict=True))
    depths = np.stack(
        [
            signed_distance(points, skin, head.faces)
            for points, skin in tqdm(pairs, "distances", leave=False, delay=2)
        ]
    )
    through = [
        behind(frame[outer], frame[inner], faces).mean()
        for frame in posed
        for inner, outer, faces in outfit.overlaps
    ]
    return Measures(
        elongation=100 * float((off / l0).mean()),
        stretch=1000 * float(off.mean()),
        bend=float(bend.mean()),
        turned=100 * float(np.mean(turned)),
        flipped=100 * float(flipped.mean()),
        inside=100 * float((depths < 0).mean()),
        deep=100 * float((depths < -DEEP).mean()),
        deepest=max(0.0, -1000 * float(depths.min())),
        through=100 * float(np.mean(through)) if through else 0.0,
    )


def _lengths(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(T, E) lengths of the edges of (T, V, 3)."""
    return np.linalg.norm(points[:, edges[:, 0]] - points[:, edges[:, 1]], axis=-1)


def _moved_by(outfit: Outfit) -> tuple[np.ndarray, np.ndarray]:
    """(F, J) which bones move the skin below each face, and (N, J) each face of it."""
    head = outfit.body.head
    middles = outfit.vertices[outfit.faces].mean(axis=1)
    skin = head.weights[head.faces].mean(axis=1)
    return closest_point_values(middles, head, head.weights), skin


def inside_out(
    centres: np.ndarray,
    normals: np.ndarray,
    body: np.ndarray,
    faces: np.ndarray,
    moved_by: np.ndarray,
    skin_moved_by: np.ndarray,
) -> np.ndarray:
    """(F,) bool: which faces of cloth show their outside to the skin they lie on.

    That is the nearest skin, if it is within 2 cm, of that which moves with the face:
    at least half of their weights is the same.

    Args:
        centres, normals: (F, 3) of the cloth. body: (V, 3). faces: (N, 3) of the body.
        moved_by: (F, J) weights of the cloth. skin_moved_by: (N, J) of body faces.
    """
    outwards = geometry.face_normals(body, faces)
    body, centres = body.astype(np.float64), centres.astype(np.float64)
    squared, found, _ = igl.point_mesh_squared_distance(centres, body, faces)
    close = squared < CLOSE**2
    away = close & ((normals * outwards[found]).sum(-1) < 0)
    shared = np.minimum(moved_by, skin_moved_by[found]).sum(-1)
    doubtful = np.flatnonzero(close & (shared < TOGETHER))
    middles = body[faces].mean(axis=1)
    size = np.linalg.norm(body[faces] - middles[:, None], axis=-1).max()
    around = cKDTree(middles).query_ball_point(centres[doubtful], CLOSE + size)
    for i, own in zip(doubtful, around, strict=True):
        # Other skin is nearer: look again, at its own alone.
        own = np.array(own, np.int64)
        own = own[np.minimum(moved_by[i], skin_moved_by[own]).sum(-1) >= TOGETHER]
        away[i] = False
        if len(own):
            point = centres[i : i + 1]
            squared, found, _ = igl.point_mesh_squared_distance(point, body, faces[own])
            against = normals[i] @ outwards[own[found.item()]] < 0
            away[i] = against and squared.item() < CLOSE**2
    return away


def turned_over(normals: np.ndarray, rest: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(T, F) bool: which faces look back against the faces that share a corner with it.

    Against the mean of their normals and its own, weighted by their areas at rest.

    Args:
        normals: (T, F, 3) unit. rest: (V, 3). faces: (F, 3).
    """
    count = len(faces)
    rows = np.repeat(np.arange(count), 3)
    corner = csr_matrix((np.ones(3 * count), (rows, faces.ravel())), (count, len(rest)))
    around = (corner @ corner.T > 0).astype(np.float64)  # (F, F)
    areas = np.linalg.norm(geometry.face_normals(rest, faces), axis=1)
    around = around.multiply(areas).tocsr()
    means = np.stack([around @ frame for frame in normals])
    return (normals * means).sum(-1) < 0
