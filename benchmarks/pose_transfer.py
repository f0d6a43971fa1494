"""Pose transfer: DSFFNet, NPT, 3D-CoreNet and a skeleton, on bodies of `anny`.

    python benchmarks/pose_transfer.py runs/pose
    python benchmarks/pose_transfer.py runs/pose --only full --device cuda

Sixteen identities in 400 poses train; fourteen others judge, in the same poses and in
400 that nobody has learnt. Runs go on where they stopped; the numbers of each part are
in OUT/PART.json.
"""

import json
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import igl
import numpy as np
import torch
import tyro
from torch import nn
from tqdm.auto import tqdm

from skinlib.datasets.anny import anny_heads
from skinlib.datasets.remesh import halve, shuffle, subdivide
from skinlib.garments.measures import joined
from skinlib.head import Head
from skinlib.io import write_head
from skinlib.pose_transfer.data import (
    Cast,
    PosePairs,
    anny_bodies,
    normalised,
    on_mesh,
    size_by_edges,
)
from skinlib.pose_transfer.losses import pose_edge, pose_reconstruction
from skinlib.pose_transfer.metrics import Scores, mean_scores, score
from skinlib.pose_transfer.networks import NETWORKS, parameter_kb
from skinlib.pose_transfer.population import OTHERS, Population, judging, npt_poses
from skinlib.pose_transfer.refine import as_rigid_as_possible
from skinlib.pose_transfer.through_skeleton import apply_pose, fit_cloud, fit_pose
from skinlib.pose_transfer.training import (
    TransferConfig,
    TransferTrainer,
    load_network,
    make_network,
    train,
)
from skinlib.pose_transfer.transfer import judge

QUICK = Population("anny", (369,))
FULL = Population("anny", (1229,))
# On, until the best is not the last.
RATES = {
    "dsffnet": (5e-4, 1e-3, 2e-3, 4e-3, 8e-3),
    "npt": (2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3),
    "corenet": (5e-4, 1e-3, 2e-3, 4e-3, 8e-3),
}
SEEDS = (0, 1, 2)
NARROW = {
    "dsffnet": {"width": 256, "encoder": 32},
    "npt": {"width": 256, "encoder": 32},
    "corenet": {"width": 256},
}
ABLATIONS = {
    "full": {},
    "SPAdaIN in place of each first FFAdaIN": {"settings": {"spadain_first": True}},
    "no side of the target": {"settings": {"target_side": False}},
    "no edges in the loss": {"edge_weight": 0.0},
}
LONG_RUNS = {
    "dsffnet": {},
    "npt": {},
    "corenet": {},
    "dsffnet_from_half": {"alpha_init": 0.5},
    "dsffnet_by_vertex": {"by_area": False},
    "npt_by_area": {"by_area": True},
}
NOISE = (0.01, 0.02, 0.05)
LONG = 4000  # steps of the narrow network that meshes and noise are tried on
JUDGED = 400  # pairs


@dataclass(frozen=True)
class Bench:
    """Where it is written, and how it is computed."""

    out: Path
    threads: int = 1
    device: str = "cpu"
    kept: dict = field(default_factory=dict)

    def casts(self, population: Population) -> list[Cast]:
        """Who trains; drawn once."""
        key = str(population)
        if key not in self.kept:
            self.kept[key] = population.casts("train", self.device)
        return self.kept[key]

    def tests(self, population: Population, **settings) -> dict[str, list[PosePairs]]:
        """Pairs in poses that were learnt and in others."""
        key = f"{population} {settings}"
        if key not in self.kept:
            both = judging(population, JUDGED, **settings)
            self.kept[key] = dict(zip(("seen", "unseen"), both, strict=True))
        return self.kept[key]

    def trained(self, name: str, population: Population, **settings) -> nn.Module:
        """The network of a run, which may have ended before."""
        config = TransferConfig(
            **{"threads": self.threads, "device": self.device} | settings
        )
        told = {"population": population.describe()}
        return train(config, self.casts(population), self.out / name, told)

    def judged(self, network: nn.Module | None, tests: dict) -> dict[str, dict]:
        """The scores of seen and unseen poses."""
        return {name: asdict(judge(network, kinds)) for name, kinds in tests.items()}


def narrow(
    name: str,
    rate: float = 2e-3,
    seed: int = 0,
    steps: int = 400,
    settings: dict | None = None,
    **changes,
) -> dict:
    """A run of a network with a fifteenth of the parameters; `settings` are its."""
    return changes | {
        "network": name,
        "settings": NARROW[name] | (settings or {}),
        "learning_rate": rate,
        "seed": seed,
        "steps": steps,
    }


# --- the parts ------------------------------------------------------------------------


def quick(bench: Bench) -> dict:
    """All methods, 400 steps: every learning rate, and the best with two more seeds."""
    tests = bench.tests(QUICK)
    found = {"copy": bench.judged(None, tests)}
    for name in NARROW:
        for rate in RATES[name]:
            run = f"quick/{name}_{rate:g}_0"
            network = bench.trained(run, QUICK, **narrow(name, rate))
            found[f"{name} {rate:g} 0"] = bench.judged(network, tests)
        # By poses that were learnt: those that were not are for the report.
        best = min(RATES[name], key=lambda r: found[f"{name} {r:g} 0"]["seen"]["pmd"])
        for seed in SEEDS[1:]:
            run = f"quick/{name}_{best:g}_{seed}"
            network = bench.trained(run, QUICK, **narrow(name, best, seed))
            found[f"{name} {best:g} {seed}"] = bench.judged(network, tests)
        found[f"{name} best rate"] = best
    for seed in SEEDS:
        settings = narrow("dsffnet", found["dsffnet best rate"], seed, mirrored=True)
        network = bench.trained(f"quick/mirrored_{seed}", QUICK, **settings)
        found[f"dsffnet, mirrored, {seed}"] = bench.judged(network, tests)
    return found


def start(bench: Bench) -> dict:
    """Alpha and beta at 0, as in the source, and at 0.5, and the source's schedule."""
    tests, found = bench.tests(QUICK), {}
    variants = {
        "0.5": {"settings": {"alpha_init": 0.5}},
        "0": {"settings": {"alpha_init": 0.0}},
        "0.5, the source's rate": {"rate": 1e-3, "falls": 25},
        "0, the source's rate": {
            "rate": 1e-3,
            "falls": 25,
            "settings": {"alpha_init": 0.0},
        },
    }
    for label, changes in variants.items():
        for seed in SEEDS:
            run = f"start/{label}_{seed}".replace(" ", "_").replace("'", "")
            settings = narrow("dsffnet", seed=seed, **changes)
            network = bench.trained(run, QUICK, **settings)
            history = json.loads((bench.out / run / "history.json").read_text())
            found[f"{label} {seed}"] = bench.judged(network, tests) | {
                "training PMD": [entry["PMD e-4"] for entry in history],
                "mixing": network.mixing().tolist(),
            }
    return found


def ablations(bench: Bench) -> dict:
    """The source's table 3, three seeds each, at 400 and at 800 steps."""
    tests, found = bench.tests(QUICK), {}
    for steps in (400, 800):
        for label, changes in ABLATIONS.items():
            for seed in SEEDS:
                run = f"ablations/{label.replace(' ', '_')}_{steps}_{seed}"
                settings = narrow("dsffnet", seed=seed, steps=steps, **changes)
                network = bench.trained(run, QUICK, **settings)
                found[f"{label} {steps} {seed}"] = bench.judged(network, tests)
    return found


def long(bench: Bench) -> dict:
    """Narrow networks for as long as a CPU allows."""
    found = {}
    for run, changes in LONG_RUNS.items():
        settings = narrow(run.partition("_")[0], steps=LONG, settings=changes)
        network = bench.trained(f"long/{run}", QUICK, **settings)
        found[run] = bench.judged(network, bench.tests(QUICK))
    # 3D-CoreNet's steps take three times as long, and time is what one has.
    settings = narrow("dsffnet", steps=3 * LONG)
    network = bench.trained("long/dsffnet_3x", QUICK, **settings)
    found["dsffnet, three times the steps"] = bench.judged(network, bench.tests(QUICK))
    found["copy"] = bench.judged(None, bench.tests(QUICK))
    return found


def meshes(bench: Bench) -> dict:
    """Other meshes than those that were trained on, as targets and as sources."""
    casts, found = other_meshes(), {}
    native, _ = casts["native"]
    for run in LONG_RUNS:
        network, _ = load_network(bench.out / "long" / run)
        for label, (cast, _) in casts.items():
            kinds = {"target": (native, cast), "source": (cast, native)}
            for role, (sources, targets) in kinds.items():
                size = sources.rest.shape[1] * targets.rest.shape[1]
                if run == "corenet" and size > 2_000_000:
                    continue  # its plan would take minutes
                pairs = PosePairs(sources, targets, 60, 5, poses=range(400, 800))
                found[f"{run}: {label} as {role}"] = asdict(judge(network, [pairs], 4))
    return found


def other_meshes() -> dict[str, tuple[Cast, Head]]:
    """Those who judge, in the same poses on other meshes, and each mesh."""
    first, judges = QUICK.heads("train")[0], QUICK.heads("judge")
    motion = joined([npt_poses(first.skeleton, 400, seed) for seed in (0, OTHERS)])
    native = quick_mesh()
    kinds = {
        "native": native,
        "halved": halve(native, 0),
        "subdivided": subdivide(native, 0),
        "1,229 vertices": _coarse(first, 1229),
        "12,272 vertices": shuffle(first, 0),
    }
    casts = {
        label: (Cast(on_mesh(judges, first, mesh), motion), mesh)
        for label, mesh in kinds.items()
    }
    soma = anny_bodies(14, OTHERS, "soma")
    casts["soma, 18,056"] = (Cast(soma, motion), soma[0])
    return casts


def quick_mesh() -> Head:
    """The mesh of 369 vertices, of the first who trains."""
    return _coarse(QUICK.heads("train")[0], 369)


def _coarse(head: Head, vertices: int) -> Head:
    """As `Population` does it with seed 0."""
    rng = np.random.default_rng((0, 0))
    return halve(head, rng, vertices / len(head.vertices))


def noise(bench: Bench) -> dict:
    """Noise on the sources, for networks that learnt without it, and one with."""
    casts = bench.casts(QUICK)
    config = TransferConfig(**narrow("dsffnet", steps=LONG), threads=bench.threads)
    trainer = TransferTrainer(config, casts, bench.out / "noise" / "learnt")
    trainer.pairs.append(PosePairs(*casts, *casts, LONG * config.batch, noise=0.05))
    trainer.run()  # half of the steps are drawn from either
    runs = {run: f"long/{run}" for run in LONG_RUNS} | {"learnt": "noise/learnt"}
    found = {}
    for run, folder in runs.items():
        network, _ = load_network(bench.out / folder)
        for amount in (0.0, *NOISE):
            tests = bench.tests(QUICK, noise=amount)
            found[f"{run} {amount:g}"] = bench.judged(network, tests)
    return found


def shape(bench: Bench) -> dict:
    """What keeping the target's shape gives, after the network."""
    found = {}
    for run in ("dsffnet", "npt", "corenet"):
        network, _ = load_network(bench.out / "long" / run)
        for label in ("seen", "unseen"):
            some = bench.tests(QUICK)[label][0].batch(range(200))
            with torch.inference_mode():
                posed = network(*some.inputs)
            for reach in (0.0, 0.03, 0.07, 0.15):
                scores = []
                for i, points in enumerate(posed.numpy()):
                    edges, own = some.edges[i].numpy(), some.identity[i].numpy()
                    points = points * size_by_edges(points, own, edges)
                    points = as_rigid_as_possible(points, own, edges, reach)
                    rest = (some.truth[i].numpy(), edges, some.height[i].item())
                    scores.append(score(normalised(points)[0], *rest))
                found[f"{run}, {label}, reach {reach:g}"] = asdict(mean_scores(scores))
    return found


def skeleton(bench: Bench) -> dict:
    """The same task through bones: what is known decides."""
    judges, first = QUICK.heads("judge"), QUICK.heads("train")[0]
    heads = on_mesh(judges, first, quick_mesh())
    known = npt_poses(first.skeleton, 400, 0)
    network, _ = load_network(bench.out / "long" / "dsffnet")
    pairs = bench.tests(QUICK)["unseen"][0].batch(range(40))
    with torch.inference_mode():
        posed = network(*pairs.inputs).numpy()
    found: dict[str, list[Scores]] = {}
    for i in tqdm(range(len(posed)), "through bones", unit="pair"):
        source, _, target, _ = pairs.who[i].tolist()
        cloud, order = pairs.source[i].numpy(), pairs.order[i].numpy()
        ordered = cloud[pairs.source_order[i].argsort().numpy()]
        fits = {
            "rest pose known": fit_pose(heads[source], ordered, scaled=True),
            "cloud, from rest": fit_cloud(heads[target], cloud, True, starts=1),
            "cloud, from known poses": fit_cloud(
                heads[target], cloud, True, poses=known
            ),
        }
        results = {"dsffnet": posed[i], "copy": pairs.identity[i].numpy()}
        for label, fit in fits.items():
            results[label] = normalised(apply_pose(fit, heads[target])[order])[0]
        rest = pairs.truth[i].numpy(), pairs.edges[i].numpy(), pairs.height[i].item()
        for label, points in results.items():
            found.setdefault(label, []).append(score(points, *rest))
    return {
        label: asdict(mean_scores(scores))
        | {"median pmd": statistics.median(one.pmd for one in scores)}
        for label, scores in found.items()
    }


def contact(bench: Bench) -> dict:
    """Limbs that the result puts into the body: the source's first limit."""
    network, _ = load_network(bench.out / "long" / "dsffnet")
    pairs = bench.tests(QUICK)["unseen"][0].batch(range(200))
    with torch.inference_mode():
        posed = network(*pairs.inputs)
    rows = [
        (_doubled(p, f), _doubled(t, f))
        for p, t, f in zip(
            posed.double().numpy(),
            pairs.truth.double().numpy(),
            pairs.faces.numpy(),
            strict=True,
        )
    ]
    mine, true = np.mean(rows, axis=0)
    return {"result, % doubled": mine, "truth, % doubled": true}


def _doubled(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Percent of the vertices that are inside the body a second time."""
    normals = igl.per_vertex_normals(vertices, faces)
    winding = igl.fast_winding_number(vertices, faces, vertices - 0.01 * normals)
    return float(100 * (winding > 1.5).mean())


class Unsupervised(TransferTrainer):
    """Training that never sees somebody in the pose of somebody else.

    The result, given back its own pose, has to be what it was made from; somebody in
    his own pose has to stay; edges keep their lengths.
    """

    def step(self) -> dict[str, float]:
        """One step; `TransferTrainer.step` with another loss."""
        batch = self.config.batch
        items = range(self.steps_done * batch, (self.steps_done + 1) * batch)
        pairs = self.pairs[0].batch(items)
        posed = self.network(*pairs.inputs)
        own = pairs.share, pairs.share
        back = self.network(pairs.identity, posed, *own)
        still = self.network(pairs.identity, pairs.identity, *own)
        loss = (
            pose_reconstruction(back, pairs.identity)
            + pose_reconstruction(still, pairs.identity)
            + self.config.edge_weight * pose_edge(posed, pairs.identity, pairs.edges)
        )
        self.optimizer.zero_grad()
        loss.backward()
        told = {"loss": loss.item()}
        self._update(told)
        return told


class OnePerson(PosePairs):
    """Pairs of one person in two poses: truth that any sequence of scans has."""

    def _drawn(self, item: int) -> tuple[np.ndarray, ...]:
        who, *rest = super()._drawn(item)
        who[2] = who[0]
        return who, *rest


def unsupervised(bench: Bench) -> dict:
    """The source's second limit, the need for truth: two ways to do without."""
    tests, found = bench.tests(QUICK), {}
    settings = narrow("dsffnet", steps=800) | {"threads": bench.threads}
    casts = bench.casts(QUICK)
    for weight in (0.0005, 0.05):
        config = TransferConfig(**settings | {"edge_weight": weight})
        trainer = Unsupervised(config, casts, bench.out / f"unsupervised/{weight:g}")
        found[f"cycle, edges {weight:g}"] = bench.judged(trainer.run(), tests)
    trainer = TransferTrainer(
        TransferConfig(**settings), casts, bench.out / "unsupervised" / "one_person"
    )
    trainer.pairs = [OnePerson(*casts, *casts, 800 * 8)]
    found["one person in two poses"] = bench.judged(trainer.run(), tests)
    return found


def faces(bench: Bench) -> dict:
    """Heads with expressions: 16 to learn, 5 to judge, bones turned at random."""
    folder = bench.out / "faces" / "heads"
    if not folder.exists():
        heads = anny_heads(21)
        folder.mkdir(parents=True)
        for head in heads:
            write_head(folder / f"{head.name}.npz", head)
    population = Population(str(folder), (500,), limits="wide")
    found = {"copy": bench.judged(None, bench.tests(population))}
    for run in ("dsffnet", "dsffnet_by_vertex", "npt"):
        settings = narrow(run.partition("_")[0], steps=800, settings=LONG_RUNS[run])
        network = bench.trained(f"faces/{run}", population, **settings)
        found[run] = bench.judged(network, bench.tests(population))
    return found


def speed(bench: Bench) -> dict:
    """Parameters, and milliseconds for one pair of 6,890 vertices each."""
    found = {}
    device = torch.device(bench.device)
    torch.set_num_threads(2)
    points = 2 * torch.rand(2, 1, 6890, 3, device=device) - 1
    shares = points.new_full((2, 1, 6890), 1 / 6890)
    networks = {name: make_network(name, {}, 0).eval().to(device) for name in NETWORKS}
    times: dict[str, list[float]] = {name: [] for name in networks}
    with torch.inference_mode():
        for repeat in range(21):
            for name, network in networks.items():  # by turns, as machines drift
                began = time.perf_counter()
                network(*points, *shares)
                if device.type == "cuda":
                    torch.cuda.synchronize()
                if repeat:
                    times[name].append(1000 * (time.perf_counter() - began))
    for name, network in networks.items():
        found[name] = {
            "KB": parameter_kb(network),
            "ms": statistics.median(times[name]),
        }
    return found


def full(bench: Bench) -> dict:
    """All methods at full width, 51,200 steps: a GPU's work."""
    tests, found = bench.tests(FULL), {}
    found["copy"] = bench.judged(None, tests)
    for name in NETWORKS:
        settings = {"network": name, "learning_rate": 1e-3}
        network = bench.trained(f"full/{name}", FULL, **settings)
        found[name] = bench.judged(network, tests)
    return found


PARTS: dict[str, Callable[[Bench], dict]] = {
    part.__name__: part
    for part in (
        *(quick, start, ablations, long, meshes, noise),
        *(shape, skeleton, contact, unsupervised, faces, speed, full),
    )
}


def main(
    out: tyro.conf.Positional[Path],
    *,
    only: tuple[str, ...] = tuple(part for part in PARTS if part != "full"),
    threads: int = 1,
    device: str = "cpu",
) -> None:
    """Train and judge, or go on where it stopped.

    Args:
        out: Folder for networks and numbers.
        only: These parts.
        threads: CPU cores to use.
        device: Such as cuda.
    """
    torch.set_num_threads(threads)
    bench = Bench(out, threads, device)
    for name in only:
        found = PARTS[name](bench)
        path = out / f"{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found, indent=1) + "\n")
        print(name)
        for label, values in found.items():
            print(f"  {label}: {_told(values)}")


def _told(values) -> str:
    if isinstance(values, dict) and "seen" in values:
        pmd = [1e4 * values[kind]["pmd"] for kind in ("seen", "unseen")]
        return "PMD e-4, seen and unseen: {:.1f} {:.1f}".format(*pmd)
    if isinstance(values, dict) and "pmd" in values:
        middle = values.pop("median pmd", None)
        line = Scores(**values).line()
        return line if middle is None else f"{line}, median PMD {1e4 * middle:.3g} e-4"
    return str(values)


if __name__ == "__main__":
    tyro.cli(main)
