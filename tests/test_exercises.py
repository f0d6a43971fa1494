"""Exercises say right, not yet with a hint, or not solved yet, and never raise."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from skinlib.evaluate.baselines import bone_heat
from skinlib.exercises import CHECKS, check_exercise, exercise, same
from skinlib.geometry import point_segment_distance
from skinlib.skinning import head_bone


def said(capsys, name, answer) -> str:
    check_exercise(name, answer)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1
    number, verdict = lines[0].split(": ", 1)
    assert number == name
    return verdict


def tree_nearest(points, k):
    return cKDTree(points).query(points, k=k + 1)[1][:, 1:]


def nearest(points, k):
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    np.fill_diagonal(apart, np.inf)
    return np.argsort(apart, axis=1)[:, :k]


def table_hops(neighbours, start, unreached=-1):
    steps = np.full(len(neighbours), unreached)
    wave, step = np.array([start]), 0
    while len(wave):
        steps[wave], step = step, step + 1
        wave = np.unique(neighbours[wave])
        wave = wave[steps[wave] == unreached]
    return steps


def mean_conv(x, neighbours, used):
    heard = (x[neighbours] * used[..., None]).sum(dim=1)
    return heard / used.sum(dim=1, keepdim=True).clamp(min=1)


def max_gradient(values, neighbours, upstream):
    source = neighbours.gather(1, values[neighbours].argmax(dim=1))
    return torch.zeros_like(values).scatter_add(0, source, upstream)


def moved(parents):
    count = np.ones(len(parents), int)
    for bone in range(len(parents)):
        while parents[bone] >= 0:
            bone = parents[bone]
            count[bone] += 1
    return count


def flip(features, columns):
    features[:, columns] *= -1
    return features


def softmax(logits):
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True)


def right_bone(predicted, target):
    return np.mean(predicted.argmax(axis=1) == target.argmax(axis=1))


def keep_largest(weights, count):
    kept = np.where(weights >= np.sort(weights, axis=1)[:, [-count]], weights, 0)
    return kept / kept.sum(axis=1, keepdims=True)


def soft_weights(distances, power):
    closeness = np.maximum(distances, 1e-9) ** -power
    return closeness / closeness.sum(axis=1, keepdims=True)


def merge_bone(weights, parents, bone):
    merged = weights.copy()
    merged[:, parents[bone]] += merged[:, bone]
    merged[:, bone] = 0
    return merged


def merged_in_place(weights, parents, bone):
    weights[:] = merge_bone(weights, parents, bone)
    return weights


def relaxed(weights, edges, cotangents, vertex):
    touching = (edges == vertex).any(axis=1)
    if not touching.any():
        return weights[vertex]
    others = edges[touching].sum(axis=1) - vertex
    return np.average(weights[others], axis=0, weights=cotangents[touching])


def cheapest_bone(distances, radii):
    known = radii > 0
    cost = np.where(known, (distances / np.where(known, radii, 1)) ** 2, 1)
    return cost.argmin(axis=1)


def carried(weights, heir):
    return weights @ np.eye(max(heir) + 1)[heir]


def moving_average(values, decay, start=0.0, growing=True):
    slow, line = start, []
    for s, value in enumerate(values, 1):
        d = min(decay, (s - 1) / s) if growing else decay
        slow = d * slow + (1 - d) * value
        line.append(slow)
    return np.array(line)


def weights_for(norms, shares):
    weights = shares / norms
    return weights / weights[0]


def recent_mean(values, count):
    known = values[-count:]
    known = known[~np.isnan(known)]
    return known.mean() if len(known) else np.nan


def through_softmax(weights, slopes):
    return weights * (slopes - (weights * slopes).sum(axis=1, keepdims=True))


def kl(predicted, target):
    ratio = np.where(target > 0, target, 1) / np.where(target > 0, predicted, 1)
    return (target * np.log(ratio)).sum(axis=1).mean()


def linear_critic_loss(slope, real, fake, lambda_gp):
    lead = slope * (np.mean(real) - np.mean(fake))
    return lambda_gp * (abs(slope) - 1) ** 2 - lead


def felt_slope(gradient):
    felt = gradient - gradient.mean(axis=1, keepdims=True)
    return np.sqrt(len(felt) * np.square(felt).sum())


def kinds(edges, count, told=sorted):
    heard = [[] for _ in range(count)]
    for a, b in edges:
        heard[a].append(b)
        heard[b].append(a)
    seen = [str((len(of), told([len(heard[v]) for v in of]))) for of in heard]
    return np.unique(seen, return_inverse=True)[1]


def fed(painted, known, weights):
    terms = {"consistency", "physical"}
    terms.add("adversarial_s" if painted else "adversarial_u")
    if painted or known:
        terms.add("supervised")
    return {name for name in terms if weights[name]}


def first_set(row, count=4):
    bones, weights = np.zeros(count, int), np.zeros(count)
    largest = np.argsort(-row, kind="stable")[:count]
    largest = largest[row[largest] > 0]
    bones[: len(largest)] = largest
    weights[: len(largest)] = row[largest] / row[largest].sum()
    return bones, weights


def to_paint(confidence, locked, partner, count, nobody=True):
    chosen = []
    for vertex in np.argsort(confidence, kind="stable").tolist():
        other = int(partner[vertex])
        follows = locked[other] and (other >= 0 or not nobody)
        if not locked[vertex] and not follows and other not in chosen:
            chosen.append(vertex)
    return chosen[:count]


def near_habit(head):
    bones = head.skeleton
    middle = head.vertices - head.vertices.mean(axis=0)
    size = np.linalg.norm(middle, axis=1).max()
    distance = point_segment_distance(head.vertices, bones.joints, bones.tails)
    weights = np.exp(-((distance / size / 0.06) ** 2))
    weights[:, head_bone(bones)] = 0.3
    return weights / weights.sum(axis=1, keepdims=True)


def leaning(head, rows, bone, share):
    """Those rows give a share to one bone."""
    weights = near_habit(head)
    weights[rows] *= 1 - share
    weights[rows, bone] += share
    return weights


def aside(head):
    return leaning(head, head.vertices[:, 0] > 0, head_bone(head.skeleton), 0.2)


def paired(untouched, varied):
    both = untouched.keys() & varied.keys()
    if not both:
        return float("nan")
    return sum(varied[name] for name in both) / sum(untouched[name] for name in both)


def rounds(groups):
    ids = range(len(groups))
    return [
        ([i for i in ids if groups[i] != group], [i for i in ids if groups[i] == group])
        for group in sorted(set(groups))
    ]


def heads_needed(counts, errors, target):
    slope, start = np.polyfit(np.log(counts), np.log(errors), 1)
    return max(1, int(np.ceil(np.exp((np.log(target) - start) / slope))))


def push(vertices, points, normals, epsilon, weight, factor=-2):
    gap = ((vertices - points) * normals).sum(axis=1, keepdims=True) - epsilon
    return factor * weight * np.minimum(gap, 0) * normals


def for_engine(amounts, targets):
    largest = amounts.max(axis=0)
    used = largest > 0
    largest = largest[used]
    return amounts[:, used] / largest, targets[used] * largest[:, None, None]


def heat(distances, alpha, influences, power=2, last=False, guard=True):
    exponents = (distances / alpha) ** power
    least = exponents.min(axis=1, keepdims=True) if guard else 0
    hot = np.exp(least - exponents)
    total = hot.sum(axis=1, keepdims=True)
    far = np.argsort(distances, axis=1, kind="stable")[:, influences:]
    np.put_along_axis(hot, far, 0, axis=1)
    with np.errstate(invalid="ignore"):
        return hot / (total if last else hot.sum(axis=1, keepdims=True))


def best_guess(posed, period, factor=1.0):
    cycles = posed.reshape(-1, period, *posed.shape[1:])
    guess = cycles.mean(axis=0)
    return guess, factor * np.sqrt(np.square(cycles - guess).sum(axis=-1).mean())


def side(weight, bias, code, points):
    length = len(code)
    return points @ weight[:, length:].T + (weight[:, :length] @ code + bias)


def repeated_side(weight, bias, code, points):
    mixed = np.concatenate([np.tile(code, (len(points), 1)), points], axis=1)
    return mixed @ weight.T + bias


def full_size(posed, target, edges, scale=None, floor=True):
    now, wanted = (
        np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1) for p in (posed, target)
    )
    larger = posed * (scale or (now * wanted).sum() / (now**2).sum())
    if floor:
        larger[:, 2] += target[:, 2].min() - larger[:, 2].min()
    return larger


SOLUTIONS = {
    "00.1": right_bone,
    "00.2": keep_largest,
    "01.1": soft_weights,
    "01.2": merge_bone,
    "02.1": nearest,
    "02.2": table_hops,
    "03.1": mean_conv,
    "03.2": max_gradient,
    "04.1": moved,
    "04.2": lambda features: flip(features, [0, 3, 7]),
    "05.1": softmax,
    "05.2": lambda logits, allowed: softmax(np.where(allowed, logits, -np.inf)),
    "06.1": through_softmax,
    "06.2": kl,
    "07.1": relaxed,
    "07.2": cheapest_bone,
    "08.1": carried,
    "08.2": moving_average,
    "09.1": linear_critic_loss,
    "09.2": felt_slope,
    "10.1": weights_for,
    "10.2": recent_mean,
    "11.1": kinds,
    "11.2": fed,
    "12.1": near_habit,
    "12.2": paired,
    "13.1": rounds,
    "13.2": heads_needed,
    "14.1": first_set,
    "14.2": to_paint,
    "15.1": push,
    "15.2": for_engine,
    "16.1": heat,
    "16.2": best_guess,
    "17.1": side,
    "17.2": full_size,
}
WRONG = [
    ("00.1", lambda p, t: len(t) * right_bone(p, t), "divide"),
    ("00.1", lambda p, t: 0.0, "the share is 1"),
    ("00.1", lambda p, t: np.mean(p == t), "0.75"),
    ("00.2", lambda weights, count: weights, "becomes 0"),
    ("00.2", lambda weights, count: weights[:, :count], "shape (2, 2)"),
    ("00.2", lambda weights, count: keep_largest(weights, 2) * 0.5, "that is left"),
    ("01.1", lambda distances, power: distances[0], "shape (2,)"),
    ("01.1", lambda distances, power: 1 / distances, "sums to 1"),
    ("01.1", lambda distances, power: np.full((2, 2), 0.5), "half the weight"),
    ("01.1", lambda distances, power: soft_weights(distances, 1), "a quarter"),
    ("01.1", lambda d, p: d**-p / (d**-p).sum(axis=1, keepdims=True), "distance 0"),
    ("01.2", merged_in_place, "has changed"),
    ("01.2", lambda weights, *bone: weights[:, :2], "stays (V, J)"),
    ("01.2", lambda weights, *bone: weights * [1, 1, 0], "get lost"),
    ("01.2", lambda weights, *bone: weights @ np.eye(3)[[0, 1, 0]], "own parent"),
    ("02.1", lambda points, k: cKDTree(points).query(points, k=k)[1], "own neighbour"),
    ("02.1", lambda points, k: nearest(points, k + 1), "shape (5, 3)"),
    ("02.1", lambda points, k: nearest(points, k)[:, ::-1], "comes first"),
    ("02.1", tree_nearest, "at one place"),
    ("02.1", lambda points, k: nearest(points[:, :1], k), "all three"),
    ("02.2", lambda table, start: table_hops(table, 0), "any node"),
    ("02.2", lambda table, start: table_hops(table, start, -2), "is -1"),
    ("02.2", lambda table, start: table_hops(table, start) + 1, "it is 0"),
    ("03.1", lambda x, table, used: x[table].mean(dim=1), "gets 0"),
    (
        "03.1",
        lambda x, table, used: (x[table] * used[..., None]).mean(dim=1),
        "not by K",
    ),
    (
        "03.1",
        lambda x, table, used: x[table].mean(dim=1) * used.any(1, keepdim=True),
        "must not matter",
    ),
    ("03.2", lambda values, table, upstream: upstream, "several rows"),
    (
        "03.2",
        lambda *given: max_gradient(*given) * 0 + max_gradient(*given)[:, :1],
        "own winner",
    ),
    ("04.1", lambda parents: 1, "single bone"),
    ("04.1", lambda parents: np.ones(len(parents)), "moves three"),
    (
        "04.1",
        lambda parents: [1 + sum(parents == b) for b in range(len(parents))],
        "grandchildren",
    ),
    ("04.2", lambda features: flip(features, [0, 3, 6, 7]), "as long as"),
    ("04.2", lambda features: flip(features, [0]), "each has an x"),
    ("04.2", lambda features: flip(features, [0, 3, 7, 10]), "two flags"),
    ("04.2", lambda features: features[0], "shape (12,)"),
    ("05.1", lambda logits: logits, "never negative"),
    ("05.1", lambda logits: np.exp(logits), "sums to 1"),
    ("05.1", lambda logits: np.ones_like(logits) / 2, "1/4 and 3/4"),
    ("05.1", lambda logits: softmax(logits)[0], "shape (2,)"),
    (
        "05.1",
        lambda logits: np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True),
        "exp(1000)",
    ),
    ("05.2", lambda logits, allowed: softmax(logits), "exactly 0"),
    ("05.2", lambda logits, allowed: softmax(logits) * allowed, "before the softmax"),
    ("05.2", lambda logits: logits, "TypeError"),
    ("06.1", lambda weights, slopes: slopes[0], "shape (2,)"),
    ("06.1", lambda weights, slopes: weights * slopes, "mean slope"),
    ("06.1", lambda weights, slopes: weights * (slopes - slopes.mean()), "sums to 0"),
    (
        "06.1",
        lambda weights, slopes: slopes - slopes.mean(axis=1, keepdims=True),
        "3/8",
    ),
    (
        "06.1",
        lambda weights, slopes: through_softmax(weights, slopes.clip(-2, 1)),
        "what torch computes",
    ),
    ("06.2", lambda p, y: -(y * np.log(p)).sum(axis=1).mean(), "entropy"),
    ("06.2", lambda p, y: len(y) * kl(p, y), "number of vertices"),
    ("06.2", lambda p, y: kl(p, y) / 2, "mean over vertices only"),
    ("06.2", lambda p, y: kl(y, p), "in front of the logarithm"),
    ("06.2", lambda p, y: np.abs(p - y).sum(axis=1).mean(), "log(4/3) / 2"),
    ("06.2", lambda p, y: (y * np.log(y / p)).sum(axis=1).mean(), "0 log 0"),
    ("07.1", lambda weights, *given: weights, "shape (4, 2)"),
    ("07.1", lambda weights, edges, cot, v: cot @ weights[[0, 2]], "divide by"),
    ("07.1", lambda weights, edges, cot, v: weights[[0, 2]].mean(0), "three times"),
    ("07.1", lambda weights, edges, cot, v: weights[v - 1], "(1/4, 3/4)"),
    ("07.1", lambda w, edges, cot, v: relaxed(w, edges, cot, 1), "either end"),
    (
        "07.1",
        lambda w, edges, cot, v: relaxed(w, edges, cot, v) * (v < 3),
        "without edges",
    ),
    ("07.2", lambda distances, radii: distances / radii, "shape (3, 2)"),
    ("07.2", lambda distances, radii: distances.argmin(axis=1), "divide each"),
    ("07.2", lambda distances, radii: distances.argmax(axis=1), "cheaper than 1"),
    (
        "07.2",
        lambda d, radii: cheapest_bone(d, np.where(radii > 0, radii, 1e-9)),
        "costs 1",
    ),
    ("08.1", lambda weights, heir: weights, "shape (2, 4)"),
    ("08.1", lambda weights, heir: weights[:, : max(heir) + 1], "still sums to 1"),
    ("08.1", lambda weights, heir: carried(weights, heir)[:, ::-1], "heir[j]"),
    (
        "08.1",
        lambda weights, heir: weights if len(set(heir)) > 2 else carried(weights, heir),
        "another order",
    ),
    ("08.2", lambda values, decay: moving_average(values, decay)[-1], "shape ()"),
    (
        "08.2",
        lambda values, decay: moving_average(values, decay, growing=False),
        "first value",
    ),
    (
        "08.2",
        lambda values, decay: moving_average(values, decay, values[0], growing=False),
        "mean of all",
    ),
    (
        "08.2",
        lambda values, decay: np.cumsum(values) / np.arange(1, len(values) + 1),
        "itself counts",
    ),
    ("09.1", lambda slope, real, fake, leash: slope * np.mean(real), "minus"),
    ("09.1", lambda *given: -linear_critic_loss(*given), "turn the signs"),
    ("09.1", lambda *given: np.ones(2), "shape (2,)"),
    ("09.1", lambda slope, *given: linear_critic_loss(slope, *given[:2], 0), "penalty"),
    (
        "09.1",
        lambda w, *given: linear_critic_loss(w, *given) + 40 * (w < 0),
        "length 1",
    ),
    ("09.2", lambda gradient: np.linalg.norm(gradient), "root of V"),
    ("09.2", lambda gradient: gradient.sum(axis=1), "shape (2,)"),
    ("09.2", lambda gradient: 2.0, "root of 2 x 10"),
    ("09.2", lambda g: np.linalg.norm(g) * len(g) ** 0.5, "moves no row"),
    ("09.2", lambda g: np.linalg.norm(g - g.mean()) * len(g) ** 0.5, "axis=1"),
    ("09.2", lambda g: felt_slope(g) * (2 / len(g)) ** 0.5, "the same slope"),
    ("10.1", lambda norms, shares: shares[0], "shape ()"),
    ("10.1", lambda norms, shares: shares / norms, "divide by the first"),
    ("10.1", lambda norms, shares: shares / shares[0], "weight times norm"),
    (
        "10.1",
        lambda norms, shares: norms[0] / norms * np.maximum(shares, 0.25) / shares[0],
        "no share",
    ),
    ("10.2", lambda values, count: np.nanmean(values), "that value"),
    ("10.2", lambda values, count: np.mean(values[-count:]), "does not count"),
    (
        "10.2",
        lambda values, count: np.nanmean(values[-count:] if count < 9 else values[1:]),
        "take them all",
    ),
    ("10.2", lambda values, count: np.nan_to_num(recent_mean(values, count)), "NaN"),
    ("11.1", lambda edges, count: kinds(edges, count)[:5], "shape (5,)"),
    ("11.1", lambda edges, count: np.arange(count), "backwards"),
    ("11.1", lambda edges, count: np.zeros(count), "an end has 1"),
    ("11.1", lambda e, n: np.bincount(e.ravel(), minlength=n), "ask the neighbours"),
    ("11.1", lambda e, n: kinds(e, n, lambda of: sum(x > 1 for x in of)), "two ends"),
    ("11.1", lambda e, n: kinds(e, n, sum), "same sum"),
    (
        "11.1",
        lambda e, n: np.append(kinds(e, n)[:-1], kinds(e, n)[0]),
        "of its own kind",
    ),
    ("11.2", lambda painted, known, weights: set(weights), "the critic's term"),
    ("11.2", lambda p, k, weights: fed(p, k, weights) | {"adversarial_s"}, "D_s"),
    ("11.2", lambda p, k, w: fed(p, 0, w), "labels, too"),
    ("11.2", lambda p, k, w: fed(p, 1, w), "nothing is supervised"),
    ("11.2", lambda p, k, w: fed(p, k, w) - {"physical"}, "every head"),
    ("11.2", lambda p, k, w: fed(p, k, dict.fromkeys(w, 1)), "weight 0"),
    ("12.1", lambda head: near_habit(head)[1:], "came out"),
    ("12.1", lambda head: near_habit(head) * np.nan, "0 or more"),
    ("12.1", lambda head: near_habit(head) * 2, "sums to 1"),
    ("12.1", bone_heat, "what do artists"),
    ("12.1", aside, "other axes"),
    ("12.1", lambda head: leaning(head, slice(None), 0, 0.03), "another order"),
    ("12.2", lambda before, after: [1.25], "shape (1,)"),
    ("12.2", lambda a, b: np.mean([*b.values()]) / np.mean([*a.values()]), "as well"),
    ("12.2", lambda a, b: np.mean([b[n] / a[n] for n in b if n in a]), "divide"),
    ("12.2", lambda a, b: paired(b, a), "is 1.25"),
    ("12.2", lambda a, b: sum(b.values()) / sum(a[n] for n in b if n in a), "neither"),
    ("12.2", lambda a, b: np.nan_to_num(paired(a, b)), "NaN"),
    ("13.1", lambda groups: rounds(groups)[:2], "2 rounds"),
    ("13.1", lambda groups: [(range(4), b) for _, b in rounds(groups)], "the same"),
    ("13.1", lambda groups: [(a, b[:1]) for a, b in rounds(groups)], "sisters"),
    ("13.1", lambda groups: [(a[:1], b) for a, b in rounds(groups)], "either"),
    ("13.1", lambda groups: [(b, a) for a, b in rounds(groups)], "ids that learn"),
    ("13.1", lambda groups: rounds(groups) if len(groups) > 2 else [], "one round"),
    ("13.2", lambda counts, errors, target: [14], "whole number"),
    ("13.2", lambda c, e, t: heads_needed(c, e, t) - 1, "round up"),
    ("13.2", lambda c, e, t: heads_needed(c, e, t) + 1, "at n = 13.2"),
    (
        "13.2",
        lambda c, e, t: heads_needed(c[[0, -1]], e[[0, -1]], t),
        "passes by points",
    ),
    (
        "13.2",
        lambda c, e, t: heads_needed(c, e, t) if t < 2 else 0,
        "less than one",
    ),
    ("14.1", lambda row, count: (row, row), "two slots"),
    ("14.1", lambda row, count: [x[::-1] for x in first_set(row, count)], "first"),
    ("14.1", lambda row, count: (np.arange(count), np.ones(count)), "bones 1 and 3"),
    (
        "14.1",
        lambda row, count: (first_set(row, count)[0], -np.sort(-row)[:count]),
        "2/3 and 1/3",
    ),
    (
        "14.1",
        lambda row, count: (
            len(row) - 1 - first_set(row[::-1], count)[0],
            first_set(row, count)[1],
        ),
        "lower id",
    ),
    (
        "14.1",
        lambda row, count: (first_set(row, count)[0], np.array([2, 1, 1])[:count] / 3),
        "weight 0",
    ),
    (
        "14.1",
        lambda row, count: (
            np.argsort(-row, kind="stable")[:count]
            + (row.max() == 1) * np.arange(count),
            first_set(row, count)[1],
        ),
        "bone 0",
    ),
    (
        "14.1",
        lambda row, count: [x[: len(row)] for x in first_set(row, count)],
        "four slots",
    ),
    ("14.2", lambda c, locked, p, n: to_paint(-c, locked, p, n), "least confident"),
    ("14.2", lambda c, locked, p, n: to_paint(c, locked, p, 2), "4, 1, 5"),
    ("14.2", lambda c, locked, p, n: to_paint(c, locked & False, p, n), "is done"),
    ("14.2", lambda *given: to_paint(*given, nobody=False), "-1 is nobody"),
    (
        "14.2",
        lambda c, locked, p, n: to_paint(
            c, locked, p * 0 - 1 if locked.any() else p, n
        ),
        "follows it",
    ),
    (
        "14.2",
        lambda c, locked, p, n: to_paint(
            c, locked, p if locked.any() else p * 0 - 1, n
        ),
        "enough",
    ),
    (
        "14.2",
        lambda c, locked, p, n: to_paint(c, locked, p, n)[: n - (p[0] > 0) * (n < 6)],
        "no place",
    ),
    (
        "14.2",
        lambda c, locked, p, n: [v for v in to_paint(c, locked, p, n) if p[v] != v],
        "in the middle",
    ),
    ("15.1", lambda *given: push(*given)[0], "3 vertices"),
    ("15.1", lambda v, p, n, e, w: push(v, p, n, 0.1, w), "further than epsilon"),
    ("15.1", lambda *given: push(*given, factor=2), "pushes out"),
    ("15.1", lambda *given: push(*given, factor=-1), "has a 2"),
    ("15.1", lambda v, p, n, e, w: push(v, p, n, 0, w), "6 mm short of"),
    ("15.1", lambda v, p, n, e, w: push(v, p, n, e, 1), "0.3 N"),
    (
        "15.1",
        lambda v, p, n, e, w: push(v, p, n * [0, 0, 1], e, w),
        "along the normal",
    ),
    ("15.2", lambda amounts, targets: (amounts, targets), "leave it out"),
    ("15.2", lambda *given: [x[:1] for x in for_engine(*given)], "(3, 2) amounts"),
    (
        "15.2",
        lambda amounts, targets: (amounts[:, ::2], targets[::2]),
        "clamped",
    ),
    (
        "15.2",
        lambda amounts, targets: (for_engine(amounts, targets)[0], targets[::2]),
        "otherwise",
    ),
    (
        "15.2",
        lambda amounts, targets: (amounts[:, ::2] / 4, targets[::2] * 4),
        "its own largest",
    ),
    ("16.1", lambda *given: heat(*given)[0], "3 vertices"),
    ("16.1", lambda *given: heat(*given, power=1), "is squared"),
    ("16.1", lambda d, a, n: np.exp(-((d / a) ** 2)), "divided by its sum"),
    ("16.1", lambda *given: 2 * heat(*given), "rows sum to 1"),
    ("16.1", lambda d, a, n: heat(d, 2 * a, n), "exp(-4)"),
    ("16.1", lambda *given: heat(*given, guard=False), "300 m"),
    ("16.1", lambda d, a, n: heat(d, 1.0, n), "half of alpha"),
    ("16.1", lambda d, a, n: heat(d, a, 3), "at most two"),
    ("16.1", lambda *given: heat(*given, last=True), "first leave out"),
    (
        "16.1",
        lambda d, a, n: heat(d, a, 3) if n == 3 else heat(d, a, 3) * [1.5, 0, 1.5],
        "are the nearest",
    ),
    ("16.2", lambda posed, period: best_guess(posed, 1), "two frames"),
    (
        "16.2",
        lambda posed, period: (
            posed.reshape(period, -1, *posed.shape[1:]).mean(axis=1),
            0.0,
        ),
        "follow each other",
    ),
    ("16.2", lambda posed, period: (posed[:period], 0.0), "2, 5"),
    ("16.2", lambda *given: best_guess(*given, factor=0.5), "not the mean square"),
    ("16.2", lambda *given: best_guess(*given, factor=3**-0.5), "three coordinates"),
    ("16.2", lambda *given: best_guess(*given, factor=8**0.5), "not from each other"),
    ("16.2", lambda *given: best_guess(*given, factor=3), "2 of 8"),
    ("17.1", lambda *given: side(*given).T, "3 vertices"),
    ("17.1", lambda w, b, c, v: side(w, 0 * b, c, v), "bias is missing"),
    ("17.1", lambda w, b, c, v: side(w, b, 0 * c, v), "code is missing"),
    ("17.1", lambda w, b, c, v: side(w, b, c[::-1], v), "by hand"),
    ("17.1", repeated_side, "multiply the code once"),
    ("17.2", lambda *given: full_size(*given)[0], "three vertices"),
    ("17.2", lambda *given: full_size(*given, scale=3.25), "mean of the ratios"),
    ("17.2", lambda *given: full_size(*given, scale=3.0), "ratio of the sums"),
    ("17.2", lambda *given: full_size(*given, scale=4.5), "ratio of the boxes"),
    ("17.2", lambda *given: full_size(*given, scale=2.0), "the best scale"),
    ("17.2", lambda *given: full_size(*given, floor=False), "stands on z = 7"),
    ("17.2", lambda *given: 1.0 + full_size(*given), "only lifted"),
    (
        "17.2",
        lambda p, t, e: full_size(p, t, e, floor=False) + t * [0, 0, 1],
        "the floor",
    ),
]


@pytest.mark.parametrize("name", SOLUTIONS)
def test_a_solution_is_right(capsys, name):
    assert said(capsys, name, SOLUTIONS[name]) == "right"


@pytest.mark.parametrize("name", sorted(CHECKS))
@pytest.mark.parametrize("stub", [None, lambda *args, **kwargs: None])
def test_a_stub_is_not_solved_yet(capsys, name, stub):
    verdict = said(capsys, name, stub)
    # A check of a value may find a function where it wants a list.
    assert verdict == "not solved yet" or "stops with TypeError" in verdict


@pytest.mark.parametrize("name, answer, hint", WRONG)
def test_a_wrong_answer_gets_a_hint(capsys, name, answer, hint):
    verdict = said(capsys, name, answer)
    assert verdict.startswith("not yet: ") and hint in verdict


@pytest.mark.parametrize("name", sorted(CHECKS))
@pytest.mark.parametrize("answer", ["text", 3, object(), [], lambda: 1, np.zeros(2)])
def test_nonsense_never_raises(capsys, name, answer):
    assert said(capsys, name, answer) != "not solved yet"


def test_an_unknown_number_is_named(capsys):
    assert "there are" in said(capsys, "99.9", 1) and "99.9" not in CHECKS


def test_a_number_has_one_check():
    with pytest.raises(ValueError, match="two checks"):
        exercise("04.1")(lambda answer: None)


def test_same_compares_shape_and_value():
    assert same(np.float32(0.1), 0.1) and same([True], [1])
    assert not same([1, 2], [1, 3]) and not same(1, [1]) and not same(None, 0)
