"""Training: heads in, a checkpoint out; it can be stopped at any step and goes on."""

from skinlib.training.checkpoint import (
    CONFIG,
    STATE,
    WEIGHTS,
    load_model,
    save_model,
)
from skinlib.training.config import (
    AS_WRITTEN,
    SUPERVISED_ONLY,
    TermForms,
    TrainConfig,
)
from skinlib.training.state import HISTORY
from skinlib.training.trainer import Trainer, train

__all__ = [
    "AS_WRITTEN",
    "CONFIG",
    "HISTORY",
    "STATE",
    "SUPERVISED_ONLY",
    "WEIGHTS",
    "TermForms",
    "TrainConfig",
    "Trainer",
    "load_model",
    "save_model",
    "train",
]
