"""The settings of a training run."""

import os
from dataclasses import dataclass, field, replace

from skinlib.datasets.augment import AugmentConfig
from skinlib.losses import LossWeights
from skinlib.model import ModelConfig


@dataclass(frozen=True)
class TrainConfig:
    """What a training run is; the same configuration and heads give the same model."""

    minutes: float = 30.0  # training time, unless `steps` is given
    steps: int | None = None  # number of steps, for runs that repeat to the bit
    batch: int = 2  # heads a step
    judged_nodes: int = 1024  # nodes of a head whose weights enter the loss
    optimizer: str = "muon"  # muon: for matrices, with AdamW for the rest; or adamw
    learning_rate: float = 5e-3  # after the warm-up
    weight_decay: float = 0.01  # pull of every parameter towards 0
    warmup: int = 100  # steps over which the learning rate rises
    cooldown: float = 0.5  # last part of the run, in which the learning rate falls to 0
    clip: float = 1.0  # largest norm of a step's gradient
    ema: float = 0.998  # decay of the averaged parameters that are kept
    seed: int = 0  # of parameters, order and augmentation
    threads: int = min(2, os.cpu_count() or 1)  # heads differentiated at once
    device: str = "cpu"  # cpu, cuda, cuda:1, ...
    validation_share: float = 0.08  # of the heads, when no validation heads are given
    validations: int = 20  # how often the run is validated
    save_seconds: float = 60.0  # how often the state to resume from is written
    unlabelled_share: float = 0.25  # of the draws, when unlabelled heads are given
    unlabelled_start: float = 0.3  # part of the run after which they are drawn
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossWeights = field(default_factory=LossWeights)
    augment: AugmentConfig = field(default_factory=AugmentConfig)


def finetune_config(config: TrainConfig, **changes) -> TrainConfig:
    """A configuration for going on from a trained model: a tenth of the step size."""
    return replace(config, learning_rate=config.learning_rate / 10, **changes)
