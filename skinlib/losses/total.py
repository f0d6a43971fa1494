"""The weighted sum that the generator minimises."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class TermWeights:
    """How much each term of the total counts: the source's alpha to epsilon."""

    supervised: float = 1.0  # alpha
    adversarial_s: float = 0.1  # beta, the critic of labelled heads
    adversarial_u: float = 0.1  # gamma, the critic of unlabelled heads
    consistency: float = 0.05  # delta
    physical: float = 0.05  # epsilon, of L_smooth + L_joint or what replaces them


def total(terms: Mapping[str, Tensor], weights: TermWeights | None = None) -> Tensor:
    """L_total = sum_t weight_t L_t over the terms that are there.

    Equation `total`. A step on a labelled head has other terms than one on an
    unlabelled head; what is absent counts nothing. A term of weight 0 is left out, so
    that not even its NaN reaches the sum; a sum of nothing is a constant 0.

    Args:
        terms: scalars by the name of their weight. weights: None: the source's.

    Raises:
        ValueError: a term that `TermWeights` does not know.

    >>> terms = {"supervised": torch.tensor(2.0), "consistency": torch.tensor(4.0)}
    >>> round(total(terms).item(), 4)  # 1.0 x 2 + 0.05 x 4
    2.2
    """
    known = asdict(weights or TermWeights())
    if unknown := sorted(set(terms) - set(known)):
        raise ValueError(f"unknown terms {unknown}: use {list(known)}")
    counted = [known[name] * term for name, term in terms.items() if known[name]]
    return sum(counted, start=torch.zeros(()))
