"""The networks that take part in HeadBench, and how they are trained."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from skinlib.head import Head
from skinlib.model import SkinningModel
from skinlib.model.rivals import PointTransformer, RigNetSkinning
from skinlib.training import TrainConfig, Trainer

OURS = "skinlib, supervised"


@dataclass(frozen=True)
class Recipe:
    """A network, and what it sees beside heads with weights."""

    network: Callable[[], SkinningModel]
    unlabelled: bool = False  # heads without weights
    remeshed: int = 0  # copies of each head that have another mesh


RECIPES = {
    OURS: Recipe(SkinningModel),
    "skinlib, semi-supervised": Recipe(SkinningModel, unlabelled=True),
    "skinlib, remeshed": Recipe(SkinningModel, remeshed=4),
    "RigNet's skinning": Recipe(RigNetSkinning),
    "point transformer": Recipe(PointTransformer),
}


class ByProcessorTime(Trainer):
    """Counts the time it computes, so that no run pays for the machine's other work."""

    clock = staticmethod(time.process_time)


def train_networks(
    out: Path,
    labelled: Sequence[Head],
    unlabelled: Sequence[Head],
    minutes: float,
    seed: int,
) -> None:
    """Train every recipe in `out/NAME`; what is finished there is not trained again.

    All have the same heads, the same augmentation, optimiser and learning rate, and the
    same minutes of processor time on one thread, and keep their last, averaged
    parameters. Without unlabelled heads the recipes that want some are left out.
    """
    for name, recipe in RECIPES.items():
        if recipe.unlabelled and not unlabelled:
            continue
        # With one thread the processor's time is the run's.
        config = TrainConfig(
            minutes=minutes, seed=seed, threads=1, remeshed=recipe.remeshed
        )
        bare = ()
        if recipe.unlabelled:
            config, bare = replace(config, unlabelled_share=0.3), unlabelled
        torch.manual_seed(seed)
        run = ByProcessorTime(
            config,
            labelled,
            out / name,
            bare,
            validation=[],
            start=recipe.network(),
        )
        if not run.finished:
            run.run()
