"""How well a garment moves: is it outside the body, as long as it was cut, unfolded.

Share and depth inside are measured with the true distance to the posed body, which
training never sees: there the nearest vertex has to do. Elongation, bend and collision
are named as in GAPS (WACV 2024).
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import igl
import numpy as np
import torch
from tqdm.auto import tqdm

from skinlib import geometry
from skinlib.garments.binding import behind, signed_distance
from skinlib.garments.energies import face_normals
from skinlib.garments.motion import Motion
from skinlib.garments.outfit import Outfit
from skinlib.garments.pbns import PBNSConfig
from skinlib.skinning import linear_blend_skinning

DEEP, CLOSE = 0.005, 0.02  # metres


@dataclass(frozen=True)
class Measures:
    """Means over all frames, but for the deepest; lengths in mm, shares in percent."""

    elongation: float  # mean |l - l0| / l0 over edges
    stretch: float  # mean |l - l0|
    bend: float  # mean 1 - cos of the angles between neighbouring faces
    turned: float  # faces within 2 cm of the skin with the outside towards it
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
    turned = [
        _inside_out(*frame, head.faces)
        for frame in zip(corners, normals, bodies, strict=True)
    ]
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
        inside=100 * float((depths < 0).mean()),
        deep=100 * float((depths < -DEEP).mean()),
        deepest=max(0.0, -1000 * float(depths.min())),
        through=100 * float(np.mean(through)) if through else 0.0,
    )


def _lengths(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(T, E) lengths of the edges of (T, V, 3)."""
    return np.linalg.norm(points[:, edges[:, 0]] - points[:, edges[:, 1]], axis=-1)


def _inside_out(
    centres: np.ndarray, normals: np.ndarray, body: np.ndarray, faces: np.ndarray
) -> float:
    """Share of the faces that lie close to the skin and show it their outside."""
    squared, face, _ = igl.point_mesh_squared_distance(
        centres.astype(np.float64), body.astype(np.float64), faces
    )
    away = (normals * geometry.face_normals(body, faces)[face]).sum(-1) < 0
    return float((away & (squared < CLOSE**2)).mean())
