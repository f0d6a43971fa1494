"""Label propagation: rows of painted heads, carried to heads that nobody painted.

Artists make a new head from parts of older ones. Where the mesh around a vertex is
connected as on a painted head, and the vertex lies at about the same place, it is the
same vertex, sculpted anew, and its weights can be taken over. No network guesses here.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from skinlib.geometry import neighbourhood_kinds
from skinlib.head import Head, HeadError
from skinlib.model.inputs import bone_frame

RINGS = (4, 3, 2)  # how far two meshes have to agree around a vertex; the deepest wins
REACH = 0.25  # in the frame of the bones: how far the same vertex may have moved
APART = 1e3 * REACH  # between two kinds of neighbourhood, so that no search mixes them
WITNESSES = 4  # painted vertices that are asked
DISAGREE = 0.1  # row-L1, how far their rows may lie apart on average
FAMILY = 0.1  # of the vertices; a head with fewer known ones shares them by chance
LOST = 0.01  # weight that may lie on bones which the other skeleton has not


class Propagation:
    """What painted heads know about the vertices of others.

    Equation `propagation`.

    Args:
        painted: heads with weights.

    Raises:
        HeadError: one of them has none.
    """

    def __init__(self, painted: Sequence[Head]):
        self.painted = list(painted)
        for head in self.painted:
            if head.weights is None:
                fix = "take over weights from skinned heads"
                raise HeadError("weights", f"head {head.name!r} has none", fix)
        sizes = [len(head.vertices) for head in self.painted]
        self._head = np.repeat(np.arange(len(sizes)), sizes)
        self._vertex = np.concatenate([np.arange(size) for size in sizes])
        places = np.concatenate([_places(head) for head in self.painted])
        self._near = cKDTree(places)
        self._trees = []
        for rings in RINGS:
            kinds = [_kinds(head, rings) for head in self.painted]
            met, ranks = np.unique(np.concatenate(kinds), return_inverse=True)
            tree = cKDTree(np.column_stack([places, APART * ranks]))
            self._trees.append((rings, met, tree))

    def rows(self, head: Head) -> tuple[np.ndarray, np.ndarray]:
        """Weights for a head, and which of them painted heads really know.

        The same vertex is looked for on all painted heads, with the most rings first.
        The nearest one lends its row, unless the next ones were painted differently:
        then artists disagree, and nothing is known. Where there is no such vertex, the
        nearest of any kind lends its row, which is good enough to pose a head by.
        Bones are matched by name.

        Returns:
            weights: (V, J) float32, rows sum to 1.
            known: (V,) bool.
        """
        places = _places(head)
        source = np.full((len(places), WITNESSES), -1)
        for rings, met, tree in self._trees:
            kinds = _kinds(head, rings)
            rank = np.searchsorted(met, kinds).clip(max=len(met) - 1)
            asked = np.flatnonzero((source[:, 0] < 0) & (met[rank] == kinds))
            where = np.column_stack([places, APART * rank])[asked]
            _, found = tree.query(where, k=WITNESSES, distance_upper_bound=REACH)
            source[asked] = np.where(found < tree.n, found, -1)
        known = source[:, 0] >= 0
        _, source[~known, 0] = self._near.query(places[~known])  # a template copy
        weights = self._rows(source[:, 0], head)
        total = weights.sum(axis=1)
        known &= total > 1 - LOST
        spread, count = np.zeros(len(places)), np.ones(len(places))
        for other in source.T[1:]:
            there = known & (other >= 0)
            apart = np.abs(self._rows(other[there], head) - weights[there]).sum(axis=1)
            spread[there] += apart
            count[there] += 1
        known &= spread <= DISAGREE * count
        if known.mean() < FAMILY:
            known[:] = False
        # What hangs on bones that are not there goes to the root.
        weights[:, int(np.argmin(head.skeleton.parents))] += 1 - total
        return weights, known

    def _rows(self, source: np.ndarray, head: Head) -> np.ndarray:
        """(S, J) rows of painted vertices, in the bones of `head`."""
        rows = np.zeros((len(source), len(head.skeleton)), np.float32)
        column = {name: bone for bone, name in enumerate(head.skeleton.names)}
        for place in np.unique(self._head[source]):
            painted = self.painted[place]
            mine = np.flatnonzero(self._head[source] == place)
            pairs = [
                (bone, column[name])
                for bone, name in enumerate(painted.skeleton.names)
                if name in column
            ]
            if pairs:
                theirs, ours = np.array(pairs).T
                taken = painted.weights[self._vertex[source[mine]]]
                rows[np.ix_(mine, ours)] = taken[:, theirs]
        return rows


def _places(head: Head) -> np.ndarray:
    return bone_frame(head).apply(head.vertices)


def _kinds(head: Head, rings: int) -> np.ndarray:
    return neighbourhood_kinds(head.vertices, head.faces, rings)
