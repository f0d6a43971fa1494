"""EdgeConv, forward + backward: ours against torch_geometric's, same numbers out.

    python benchmarks/edgeconv.py

Prints milliseconds (median of 15) and peak extra memory of one layer on a graph of
4,406 nodes with 14 neighbours and 96 channels. Peak memory is what the process grows
by, read by its own child process for each layer.
"""

import json
import resource
import statistics
import subprocess
import sys
import time

import torch
from torch import nn

from skinlib.model.layers import EdgeConv

NODES, NEIGHBOURS, CHANNELS = 4406, 14, 96


def layers():
    """The two layers with the same parameters, and a graph for each."""
    from torch_geometric.nn import EdgeConv as PygEdgeConv

    torch.manual_seed(0)
    ours = EdgeConv(CHANNELS, CHANNELS)
    theirs = PygEdgeConv(nn.Sequential(ours.linear, nn.ReLU()), aggr="max")
    table = torch.randint(NODES, (NODES, NEIGHBOURS))
    receivers = torch.arange(NODES).repeat_interleave(NEIGHBOURS)
    return {"ours": (ours, table), "torch_geometric": (theirs, None)}, (
        table,
        torch.stack([table.flatten(), receivers]),
    )


def measure(name: str) -> dict:
    """Milliseconds and megabytes of one layer, in this process."""
    pair, (table, edge_index) = layers()
    layer = pair[name][0]
    graph = table if name == "ours" else edge_index
    x = torch.randn(NODES, CHANNELS, requires_grad=True)
    layer(x[:32].detach(), table[:32] % 32) if name == "ours" else None
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    forward, backward = [], []
    for _ in range(15):
        began = time.perf_counter()
        out = layer(x, graph)
        middle = time.perf_counter()
        out.sum().backward()
        forward.append(middle - began)
        backward.append(time.perf_counter() - middle)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return {
        "forward_ms": round(1e3 * statistics.median(forward), 1),
        "backward_ms": round(1e3 * statistics.median(backward), 1),
        "peak_mb": round(grown / 1024, 1),
    }


def largest_difference() -> float:
    """Largest difference between the two outputs and input gradients."""
    pair, (table, edge_index) = layers()
    results = []
    x = torch.randn(NODES, CHANNELS)
    for name, graph in (("ours", table), ("torch_geometric", edge_index)):
        leaf = x.clone().requires_grad_()
        out = pair[name][0](leaf, graph)
        (gradient,) = torch.autograd.grad((out * x).sum(), leaf)
        results.append((out, gradient))
    return max((a - b).abs().max().item() for a, b in zip(*results, strict=True))


def main() -> None:
    """Measure each layer in a process of its own and print the table."""
    if len(sys.argv) == 2:
        torch.set_num_threads(2)
        print(json.dumps(measure(sys.argv[1])))
        return
    rows = {}
    for name in ("ours", "torch_geometric"):
        command = [sys.executable, __file__, name]
        rows[name] = json.loads(subprocess.check_output(command, text=True))
    ours, theirs = rows["ours"], rows["torch_geometric"]
    time_ratio = sum(theirs[k] for k in ("forward_ms", "backward_ms")) / sum(
        ours[k] for k in ("forward_ms", "backward_ms")
    )
    rows["times_faster"] = round(time_ratio, 2)
    rows["share_of_peak_memory"] = round(ours["peak_mb"] / theirs["peak_mb"], 3)
    rows["largest_difference"] = float(f"{largest_difference():.1e}")
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
