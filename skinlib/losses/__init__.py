"""The loss terms of the training, one function each, each a scalar to minimise.

Equation ids are those of docs/equations.md.
"""

from skinlib.losses.adversarial import (
    critic_loss,
    generator_loss,
    gradient_penalty,
    unsupervised_critic_loss,
    unsupervised_generator_loss,
)
from skinlib.losses.supervised import (
    LossWeights,
    cross_entropy,
    row_l1,
    seed_supervised,
    supervised,
)

__all__ = [
    "LossWeights",
    "critic_loss",
    "cross_entropy",
    "generator_loss",
    "gradient_penalty",
    "row_l1",
    "seed_supervised",
    "supervised",
    "unsupervised_critic_loss",
    "unsupervised_generator_loss",
]
