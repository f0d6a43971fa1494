"""Training of pose transfer, and what it leaves: a network in a folder.

Step s of a run depends on the seed, s and the parameters alone, so a run that was
interrupted ends in the same bits as one that was not, if the threads are as many.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from zlib import crc32

import numpy as np
import torch
from torch import nn

from skinlib.head import HeadError
from skinlib.paths import trained
from skinlib.pose_transfer.data import Cast, PosePairs
from skinlib.pose_transfer.losses import EDGE_WEIGHT, pose_loss
from skinlib.pose_transfer.networks import NETWORKS
from skinlib.training.checkpoint import (
    CONFIG,
    WEIGHTS,
    reading_finished,
    replace_file,
    write_tensors,
)
from skinlib.training.run import Run

WARM_UP = 0.1  # of a run, in which the learning rate rises
FALL = 0.8  # what is left of the learning rate each time that it falls


@dataclass(frozen=True)
class TransferConfig:
    """What a training run is; with the same casts it gives the same network.

    Raises:
        HeadError: a network that there is none of, or numbers that make no sense.
    """

    network: str = "dsffnet"  # or npt, corenet
    settings: dict = field(default_factory=dict)  # of it, where not the default
    steps: int = 51_200  # the source: 200 epochs of 256
    batch: int = 8  # pairs a step
    learning_rate: float = 2e-3  # rises for a tenth of the run, then falls to 1 %
    falls: int = 0  # or it falls so often, to 0.8; the source: 25, every 8 epochs
    edge_weight: float = EDGE_WEIGHT  # lambda
    noise: float = 0.0  # on the sources, as a share of their size
    mirrored: bool = False  # every second step sees people and poses in a mirror
    seed: int = 0  # of parameters and pairs
    threads: int = 2  # another number, other last bits
    device: str = "cpu"
    save_seconds: float = 60.0  # how often the state to resume from is written

    def __post_init__(self):
        if self.network not in NETWORKS:
            raise HeadError(
                "network",
                f"there is no {self.network!r}",
                f"use {', '.join(NETWORKS)}",
            )
        for name in ("steps", "batch", "threads"):
            if getattr(self, name) < 1:
                raise HeadError(name, f"{getattr(self, name)}", "give 1 or more")
        for name in ("falls", "edge_weight", "noise", "seed"):
            if not 0 <= getattr(self, name) < np.inf:
                raise HeadError(name, f"{getattr(self, name)}", "give 0 or more")


def train(
    config: TransferConfig,
    casts: Sequence[Cast],
    out: str | Path,
    told: dict | None = None,
) -> nn.Module:
    """Train a network and keep it in `out`.

    Called again with the same arguments after an interrupt it goes on where it was;
    called after the end it returns the trained network.

    Args:
        casts: who takes part, on one mesh each; sources and targets are drawn from all.
        told: what `config.json` is to say besides, such as where the casts come from.

    Raises:
        HeadError: `out` holds another run, or the casts do not fit together.
        FloatingPointError: the loss of a step is not finite.
        KeyboardInterrupt: passed on, after the state has been written.
    """
    return TransferTrainer(config, casts, out, told).run()


class TransferTrainer(Run):
    """One training run; see `train`. `step()` is one step, for a look inside."""

    what = "pose transfer"

    def __init__(
        self,
        config: TransferConfig,
        casts: Sequence[Cast],
        out: str | Path,
        told: dict | None = None,
    ):
        if not casts:
            raise HeadError("casts", "there are none", "give one or more")
        self.casts, self.told = casts, told or {}
        self.network = make_network(config.network, config.settings, config.seed)
        self.network.to(config.device)
        groups = [{"params": list(self.network.parameters())}]
        self.pairs = [
            PosePairs(
                sources,
                targets,
                config.steps * config.batch,
                config.seed,
                noise=config.noise,
            )
            for sources in casts
            for targets in casts
        ]
        self._start(config, out, groups, torch.optim.AdamW)

    def _fallen(self, done: float) -> float:
        if self.config.falls:
            return FALL ** int(done * self.config.falls)
        risen = min(1, (done + 1 / self.config.steps) / WARM_UP)
        return risen * super()._fallen(done)

    def step(self) -> dict[str, float]:
        """One step over `batch` pairs, of one pair of meshes; returns loss and PMD."""
        config = self.config
        rng = np.random.default_rng((config.seed, 2, self.steps_done))
        first = self.steps_done * config.batch
        items = range(first, first + config.batch)
        pairs = self.pairs[rng.integers(len(self.pairs))].batch(items)
        source, identity, truth = pairs[:3]
        if config.mirrored and self.steps_done % 2:
            mirror = source.new_tensor([-1, 1, 1])
            source, identity, truth = source * mirror, identity * mirror, truth * mirror
        predicted = self.network(source, identity, pairs.source_share, pairs.share)
        loss = pose_loss(predicted, truth, pairs.edges, config.edge_weight)
        self.optimizer.zero_grad()
        loss.backward()
        if not torch.isfinite(loss):
            raise FloatingPointError(
                f"the loss of step {self.steps_done} is not finite: lower "
                f"learning_rate ({config.learning_rate})"
            )
        with torch.no_grad():
            off = (predicted - truth).square().mean()
        told = {"loss": loss.item(), "PMD e-4": 1e4 * off.item()}
        self._update(told)
        return told

    def _shown(self) -> dict[str, str]:
        return {name: f"{value:.4g}" for name, value in self.recent.items()}

    def _finish(self) -> nn.Module:
        network = self.network.cpu().eval()
        training = asdict(self.config)
        told = self.told | {"training": training, "seconds": round(self.seconds)}
        save_network(self.out, network, told)
        return network

    def _identity(self) -> dict:
        machine = ("threads", "device", "save_seconds")
        settings = {k: v for k, v in asdict(self.config).items() if k not in machine}
        bits = 0
        for cast in self.casts:
            for part in (cast.rest, cast.weights, cast.transforms, cast.faces):
                bits = crc32(part.cpu().numpy().tobytes(), bits)
        return json.loads(json.dumps(settings | {"people": bits}))


def make_network(name: str, settings: dict, seed: int) -> nn.Module:
    """An untrained network of `NETWORKS`; its parameters depend on the seed alone.

    Raises:
        HeadError: settings that it does not have.
    """
    kind, config = NETWORKS[name]
    try:
        settings = config(**settings)
    except TypeError as error:
        raise HeadError(
            "settings", str(error), f"see the fields of {config.__name__}"
        ) from error
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return kind(settings)


def save_network(folder: str | Path, network: nn.Module, told: dict) -> None:
    """Write `model.safetensors` and a readable `config.json` into a folder."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    names = {kind: name for name, (kind, _) in NETWORKS.items()}
    own = {"pose transfer": names[type(network)], "settings": network.describe()}
    config = json.dumps(own | told, indent=1)
    tensors = {k: v.cpu().contiguous() for k, v in network.state_dict().items()}
    write_tensors(folder / WEIGHTS, tensors, {"config": config})
    replace_file(folder / CONFIG, f"{config}\n".encode())


def load_network(name: str | Path) -> tuple[nn.Module, dict]:
    """A network that `train` wrote, or a shipped one, and what is told of it.

    Args:
        name: a folder, or a name in `checkpoints/`.

    Raises:
        HeadError: there is none, its training has not ended, or the file is damaged.
    """
    folder, command = trained(name), "skinlib pose train"
    with reading_finished(folder, "model", "pose transfer", command) as (
        tensors,
        metadata,
    ):
        told = json.loads(metadata["config"])
        kind, config = NETWORKS[told["pose transfer"]]
        network = kind(config(**told["settings"]))
        network.load_state_dict(tensors)
    return network.eval(), told
