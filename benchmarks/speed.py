"""How fast a training step and a skinned head are, beside what others offer.

    python benchmarks/speed.py                       # on the processor, two threads
    python benchmarks/speed.py --device cuda         # the network alone, on a GPU

Prints JSON. On the processor, medians of `rounds` rounds in which all kinds take turns,
so that a busy machine slows all alike; beside the seconds on the clock stand those of
the processor, all threads together, which a busy machine changes less.

- training_step: forward, loss, backward and AdamW on a head of 4,400 vertices and 35
  bones, for our network and for the same one with torch_geometric's EdgeConv, which
  gives the same numbers. Peak memory is what a process of its own grows by.
- inference: skin weights of a head in memory, with 10,000 vertices and 60 bones. Of
  Blender the bare call of the operator, and all of it, with the start of the program.
- network, on a GPU: heads a second, in bfloat16, compiled, one head after another; and
  which share of the memory's bandwidth the mesh encoder uses, see `encoder_bytes`.

The heads are `data_samples/adult.glb`, remeshed, with some bones merged into others.
"""

import copy
import json
import os
import statistics
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal
from unittest.mock import patch

import numpy as np
import torch
import tyro
from torch import Tensor, nn

from skinlib import Head, HeadError
from skinlib.datasets.augment import merge_bones
from skinlib.datasets.remesh import isotropic
from skinlib.evaluate import volumetric
from skinlib.evaluate.baselines import bone_heat
from skinlib.graph import MESH
from skinlib.io import read_head
from skinlib.losses import supervised
from skinlib.model import (
    MeshInput,
    ModelConfig,
    SkeletonInput,
    SkinningModel,
    prepare,
)
from skinlib.model.mesh_encoder import MESH_FEATURES
from skinlib.paths import DEFAULT_CHECKPOINT, sample
from skinlib.training import TrainConfig, load_model

OPERATOR = 'bpy.ops.object.parent_set(type="ARMATURE_AUTO")'
MISSING = "torch_geometric is not installed"


Part = Literal["training_step", "inference", "network"]


@dataclass(frozen=True)
class Config:
    """How fast a training step and a skinned head are, beside what others offer."""

    device: str = "cpu"  # of the part "network"
    parts: tuple[Part, ...] | None = None  # None: as the device asks, see above
    threads: int = 2  # of the processor
    rounds: int = 9  # of which the median is taken
    step_vertices: int = 4400  # of the head of the training step
    step_bones: int = 35
    vertices: int = 10_000  # of the head that is skinned on the processor
    bones: int = 60
    gpu_vertices: int = 5000  # of the heads that are skinned on a GPU
    gpu_heads: int = 16  # different heads, one after another


def resized(vertices: int, bones: int, seed: int = 0) -> Head:
    """The adult sample with about so many vertices, and at most so many bones."""
    head = isotropic(read_head(sample("adult.glb")), seed, vertices)
    while len(head.skeleton) > bones:
        parents = head.skeleton.parents
        leaves = np.setdiff1d(np.flatnonzero(parents >= 0), parents)
        spare = leaves[: len(parents) - bones]
        head = merge_bones(head, np.isin(np.arange(len(parents)), spare))
    return head


def turns(kinds: dict[str, Callable[[], object]], rounds: int) -> dict[str, dict]:
    """Median seconds of each kind, on the clock and of the processor, after a first."""
    clock, used = ({name: [] for name in kinds} for _ in range(2))
    for _ in range(rounds + 1):
        for name, function in kinds.items():
            began, began_used = time.perf_counter(), time.process_time()
            function()
            clock[name].append(time.perf_counter() - began)
            used[name].append(time.process_time() - began_used)
    return {
        name: {
            "seconds": round(statistics.median(clock[name][1:]), 5),
            "processor_seconds": round(statistics.median(used[name][1:]), 5),
        }
        for name in kinds
    }


# ---------------------------------------------------------------- a training step


class GeometricEdgeConv(nn.Module):
    """torch_geometric's EdgeConv in the place of ours: one row an edge.

    Args:
        linear: the parameters. edges: (2, E) senders and receivers.
    """

    def __init__(self, linear: nn.Linear, edges: Tensor):
        super().__init__()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it uses torch.jit, now deprecated
            from torch_geometric.nn import EdgeConv

        # It draws new parameters for what it is given.
        message = nn.Sequential(copy.deepcopy(linear), nn.ReLU())
        self.layer = EdgeConv(message, aggr="max")
        message[0].load_state_dict(linear.state_dict())
        self.edges = edges

    def forward(self, x: Tensor, _neighbours: Tensor) -> Tensor:
        """(N, C) -> (N, C)."""
        return self.layer(x, self.edges)


def geometric(model: SkinningModel, mesh: MeshInput) -> SkinningModel:
    """A copy of the network with torch_geometric's graph layers, for one mesh.

    Raises:
        ImportError: torch_geometric is not installed.
    """
    twin = copy.deepcopy(model)
    for place, layer in enumerate(twin.mesh_encoder.local):
        used = mesh.used if place % 2 else mesh.kinds == MESH
        used = used.clone()
        used[:, 0] = True  # a node without neighbours hears itself
        receivers, column = used.nonzero(as_tuple=True)
        edges = torch.stack([mesh.neighbours[receivers, column], receivers])
        twin.mesh_encoder.local[place] = GeometricEdgeConv(layer.linear, edges)
    return twin


class Step:
    """A training step of our network, or of its twin, on one head."""

    def __init__(self, mesh: MeshInput, skeleton: SkeletonInput, twin: bool):
        torch.manual_seed(0)
        self.mesh, self.skeleton = mesh, skeleton
        self.model = SkinningModel()
        count = len(mesh.positions)
        self.nodes = torch.randperm(count)[: TrainConfig().judged_nodes]
        self.target = torch.rand(len(self.nodes), len(skeleton.joints)).softmax(dim=1)
        if twin:
            self.model = geometric(self.model, mesh)
        self.optimizer = torch.optim.AdamW(self.model.parameters())

    def gradients(self) -> tuple[Tensor, list[Tensor]]:
        """Logits of the judged nodes, and the gradient of each parameter."""
        logits = self.model.node_logits(self.mesh, self.skeleton, self.nodes)
        loss = supervised(logits, self.target)
        parameters = list(self.model.parameters())
        return logits, list(torch.autograd.grad(loss, parameters))

    def __call__(self) -> None:
        """One step."""
        _, gradients = self.gradients()
        for parameter, gradient in zip(self.model.parameters(), gradients, strict=True):
            parameter.grad = gradient
        self.optimizer.step()


def differences(ours: Step, twin: Step) -> dict[str, float]:
    """Largest difference of the outputs, and of the gradients beside the largest one.

    Raises:
        AssertionError: outputs differ by 1e-5 or more: it is not the same network.
    """
    (mine, my_slopes), (theirs, slopes) = ours.gradients(), twin.gradients()
    output = (mine.softmax(1) - theirs.softmax(1)).abs().max().item()
    assert output < 1e-5, f"the two networks differ by {output}"
    pairs = zip(my_slopes, slopes, strict=True)
    slope = max((a - b).abs().max().item() for a, b in pairs)
    slope /= max(b.abs().max().item() for b in slopes)
    return {"outputs": float(f"{output:.1e}"), "gradients": float(f"{slope:.1e}")}


def step_memory(inputs: tuple, twin: bool, threads: int) -> float:
    """Megabytes by which this process grows in three steps."""
    torch.set_num_threads(threads)
    step = Step(*inputs, twin)
    before = peak_megabytes()
    for _ in range(3):
        step()
    return round(peak_megabytes() - before, 1)


def peak_megabytes() -> float:
    """The most memory that this process has held; nan where there is no /proc.

    Not `ru_maxrss`, which begins with what the process that started this one held.
    """
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    found = [line.split()[1] for line in lines if line.startswith("VmHWM:")]
    return int(found[0]) / 1024 if found else float("nan")


def in_a_process_of_its_own(function: Callable, *arguments):
    """The result of a function that a fresh process computes."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def training_step(config: Config) -> dict:
    """Our training step beside that of the network made of torch_geometric's layers."""
    inputs = prepare(resized(config.step_vertices, config.step_bones))
    ours = Step(*inputs, twin=False)
    try:
        twin = Step(*inputs, twin=True)
    except ImportError:
        return turns({"ours": ours}, config.rounds) | {"torch_geometric": MISSING}
    found = differences(ours, twin)
    rows = turns({"ours": ours, "torch_geometric": twin}, config.rounds)
    for name, row in rows.items():
        row["peak_mb"] = in_a_process_of_its_own(
            step_memory, inputs, name != "ours", config.threads
        )
    return rows | {
        "times_faster": ratios(rows["torch_geometric"], rows["ours"]),
        "largest_difference": found,
    }


def ratios(slow: dict, fast: dict) -> dict[str, float]:
    """How many times larger each number is."""
    return {
        name: round(slow[name] / fast[name], 2) for name in fast if fast[name] and slow
    }


# ---------------------------------------------------------------- a skinned head


def blender_seconds(head: Head) -> dict[str, float]:
    """Seconds of Blender's operator by itself, and of Blender from start to end.

    Raises:
        HeadError: there is no Blender.
    """
    source = volumetric.SCRIPT.read_text()
    assert OPERATOR in source, "the operator is called in another way now"
    with TemporaryDirectory() as folder:
        answer, script = Path(folder, "seconds"), Path(folder, "script.py")
        lines = (
            "import time",
            "began = time.perf_counter(), time.process_time()",
            OPERATOR,
            "spent = time.perf_counter() - began[0], time.process_time() - began[1]",
            f"np.savetxt({str(answer)!r}, spent)",
        )
        script.write_text(source.replace(OPERATOR, "\n    ".join(lines)))
        with patch.object(volumetric, "SCRIPT", script):
            began = time.perf_counter()
            weights = volumetric.blender_weights(head)
            whole = time.perf_counter() - began
        seconds, processor = np.loadtxt(answer)
    return {
        "seconds": round(seconds, 4),
        "processor_seconds": round(processor, 4),
        "whole_program_seconds": round(whole, 3),
        "vertices_without_weight": int((weights.sum(axis=1) == 0).sum()),
    }


def inference(config: Config) -> dict:
    """Seconds a head for our network and for three methods without one."""
    head, model = resized(config.vertices, config.bones), load_model(DEFAULT_CHECKPOINT)
    rows = turns(
        {
            "skinlib": lambda: model.predict(head),
            "skinlib, graph and features alone": lambda: prepare(head),
            "bone_heat": lambda: bone_heat(head),
        },
        config.rounds,
    )
    try:
        runs = [blender_seconds(head) for _ in range(min(3, config.rounds))]
        rows["blender_automatic"] = {
            name: statistics.median(run[name] for run in runs) for name in runs[0]
        }
    except HeadError as error:
        rows["blender_automatic"] = str(error)
    solve = {"bounded_biharmonic": lambda: volumetric.bounded_biharmonic(head)}
    rows |= turns(solve, rounds=1)
    ours = rows["skinlib"]
    rivals = ("bone_heat", "blender_automatic", "bounded_biharmonic")
    return rows | {
        "vertices": len(head.vertices),
        "bones": len(head.skeleton),
        "times_faster": {
            name: ratios(rows[name], ours)
            for name in rivals
            if not isinstance(rows[name], str)
        },
    }


# ---------------------------------------------------------------- a GPU


def encoder_bytes(config: ModelConfig, nodes: int, neighbours: int, size: int) -> dict:
    """The least bytes that the mesh encoder has to read and write, by layer.

    Each part reads its weights once, its input once (or twice where a sum over all
    nodes comes before what is done to each), and writes its output once. Nothing else
    is counted: not what stays on the chip when a part is one kernel, nor a neighbour's
    row more than once. So the share of the bandwidth is never said to be too high.

    Args:
        nodes, neighbours: N and K of the graph. size: bytes of a number; a neighbour's
            id takes 8.
    """
    channels, points = config.mesh_width, config.points
    rows, square = nodes * channels, channels**2
    embed = nodes * MESH_FEATURES + rows + (MESH_FEATURES + channels) * channels
    # EdgeConv with its norm and its sum, two a block: x in, x out.
    convolution = 2 * rows + 2 * square
    # The islands' means, a linear layer, the sum: x in twice, x out.
    pool = 3 * rows + square
    # The points read x; then x reads the points: two attentions of four matrices, two
    # feed-forward layers of two matrices of twice the width.
    induced = 3 * rows + (2 * 4 + 2 * 4) * square + 4 * points * channels
    numbers = {
        "embed": embed,
        "edge convolutions": 2 * config.blocks * convolution,
        "island means": config.blocks * pool,
        "induced Transformers": config.blocks * induced,
        "last norm": 2 * rows,
    }
    layers = {name: size * number for name, number in numbers.items()}
    layers["edge convolutions"] += 2 * config.blocks * nodes * neighbours * 8
    return layers


def bandwidth(device: str, megabytes: int = 1024) -> float:
    """Bytes a second that a copy within the device's memory reads and writes."""
    source = torch.zeros(megabytes << 20, dtype=torch.uint8, device=device)
    target = torch.zeros_like(source)
    return 2 * len(source) / seconds_on(device, lambda: target.copy_(source), 9)


def seconds_on(device: str, function: Callable[[], object], rounds: int) -> float:
    """Median seconds of a call, until the device has done its work."""
    wait = torch.cuda.synchronize if device.startswith("cuda") else lambda: None
    function()
    seconds = []
    for _ in range(rounds):
        wait()
        began = time.perf_counter()
        function()
        wait()
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds)


@torch.inference_mode()
def network(config: Config) -> dict:
    """Heads a second of the network on a device, and the encoder's share of bandwidth.

    In bfloat16; compiled, unless the device is a processor.
    """
    device, on_gpu = config.device, not config.device.startswith("cpu")
    model = load_model(DEFAULT_CHECKPOINT).to(device)
    heads = [
        resized(config.gpu_vertices, config.bones, seed)
        for seed in range(config.gpu_heads)
    ]
    inputs = [[part.to(device) for part in prepare(head)] for head in heads]
    compiled = partial(torch.compile, dynamic=True) if on_gpu else lambda module: module
    encoder, whole = compiled(model.mesh_encoder), compiled(model)
    half = torch.autocast(torch.device(device).type, torch.bfloat16)
    with half:
        encoded = seconds_on(
            device, lambda: [encoder(mesh) for mesh, _ in inputs], config.rounds
        )
        skinned = seconds_on(
            device, lambda: [whole(*part) for part in inputs], config.rounds
        )
    exact = [model(*part) for part in inputs]
    with half:
        rounded = [whole(*part) for part in inputs]
    apart = [(a - b).abs().sum(1).mean() for a, b in zip(exact, rounded, strict=True)]
    prepared = seconds_on("cpu", lambda: [prepare(head) for head in heads], 3)
    shapes = [mesh.neighbours.shape for mesh, _ in inputs]
    counted = [encoder_bytes(model.config, *shape, size=2) for shape in shapes]
    moved, most = sum(sum(layers.values()) for layers in counted), bandwidth(device)
    return {
        "device": torch.cuda.get_device_name() if on_gpu else device,
        "vertices": round(statistics.mean(len(head.vertices) for head in heads)),
        "heads_a_second": round(len(heads) / skinned, 1),
        "heads_a_second_with_graphs_on_the_processor": round(
            len(heads) / (skinned + prepared), 1
        ),
        "row_l1_of_bfloat16": round(torch.stack(apart).mean().item(), 5),
        "encoder_megabytes_a_head": round(moved / len(heads) / 1e6, 2),
        "encoder_bytes_of_a_head": counted[0],
        "encoder_gigabytes_a_second": round(moved / encoded / 1e9, 2),
        "copy_gigabytes_a_second": round(most / 1e9, 1),
        "share_of_bandwidth": round(moved / encoded / most, 4),
    }


def main(config: Config) -> None:
    """Measure and print."""
    torch.set_num_threads(config.threads)
    on_gpu = not config.device.startswith("cpu")
    usual = ("network",) if on_gpu else ("training_step", "inference")
    result = {"config": asdict(config), "load": os.getloadavg()}
    for part in (training_step, inference, network):
        if part.__name__ in (config.parts or usual):
            result[part.__name__] = part(config)
    result["load_after"] = os.getloadavg()
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main(tyro.cli(Config))
