"""The checks behind the notebooks' exercises.

A notebook gives a specification and a stub, and asks `check_exercise` about it. To add
an exercise, write its check below: it takes the answer (a value, or the reader's
function) and returns a hint, or None when the answer is right.

>>> check_exercise("04.2", None)
04.2: not solved yet
"""

import functools
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from skinlib.datasets.synthetic import synthetic_head
from skinlib.evaluate.metrics import row_l1
from skinlib.head import Head
from skinlib.headbench.suites import vary
from skinlib.skinning import head_bone

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


# ---- 00 quickstart


@exercise("00.1")
def _right_bone(right_bone: Callable) -> str | None:
    """`right_bone(predicted, target)`: share of rows with the same largest bone."""
    target = np.array([[0.6, 0.4], [0.3, 0.7], [0.9, 0.1], [0.2, 0.8]])
    all_right = right_bone(target, target)
    if same(all_right, 4):
        return "divide by the number of vertices"
    if not same(all_right, 1):
        return "the artist's own weights are all right: the share is 1"
    predicted = np.array([[0.9, 0.1], [0.8, 0.2], [0.6, 0.4], [0.4, 0.6]])
    if not same(right_bone(predicted, target), 0.75):
        return "three of four rows with the same largest bone are 0.75"
    return None


@exercise("00.2")
def _keep_largest(keep_largest: Callable) -> str | None:
    """`keep_largest(weights, count)`: the largest of each row, with sum 1 again."""
    weights = np.array([[0.5, 0.125, 0.375], [0.2, 0.8, 0.0]])
    kept = keep_largest(weights.copy(), 2)
    if np.shape(kept) != weights.shape:
        return f"shape (2, 3) went in, shape {np.shape(kept)} came out"
    if kept[0][1] != 0:
        return "the weight that is not among the largest becomes 0"
    if not same(np.sum(kept, axis=1), [1, 1]):
        return "divide each row by the sum that is left"
    if not same(kept, [[4 / 7, 0, 3 / 7], [0.2, 0.8, 0]]):
        return "each weight stays in its column"
    if not same(keep_largest(weights, 1), [[1, 0, 0], [0, 1, 0]]):
        return "with one bone a vertex, that bone has all the weight"
    if weights[0, 1] != 0.125:
        return "the input has changed: work on a copy"
    return None


# ---- 01 head data


@exercise("01.1")
def _soft_weights(soft_weights: Callable) -> str | None:
    """`soft_weights(distances, power)`: rows in proportion to 1 / distance**power."""
    weights = np.asarray(soft_weights(np.array([[1.0, 2.0], [3.0, 3.0]]), 1))
    if weights.shape != (2, 2):
        return f"two vertices and two bones go in, shape {weights.shape} came out"
    if not same(weights.sum(axis=1), [1, 1]):
        return "each row sums to 1: divide by the row's own sum, axis=1"
    if not same(weights, [[2 / 3, 1 / 3], [0.5, 0.5]]):
        return "twice as far is half the weight, when power is 1"
    if not same(soft_weights(np.array([[1.0, 2.0]]), 2), [[0.8, 0.2]]):
        return "twice as far is a quarter of the weight, when power is 2"
    with np.errstate(all="ignore"):
        touching = soft_weights(np.array([[0.0, 2.0]]), 2)
    if not same(touching, [[1, 0]], 1e-3):
        return "a vertex on a bone (distance 0) follows that bone alone, without NaN"
    return None


@exercise("01.2")
def _merge_bone(merge_bone: Callable) -> str | None:
    """`merge_bone(weights, parents, bone)`: the bone's weight goes to its parent."""
    weights = np.array([[0.5, 0.25, 0.25], [0.0, 0.0, 1.0]])
    parents = np.array([-1, 0, 1])
    merged = np.asarray(merge_bone(weights, parents, 2))
    if not same(weights, [[0.5, 0.25, 0.25], [0, 0, 1]]):
        return "the input has changed: work on a copy"
    if merged.shape != weights.shape:
        return "the shape stays (V, J): the bone's column becomes 0"
    if not same(merged.sum(axis=1), [1, 1]):
        return "rows have to sum to 1 still: no weight may get lost"
    if not same(merged, [[0.5, 0.5, 0], [0, 1, 0]]):
        return "all of it goes to the bone's own parent, parents[bone]"
    return None


# ---- 02 hybrid graph


@exercise("02.1")
def _nearest(nearest: Callable) -> str | None:
    """`nearest(points, k)`: (N, k) ids of the k nearest others, nearest first."""
    line = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [7, 0, 0], [8, 0, 0]])
    found = np.asarray(nearest(line.copy(), 2))
    if found.shape != (5, 2):
        return f"5 points and k = 2 went in, shape {found.shape} came out"
    if (found == np.arange(5)[:, None]).any():
        return "no point is its own neighbour: make the diagonal infinite"
    if not same(np.sort(found, axis=1), [[1, 2], [0, 2], [0, 1], [2, 4], [2, 3]]):
        return "for the points 0, 1, 3, 7, 8 on a line the ids are not the nearest"
    if not same(found, [[1, 2], [0, 2], [1, 0], [4, 2], [3, 2]]):
        return "the nearest comes first"
    twins = np.array([[0.0, 0, 0], [0, 0, 0], [5, 0, 0]])
    if not same(nearest(twins, 1)[:2], [[1], [0]]):
        return "two points may lie at one place: each is then the other's nearest"
    points = np.random.default_rng(0).normal(size=(40, 3))
    _, wanted = cKDTree(points).query(points, k=6)
    if not same(nearest(points.copy(), 5), wanted[:, 1:]):
        return "in space it differs from cKDTree: use all three coordinates"
    return None


@exercise("02.2")
def _hops_on_table(hops: Callable) -> str | None:
    """`hops(neighbours, start)`: (N,) steps along the table; -1 out of reach."""
    # A way 0 - 1 - 2 - 3, and the pair 4 - 5 that it never meets.
    table = np.array([[1, 1], [0, 2], [1, 3], [2, 2], [5, 5], [4, 4]])
    steps = np.asarray(hops(table.copy(), 0))
    if steps.shape != (6,):
        return f"6 nodes went in, shape {steps.shape} came out"
    if steps[0] != 0:
        return "from the start to itself it is 0"
    if not same(steps[4:], [-1, -1]):
        return "what no edge leads to is -1"
    if not same(steps, [0, 1, 2, 3, -1, -1]):
        return "on the way 0 - 1 - 2 - 3 the steps from 0 are 0, 1, 2, 3"
    if not same(hops(table.copy(), 2), [2, 1, 0, 1, -1, -1]):
        return "the start may be any node"
    ring = (np.arange(9)[:, None] + [1, -1]) % 9
    if not same(hops(ring, 0), [0, 1, 2, 3, 4, 4, 3, 2, 1]):
        return "around a ring there are two ways: the shorter one counts"
    return None


# ---- 03 mesh encoder


@exercise("03.1")
def _mean_conv(mean_conv: Callable) -> str | None:
    """`mean_conv(x, neighbours, used)`: the mean over the used neighbours; else 0."""
    x = torch.tensor([[1.0, 0.0], [2.0, 4.0], [6.0, 8.0], [9.0, 9.0]])
    table = torch.tensor([[1, 2], [0, 0], [1, 0], [3, 3]])
    used = torch.tensor([[True, True], [True, False], [True, True], [False, False]])
    out = mean_conv(x.clone(), table, used)
    if tuple(out.shape) != (4, 2):
        return f"x of shape (4, 2) went in, shape {tuple(out.shape)} came out"
    if not same(out[[0, 2]], [[4, 6], [1.5, 2]]):
        return "node 0 hears nodes 1 and 2: their mean is (4, 6)"
    if not same(out[3], [0, 0]):
        return "a node without neighbours gets 0, not NaN and not its own value"
    far = torch.tensor([[1, 2], [0, 3], [1, 0], [3, 3]])
    if not same(mean_conv(x.clone(), far, used), out):
        return "what stands in an unused place must not matter"
    if not same(out, [[4, 6], [1, 0], [1.5, 2], [0, 0]]):
        return "divide by the number of used neighbours, not by K"
    return None


@exercise("03.2")
def _max_gradient(max_gradient: Callable) -> str | None:
    """`max_gradient(values, neighbours, upstream)`: what `gather_max` sends back."""
    values = torch.tensor([[1.0], [2.0], [5.0], [0.0]])
    table = torch.tensor([[1, 2, 1], [0, 2, 0], [0, 1, 3], [2, 2, 2]])
    out = max_gradient(values.clone(), table, torch.ones(4, 1))
    if tuple(out.shape) != (4, 1):
        return f"values of shape (4, 1) went in, shape {tuple(out.shape)} came out"
    if same(out[2], [1]):
        return "a node may win in several rows: add what it receives from each"
    if not same(out[[0, 3]], [[0], [0]]):
        return "who never wins receives nothing"
    if not same(out, [[0], [1], [3], [0]]):
        return "of four ones, vertex 2 receives three and vertex 1 receives one"
    rng = np.random.default_rng(0)
    values = torch.from_numpy(rng.permutation(60).astype(float).reshape(20, 3))
    table = torch.from_numpy(rng.integers(0, 20, (20, 4)))
    upstream = torch.from_numpy(rng.normal(size=(20, 3)))
    leaf = values.clone().requires_grad_()
    (wanted,) = torch.autograd.grad(leaf[table].amax(dim=1), leaf, upstream)
    # A node that stands in a row twice shares with itself there: the sum is the same.
    if not same(max_gradient(values, table, upstream), wanted):
        return "each channel has its own winner, and its own gradient"
    return None


# ---- 04 skeleton encoder


@exercise("04.1")
def _moved_bones(moved: Callable) -> str | None:
    """`moved(parents)`: how many bones move when each one turns, itself included."""
    cases = [
        ([-1], [1], "a single bone moves itself: 1"),
        ([-1, 0, 0], [3, 1, 1], "a root with two children moves three bones"),
        (
            [-1, 0, 1],
            [3, 2, 1],
            "grandchildren move too: count children before parents",
        ),
        ([1, 2, -1], [1, 2, 3], "a parent may have a larger id than its child"),
        ([-1, -1, 1], [1, 2, 1], "two trees do not move each other"),
    ]
    for parents, wanted, hint in cases:
        if not same(moved(np.array(parents)), wanted):
            return hint
    return None


@exercise("04.2")
def _mirrored_features(mirrored: Callable) -> str | None:
    """`mirrored(features)`: (J, 12) bone features of the skeleton's mirror image."""
    features = torch.arange(1.0, 25.0).reshape(2, 12)
    found = mirrored(features.clone())
    if tuple(found.shape) != (2, 12):
        return f"features of shape (2, 12) went in, shape {tuple(found.shape)} came out"
    sign = np.ones(12)
    sign[[0, 3, 7]] = -1
    if same(found, features * torch.tensor(sign)):
        return None
    if not same(found[:, 6], features[:, 6]):
        return "column 6 is the length: a mirror image is as long as the bone"
    if not same(found[:, [0, 3, 7]], -features[:, [0, 3, 7]]):
        return "joint, direction and offset are vectors, and each has an x"
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


# ---- 06 supervised loss


@exercise("06.1")
def _through_softmax(through: Callable) -> str | None:
    """`through_softmax(weights, slopes)`: from slopes at weights to those at scores."""
    weights = np.array([[0.75, 0.25], [0.5, 0.5]])
    slopes = np.array([[1.0, -1.0], [0.0, -2.0]])
    found = np.asarray(through(weights, slopes))
    if found.shape != (2, 2):
        return f"two rows of two bones go in, shape {found.shape} came out"
    if same(found, weights * slopes):
        return "subtract the row's mean slope, weighted by P, first"
    if not same(found.sum(axis=1), [0, 0]):
        return "each row sums to 0: the mean is the row's own, weighted by P"
    if not same(found, [[0.375, -0.375], [0.5, -0.5]]):
        return "for P = (3/4, 1/4) and g = (1, -1) the slopes are 3/8 and -3/8"
    rng = np.random.default_rng(0)
    scores = torch.from_numpy(rng.normal(size=(5, 4))).requires_grad_()
    slopes = rng.normal(size=(5, 4))
    soft = scores.softmax(dim=1)
    (wanted,) = torch.autograd.grad((soft * torch.from_numpy(slopes)).sum(), scores)
    if not same(through(soft.detach().numpy(), slopes), wanted):
        return "with more bones it differs from what torch computes"
    return None


@exercise("06.2")
def _kl(kl: Callable) -> str | None:
    """`kl(predicted, target)`: mean over vertices of KL(target || predicted)."""
    target = np.array([[0.5, 0.5], [0.25, 0.75]])
    if not same(kl(target, target), 0):
        return "it is 0 where both are the same: take off the target's entropy"
    guess = np.array([[0.25, 0.75], [0.25, 0.75]])
    found, wanted = kl(guess, target), np.log(4 / 3) / 4
    if same(found, 2 * wanted):
        return "divide by the number of vertices"
    if same(found, wanted / 2):
        return "sum over bones, mean over vertices only"
    if same(found, (0.25 * np.log(0.5) + 0.75 * np.log(1.5)) / 2):
        return "the target is the one in front of the logarithm"
    if not same(found, wanted):
        return "for (1/2, 1/2) told as (1/4, 3/4) a row costs log(4/3) / 2"
    with np.errstate(all="ignore"):
        sure = kl(np.array([[0.25, 0.75]]), np.array([[0.0, 1.0]]))
    if not same(sure, np.log(4 / 3)):
        return "a zero of the target costs nothing: 0 log 0 is 0, not NaN"
    return None


# ---- 07 physical losses


@exercise("07.1")
def _relaxed(relaxed: Callable) -> str | None:
    """`relaxed(weights, edges, cotangents, vertex)`: (J,) the row of least energy."""
    weights = np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0], [0.25, 0.75]])
    edges, cotangents = np.array([[0, 1], [1, 2]]), np.array([1.0, 3.0])
    row = np.asarray(relaxed(weights.copy(), edges, cotangents, 1))
    if row.shape != (2,):
        return f"one row of 2 bones is asked for, shape {row.shape} came out"
    if same(row, [1, 3]):
        return "divide by the sum of the cotangents, so that the row sums to 1"
    if same(row, [0.5, 0.5]):
        return "an edge of three times the cotangent counts three times"
    if not same(row, [0.25, 0.75]):
        return "between (1, 0) with cotangent 1 and (0, 1) with 3 it is (1/4, 3/4)"
    for end, wanted in ((0, [0.5, 0.5]), (2, [0.5, 0.5])):
        if not same(relaxed(weights.copy(), edges, cotangents, end), wanted):
            return "a vertex with one edge takes its neighbour's row, at either end"
    if not same(relaxed(weights.copy(), edges, cotangents, 3), weights[3]):
        return "a vertex without edges keeps its row"
    return None


@exercise("07.2")
def _cheapest_bone(cheapest_bone: Callable) -> str | None:
    """`cheapest_bone(distances, radii)`: (V,) ids, distances in units of the radii."""
    distances = np.array([[4.0, 1.0], [1.0, 3.0], [2.0, 2.0]])
    bones = np.asarray(cheapest_bone(distances.copy(), np.array([8.0, 1.0])))
    if bones.shape != (3,):
        return f"3 vertices went in, shape {bones.shape} came out"
    if same(bones, np.arange(3)[[1, 0, 0]]):
        return "divide each distance by the radius of its bone"
    if not same(bones, [0, 0, 0]):
        return "4 at a reach of 8 is cheaper than 1 at a reach of 1: bone 0"
    for unknown in (np.nan, 0.0):
        with np.errstate(all="ignore"):
            bones = cheapest_bone(distances.copy(), np.array([2.0, unknown]))
        if not same(np.asarray(bones)[:2], [1, 0]):
            return f"a bone of radius {unknown:g} costs 1: dearer than 1 / 2, not 4 / 2"
    return None


# ---- 08 consistency


@exercise("08.1")
def _carried(carried: Callable) -> str | None:
    """`carried(weights, heir)`: (V, J) weights after bones went into their heirs."""
    weights = np.array([[0.5, 0.25, 0.25, 0], [0, 0.25, 0.25, 0.5]])
    heir = np.array([0, 1, 0, 1])
    found = np.asarray(carried(weights.copy(), heir.copy()))
    if found.shape != (2, 2):
        return f"the twin has two bones, a table of shape {found.shape} came out"
    if not same(found.sum(axis=1), [1, 1]):
        return "each row still sums to 1: several bones may go into the same one"
    if not same(found, [[0.75, 0.25], [0.25, 0.75]]):
        return "column j of the original goes into column heir[j] of the twin"
    order = np.array([2, 1, 0, 3])
    if not same(carried(weights.copy(), order), weights[:, order]):
        return "where no bone is lost, the columns are only put in another order"
    return None


@exercise("08.2")
def _moving_average(moving_average: Callable) -> str | None:
    """`moving_average(values, decay)`: (S,), the s-th decay at most (s - 1) / s."""
    values = np.array([4.0, 0.0, 2.0, 6.0])
    found = np.asarray(moving_average(values.copy(), 0.999))
    if found.shape != (4,):
        return f"four values went in, shape {found.shape} came out"
    if not same(found[0], 4):
        return "at the first value the decay is 0: slow is the first value"
    if not same(found, [4, 2, 2, 3]):
        return "with a large decay it is the mean of all values so far"
    if not same(moving_average(values.copy(), 0.5), [4, 2, 2, 4]):
        return "from where (s - 1) / s is above it, `decay` itself counts"
    return None


# ---- 09 critics and WGAN-GP


@exercise("09.1")
def _linear_critic_loss(loss: Callable) -> str | None:
    """`loss(slope, real, fake, lambda_gp)`: of D(x) = slope x, with its penalty."""
    real, fake = np.array([1.0, 3.0]), np.array([-1.0, 0.0, 4.0])  # means 2 and 1
    found = loss(1.0, real, fake, 10.0)
    if np.shape(found) != ():
        return f"a loss is one number, shape {np.shape(found)} came out"
    if same(found, 1):
        return "the critic wants the fake low and the real high: turn the signs"
    if not same(found, -1):
        return "at slope 1 there is no penalty: mean fake score minus mean real score"
    if not same(loss(2.0, real, fake, 10.0), 8):
        return "at slope 2 the penalty is 10 (2 - 1)^2, beside a lead of 2"
    if not same(loss(-1.0, real, fake, 10.0), 1):
        return "a slope of -1 has length 1, too: its penalty is 0"
    return None


@exercise("09.2")
def _felt_slope(felt_slope: Callable) -> str | None:
    """`felt_slope(gradient)`: its norm per vertex, less what moves no row."""
    gradient = np.array([[1.0, -1.0, 0.0], [0.0, 2.0, -2.0]])
    found = felt_slope(gradient.copy())
    if np.shape(found) != ():
        return f"a norm is one number, shape {np.shape(found)} came out"
    if same(found, 10**0.5):
        return "each vertex has 1 / V of a mean: multiply by the root of V"
    if not same(found, 20**0.5):
        return "for two vertices with squares 2 and 8 it is the root of 2 x 10"
    if not same(felt_slope(np.ones((4, 3))), 0):
        return "the same for all bones moves no row that sums to 1: 0"
    if not same(felt_slope(gradient + np.array([[5.0], [-3.0]])), 20**0.5):
        return "take off each row's own mean, axis=1"
    if not same(felt_slope(np.tile(gradient / 2, (2, 1))), 20**0.5):
        return "twice the vertices with half the gradient each: the same slope"
    return None


# ---- 10 the loss lab


@exercise("10.1")
def _weights_for(weights_for: Callable) -> str | None:
    """`weights_for(norms, shares)`: (T,) weights, the first of them 1."""
    norms, shares = np.array([2.0, 8.0, 0.5]), np.array([0.5, 0.25, 0.25])
    found = np.asarray(weights_for(norms.copy(), shares.copy()))
    if found.shape != (3,):
        return f"three terms went in, shape {found.shape} came out"
    if not same(found[0], 1):
        return "divide by the first weight, so that it is 1"
    if not same(found, [1, 0.125, 2]):
        return "a term pulls with weight times norm: 1 x 2, w x 8 and w x 0.5"
    if not same(weights_for(np.array([1.0, 3.0]), np.array([1.0, 0.0])), [1, 0]):
        return "a term that is to have no share has weight 0"
    return None


@exercise("10.2")
def _recent_mean(recent_mean: Callable) -> str | None:
    """`recent_mean(values, count)`: mean of the known ones of the last `count`."""
    nan = float("nan")
    values = np.array([8.0, nan, 2.0, nan, 4.0])
    if not same(recent_mean(values.copy(), 1), 4):
        return "of the last value alone it is that value"
    if not same(recent_mean(values.copy(), 3), 3):
        return "of 2, nothing, 4 it is 3: what is not known does not count"
    if not same(recent_mean(values.copy(), 99), 14 / 3):
        return "where there are fewer values than `count`, take them all"
    with np.errstate(all="ignore"):
        empty = recent_mean(np.array([1.0, nan]), 1)
    if empty is None or not np.isnan(empty):
        return "where nothing is known it is NaN"
    return None


# ---- 11 semi-supervised training


@exercise("11.1")
def _kinds(kinds: Callable) -> str | None:
    """`kinds(edges, count)`: (count,) integers, the same where one round is."""
    path = np.array([[0, 1], [1, 2], [2, 3], [3, 4]])
    hub = np.array([[5, 6], [6, 7], [7, 8], [7, 9]])
    found = np.asarray(kinds(np.concatenate([path, hub]), 11))
    if found.shape != (11,):
        return f"there are 11 vertices, shape {found.shape} came out"
    if found[0] != found[4] or found[1] != found[3]:
        return "a path read backwards has the same kinds: order does not matter"
    if found[0] == found[1]:
        return "an end has 1 neighbour, the next vertex 2"
    if found[1] == found[2]:
        return "ask the neighbours: one has (1, 2), the other (2, 2)"
    if found[0] == found[8]:
        return "of two ends, one hangs on a vertex of 2 neighbours, one on one of 3"
    if found[2] == found[6]:
        return "2 + 2 and 1 + 3 are the same sum: keep the numbers, sorted"
    if found[10] in found[:10]:
        return "a vertex without an edge is of its own kind"
    return None


@exercise("11.2")
def _fed(fed: Callable) -> str | None:
    """`fed(painted, known, weights)`: names of the generator's terms of a draw."""
    names = "supervised", "adversarial_s", "adversarial_u", "consistency", "physical"
    weights = dict.fromkeys(names, 0.1)
    painted, half = set(fed(True, 0, weights)), set(fed(False, 350, weights))
    if "adversarial_u" in painted:
        return "a painted head shows D_u what is real: that is the critic's term"
    if "adversarial_s" in half:
        return "D_s compares with an artist's rows, all of them: not on a bare head"
    if "supervised" not in half:
        return "known rows of a bare head are labels, too"
    if "supervised" in set(fed(False, 0, weights)):
        return "of a bare head without known vertices nothing is supervised"
    shared = {"supervised", "consistency", "physical"}
    if painted != shared | {"adversarial_s"} or half != shared | {"adversarial_u"}:
        return "twins and physics speak about every head, each critic about one kind"
    if set(fed(True, 0, weights | {"physical": 0.0})) != painted - {"physical"}:
        return "a term of weight 0 is left out"
    return None


# ---- 12 HeadBench


@exercise("12.1")
def _own_method(skin: Callable) -> str | None:
    """`skin(head)`: (V, J) weights of a head that has none, better than one line."""
    for seed in (3, 8):
        head = synthetic_head(seed, vertices=600, bones=12)
        found = _skinned(skin, head)
        if found.shape != head.weights.shape:
            return f"of {head.weights.shape} weights, shape {found.shape} came out"
        if not np.isfinite(found).all() or found.min() < 0:
            return "weights are numbers of 0 or more"
        if not np.allclose(found.sum(axis=1), 1, atol=1e-4):
            return "each row sums to 1"
        lazy = np.eye(len(head.skeleton))[head_bone(head.skeleton)]
        if row_l1(found, head.weights).mean() >= row_l1(lazy, head.weights).mean():
            return 'not better than "all to the head bone": what do artists give it?'
        turned = _skinned(skin, vary("rotated", head, seed=0))
        if row_l1(turned, found).mean() > 0.01:
            return "in another unit, or with other axes, the rows are the same"
        listed = vary("reordered", head, seed=0)
        order = [head.skeleton.names.index(name) for name in listed.skeleton.names]
        if row_l1(_skinned(skin, listed), found[:, order]).mean() > 0.01:
            return "listed in another order, each bone keeps its column's weights"
    return None


def _skinned(skin: Callable, head: Head) -> np.ndarray:
    return np.asarray(skin(head.replace(weights=None)), np.float64)


@exercise("12.2")
def _paired(paired: Callable) -> str | None:
    """`paired(untouched, varied)`: ratio of the means over common heads."""
    untouched = {"a": 0.1, "b": 0.3, "c": 0.9}
    found = paired(dict(untouched), {"a": 0.2, "b": 0.3})
    if np.shape(found) != ():
        return f"a ratio is one number, shape {np.shape(found)} came out"
    if same(found, 0.25 / (1.3 / 3)):
        return "c is not in the suite: leave it out of the untouched mean as well"
    if same(found, 1.5):
        return "divide the means, not each head's errors: a small one would decide"
    if not same(found, 1.25):
        return "0.2 and 0.3 against 0.1 and 0.3 is 1.25"
    if not same(paired({"a": 0.1}, {"a": 0.2, "b": 9.0}), 2):
        return "a head that was never judged untouched counts on neither side"
    with np.errstate(all="ignore"):
        empty = paired({"a": 0.1}, {"b": 0.2})
    if empty is None or not np.isnan(empty):
        return "without a common head it is NaN"
    return None


# ---- 13 your own heads


@exercise("13.1")
def _rounds(rounds: Callable) -> str | None:
    """`rounds(groups)`: (learning ids, judging ids) for each group in turn."""
    found = [tuple(map(list, pair)) for pair in rounds([2, 0, 2, 1])]
    if len(found) != 3:
        return f"there are three base meshes, {len(found)} rounds came out"
    learning, judging = found[-1]
    if set(learning) & set(judging):
        return "no head learns and judges in the same round"
    if sorted(judging) == [0] or sorted(judging) == [2]:
        return "sisters judge together: one of them must not learn"
    if sorted(learning + judging) != [0, 1, 2, 3]:
        return "in every round each head either learns or judges"
    if found != [([0, 2, 3], [1]), ([0, 1, 2], [3]), ([1, 3], [0, 2])]:
        return "group 0 judges first; in a pair come the ids that learn, then the rest"
    if [tuple(map(list, pair)) for pair in rounds([5, 5])] != [([], [0, 1])]:
        return "of one base mesh there is one round, and nobody learns in it"
    return None


@exercise("13.2")
def _heads_needed(heads_needed: Callable) -> str | None:
    """`heads_needed(counts, errors, target)`: int, from a fitted power law."""
    counts = np.array([1, 4, 9, 16])
    found = heads_needed(counts.copy(), 0.4 * counts**-0.5, 0.11)  # at n = 13.2
    if np.shape(found) != () or found != int(found):
        return "heads are counted: one whole number"
    if found == 13:
        return "13 heads are just not enough: round up"
    if found != 14:
        return "0.4 / sqrt(n) falls below 0.11 at n = 13.2: 14 heads"
    errors = np.exp([1.0, 0.0, -0.5])  # at log n = 0, 1, 2: log e = 0.917 - 0.75 log n
    if heads_needed(np.exp([0.0, 1.0, 2.0]), errors, np.exp(-0.5)) != 7:
        return "the line of least squares passes by points that lie on no line"
    if heads_needed(counts.copy(), 0.4 * counts**-0.5, 3.0) != 1:
        return "nobody learns from less than one head"
    return None


# ---- 14 into production


@exercise("14.1")
def _first_set(first_set: Callable) -> str | None:
    """`first_set(row, count)`: ids and weights as a file stores them."""
    row = np.array([0.125, 0.5, 0.0, 0.25, 0.125])
    bones, weights = first_set(row.copy(), 2)
    if np.shape(bones) != (2,) or np.shape(weights) != (2,):
        return f"two slots, shapes {np.shape(bones)} and {np.shape(weights)} came out"
    if same(bones, [3, 1]):
        return "the largest comes first"
    if not same(bones, [1, 3]):
        return "of 1/8, 1/2, 0, 1/4, 1/8 the largest two are bones 1 and 3"
    if not same(weights, [2 / 3, 1 / 3]):
        return "1/2 and 1/4, scaled to sum 1, are 2/3 and 1/3"
    bones, weights = first_set(row.copy(), 3)
    if not same(bones, [1, 3, 0]):
        return "of two equal weights the lower id stays"
    bones, weights = first_set(np.array([0.0, 0.0, 1.0]), 2)
    if not same(weights, [1, 0]):
        return "a slot that is not needed has weight 0"
    if not same(bones, [2, 0]):
        return "a slot without weight names bone 0"
    bones, weights = first_set(np.array([0.0, 1.0]), 4)
    if not same(bones, [1, 0, 0, 0]) or not same(weights, [1, 0, 0, 0]):
        return "four slots, even where the head has fewer bones"
    return None


@exercise("14.2")
def _to_paint(to_paint: Callable) -> str | None:
    """`to_paint(confidence, locked, partner, count)`: ids, least confident first."""
    sure = np.array([0.9, 0.2, 0.5, 0.3, 0.1, 0.2])
    free, alone = np.zeros(6, bool), np.full(6, -1)

    def listed(locked, partner, count):
        found = to_paint(sure.copy(), locked.copy(), partner.copy(), count)
        return [int(vertex) for vertex in found]

    if listed(free, alone, 3) in ([0, 2, 3], [4, 5, 1]):
        return "the least confident first; of equal ones the lower id"
    if listed(free, alone, 3) != [4, 1, 5]:
        return "of confidences .9 .2 .5 .3 .1 .2 the three to paint are 4, 1, 5"
    last = np.arange(6) == 5
    if 5 in listed(last, alone, 6):
        return "what is locked is done"
    if listed(last, alone, 6) != [4, 1, 3, 2, 0]:
        return "-1 is nobody: the last vertex, locked, is not everybody's partner"
    pairs = np.array([1, 0, 2, 4, 3, -1])
    if 0 in listed(np.arange(6) == 1, pairs, 6):
        return "a vertex with a locked partner follows it"
    if 3 in listed(free, pairs, 6):
        return "of two partners, the less confident one is enough"
    if listed(free, pairs, 3) != [4, 1, 5]:
        return "partners use up no place: `count` ids, as long as there are some"
    if listed(free, pairs, 6) != [4, 1, 5, 2]:
        return "a vertex in the middle is its own partner, and has to be painted"
    return None


# ---- 15 PBNS


@exercise("15.1")
def _push(push: Callable) -> str | None:
    """`push(vertices, points, normals, epsilon, weight)`: (V, 3) newtons."""
    normals = np.array([[0.0, 0, 1], [0, 0, 1], [0.6, 0, 0.8]])
    points = np.array([[1.0, 2, 3], [0, 0, 0], [0, 0, 0]])
    moved = np.array([[0, 0, -0.002], [0, 0, 0.005], [0.01, 0, -0.01]])
    vertices = points + moved

    def of(vertices, points, normals):
        given = vertices.copy(), points.copy(), normals.copy()
        return np.asarray(push(*given, 0.004, 25.0))

    found = of(vertices, points, normals)
    if found.shape != (3, 3):
        return f"a force of 3 numbers for each of 3 vertices, not {found.shape}"
    if found[1].any():
        return "5 mm outside is further than epsilon: no force there"
    if same(found[0], [0, 0, -0.3]):
        return "the force is minus the gradient: it pushes out"
    if same(found[0], [0, 0, 0.15]):
        return "the derivative of a square has a 2 in front"
    if same(found[0], [0, 0, 0.1]):
        return "2 mm deep is 6 mm short of epsilon"
    if not same(found[0], [0, 0, 0.3]):
        return "6 mm short, 25 N/m: 2 * 25 * 0.006 = 0.3 N along the normal"
    # (0.01, 0, -0.01) . (0.6, 0, 0.8) is -2 mm, as for the first vertex.
    if not same(found[2], [0.18, 0, 0.24]):
        return "depth is measured along the normal, and the push goes along it"
    return None


@exercise("15.2")
def _for_engine(for_engine: Callable) -> str | None:
    """`for_engine(amounts, targets)`: amounts within 0..1, and their targets."""
    amounts = np.array([[0.0, 0, 3], [4, 0, 1.5], [2, 0, 0]])
    targets = np.arange(18.0).reshape(3, 2, 3) - 4
    smaller, larger = map(np.asarray, for_engine(amounts.copy(), targets.copy()))
    if len(larger) == 3 or smaller.shape == (3, 3):
        return "the middle target is never used: leave it out"
    if smaller.shape != (3, 2) or larger.shape != (2, 2, 3):
        shapes = f"{smaller.shape} of {larger.shape}"
        return f"(3, 2) amounts of (2, 2, 3) targets, not {shapes}"
    if smaller.max() > 1 + 1e-6:
        return "an amount above 1 is clamped"
    moved = [np.tensordot(a, t, 1) for a, t in ((smaller, larger), (amounts, targets))]
    if not same(*moved):
        return "the cloth moves otherwise: what the amounts lose, the targets gain"
    if not same(smaller.max(axis=0), [1, 1]):
        return "each target is scaled by its own largest amount, which becomes 1"
    return None


# ---- 16 virtual bones


@exercise("16.1")
def _heat(heat: Callable) -> str | None:
    """`heat(distances, alpha, influences)`: (V, N) weights."""
    distances = np.array([[0.0, 1, 2], [2, 1, 0], [500, 400, 300]])
    found = np.asarray(heat(distances.copy(), 1.0, 3))
    if found.shape != (3, 3):
        return f"a weight for each of 3 vertices and 3 bones, not {found.shape}"
    if same(found[0], np.exp([0, -1, -2]) / np.exp([0, -1, -2]).sum()):
        return "the distance is squared"
    if same(found[0], np.exp([0, -1, -4])):
        return "the heat of a vertex is divided by its sum"
    if not same(found[:2].sum(axis=1), [1, 1]):
        return "rows sum to 1"
    weights = np.exp([0, -1, -4]) / np.exp([0, -1, -4]).sum()
    if not same(found[0], weights) or not same(found[1], weights[::-1]):
        return "0, 1 and 2 m away, alpha 1 m: heat is 1, exp(-1) and exp(-4)"
    if not np.isfinite(found[2]).all() or not same(found[2], [0, 0, 1]):
        return "a vertex 300 m from the nearest bone belongs to that bone"
    half = np.array(heat(0.5 * distances, 0.5, 3))
    if not same(half[:2], found[:2]):
        return "half the distances with half of alpha: the same weights"
    few = np.asarray(heat(distances.copy(), 1.0, 2))
    if (few[:2] > 0).sum(axis=1).max() > 2:
        return "with two influences a row has at most two weights above 0"
    if same(few[0], [*weights[:2], 0]):
        return "first leave out all but the nearest, then divide by the sum"
    if not same(few[:2].sum(axis=1), [1, 1]) or not same(few[1, 0], 0):
        return "the bones that are left are the nearest, and their weights sum to 1"
    return None


@exercise("16.2")
def _best_guess(best_guess: Callable) -> str | None:
    """`best_guess(posed, period)`: (period, V, 3) and metres."""
    posed = np.zeros((4, 2, 3))
    posed[:, 0, 0] = 1, 5, 3, 5  # the cycles differ in the first frame, by 2 m
    guess, off = best_guess(posed.copy(), 2)
    guess, off = np.asarray(guess), float(off)
    if guess.shape != (2, 2, 3):
        return f"two frames of two vertices, not {guess.shape}"
    if same(guess[:, 0, 0], [3, 4]):
        return "frames of one cycle follow each other: 0, 1, and again 0, 1"
    if not same(guess[:, 0, 0], [2, 5]) or guess[:, 1].any() or guess[..., 1:].any():
        return "after 1, 5, 3, 5 the best guess of two frames is 2, 5"
    # In two of four frames one of two vertices is off by 1 m.
    if same(off, 0.25):
        return "the root of the mean square, not the mean square"
    if same(off, (1 / 12) ** 0.5):
        return "a distance has three coordinates: sum over them, and mean over the rest"
    if same(off, 2 * 0.5**0.5):
        return "how far cycles are from the guess, not from each other"
    if not same(off, 0.5):
        return "2 of 8 places are 1 m off: the root of 2 / 8"
    return None


# ---- 17 pose transfer


@exercise("17.1")
def _side(side: Callable) -> str | None:
    """`side(weight, bias, code, points)`: (N, C), the code never repeated."""
    weight = np.array([[1.0, 0, 10, 0, 0], [0, 2, 0, 0, 1]])
    bias, code = np.array([100.0, 200]), np.array([3.0, 4])
    points = np.array([[1.0, 2, 3], [0, 0, 5], [7, 0, 0]])
    found = np.asarray(side(weight, bias, code, points))
    if found.shape != (3, 2):
        return f"2 channels for each of 3 vertices, not {found.shape}"
    right = np.array([[113, 211], [103, 213], [173, 208]])
    if same(found, right - bias):
        return "the bias is missing"
    if same(found, right - [3, 8]):
        return "the code is missing: its columns of the weights come first"
    if not same(found, right):
        return "by hand, the first vertex: 3 + 10 * 1 + 100 and 2 * 4 + 3 + 200"
    rng = np.random.default_rng(0)
    weight, code, points = (rng.normal(size=n) for n in ((2, 203), 200, (20_000, 3)))
    tracemalloc.start()
    try:
        found = side(weight, bias, code, points)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    if peak > 8e6:  # repeated: 20,000 x 203 numbers, 32 MB
        return f"{peak / 1e6:.0f} MB for a result of 0.3 MB: multiply the code once"
    return None


@exercise("17.2")
def _full_size(full_size: Callable) -> str | None:
    """`full_size(posed, target, edges)`: (N, 3) in the target's unit, on its floor."""
    posed = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 2]])
    target = np.array([[0.0, 0, 7], [0, 4, 7], [0, 9, 7]])
    edges = np.array([[0, 1], [1, 2]])
    found = np.asarray(full_size(posed.copy(), target.copy(), edges))
    if found.shape != (3, 3):
        return f"three vertices, not {found.shape}"
    scale = found[1, 0] - found[0, 0]
    for wrong, hint in {
        3.25: "that is the mean of the ratios; long edges are to count for more",
        3.0: "that is the ratio of the sums; make the sum of squares smallest",
        4.5: "that is the ratio of the boxes, which a pose changes",
    }.items():
        if same(scale, wrong):
            return f"scaled by {wrong:g}: {hint}"
    if not same(scale, 2.8):
        return "lengths 1 and 2 for 4 and 5: the best scale is (1 * 4 + 2 * 5) / 5"
    if same(found[:, 2].min(), 0):
        return "the target stands on z = 7"
    if not same(found, 2.8 * posed + [0, 0, 7]):
        return "scaled by 2.8, and then only lifted, to stand on z = 7"
    deep = np.asarray(full_size(posed - [0, 0, 5], target, edges))
    if not same(deep, 2.8 * (posed - [0, 0, 5]) + [0, 0, 21]):
        return "the lowest vertex, wherever it was, comes to stand on the floor"
    return None
