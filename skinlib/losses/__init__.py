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
from skinlib.losses.consistency import consistency
from skinlib.losses.physical import (
    dirichlet,
    falloff_radii,
    joint_distance,
    joint_falloff,
    smoothness,
)
from skinlib.losses.supervised import (
    LossWeights,
    cross_entropy,
    row_l1,
    seed_supervised,
    supervised,
)
from skinlib.losses.total import TermWeights, total

__all__ = [
    "LossWeights",
    "TermWeights",
    "consistency",
    "critic_loss",
    "cross_entropy",
    "dirichlet",
    "falloff_radii",
    "generator_loss",
    "gradient_penalty",
    "joint_distance",
    "joint_falloff",
    "row_l1",
    "seed_supervised",
    "smoothness",
    "supervised",
    "total",
    "unsupervised_critic_loss",
    "unsupervised_generator_loss",
]
