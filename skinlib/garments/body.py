"""The body that wears the clothes: a mesh, a skeleton, skin weights, and a few shapes.

A body is a `Head` like all others here: whatever has vertices, bones and weights is
posed by the same linear blend skinning. The one that ships is drawn with Anny
(https://github.com/naver/anny) from the CC0 MakeHuman assets, in metres, Z up, the face
towards -Y, the left hand at +X, in an A-pose.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from skinlib.garments.motion import Motion
from skinlib.head import Head, HeadError, Skeleton
from skinlib.io import atomic, read_npz
from skinlib.paths import sample
from skinlib.skinning import forward_kinematics

SHAPES = ("gender", "weight", "muscle", "height")
"""Anny's phenotypes along which the shipped body changes, from -1 to 1."""

ADULT = {"age": 0.67, "proportions": 0.5} | dict.fromkeys(SHAPES, 0.5)
# Fingers move with the hand and eyes with the head.
MERGED = ("finger", "metacarpal", "eye")


@dataclass(frozen=True, eq=False)
class Body:
    """A posable body and the directions in which its shape changes.

    Attributes:
        head: the mean body; V vertices, J bones, and the weights that bind them.
        shape_names: K names.
        shape_vertices: (K, V, 3) float32, what 1 of each shape adds to the vertices.
        shape_joints: (K, J, 3) float32, and to the joints.
    """

    head: Head
    shape_names: tuple[str, ...]
    shape_vertices: np.ndarray
    shape_joints: np.ndarray

    def coefficients(self, shape: Mapping[str, float]) -> np.ndarray:
        """(K,) float32: the amounts of named shapes, 0 for those left out.

        Raises:
            HeadError: an unknown name, or an amount outside -1 to 1.
        """
        unknown = sorted(set(shape) - set(self.shape_names))
        if unknown:
            raise HeadError(
                "shape",
                f"the body has no shape {unknown[0]!r}",
                f"choose from {', '.join(self.shape_names)}",
            )
        for name, amount in shape.items():
            if not -1 <= amount <= 1:
                raise HeadError("shape", f"{name} is {amount:g}", "give -1 to 1")
        return np.array([shape.get(name, 0) for name in self.shape_names], np.float32)

    def shaped(self, shape: Mapping[str, float]) -> Head:
        """The body at rest with another shape, such as `{"weight": 0.5}`."""
        amounts = self.coefficients(shape)
        skeleton = self.head.skeleton
        joints = skeleton.joints + np.tensordot(amounts, self.shape_joints, 1)
        return Head.create(
            self.head.vertices + np.tensordot(amounts, self.shape_vertices, 1),
            self.head.faces,
            Skeleton.from_heads_and_tails(
                joints, None, skeleton.parents, skeleton.names
            ),
            weights=self.head.weights,
            name=self.head.name,
        )

    def transforms(self, motion: Motion, amounts: np.ndarray) -> np.ndarray:
        """(T, J, 4, 4) of the bones when the body has another shape in each frame.

        Args:
            amounts: (T, K) or (K,), of the shapes.

        Raises:
            HeadError: the bones of the motion are not those of the body.
        """
        motion.transforms(self.head.skeleton)
        matrices = motion.matrices()
        # A joint that lies elsewhere: [R | p - R p] with p + d is a shift by d - R d.
        shift = np.tensordot(amounts, self.shape_joints, 1).astype(np.float32)
        shift = np.broadcast_to(shift, motion.rotations.shape)
        moved = shift - (matrices @ shift[..., None])[..., 0]
        moved[:, self.head.skeleton.parents < 0] += motion.translations[:, None]
        return forward_kinematics(self.head.skeleton, matrices, moved)


def read_body(path: str | Path | None = None) -> Body:
    """Read a body: the shipped one, or a `.npz` head, with or without shapes.

    Beside the fields of a head, the file may hold `shape_names` (K,), `shape_vertices`
    (K, V, 3) and `shape_joints` (K, J, 3).

    Raises:
        HeadError: it cannot be read, has no weights, its first bone is not the one
            root, or its shapes do not fit.
    """
    path = Path(path) if path else sample("body.npz")
    head = read_npz(path)
    if head.weights is None:
        raise HeadError("weights", "the body has none", "skin it first", path)
    roots = np.flatnonzero(head.skeleton.parents < 0)
    if roots.tolist() != [0]:
        raise HeadError(
            "bone_parents",
            f"the bones without a parent are {roots.tolist()}",
            "list the root first, and hang all other bones on it",
            path,
        )
    keys = ("shape_names", "shape_vertices", "shape_joints")
    try:
        with np.load(path, allow_pickle=False) as file:
            if keys[0] not in file:
                names = np.array([], str)
                vertices = np.zeros((0, len(head.vertices), 3))
                joints = np.zeros((0, len(head.skeleton), 3))
            else:
                names, vertices, joints = (file[key] for key in keys)
    except Exception as error:  # whatever a damaged archive makes the libraries raise
        raise HeadError(
            "shapes", f"they cannot be read ({error})", f"save {', '.join(keys)}", path
        ) from error
    if names.ndim != 1 or names.dtype.kind != "U" or len(set(names)) != len(names):
        raise HeadError(
            keys[0],
            f"{names.dtype} values of shape {names.shape}, or one name twice",
            "store one string per shape, each another",
            path,
        )
    for key, array, count in (
        (keys[1], vertices, len(head.vertices)),
        (keys[2], joints, len(head.skeleton)),
    ):
        fits = array.dtype.kind == "f" and array.shape == (len(names), count, 3)
        if not fits or not np.isfinite(array).all():
            raise HeadError(
                key,
                f"{array.dtype} values of shape {array.shape}, or one is not finite",
                f"store {len(names)} x {count} x 3 finite numbers",
                path,
            )
    return Body(
        head,
        tuple(map(str, names)),
        vertices.astype(np.float32),
        joints.astype(np.float32),
    )


def write_body(path: str | Path, body: Body) -> None:
    """Write a body to a compressed `.npz` file; shapes to half precision (0.1 mm)."""
    head, skeleton = body.head, body.head.skeleton
    with atomic(path) as file:
        np.savez_compressed(
            file,
            vertices=head.vertices,
            faces=head.faces.astype(np.int32),
            bone_names=np.array(skeleton.names),
            bone_parents=skeleton.parents,
            bone_heads=skeleton.joints,
            bone_tails=skeleton.tails,
            weights=head.weights,
            shape_names=np.array(body.shape_names, str),
            shape_vertices=body.shape_vertices.astype(np.float16),
            shape_joints=body.shape_joints,
        )


class AnnyRig(NamedTuple):
    """Anny's model on one mesh, with the J bones that are kept.

    Attributes:
        model: the package's own. kept: J ids of its bones.
        names: J strings. parents: J ids among the kept, -1 for the root.
        weights: (V, J), those of a bone that is left out added to its parent's.
    """

    model: object
    kept: list[int]
    names: list[str]
    parents: list[int]
    weights: np.ndarray

    def skeleton(self, joints: np.ndarray) -> Skeleton:
        """The kept bones of somebody, from the (B, 3) joints of all."""
        return Skeleton.from_heads_and_tails(
            joints[self.kept], None, self.parents, self.names
        )


@lru_cache(maxsize=4)
def anny_rig(topology: str = "notoes") -> AnnyRig:
    """The rig of all bodies of Anny's; the first call takes minutes, once.

    Raises:
        HeadError: the package `anny` is not installed.
    """
    try:
        from anny import Anny
    except ImportError as error:
        raise HeadError(
            "anny body", "the package anny is not installed", "run `pip install anny`"
        ) from error
    model = Anny(rig="anny-notoes", topology=topology, skinning_method="lbs")
    names = model.bone_labels
    kept = [b for b, name in enumerate(names) if not name.startswith(MERGED)]
    place = {bone: i for i, bone in enumerate(kept)}
    parents = [place.get(model.bone_parents[bone], -1) for bone in kept]
    for bone, parent in enumerate(model.bone_parents):  # parents come first
        place.setdefault(bone, place.get(parent))
    columns = np.array([place[bone] for bone in range(len(names))])
    influences = columns[model.vertex_bone_indices.numpy()]
    weights = np.zeros((len(influences), len(kept)))
    rows = np.arange(len(weights))[:, None]
    np.add.at(weights, (rows, influences), model.vertex_bone_weights.numpy())
    return AnnyRig(model, kept, [names[bone] for bone in kept], parents, weights)


def anny_body() -> Body:
    """Build the shipped body anew: 12,272 vertices, 24,540 triangles, 36 bones.

    The mean adult, without toes, closed; the first call takes minutes, as for
    `skinlib.datasets.anny.anny_heads`.

    Raises:
        HeadError: the package `anny` is not installed.
    """
    import torch

    rig = anny_rig()

    def rest(**changes) -> tuple[np.ndarray, np.ndarray]:
        with torch.inference_mode():
            body = rig.model(None, phenotype_kwargs=ADULT | changes)
        return (
            body["rest_vertices"][0].numpy().astype(np.float32),
            body["rest_bone_heads"][0].numpy().astype(np.float32),
        )

    vertices, joints = rest()
    # Half the way from one end of the phenotype to the other: 1 is the end itself.
    ends = [(rest(**{name: 1.0}), rest(**{name: 0.0})) for name in SHAPES]
    faces = rig.model.get_triangular_faces().numpy()
    return Body(
        Head.create(vertices, faces, rig.skeleton(joints), rig.weights, name="body"),
        SHAPES,
        np.stack([(high[0] - low[0]) / 2 for high, low in ends]),
        np.stack([(high[1] - low[1])[rig.kept] / 2 for high, low in ends]),
    )
