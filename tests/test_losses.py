"""The loss terms: values by hand, derivatives, and who wins."""

import pytest
import torch
import torch.nn.functional as F
from torch.autograd import gradcheck

from skinlib.losses import (
    LossWeights,
    cross_entropy,
    row_l1,
    seed_supervised,
    supervised,
)

TARGET = torch.tensor([[1.0, 0, 0, 0], [0.5, 0.5, 0, 0]])
GUESS = torch.tensor([[0.5, 0.5, 0, 0], [0.5, 0, 0.5, 0]])


def test_row_l1_by_hand():
    assert row_l1(GUESS, TARGET).item() == 1
    assert row_l1(TARGET, TARGET).item() == 0
    assert row_l1(TARGET, TARGET.flip(1)).item() == 2


def test_seed_supervised_by_hand():
    # Squares: 2 / 4 / 4 in both rows; cosines: 1 / sqrt(2) and 1/2.
    cosine = (0.5**0.5 + 0.5) / 2
    for balance in (0.0, 0.1, 1.0):
        expected = 0.125 - balance * cosine
        loss = seed_supervised(GUESS, TARGET, balance).item()
        assert loss == pytest.approx(expected, abs=1e-6)
    assert seed_supervised(TARGET, TARGET).item() == pytest.approx(-0.1)


def test_the_sources_squares_shrink_with_the_number_of_bones():
    wide = [F.pad(rows, (0, 96)) for rows in (GUESS, TARGET)]
    narrow = seed_supervised(GUESS, TARGET, balance=0.0)
    assert seed_supervised(*wide, balance=0.0) == pytest.approx(narrow / 25)
    assert row_l1(*wide) == row_l1(GUESS, TARGET)


def test_cross_entropy_by_hand():
    logits = torch.tensor([[0.0, 0, 0, 0], [3, 3, -torch.inf, -torch.inf]])
    finite = logits.clamp(min=-1e4)
    expected = (torch.tensor(4.0).log() + torch.tensor(2.0).log()) / 2
    torch.testing.assert_close(cross_entropy(finite, TARGET), expected)


def test_cross_entropy_is_that_of_torch_and_least_at_the_target():
    logits, target = torch.randn(5, 7), torch.rand(5, 7).softmax(dim=1)
    torch.testing.assert_close(
        cross_entropy(logits, target), F.cross_entropy(logits, target)
    )
    assert cross_entropy(target.log(), target) < cross_entropy(logits, target)


def test_supervised_is_the_weighted_sum():
    logits = torch.tensor([[0.0, 1, 2, 3], [3, 0, 0, 0]])
    predicted = logits.softmax(dim=1)
    terms = (
        row_l1(predicted, TARGET),
        cross_entropy(logits, TARGET),
        seed_supervised(predicted, TARGET),
    )
    for weights in ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (0.5, 2.0, 3.0)):
        expected = sum(w * t for w, t in zip(weights, terms, strict=True))
        loss = supervised(logits, TARGET, LossWeights(*weights))
        torch.testing.assert_close(loss, expected)
    default = LossWeights()
    expected = default.row_l1 * terms[0] + default.cross_entropy * terms[1]
    torch.testing.assert_close(supervised(logits, TARGET), expected)
    assert supervised(logits, TARGET, LossWeights(0, 0, 0)).item() == 0
    source = supervised(logits, TARGET, LossWeights(0, 0, 1, balance=0.7))
    assert source == seed_supervised(predicted, TARGET, balance=0.7)


TERMS = {
    "row_l1": lambda x, y: row_l1(x.softmax(1), y),
    "cross_entropy": cross_entropy,
    "sup_seed": lambda x, y: seed_supervised(x.softmax(1), y),
    "all": lambda x, y: supervised(x, y, LossWeights(1, 1, 1)),
}


@pytest.mark.parametrize("term", TERMS)
def test_derivatives(term):
    torch.manual_seed(0)
    logits = torch.randn(6, 5, dtype=torch.float64, requires_grad=True)
    target = torch.rand(6, 5, dtype=torch.float64).softmax(dim=1)
    assert gradcheck(TERMS[term], (logits, target))


@pytest.mark.parametrize("term", TERMS)
def test_permuting_vertices_and_bones_changes_nothing(term):
    torch.manual_seed(0)
    logits, target = torch.randn(6, 5), torch.rand(6, 5).softmax(dim=1)
    rows, columns = torch.randperm(6), torch.randperm(5)
    expected = TERMS[term](logits, target)
    torch.testing.assert_close(
        TERMS[term](logits[rows][:, columns], target[rows][:, columns]), expected
    )


@pytest.mark.parametrize("term", TERMS)
def test_each_term_leads_to_the_target(term):
    torch.manual_seed(0)
    target = torch.tensor([[0.7, 0.3, 0.0], [0.0, 0.0, 1.0]])
    logits = torch.zeros(2, 3, requires_grad=True)
    optimizer = torch.optim.Adam([logits], lr=0.05)
    for _ in range(300):
        optimizer.zero_grad()
        TERMS[term](logits, target).backward()
        optimizer.step()
    assert row_l1(logits.softmax(1), target) < 0.05


def test_the_gradient_of_a_vertex_that_is_far_off():
    # All weight on the wrong bone: cross-entropy pushes, the others have given up.
    target, logits = torch.tensor([[1.0, 0.0]]), torch.tensor([[-9.0, 9.0]])
    push = {}
    for name, term in TERMS.items():
        leaf = logits.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(term(leaf, target), leaf)
        push[name] = gradient.abs().max().item()
    assert push["cross_entropy"] > 0.9
    assert max(push["row_l1"], push["sup_seed"]) < 1e-3


@pytest.mark.parametrize("term", TERMS)
@pytest.mark.parametrize("bones", [1, 200])
def test_extreme_logits_stay_finite(term, bones):
    logits = torch.full((3, bones), -1e4)
    logits[:, 0] = 1e4
    logits.requires_grad_()
    target = torch.zeros(3, bones)
    target[:, -1] = 1
    loss = TERMS[term](logits, target)
    assert loss.isfinite()
    assert torch.autograd.grad(loss, logits)[0].isfinite().all()
