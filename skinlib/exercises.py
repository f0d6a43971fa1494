"""The checks behind the notebooks' exercises.

A notebook gives a specification and a stub, and asks `check_exercise` about it. To add
an exercise, write its check below: it takes the answer (a value, or the reader's
function) and returns a hint, or None when the answer is right.

>>> check_exercise("04.2", None)
04.2: not solved yet
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

Check = Callable[[Any], str | None]
CHECKS: dict[str, Check] = {}


class _NotSolved(Exception):
    """The reader's function returned None, as a stub does."""


def exercise(name: str) -> Callable[[Check], Check]:
    """Register a check under the exercise's number, such as "01.1"."""

    def register(check: Check) -> Check:
        if name in CHECKS:
            raise ValueError(f"exercise {name} has two checks")
        CHECKS[name] = check
        return check

    return register


def check_exercise(name: str, answer: Any) -> None:
    """Say in one line whether an exercise is solved; never raise.

    Args:
        name: the exercise's number, such as "01.1".
        answer: the reader's value or function; None, or a function that returns
            None, is a stub.

    >>> check_exercise("05.1", lambda logits: logits / logits.sum())
    05.1: not yet: a row of weights is never negative
    """
    if name not in CHECKS:
        verdict = f"no such exercise; there are {', '.join(sorted(CHECKS))}"
    else:
        verdict = _verdict(CHECKS[name], answer)
    print(f"{name}: {verdict}")  # noqa: T201  a reader in a notebook


def _verdict(check: Check, answer: Any) -> str:
    if answer is None:
        return "not solved yet"
    if callable(answer):
        answer = _called(answer)
    try:
        hint = check(answer)
    except _NotSolved:
        return "not solved yet"
    except Exception as error:
        text = " ".join(str(error).split())
        return f"not yet: it stops with {type(error).__name__}: {text}"
    return "right" if hint is None else f"not yet: {hint}"


def _called(function: Callable) -> Callable:
    """The reader's function; a None from it ends the check as not solved."""

    @functools.wraps(function)
    def call(*args, **kwargs):
        result = function(*args, **kwargs)
        if result is None:
            raise _NotSolved
        return result

    return call


def same(found: Any, wanted: Any, tolerance: float = 1e-5) -> bool:
    """Whether two arrays, tensors or numbers have one shape and nearly one value.

    >>> same([1.0, 2.0], (1, 2)), same([1, 2], [[1, 2]]), same("a", 1)
    (True, False, False)
    """
    found, wanted = np.asarray(found), np.asarray(wanted)
    if found.shape != wanted.shape or found.dtype.kind not in "biuf":
        return False
    return bool(np.allclose(found, wanted, rtol=tolerance, atol=tolerance))


# ---- 04 skeleton encoder


@exercise("04.1")
def _hops(hops: Callable) -> str | None:
    """`hops(parents, a, b)`: edges on the way from bone a to bone b; -1 for none."""
    parents = np.array([-1, 0, 1, 0, -1])
    cases = [
        (2, 2, 0, "from a bone to itself it is 0"),
        (1, 0, 1, "a bone and its parent are 1 apart"),
        (0, 2, 2, "the way down is as long as the way up"),
        (2, 3, 3, "go up from both bones, and meet at an ancestor they share"),
        (2, 4, -1, "two trees share no ancestor: the answer is -1"),
    ]
    for a, b, wanted, hint in cases:
        if not same(hops(parents, a, b), wanted):
            return hint
    if not same(hops(np.array([1, 2, -1]), 0, 2), 2):
        return "a parent may have a larger id than its child"
    return None


@exercise("04.2")
def _mirrored_columns(columns: Any) -> str | None:
    """Which of the 12 bone features change sign when x does."""
    columns = sorted(int(column) for column in columns)
    if columns == [0, 3, 7]:
        return None
    if 6 in columns:
        return "a mirror image is as long as the bone"
    if not {0, 3, 7} <= set(columns):
        return "three of the blocks are vectors, and each has an x"
    return "y, z and the two flags are the same in a mirror"


# ---- 05 cross-attention


@exercise("05.1")
def _softmax(softmax: Callable) -> str | None:
    """`softmax(logits)`: (V, J) to (V, J), also for logits of 1000."""
    weights = np.asarray(softmax(np.array([[0.0, np.log(3.0)], [-1.0, -2.0]])))
    if weights.shape != (2, 2):
        return f"two vertices and two bones go in, shape {weights.shape} came out"
    if (weights < 0).any():
        return "a row of weights is never negative"
    if not same(weights.sum(axis=1), [1, 1]):
        return "each row sums to 1: divide by the row's own sum, axis=1"
    if not same(weights[0], [0.25, 0.75]):
        return "for logits 0 and log 3 the weights are 1/4 and 3/4"
    with np.errstate(all="ignore"):
        large = softmax(np.array([[1000.0, 0.0]]))
    if not same(large, [[1, 0]]):
        return "exp(1000) is infinite: subtract the row's largest logit first"
    return None


@exercise("05.2")
def _masked(masked: Callable) -> str | None:
    """`masked(logits, allowed)`: a forbidden bone gets 0, the others share its part."""
    logits = np.log(np.array([[1.0, 2.0, 5.0], [1.0, 1.0, 2.0]]))
    allowed = np.array([[True, True, False], [True, True, True]])
    weights = np.asarray(masked(logits, allowed))
    if weights.shape != logits.shape:
        return f"logits of shape (2, 3) went in, shape {weights.shape} came out"
    if weights[0, 2] != 0:
        return "exp of which logit is exactly 0?"
    if not same(weights.sum(axis=1), [1, 1]):
        return "mask before the softmax, so that each row still sums to 1"
    if not same(weights, [[1 / 3, 2 / 3, 0], [0.25, 0.25, 0.5]]):
        return "the bones that are left keep their proportions"
    return None
