"""Training: heads in, a checkpoint out; it can be stopped at any step and goes on."""

from skinlib.training.checkpoint import (
    CONFIG,
    STATE,
    WEIGHTS,
    load_model,
    save_model,
)
from skinlib.training.config import TrainConfig, finetune_config
from skinlib.training.trainer import HISTORY, Trainer, train

__all__ = [
    "CONFIG",
    "HISTORY",
    "STATE",
    "WEIGHTS",
    "TrainConfig",
    "Trainer",
    "finetune_config",
    "load_model",
    "save_model",
    "train",
]
