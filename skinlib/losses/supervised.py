"""Supervised loss terms: one function a term, each a scalar to minimise.

Symbols: V vertices, J bones, Y the artist's weights, P the predicted ones; rows of both
sum to 1. Equation ids are those of docs/equations.md.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor


def seed_supervised(predicted: Tensor, target: Tensor, balance: float = 0.1) -> Tensor:
    """The source's L_sup as written: mean over V and J of squares, minus cosines.

    L_sup = 1/V sum_v [ 1/J sum_j (P_vj - Y_vj)^2 - balance cos(P_v, Y_v) ]

    Equation `sup_seed`. The mean over J makes the squares tiny beside the cosine when
    there are many bones.

    Args:
        predicted, target: (V, J).

    >>> rows = torch.tensor([[1.0, 0.0]])
    >>> round(seed_supervised(rows, rows).item(), 4)
    -0.1
    """
    square = (predicted - target).square().mean(dim=1)
    cosine = F.cosine_similarity(predicted, target, dim=1)
    return (square - balance * cosine).mean()


def row_l1(predicted: Tensor, target: Tensor) -> Tensor:
    """Mean over vertices of sum_j |P_vj - Y_vj|, from 0 to 2: the metric itself.

    Equation `row_l1`.

    >>> row_l1(torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, 1.0]])).item()
    2.0
    """
    return (predicted - target).abs().sum(dim=1).mean()


def cross_entropy(logits: Tensor, target: Tensor) -> Tensor:
    """Mean over vertices of -sum_j Y_vj log P_vj, P the softmax of the logits.

    Equation `cross_entropy`. Its gradient does not vanish where P is far off.

    >>> round(cross_entropy(torch.zeros(1, 2), torch.tensor([[1.0, 0.0]])).item(), 4)
    0.6931
    """
    return -(target * logits.log_softmax(dim=1)).sum(dim=1).mean()


@dataclass(frozen=True)
class LossWeights:
    """How much each supervised term counts."""

    row_l1: float = 1.0  # sum over bones of absolute differences
    cross_entropy: float = 0.3  # cross-entropy to the artist's rows
    seed: float = 0.0  # the source's L_sup
    balance: float = 0.1  # lambda, of the cosine in the source's L_sup


def supervised(
    logits: Tensor, target: Tensor, weights: LossWeights | None = None
) -> Tensor:
    """The weighted sum of the supervised terms that count.

    Args:
        logits: (V, J) before the softmax. target: (V, J) rows that sum to 1.
    """
    weights = weights or LossWeights()
    predicted = torch.softmax(logits, dim=1)
    total = logits.new_zeros(())
    if weights.row_l1:
        total = total + weights.row_l1 * row_l1(predicted, target)
    if weights.cross_entropy:
        total = total + weights.cross_entropy * cross_entropy(logits, target)
    if weights.seed:
        total = total + weights.seed * seed_supervised(
            predicted, target, weights.balance
        )
    return total
