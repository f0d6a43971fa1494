"""The data contract: a head, its skeleton and, if an artist painted them, its weights.

Everything is checked once, here at the door. Code behind the door may trust a `Head`:
arrays are finite, typed, read-only, ids are in range, parents form a forest, and each
row of weights is a probability distribution over bones.
"""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from skinlib.geometry import safe_normalize, vertex_normals

WEIGHT_SUM_TOLERANCE = 1e-3
# Squares of coordinates have to fit into float32.
LARGEST_COORDINATE = 1e15


class HeadError(ValueError):
    """What is wrong with a head, where, and what to do about it.

    Args:
        field: the field at fault, such as `"parents"`.
        found: what was found there.
        fix: what the person who made the file can do.
        file: the file it came from, when there is one.
    """

    def __init__(
        self, field: str, found: str, fix: str, file: str | Path | None = None
    ):
        self.field, self.found, self.fix = field, found, fix
        self.file = None if file is None else str(file)
        where = f"{self.file}: " if self.file else ""
        super().__init__(f"{where}{field}: {found}. {fix[:1].upper()}{fix[1:]}.")


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A forest of J bones. Build one with `Skeleton.from_heads_and_tails`.

    Attributes:
        joints: (J, 3) float32, where each bone begins, in the unit of the vertices.
        parents: (J,) int64, the parent bone or -1 for a root; any order.
        lengths: (J,) float32, head to tail; 0 when a bone has no tail.
        directions: (J, 3) float32, unit, head to tail; 0 when the length is 0.
        names: J strings, shown to people; the network never reads them.
    """

    joints: np.ndarray
    parents: np.ndarray
    lengths: np.ndarray
    directions: np.ndarray
    names: tuple[str, ...]

    @classmethod
    def from_heads_and_tails(
        cls,
        heads: ArrayLike,
        tails: ArrayLike | None,
        parents: ArrayLike,
        names: Sequence[str],
        file: str | Path | None = None,
    ) -> "Skeleton":
        """Check the four arrays and make a `Skeleton` of them.

        A tail may be NaN (FBX and glTF know none): a bone with children then ends at
        their mean head, and a leaf has length 0.

        Args:
            heads: (J, 3). tails: (J, 3) or None. parents: (J,). names: J strings.

        Raises:
            HeadError: wrong shape, NaN, a cycle, no bone, a name missing or used twice.

        >>> jaw = Skeleton.from_heads_and_tails(
        ...     [[0, 0, 0], [0, 1, 0]], None, [-1, 0], ["head", "jaw"])
        >>> jaw.lengths.tolist(), jaw.depths.tolist()
        ([1.0, 0.0], [0, 1])
        """
        joints = _array(heads, np.float32, (None, 3), "bone_heads", file)
        count = len(joints)
        if count == 0:
            raise HeadError(
                "bone_heads",
                "there are no bones",
                "export the head with its skeleton",
                file,
            )
        _finite(joints, "bone_heads", file)
        _bounded(joints, "bone_heads", file)
        parents = _forest(parents, count, file)
        names = _names(names, count, file)

        if tails is None:
            tails = np.full((count, 3), np.nan, np.float32)
        tails = _array(tails, np.float32, (count, 3), "bone_tails", file).copy()
        if np.isinf(tails).any():
            raise HeadError(
                "bone_tails",
                "it holds infinite values",
                "use NaN for a bone without a tail",
                file,
            )
        _bounded(tails[~np.isnan(tails)], "bone_tails", file)
        child = np.flatnonzero(parents >= 0)
        ends, children = np.zeros_like(joints), np.zeros((count, 1), np.float32)
        np.add.at(ends, parents[child], joints[child])
        np.add.at(children, parents[child], 1)
        ends = np.where(children > 0, ends / np.maximum(children, 1), joints)
        tails = np.where(np.isnan(tails).any(axis=1, keepdims=True), ends, tails)

        offsets = tails.astype(np.float64) - joints
        lengths = np.linalg.norm(offsets, axis=1)
        directions = safe_normalize(offsets)
        return cls(
            _frozen(joints),
            _frozen(parents),
            _frozen(lengths.astype(np.float32)),
            _frozen(directions.astype(np.float32)),
            names,
        )

    def __len__(self) -> int:
        return len(self.parents)

    @property
    def tails(self) -> np.ndarray:
        """(J, 3) float32, where each bone ends; equal to `joints` without a tail."""
        return self.joints + self.lengths[:, None] * self.directions

    @property
    def order(self) -> np.ndarray:
        """(J,) int64, a permutation in which parents come before their children."""
        return np.argsort(self.depths, kind="stable")

    @property
    def depths(self) -> np.ndarray:
        """(J,) int64, the number of ancestors of each bone."""
        ancestor, depths = self.parents, (self.parents >= 0).astype(np.int64)
        while (ancestor >= 0).any():
            depths = depths + np.where(ancestor >= 0, depths[ancestor], 0)
            ancestor = _twice_as_far(ancestor)
        return depths

    def children(self) -> list[list[int]]:
        """The ids of each bone's children."""
        children: list[list[int]] = [[] for _ in range(len(self))]
        for bone, parent in enumerate(self.parents.tolist()):
            if parent >= 0:
                children[parent].append(bone)
        return children

    def reordered(self, permutation: ArrayLike) -> "Skeleton":
        """The same skeleton with bone `permutation[i]` in place i."""
        permutation = np.asarray(permutation, np.int64)
        place = np.zeros_like(permutation)
        place[permutation] = np.arange(len(permutation))
        parents = self.parents[permutation]
        return Skeleton(
            _frozen(self.joints[permutation]),
            _frozen(np.where(parents >= 0, place[parents], -1)),
            _frozen(self.lengths[permutation]),
            _frozen(self.directions[permutation]),
            tuple(self.names[i] for i in permutation),
        )


@dataclass(frozen=True, eq=False)
class Head:
    """A mesh bound, or to be bound, to a skeleton. Build one with `Head.create`.

    Attributes:
        vertices: (V, 3) float32, rest positions; any unit, any up-axis.
        normals: (V, 3) float32, unit.
        faces: (F, 3) int64, vertex ids of triangles.
        skeleton: the J bones.
        weights: (V, J) float32, rows >= 0 with sum 1; None when unlabelled.
        name: shown to people, usually the file's stem.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    skeleton: Skeleton
    weights: np.ndarray | None = None
    name: str = ""

    @classmethod
    def create(
        cls,
        vertices: ArrayLike,
        faces: ArrayLike,
        skeleton: Skeleton,
        weights: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        name: str = "",
        file: str | Path | None = None,
    ) -> "Head":
        """Check everything and make a `Head`; normals are computed when absent.

        Raises:
            HeadError: naming the field, what was found and what to do.

        >>> bone = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["head"])
        >>> Head.create(np.eye(3), [[0, 1, 2]], bone, weights=[[1]] * 3).normals[0]
        array([0.57735026, 0.57735026, 0.57735026], dtype=float32)
        """
        vertices = _array(vertices, np.float32, (None, 3), "vertices", file)
        if len(vertices) == 0:
            raise HeadError(
                "vertices", "there are none", "export a mesh with vertices", file
            )
        _finite(vertices, "vertices", file)
        _bounded(vertices, "vertices", file)
        faces = _array(faces, np.int64, (None, 3), "faces", file)
        if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
            bad = faces[(faces < 0) | (faces >= len(vertices))][0]
            raise HeadError(
                "faces",
                f"vertex id {bad} with {len(vertices)} vertices",
                f"use ids from 0 to {len(vertices) - 1}",
                file,
            )
        if normals is None:
            normals = vertex_normals(vertices, faces)
        normals = _array(normals, np.float32, vertices.shape, "normals", file)
        _finite(normals, "normals", file)
        normals = _unit_normals(normals)
        if weights is not None:
            weights = _weights(weights, len(vertices), len(skeleton), file)
        return cls(
            _frozen(vertices),
            _frozen(normals),
            _frozen(faces),
            skeleton,
            None if weights is None else _frozen(weights),
            str(name),
        )

    def replace(self, **changes) -> "Head":
        """A checked copy with some fields changed.

        New vertices or faces without new normals have their normals computed.
        """
        if {"vertices", "faces"} & changes.keys():
            changes.setdefault("normals", None)
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return Head.create(**(fields | changes))


def _array(values, dtype, shape, field, file) -> np.ndarray:
    """`values` as a C-contiguous array of the wanted kind, or a HeadError."""
    try:
        array = np.asarray(values)
    except ValueError:
        array = np.asarray(values, dtype=object)
    wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
    kinds = "iu" if np.issubdtype(dtype, np.integer) else "iuf"
    if array.size == 0 and len(shape) == 2 and array.ndim == 1:
        array = array.reshape(0, 3)
    if array.size and array.dtype.kind not in kinds:
        raise HeadError(
            field,
            f"values of type {array.dtype}",
            f"store {np.dtype(dtype).name} values of shape {wanted}",
            file,
        )
    fits = array.ndim == len(shape) and all(
        n is None or n == m for n, m in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise HeadError(
            field, f"an array of shape {array.shape}", f"make its shape {wanted}", file
        )
    # A caller may go on writing to his own array; a read-only one can be shared.
    with np.errstate(over="ignore"):
        if array.flags.writeable:
            return np.array(array, dtype, order="C")
        return np.ascontiguousarray(array, dtype)


def _finite(array, field, file) -> None:
    bad = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
    if bad.any():
        raise HeadError(
            field,
            f"{int(bad.sum())} rows hold NaN or infinity, the first is row "
            f"{int(np.flatnonzero(bad)[0])}",
            "export the head again with finite values",
            file,
        )


def _bounded(array, field, file) -> None:
    extent = float(np.abs(array).max(initial=0))
    if extent > LARGEST_COORDINATE:
        raise HeadError(
            field,
            f"the largest coordinate is {extent:.3g}",
            f"use a unit in which a head measures less than {LARGEST_COORDINATE:g}",
            file,
        )


def _forest(parents, count, file) -> np.ndarray:
    parents = _array(parents, np.int64, (count,), "bone_parents", file)
    bad = np.flatnonzero((parents < -1) | (parents >= count))
    if len(bad):
        raise HeadError(
            "bone_parents",
            f"bone {bad[0]} has parent {parents[bad[0]]} with {count} bones",
            f"use ids from 0 to {count - 1}, or -1 for a root",
            file,
        )
    ancestor = parents
    for _ in range(count.bit_length()):
        ancestor = _twice_as_far(ancestor)
    if (ancestor >= 0).any():
        bone = int(np.flatnonzero(ancestor >= 0)[0])
        raise HeadError(
            "bone_parents",
            f"bone {bone} is its own ancestor",
            "break the cycle: give one of its bones the parent -1",
            file,
        )
    return parents


def _twice_as_far(ancestor: np.ndarray) -> np.ndarray:
    """From each bone's n-th ancestor to the 2n-th; -1 when there is none."""
    return np.where(ancestor >= 0, ancestor[ancestor], -1)


def _names(names, count, file) -> tuple[str, ...]:
    names = tuple(str(name) for name in names)
    if len(names) != count:
        raise HeadError(
            "bone_names",
            f"{len(names)} names for {count} bones",
            "give one name per bone",
            file,
        )
    for name, uses in Counter(names).items():
        if not name:
            raise HeadError("bone_names", "an empty name", "name every bone", file)
        if uses > 1:
            raise HeadError(
                "bone_names",
                f"{name!r} is used {uses} times",
                "give each bone a name of its own",
                file,
            )
    return names


def _weights(weights, vertex_count, bone_count, file) -> np.ndarray:
    shape = (vertex_count, bone_count)
    weights = _array(weights, np.float32, shape, "weights", file)
    _finite(weights, "weights", file)
    if (weights < -WEIGHT_SUM_TOLERANCE).any():
        vertex, bone = np.argwhere(weights < -WEIGHT_SUM_TOLERANCE)[0]
        raise HeadError(
            "weights",
            f"vertex {vertex} has weight {weights[vertex, bone]:.4g} on bone {bone}",
            "make all weights at least 0",
            file,
        )
    weights = np.maximum(weights, 0)
    sums = weights.sum(axis=1, dtype=np.float64)
    off = np.flatnonzero(np.abs(sums - 1) > WEIGHT_SUM_TOLERANCE)
    if len(off):
        raise HeadError(
            "weights",
            f"{len(off)} rows do not sum to 1, vertex {off[0]} sums to "
            f"{sums[off[0]]:.4g}",
            "normalise the weights, and give each vertex at least one bone",
            file,
        )
    # Divide only where it is needed, so that exact weights stay exact to the bit.
    rows = np.abs(sums - 1) > 1e-6
    if rows.any():
        weights = weights.copy()
        weights[rows] = weights[rows] / sums[rows, None]
    return weights


def _unit_normals(normals) -> np.ndarray:
    """Normals of length 1; one that is 0 (an isolated vertex) points along +Z."""
    length = np.linalg.norm(normals.astype(np.float64), axis=1)
    off = np.abs(length - 1) > 1e-6
    if off.any():
        normals = normals.copy()
        normals[off] = safe_normalize(normals[off], fallback=(0, 0, 1))
    return normals


def _frozen(array: np.ndarray) -> np.ndarray:
    """A read-only view, so that a shared head cannot be changed from afar."""
    view = array.view()
    view.flags.writeable = False
    return view
