"""Adversarial loss terms of critic and generator, after WGAN-GP.

A critic gives a score to a table of skin weights on a head. *Real* are scores of the
artist's weights, *fake* of the generator's. The penalty is a term of its own: add
`lambda_gp * gradient_penalty(...)` to a critic's loss, lambda_gp = 10 in the source.
Equation ids are those of docs/equations.md.
"""

from collections.abc import Callable

import torch
from torch import Tensor


def critic_loss(real: Tensor, fake: Tensor, signs: str = "wgan") -> Tensor:
    """What D_s minimises, without the penalty: E[fake] - E[real].

    Equation `adv_s`. With `signs="source"` it is E[real] - E[fake], Equation
    `adv_s_seed`: critic and generator then both raise the fake score, and nobody
    opposes anybody.

    Args:
        real, fake: scores, scalars or (B,).

    Raises:
        ValueError: other signs.

    >>> critic_loss(torch.tensor([3.0, 5.0]), torch.tensor(1.0)).item()
    -3.0
    """
    if signs not in ("wgan", "source"):
        raise ValueError(f"signs is {signs!r}: use wgan or source")
    apart = real.mean() - fake.mean()
    return apart if signs == "source" else -apart


def generator_loss(fake: Tensor) -> Tensor:
    """What the generator minimises beside D_s: -E[fake].

    The second line of Equation `adv_s`, which the source has too.
    """
    return -fake.mean()


def unsupervised_critic_loss(fake: Tensor, real: Tensor | None = None) -> Tensor:
    """What D_u minimises, without the penalty: E[fake] - E[real].

    Equation `adv_u`. `real` are scores of the artist's weights on labelled heads.
    Without them it is the source's -E[fake], Equation `adv_u_seed`: D_u is never shown
    what plausible weights look like.

    Args:
        fake, real: scores, scalars or (B,).
    """
    return -fake.mean() if real is None else critic_loss(real, fake)


def unsupervised_generator_loss(fake: Tensor, as_written: bool = True) -> Tensor:
    """What the generator minimises beside D_u: E[fake] as written, or -E[fake].

    Equation `adv_u_seed` as written, which opposes a D_u without positives. A D_u with
    positives gives good weights a high score; the generator has to raise it, which is
    Equation `adv_u`.
    """
    return fake.mean() if as_written else generator_loss(fake)


def gradient_penalty(
    critic: Callable[[Tensor], Tensor],
    real: Tensor,
    fake: Tensor,
    mix: Tensor | float,
    per_vertex: bool = True,
) -> Tensor:
    """(||gradient|| - 1)^2 at mix * real + (1 - mix) * fake.

    Equation `gp`. A critic is a mean over V vertices, so each vertex has about 1 / V of
    its gradient, and the norm over all numbers shrinks with 1 / sqrt(V).

    Args:
        critic: (V, J) weights -> () score.
        real, fake: (V, J) of one head, no gradient goes back into them. Where a head
            has no real weights, give the fake ones twice.
        mix: 0 .. 1, drawn anew for every step.
        per_vertex: the norm of the gradient that belongs to the distance
            sqrt(mean_v |P_v - Q_v|^2) between weights, which does not shrink with V.
            False: as the source writes it, over all V x J numbers.

    >>> weights = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    >>> slope = torch.tensor([3.0, 0.0])
    >>> def critic(weights):
    ...     return (weights * slope).sum(dim=1).mean()
    >>> round(gradient_penalty(critic, weights, weights.flip(1), mix=0.5).item(), 4)
    4.0
    """
    between = (mix * real + (1 - mix) * fake).detach().requires_grad_()
    # Also where nothing else asks for gradients, so that it can be measured.
    with torch.enable_grad():
        (gradient,) = torch.autograd.grad(critic(between), between, create_graph=True)
    norm = torch.linalg.vector_norm(gradient)
    if per_vertex:
        norm = norm * len(real) ** 0.5
    return (norm - 1).square()
