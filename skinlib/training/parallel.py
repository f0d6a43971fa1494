"""Several processes, one run: the same result as one process, sooner.

    torchrun --nproc-per-node 2 -m skinlib train --labelled HEADS --out OUT

Each process differentiates its share of a step's heads. All gradients go to all
processes, which sum them in the order of the heads, not of the processes, and take the
same step. So the number of processes changes the time, not the result.
"""

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace

import torch
import torch.distributed as dist
from torch import Tensor

from skinlib.losses import TermWeights
from skinlib.training.config import TrainConfig

TERMS = [field.name for field in fields(TermWeights)]
SCORES = [f"adversarial_{u}_{kind}" for u in "su" for kind in ("real", "fake")]
SHOWN = ["row_l1", "guess_row_l1", *TERMS, *SCORES]  # the numbers of a head, in order

Part = tuple[list[Tensor], dict[str, float]]  # gradients, numbers to show


@contextlib.contextmanager
def processes(config: TrainConfig) -> Iterator[TrainConfig]:
    """Join the processes that `torchrun` started, if it did; each gets its device."""
    if "WORLD_SIZE" not in os.environ or dist.is_initialized():
        yield config
        return
    cuda = config.device.startswith("cuda")
    if cuda:
        config = replace(config, device=f"cuda:{os.environ['LOCAL_RANK']}")
        torch.cuda.set_device(config.device)
    dist.init_process_group("nccl" if cuda else "gloo")
    try:
        yield config
    finally:
        dist.destroy_process_group()


def place() -> tuple[int, int]:
    """(number of this process, number of processes)."""
    if dist.is_initialized():
        return dist.get_rank(), dist.get_world_size()
    return 0, 1


def is_first() -> bool:
    """Whether this process writes the files."""
    return place()[0] == 0


def share_draws(draws: Sequence[int]) -> Sequence[int]:
    """The draws of this process: every `size`-th one."""
    rank, size = place()
    return draws[rank::size]


def gather_draws(
    mine: Sequence[Part], count: int, like: Sequence[Tensor]
) -> list[Part]:
    """The parts of all draws of a step, in their order, in every process.

    Args:
        mine: the parts of `share_draws`. count: draws in all. like: the parameters.
    """
    size = place()[1]
    if size == 1:
        return list(mine)
    # Processes may have one draw more or less; a row of zeros fills up.
    rows = -(-count // size)
    width = sum(parameter.numel() for parameter in like)
    flat = like[0].new_zeros(rows, width)
    shown = like[0].new_full((rows, len(SHOWN)), torch.nan, dtype=torch.float64)
    for row, (gradients, numbers) in enumerate(mine):
        flat[row] = torch.cat([gradient.flatten() for gradient in gradients])
        for name, value in numbers.items():
            shown[row, SHOWN.index(name)] = value
    every_flat, every_shown = _all_gather(flat, size), _all_gather(shown, size)
    return [
        (
            _unflatten(every_flat[draw % size][draw // size], like),
            _named(every_shown[draw % size][draw // size]),
        )
        for draw in range(count)
    ]


def from_first(value: float) -> float:
    """The first process's value, so that all stop at the same step."""
    if place()[1] == 1:
        return value
    device = "cuda" if dist.get_backend() == "nccl" else "cpu"
    shared = torch.tensor(value, dtype=torch.float64, device=device)
    dist.broadcast(shared, 0)
    return shared.item()


def wait() -> None:
    """Until every process is here."""
    if place()[1] > 1:
        dist.barrier()


def _all_gather(tensor: Tensor, size: int) -> list[Tensor]:
    every = [torch.zeros_like(tensor) for _ in range(size)]
    dist.all_gather(every, tensor)
    return every


def _unflatten(flat: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    parts = flat.split([parameter.numel() for parameter in like])
    return [part.view_as(p) for part, p in zip(parts, like, strict=True)]


def _named(row: Tensor) -> dict[str, float]:
    pairs = zip(SHOWN, row.tolist(), strict=True)
    return {name: value for name, value in pairs if value == value}
