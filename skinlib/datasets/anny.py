"""Artist-rigged heads without end: identities drawn from the Anny body model.

Anny (https://github.com/naver/anny, code Apache-2.0) evaluates the CC0 MakeHuman
assets: phenotypes, local shape changes and facial actions move one mesh with one rig,
whose weights an artist painted. The body is cropped to the head here. All heads share
mesh and weights, vertex by vertex, so a model that trains on them has to see them
through `skinlib.datasets.remesh`, or it learns to count vertices.
"""

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from skinlib.head import Head, HeadError, Skeleton

NECK = "neck01"
HEAD_SHARE = 0.999  # a vertex of a head follows the neck, head and face more than this
BUST_SHARE = 0.001  # and a vertex of a bust more than this
REGIONS = "cheek chin ear eye eyebrows forehead head mouth neck nose".split()
# What tells the left of a pair from the right; jawLeft and jawRight are opposites.
SIDE = re.compile(r"^[lr]-|(?<!^jaw)(?<!^mouth)(?:Left|Right)$")
BATCH = 16


@dataclass(frozen=True)
class AnnyConfig:
    """How widely heads are drawn."""

    age: tuple[float, float] = (0.3, 1.0)  # 0 baby, 1/3 child, 2/3 adult, 1 old
    shape_share: float = 0.4  # share of the local shapes that leave their mean
    shape_spread: float = 0.35  # their standard deviation; 1 is the artist's extreme
    expression_share: float = 0.7  # share of heads with a facial expression
    expression_strength: float = 0.9  # the strongest facial action, 0 to 1
    helper_bones: bool = True  # keep the ancestors that carry no weight themselves
    bust: bool = False  # down to the shoulders, all the body's weight on one spine bone


class _Crop(NamedTuple):
    """The head's part of the body model."""

    model: object
    vertices: np.ndarray  # (V,) ids in the body
    faces: np.ndarray  # (F, 3) ids in the head
    bones: np.ndarray  # (J,) ids in the body
    parents: np.ndarray  # (J,) places in `bones`, -1 for the root
    weights: np.ndarray  # (V, J) float64


def anny_heads(
    count: int, seed: int = 0, config: AnnyConfig | None = None
) -> list[Head]:
    """Draw `count` labelled heads, in metres, Z up, the face towards -Y.

    Head i depends on `seed + i` alone: the last of `anny_heads(3, 10)` is the only one
    of `anny_heads(1, 12)`. Each has 4,406 vertices, 8,748 triangles and 63 bones, of
    which 35 carry weight; a bust has 4,864 vertices and one bone more. The first call
    builds Anny, which takes minutes and 1.2 GB in `~/.cache/anny`, or in the folder
    `ANNY_CACHE_DIR`.

    Raises:
        HeadError: the package `anny` is not installed.
    """
    config = config or AnnyConfig()
    crop = _crop(config.bust)
    heads = []
    for start in range(seed, seed + count, BATCH):
        seeds = range(start, min(start + BATCH, seed + count))
        identities = [_identity(crop.model, s, config) for s in seeds]
        heads += _evaluate(crop, identities, seeds, config.helper_bones)
    return heads


def _identity(model, seed: int, config: AnnyConfig) -> tuple[np.ndarray, ...]:
    """Phenotype, local shape and facial action values of one identity."""
    rng = np.random.default_rng(seed)
    phenotype = dict(zip(model.phenotype_labels, rng.random(11), strict=True))
    phenotype["age"] = rng.uniform(*config.age)
    ethnicity = rng.dirichlet(np.ones(3))
    phenotype |= zip(("african", "asian", "caucasian"), ethnicity, strict=True)

    def local_shape():
        return rng.normal(0, config.shape_spread) * (rng.random() < config.shape_share)

    shape = _draw_pairs(model.local_change_labels, local_shape, rng)
    for label in shape:
        region = SIDE.sub("", label).split("-")[0]
        shape[label] = np.clip(shape[label], -1, 1) * (region in REGIONS)

    share = rng.uniform(0, 0.25) * (rng.random() < config.expression_share)

    def facial_action():
        return rng.uniform(0, config.expression_strength) * (rng.random() < share)

    actions = _draw_pairs(model.facial_action_labels, facial_action, rng)
    # It only closes lips that the jaw has parted; alone, it pushes them through.
    actions["mouthClose"] *= actions["jawOpen"]
    return (
        np.array([phenotype[label] for label in model.phenotype_labels]),
        np.array(list(shape.values())),
        np.array(list(actions.values())),
    )


def _draw_pairs(labels, draw, rng: np.random.Generator) -> dict[str, float]:
    """One value a label; left and right of a pair differ by a fifth or so."""
    drawn, values = {}, {}
    for label in labels:
        pair = SIDE.sub("", label)
        if pair not in drawn:
            drawn[pair] = draw()
        values[label] = drawn[pair] * (rng.uniform(0.8, 1) if pair != label else 1)
    return values


def _evaluate(crop: _Crop, identities, seeds, helper_bones: bool) -> list[Head]:
    import torch

    batch = [torch.from_numpy(np.stack(v)) for v in zip(*identities, strict=True)]
    with torch.inference_mode():
        body = crop.model(None, *batch)
    vertices = body["rest_vertices"][:, crop.vertices].numpy()
    joints = body["rest_bone_heads"][:, crop.bones].numpy()
    tails = body["rest_bone_tails"][:, crop.bones].numpy()

    kept = np.arange(len(crop.bones))
    if not helper_bones:
        kept = np.flatnonzero(crop.weights.any(axis=0))
    parents = _nearest_kept(crop.parents, kept)
    names = [crop.model.bone_labels[b] for b in crop.bones[kept]]
    heads = []
    for i, seed in enumerate(seeds):
        skeleton = Skeleton.from_heads_and_tails(
            joints[i, kept], tails[i, kept], parents, names
        )
        head = Head.create(
            vertices[i],
            crop.faces,
            skeleton,
            weights=crop.weights[:, kept],
            name=f"anny_{seed:05d}",
        )
        heads.append(head)
    return heads


def _nearest_kept(parents: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """The place in `kept` of each kept bone's nearest kept ancestor, or -1."""
    place = {bone: i for i, bone in enumerate(kept)}
    result = []
    for bone in kept:
        ancestor = parents[bone]
        while ancestor >= 0 and ancestor not in place:
            ancestor = parents[ancestor]
        result.append(place.get(ancestor, -1))
    return np.array(result)


@lru_cache(maxsize=1)
def _model():
    try:
        from anny import Anny
    except ImportError as error:
        raise HeadError(
            "anny heads", "the package anny is not installed", "run `pip install anny`"
        ) from error
    # Plain LBS: the default compiles a warp kernel, and only rest poses are asked for.
    return Anny(
        rig="makehuman",
        topology="anny",
        local_changes="all",
        facial_actions="all",
        phenotypes="all",
        skinning_method="lbs",
    )


@lru_cache(maxsize=2)
def _crop(bust: bool) -> _Crop:
    model = _model()
    weights = np.zeros((len(model.vertex_bone_weights), model.bone_count))
    rows = np.arange(len(weights))[:, None]
    np.add.at(weights, (rows, model.vertex_bone_indices), model.vertex_bone_weights)

    # The neck and all below it in the tree; in Anny parents come before children.
    neck = model.bone_labels.index(NECK)
    place, parents = {neck: 0}, [-1]
    for bone, parent in enumerate(model.bone_parents):
        if parent in place:
            place[bone] = len(place)
            parents.append(place[parent])
    bones, parents = np.array(list(place)), np.array(parents)

    share = weights[:, bones].sum(axis=1)
    inside = share > (BUST_SHARE if bust else HEAD_SHARE)
    vertices = np.flatnonzero(inside)
    faces = model.get_triangular_faces().numpy()
    faces = np.searchsorted(vertices, faces[inside[faces].all(axis=1)])
    weights = weights[np.ix_(vertices, bones)]
    if bust:
        bones = np.append(bones, model.bone_parents[neck])
        parents = np.append(parents, -1)
        parents[0] = len(bones) - 1
        weights = np.column_stack([weights, 1 - share[vertices]]).clip(0)
    weights /= weights.sum(axis=1, keepdims=True)
    return _Crop(model, vertices, faces, bones, parents, weights)
