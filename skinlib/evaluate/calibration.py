"""What a confidence is worth: does it order the vertices, does it say the truth?"""

import numpy as np
from scipy.stats import rankdata, spearmanr

REPAINTED = (0.05, 0.1, 0.2)
BINS = 15


def calibration_scores(
    confidence: np.ndarray, errors: np.ndarray, tolerance: float = 0.2
) -> dict[str, float]:
    """What a confidence per vertex says about the row-L1 that the vertex then has.

    * `ece`: `expected_calibration_error`, in 0 .. 1.
    * `auroc`, `average_precision`: of finding the vertices above the tolerance, by the
      least confident first; left out where all vertices are on one side of it.
    * `spearman`: rank correlation of doubt and error; left out where one is constant.
    * `captured_5`, `_10`, `_20`: `error_captured` by that many per cent.
    * `share_wrong`: part of the vertices above the tolerance.

    Args:
        confidence: (V,), 0 .. 1; the ranks alone matter except for `ece`.
        errors: (V,) row-L1. tolerance: up to which a vertex counts as right.

    Raises:
        ValueError: no vertices, shapes that differ, or NaN.
    """
    confidence, errors = (np.asarray(x, np.float64) for x in (confidence, errors))
    if confidence.ndim != 1 or confidence.shape != errors.shape or not len(errors):
        raise ValueError(f"confidence {confidence.shape}, errors {errors.shape}")
    if not (np.isfinite(confidence).all() and np.isfinite(errors).all()):
        raise ValueError("confidence or errors hold NaN or infinity")
    wrong = errors > tolerance
    scores = {
        "share_wrong": float(wrong.mean()),
        "ece": expected_calibration_error(confidence, ~wrong),
    }
    if 0 < wrong.sum() < len(wrong):
        scores["auroc"] = auroc(-confidence, wrong)
        scores["average_precision"] = average_precision(-confidence, wrong)
    if np.ptp(confidence) and np.ptp(errors):
        scores["spearman"] = float(spearmanr(-confidence, errors).statistic)
    for part in REPAINTED:
        scores[f"captured_{round(100 * part)}"] = error_captured(
            -confidence, errors, part
        )
    return scores


def expected_calibration_error(
    confidence: np.ndarray, right: np.ndarray, bins: int = BINS
) -> float:
    """Mean of |share that is right - mean confidence| over bins of equal width.

    Source: Guo et al. 2017, On Calibration of Modern Neural Networks, equation 3.

    >>> round(expected_calibration_error(np.array([0.9, 0.9]), np.array([1, 0])), 3)
    0.4
    """
    place = (confidence * bins).astype(int).clip(0, bins - 1)
    gap = np.bincount(place, weights=right - confidence, minlength=bins)
    return float(np.abs(gap).sum() / len(confidence))


def auroc(score: np.ndarray, positive: np.ndarray) -> float:
    """Chance that a positive one scores above a negative one; a tie counts half.

    >>> auroc(np.array([3, 1, 2]), np.array([True, False, False]))
    1.0
    """
    count = np.count_nonzero(positive)
    above = rankdata(score)[positive].sum() - count * (count + 1) / 2
    return float(above / (count * (len(score) - count)))


def average_precision(score: np.ndarray, positive: np.ndarray) -> float:
    """Area under precision over recall, a step for each value of the score.

    >>> average_precision(np.array([4, 3, 2, 1]), np.array([True, False, False, True]))
    0.75
    """
    order = np.argsort(-score, kind="stable")
    last = np.flatnonzero(np.append(np.diff(score[order]) != 0, True))
    found = np.cumsum(positive[order])[last]
    step = np.diff(found, prepend=0)
    return float((step * found / (last + 1)).sum() / found[-1])


def error_captured(score: np.ndarray, errors: np.ndarray, part: float) -> float:
    """Share of the total error that is gone once the worst `part` is painted by hand.

    The worst by the score; of equal scores nobody knows which comes first, so they
    share their errors. 1 when there is no error.

    >>> error_captured(np.array([2, 1, 0, 0]), np.array([0.6, 0.2, 0.2, 0.0]), 0.25)
    0.6
    """
    total = errors.sum()
    if total <= 0:
        return 1.0
    values, group = np.unique(-score, return_inverse=True)
    sizes = np.bincount(group, minlength=len(values))
    mean = np.bincount(group, weights=errors, minlength=len(values)) / sizes
    painted = np.diff(np.minimum(np.cumsum(sizes), part * len(score)), prepend=0)
    return float((painted * mean).sum() / total)
