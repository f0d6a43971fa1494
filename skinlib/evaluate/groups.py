"""Which heads are edits of one base mesh, and splits that keep such heads together.

Game studios sculpt many characters from one mesh. A network, or a template, that has
seen one of them knows the others' vertices: a score on such heads flatters.
"""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from skinlib.geometry import neighbourhood_kinds
from skinlib.head import Head, HeadError

# There is no gap between edits of one mesh and other heads: similarity falls off
# gradually. On 82 game characters 0.5 gives the number of heads, 38, that are known to
# share a base mesh; a lower value makes larger groups and a stricter split.
SHARED = 0.5
# For folds: so strict that no edit of a base mesh is on both sides.
STRICT = 0.47
FOLDS = 4
ROUNDS = 3


def topology_groups(heads: Sequence[Head], shared: float = SHARED) -> list[int]:
    """Group number of each head; heads with the same number share a base mesh.

    Positions, scale, vertex order and cuts along seams do not matter: heads are
    compared by the connectivity around each vertex, three rings deep. Two heads are
    linked when more than `shared` of the smaller one's kinds of neighbourhood occur in
    the other; a group is what links connect. Numbers count up in order of appearance.

    >>> from skinlib.head import Skeleton
    >>> bone = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["head"])
    >>> square = Head.create([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
    ...                      [[0, 1, 2], [0, 2, 3]], bone)
    >>> triangle = Head.create(np.eye(3), [[0, 1, 2]], bone)
    >>> larger = square.replace(vertices=square.vertices * 2)
    >>> topology_groups([square, triangle, larger])
    [0, 1, 0]
    """
    similarity = shared_topology(heads)
    _, groups = connected_components(csr_matrix(similarity > shared), directed=False)
    _, first = np.unique(groups, return_index=True)
    rank = np.argsort(np.argsort(first))
    return rank[groups].tolist()


def shared_topology(heads: Sequence[Head]) -> np.ndarray:
    """(N, N) in 0 .. 1: neighbourhoods in both heads, of the smaller one's kinds."""
    kinds = [_neighbourhoods(head) for head in heads]
    similarity = np.eye(len(heads))
    for a in range(len(heads)):
        for b in range(a):
            common = np.intersect1d(kinds[a], kinds[b], assume_unique=True)
            similarity[a, b] = len(common) / min(len(kinds[a]), len(kinds[b]))
            similarity[b, a] = similarity[a, b]
    return similarity


def group_split(
    heads: Sequence[Head], fraction: float = 0.2, seed: int = 0
) -> tuple[list[int], list[int]]:
    """Ids of training and validation heads that share no base mesh.

    Whole groups go to validation, in random order, as long as its size does not come
    further away from `fraction` of all heads by it.

    Returns:
        (training ids, validation ids), both sorted; validation is empty when all heads
        are of one group.
    """
    groups = np.array(topology_groups(heads))
    wanted = fraction * len(heads)
    held_out = np.zeros(len(heads), bool)
    for group in np.random.default_rng(seed).permutation(groups.max() + 1):
        members = groups == group
        grown = held_out.sum() + members.sum()
        if abs(grown - wanted) < abs(held_out.sum() - wanted) and grown < len(heads):
            held_out |= members
    return np.flatnonzero(~held_out).tolist(), np.flatnonzero(held_out).tolist()


def fold(heads: Sequence[Head], number: int) -> tuple[list[Head], list[Head]]:
    """(training heads, held-out heads) of fold `number` of `FOLDS`.

    The two share no topology group; groups are joined at `STRICT` shared topology. A
    group that holds more than a quarter of all heads is always trained on, where there
    are others.

    Raises:
        HeadError: nothing is held out, or nothing is left to train on.
    """
    groups = np.array(topology_groups(heads, STRICT), np.int64)
    sizes = np.bincount(groups)
    small = np.flatnonzero(sizes <= max(1, len(heads) / 4))
    held_out = np.isin(groups, small[number::FOLDS])
    if held_out.all() or not held_out.any():
        raise HeadError(
            "heads",
            f"{len(heads)} heads in {len(sizes)} topology groups make no fold {number}",
            "give more heads, with meshes of their own",
        )
    pairs = list(zip(heads, held_out, strict=True))
    return [h for h, out in pairs if not out], [h for h, out in pairs if out]


def apart(heads: Sequence[Head], held_out: Sequence[Head]) -> list[Head]:
    """The heads that share no topology (`STRICT`) with any of the held-out ones."""
    if not held_out:
        return list(heads)
    similarity = shared_topology([*held_out, *heads])[: len(held_out), len(held_out) :]
    return [heads[i] for i in np.flatnonzero(similarity.max(axis=0) <= STRICT)]


def _neighbourhoods(head: Head) -> np.ndarray:
    """Sorted kinds of vertex neighbourhood."""
    return np.unique(neighbourhood_kinds(head.vertices, head.faces, ROUNDS))
