"""The consistency term: the same head, disturbed, should get the same weights.

Symbols: V vertices, J bones. Equation ids are those of docs/equations.md.
"""

import torch
from torch import Tensor

from skinlib.losses.supervised import row_l1


def consistency(first: Tensor, second: Tensor, kind: str = "squares") -> Tensor:
    """How far two predictions for the same vertices and bones lie apart.

    L_cons = 1/V sum_v 1/J sum_j (first_vj - second_vj)^2

    Equation `cons`.

    Args:
        first, second: (V, J) rows that sum to 1. Detach the one that teaches.
        kind: "squares", the source's form, from 0 to 2 / J; "row_l1", from 0 to 2,
            whatever the number of bones; "kl", KL(second || first) >= 0, in nats.

    Raises:
        ValueError: two shapes, or an unknown kind.

    >>> one, other = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.5, 0.5]])
    >>> [round(consistency(one, other, k).item(), 2) for k in ("squares", "row_l1")]
    [0.25, 1.0]
    >>> round(consistency(other, one, "kl").item(), 4)
    0.6931
    """
    if first.shape != second.shape:
        raise ValueError(
            f"weights {tuple(first.shape)} and {tuple(second.shape)}: a twin needs the "
            "vertices and the bones of the original, in the same order"
        )
    if kind == "squares":
        return (first - second).square().mean(dim=1).mean()
    if kind == "row_l1":
        return row_l1(first, second)
    if kind == "kl":
        return _kl(second, first)
    raise ValueError(f"kind is {kind!r}: use squares, row_l1 or kl")


def _kl(target: Tensor, predicted: Tensor) -> Tensor:
    """Mean over vertices of KL(target || predicted)."""
    # A softmax in float32 does reach 0, whose logarithm would leave NaN gradients.
    least = torch.finfo(predicted.dtype).tiny
    ratio = target.clamp(min=least).log() - predicted.clamp(min=least).log()
    return (target * ratio).sum(dim=1).mean()
