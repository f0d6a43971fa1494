"""The consistency term and the weighted sum of all terms."""

import pytest
import torch
import torch.nn.functional as F
from torch.autograd import gradcheck

from skinlib.losses import TermWeights, consistency, row_l1, total

FIRST = torch.tensor([[1.0, 0, 0, 0], [0.5, 0.5, 0, 0]])
SECOND = torch.tensor([[0.5, 0.5, 0, 0], [0.5, 0, 0.5, 0]])
KINDS = ["squares", "row_l1", "kl"]


def rows(*shape, seed=0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64).softmax(1)


def test_by_hand():
    # Both rows: two bones are off by a half.
    assert consistency(FIRST, SECOND).item() == pytest.approx(2 * 0.25 / 4)
    assert consistency(FIRST, SECOND, "row_l1").item() == 1
    # KL of (3/4, 1/4) against (1/4, 3/4): 3/4 ln 3 - 1/4 ln 3.
    one, other = torch.tensor([[0.25, 0.75]]), torch.tensor([[0.75, 0.25]])
    expected = torch.tensor(3.0).log().item() / 2
    assert consistency(one, other, "kl").item() == pytest.approx(expected)


def test_kl_teaches_the_first_from_the_second():
    sure, unsure = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.5, 0.5]])
    assert consistency(unsure, sure, "kl").item() == pytest.approx(0.6931, abs=1e-4)
    assert consistency(sure, unsure, "kl").item() > 40  # it rules out what is possible


def test_kl_is_that_of_torch():
    first, second = rows(6, 5), rows(6, 5, seed=1)
    expected = F.kl_div(first.log(), second, reduction="batchmean")
    torch.testing.assert_close(consistency(first, second, "kl"), expected)


@pytest.mark.parametrize("kind", KINDS)
def test_twins_that_agree_cost_nothing(kind):
    assert consistency(FIRST, FIRST.clone(), kind).item() == 0


def test_the_range():
    apart = torch.eye(2), torch.eye(2).flip(1)
    assert consistency(*apart).item() == 2 / 2
    assert consistency(*apart, "row_l1").item() == 2


def test_only_the_squares_shrink_with_bones_that_move_nothing():
    wide = [F.pad(table, (0, 96)) for table in (FIRST, SECOND)]
    assert consistency(*wide) == pytest.approx(consistency(FIRST, SECOND) / 25)
    for kind in ("row_l1", "kl"):
        assert consistency(*wide, kind) == consistency(FIRST, SECOND, kind)


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives(kind):
    first, second = rows(6, 5).requires_grad_(), rows(6, 5, seed=1).requires_grad_()
    assert gradcheck(lambda x, y: consistency(x, y, kind), (first, second))


@pytest.mark.parametrize("kind", KINDS)
def test_permuting_vertices_and_bones_changes_nothing(kind):
    first, second = rows(6, 5), rows(6, 5, seed=1)
    v, j = torch.randperm(6), torch.randperm(5)
    again = consistency(first[v][:, j], second[v][:, j], kind)
    torch.testing.assert_close(again, consistency(first, second, kind))


@pytest.mark.parametrize("kind", KINDS)
def test_a_softmax_that_reaches_zero_has_finite_derivatives(kind):
    logits = torch.tensor([[1e4, -1e4], [0.0, 0.0]]).requires_grad_()
    loss = consistency(logits.softmax(1), torch.eye(2).flip(1), kind)
    (gradient,) = torch.autograd.grad(loss, logits)
    assert loss.isfinite() and gradient.isfinite().all()


def test_consistency_refuses():
    with pytest.raises(ValueError, match=r"\(2, 4\) and \(3, 4\): a twin needs"):
        consistency(FIRST, rows(3, 4))
    with pytest.raises(ValueError, match="'l2': use squares, row_l1 or kl"):
        consistency(FIRST, SECOND, "l2")


# -- the total -----------------------------------------------------------------------

TERMS = {
    "supervised": 2.0,
    "adversarial_s": 3.0,
    "adversarial_u": -5.0,
    "consistency": 7.0,
    "physical": 11.0,
}


def tensors(terms):
    return {name: torch.tensor(value) for name, value in terms.items()}


def test_total_by_hand():
    # 1.0 x 2 + 0.1 x 3 - 0.1 x 5 + 0.05 x 7 + 0.05 x 11
    assert total(tensors(TERMS)).item() == pytest.approx(2.7)
    weights = TermWeights(0.0, 1.0, 2.0, 3.0, 4.0)
    assert total(tensors(TERMS), weights).item() == 3 - 10 + 21 + 44


def test_the_order_of_the_terms_does_not_matter():
    turned = dict(reversed(TERMS.items()))
    torch.testing.assert_close(total(tensors(turned)), total(tensors(TERMS)))


def test_an_absent_term_counts_nothing():
    assert total({"consistency": torch.tensor(4.0)}).item() == pytest.approx(0.2)
    assert total({}).item() == 0


def test_a_term_of_weight_zero_is_left_out():
    terms = {"supervised": torch.tensor(2.0), "physical": torch.tensor(torch.nan)}
    assert total(terms, TermWeights(physical=0.0)).item() == 2
    assert total(terms).isnan()
    assert total(terms, TermWeights(0, 0, 0, 0, 0)).item() == 0


def test_the_derivative_of_the_total_is_the_weight():
    terms = {k: v.double().requires_grad_() for k, v in tensors(TERMS).items()}
    assert gradcheck(
        lambda *v: total(dict(zip(terms, v, strict=True))), [*terms.values()]
    )
    total(terms).backward()
    found = [term.grad.item() for term in terms.values()]
    assert found == pytest.approx([1.0, 0.1, 0.1, 0.05, 0.05])


def test_total_refuses_an_unknown_term():
    with pytest.raises(ValueError, match=r"unknown terms \['smooth'\]: use \['super"):
        total({"smooth": torch.tensor(1.0), "physical": torch.tensor(1.0)})


def test_total_takes_what_the_terms_return():
    predicted = rows(4, 3).requires_grad_()
    terms = {
        "supervised": row_l1(predicted, rows(4, 3, seed=1)),
        "consistency": consistency(predicted, rows(4, 3, seed=2)),
    }
    assert total(terms).dtype == torch.float64
    assert torch.autograd.grad(total(terms), predicted)[0].any()
