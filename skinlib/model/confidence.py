"""How sure is the network, vertex by vertex: "look here before you ship".

A row of weights is doubtful when it is torn between bones, and when the network
answers otherwise for the same head seen in a mirror and bent a little. `uncertainty`
is the geometric mean of the two. It orders the vertices; a `Calibration`, fitted on
heads the network never saw, turns it into a share and into an error. What else was
tried is in benchmarks/README.md.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import numpy as np
import torch
from scipy.optimize import isotonic_regression

from skinlib.datasets.augment import mirror, warp
from skinlib.graph import build_graph
from skinlib.head import Head, HeadError, Skeleton
from skinlib.model.inputs import FAR, bone_frame, mesh_input, skeleton_input
from skinlib.model.skinning_model import SkinningModel, working_size
from skinlib.painting import prune
from skinlib.paths import DEFAULT_CHECKPOINT, checkpoint
from skinlib.skinning import mirror_pairs

CALIBRATION = "calibration.json"
NETWORK = "model.safetensors"
TOLERANCE = 0.2  # row-L1: a tenth of the weight lies on wrong bones
WARP = 0.2  # relative change of lengths that no artist would paint differently
LEAST = 1e-6  # below this, rounding may have made the doubt
BINS = 100  # a fit averages over this many groups of vertices, alike in uncertainty


@dataclass(frozen=True)
class Calibration:
    """From an uncertainty to a confidence and to an error to expect; piecewise linear.

    >>> calibration = Calibration(0.2, (0.0, 1.0), (1.0, 0.5), (0.0, 0.4), "by hand")
    >>> calibration.confidence(np.array([0.0, 0.5, 9.0])).tolist()
    [1.0, 0.75, 0.5]

    Raises:
        HeadError: the knots are no calibration.
    """

    tolerance: float  # row-L1 up to which a vertex counts as right
    knots: tuple[float, ...]  # uncertainties, ascending, the first is 0
    confidences: tuple[float, ...]  # share of right vertices at each knot, descending
    errors: tuple[float, ...]  # mean row-L1 at each knot, ascending
    fitted_on: str = ""  # which heads and which network, in words

    def __post_init__(self):
        try:
            knots, shares, errors = (
                np.asarray(part, np.float64)
                for part in (self.knots, self.confidences, self.errors)
            )
            valid = (
                knots.ndim == 1
                and len(knots) > 0
                and knots.shape == shares.shape == errors.shape
                and all(np.isfinite(part).all() for part in (knots, shares, errors))
                and knots[0] == 0
                and (np.diff(knots) > 0).all()
                and (np.diff(shares) <= 0).all()
                and (np.diff(errors) >= 0).all()
                and 0 <= shares[-1] <= shares[0] <= 1
                and 0 <= errors[0] <= errors[-1] <= 2
                and 0 < self.tolerance <= 2
            )
        except (TypeError, ValueError):
            valid = False
        if not valid:
            raise HeadError(
                "calibration",
                "its numbers are no calibration",
                "take one that `Calibration.fit` made",
            )

    def confidence(self, uncertainty: np.ndarray) -> np.ndarray:
        """(V,) in 0 .. 1: of vertices with confidence c, a share c is right."""
        return np.interp(uncertainty, self.knots, self.confidences)

    def expected_error(self, uncertainty: np.ndarray) -> np.ndarray:
        """(V,) row-L1 to expect, 0 .. 2."""
        return np.interp(uncertainty, self.knots, self.errors)

    @classmethod
    def fit(
        cls,
        uncertainties: Sequence[np.ndarray],
        errors: Sequence[np.ndarray],
        tolerance: float = TOLERANCE,
        fitted_on: str = "",
    ) -> Self:
        """Isotonic regression of "is right" and of row-L1; each head counts the same.

        Args:
            uncertainties, errors: (V,) of each head; row-L1 of what was predicted.

        Raises:
            HeadError: there is no vertex to fit on.
        """
        if not sum(map(len, errors)):
            raise HeadError("heads", "there are none", "give heads with weights")
        found, error, weight = (
            np.concatenate(parts).astype(np.float64)
            for parts in (
                uncertainties,
                errors,
                [np.full(len(e), 1 / max(1, len(e))) for e in errors],
            )
        )
        # Groups of equal weight: a few vertices at the end would decide by themselves.
        order = np.argsort(found, kind="stable")
        total = np.cumsum(weight[order])
        group = np.zeros(len(order), np.int64)
        group[order] = ((total - total[0] / 2) / total[-1] * BINS).astype(int)

        def mean(values):
            return np.bincount(group, weight * values) / np.bincount(group, weight)

        group = np.unique(group, return_inverse=True)[1]
        # What is about equally uncertain is one group; no doubt at all is certainty.
        knots = np.maximum(mean(found).round(4), LEAST)
        knots, joined = np.unique(knots, return_inverse=True)
        group = joined[group]
        mass = np.bincount(group, weight)
        share = isotonic_regression(
            mean(error <= tolerance), weights=mass, increasing=False
        ).x.clip(0, 1)
        size = isotonic_regression(mean(error), weights=mass).x.clip(0, 2)
        knots, share, size = np.r_[0, knots], np.r_[1, share], np.r_[0, size]
        return cls(
            tolerance,
            *(tuple(part.round(6).tolist()) for part in (knots, share, size)),
            fitted_on,
        )

    def write(self, folder: str | Path) -> Path:
        """Write `calibration.json` beside a network."""
        path = Path(folder) / CALIBRATION
        path.write_text(json.dumps(asdict(self), indent=1) + "\n")
        return path

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """The calibration of a file that `write` made.

        Raises:
            HeadError: the file cannot be read, or holds something else.
        """
        path = Path(path)
        try:
            stored = json.loads(path.read_text())
            return cls(
                float(stored["tolerance"]),
                tuple(map(float, stored["knots"])),
                tuple(map(float, stored["confidences"])),
                tuple(map(float, stored["errors"])),
                str(stored["fitted_on"]),
            )
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise HeadError(
                "calibration",
                f"it cannot be used ({error})",
                "copy the file again, or fit a new one with `fit_calibration`",
                path,
            ) from error


def load_calibration(name: str | Path) -> Calibration:
    """The calibration of a network, by the name or folder that `load_model` takes.

    A network that was never calibrated gets the shipped network's, whose `fitted_on`
    tells so: its confidence still puts the vertices in the right order.

    Raises:
        HeadError: there is no such network, or the file is damaged.
    """
    folder = Path(name)
    if folder.suffix == ".safetensors":
        folder = folder.parent
    elif not any((folder / file).is_file() for file in (CALIBRATION, NETWORK)):
        # Somebody's folder of heads may have the name of a shipped checkpoint.
        if str(name) != folder.name:
            raise HeadError(
                "checkpoint",
                "no network is there",
                "give a folder that `skinlib train --out` wrote, or a shipped name",
                folder,
            )
        folder = checkpoint(folder.name)
    path = folder / CALIBRATION
    if not path.is_file():
        path = checkpoint(DEFAULT_CHECKPOINT) / CALIBRATION
    return Calibration.read(path)


def fit_calibration(
    model: SkinningModel,
    heads: Sequence[Head],
    tolerance: float = TOLERANCE,
    fitted_on: str = "",
) -> Calibration:
    """The calibration of a network by skinned heads that it never learnt from.

    Raises:
        HeadError: no heads, or heads without weights.
    """
    uncertainties, errors = [], []
    for head in heads:
        if head.weights is None:
            raise HeadError("weights", "there are none", "calibrate by skinned heads")
        weights, found = predict_with_uncertainty(model, head)
        uncertainties.append(found)
        errors.append(np.abs(weights - head.weights).sum(axis=1))
    return Calibration.fit(uncertainties, errors, tolerance, fitted_on)


def predict_with_confidence(
    model: SkinningModel,
    head: Head,
    calibration: Calibration | None = None,
    pruned: float = 0.01,
) -> tuple[np.ndarray, np.ndarray]:
    """(V, J) weights as `model.predict` gives them, and (V,) confidence in each row.

    Args:
        calibration: of this network; the shipped network's when absent.
    """
    calibration = calibration or load_calibration(DEFAULT_CHECKPOINT)
    weights, found = predict_with_uncertainty(model, head, pruned)
    return weights, calibration.confidence(found)


def colours(confidence: np.ndarray) -> np.ndarray:
    """(V, 3) linear RGB: white where the confidence is 1, red where it is 0.

    Viewers multiply a head's own colours by these: white changes nothing.

    >>> colours(np.array([1.0, 0.0])).tolist()
    [[1.0, 1.0, 1.0], [1.0, 0.0, 0.0]]
    """
    doubtful = 1 - np.asarray(confidence)[:, None]
    return 1 - doubtful * [0.0, 1.0, 1.0]


def predict_with_uncertainty(
    model: SkinningModel, head: Head, pruned: float = 0.01
) -> tuple[np.ndarray, np.ndarray]:
    """(V, J) weights as `model.predict` gives them, and (V,) how doubtful each row is.

    Takes one forward pass more than `predict`; the graph is built once.
    """
    weights, other = two_opinions(model, head)
    return prune(weights, pruned), doubt(weights, other)


def uncertainty(model: SkinningModel, head: Head) -> np.ndarray:
    """(V,) how doubtful the predicted weights of each vertex are; see `doubt`."""
    return doubt(*two_opinions(model, head))


def doubt(weights: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(V,) sqrt(g d): Gini impurity g = 1 - sum_j w_j^2, row-L1 d to a second opinion.

    0 where one bone has all the weight or both opinions agree, at most sqrt(2).
    Equation `doubt`.

    >>> doubt(np.array([[0.5, 0.5], [1, 0]]), np.array([[0.25, 0.75], [1, 0]])).tolist()
    [0.5, 0.0]
    """
    weights = weights.astype(np.float64)
    impurity = (1 - (weights**2).sum(axis=1)).clip(min=0)
    return np.sqrt(impurity * np.abs(weights - other).sum(axis=1))


@torch.no_grad()
def two_opinions(model: SkinningModel, head: Head) -> tuple[np.ndarray, np.ndarray]:
    """(V, J) weights of a head, and once more of it mirrored and bent a little."""
    head, back = working_size(head)
    graph = build_graph(head, model.config.graph)
    device = next(model.parameters()).device

    def weights(view):
        mesh, skeleton = mesh_input(view, graph), skeleton_input(view)
        found = model(mesh.to(device), skeleton.to(device)).cpu().numpy()
        return found if back is None else back @ found

    # The mirrored head's left eye is the right one's image, under the left one's name.
    return weights(head), weights(other_view(head))[:, mirror_pairs(head.skeleton)]


def other_view(head: Head) -> Head:
    """The head in its own frame, left and right swapped, under a fixed smooth warp.

    The same vertices and triangles, so the head's graph fits. The frame makes the
    warp independent of the file's axes and unit, a fixed seed the same every time.
    """
    frame, skeleton = bone_frame(head), head.skeleton

    def place(points):
        return frame.apply(points).clip(-FAR, FAR)

    framed = Head.create(
        place(head.vertices),
        head.faces,
        Skeleton.from_heads_and_tails(
            place(skeleton.joints),
            place(skeleton.tails),
            skeleton.parents,
            skeleton.names,
        ),
    )
    bent = warp(mirror(framed), np.random.default_rng(0), WARP)
    return bent.replace(normals=None)
