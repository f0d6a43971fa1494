"""Exercises say right, not yet with a hint, or not solved yet, and never raise."""

import numpy as np
import pytest

from skinlib.exercises import CHECKS, check_exercise, exercise, same


def said(capsys, name, answer) -> str:
    check_exercise(name, answer)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1
    number, verdict = lines[0].split(": ", 1)
    assert number == name
    return verdict


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


SOLUTIONS = {
    "04.1": moved,
    "04.2": lambda features: flip(features, [0, 3, 7]),
    "05.1": softmax,
    "05.2": lambda logits, allowed: softmax(np.where(allowed, logits, -np.inf)),
}
WRONG = [
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
