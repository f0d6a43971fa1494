"""Training: heads in, a checkpoint out; it can be stopped at any step and goes on.

Step s of a run depends on the seed, s and the parameters, on nothing else: each head is
drawn, disturbed and differentiated by itself, on one thread, and the gradients are
summed in a fixed order. So a run in steps that was interrupted ends in the same bits as
one that was not, and the number of threads changes the time, not the result. In a run
in minutes the clock decides how many steps there are, and how they cool down.
"""

import copy
import json
import time
import zlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim import AdamW, Muon
from tqdm.auto import tqdm

from skinlib.datasets.augment import augment
from skinlib.datasets.remesh import another_mesh
from skinlib.evaluate.groups import group_split
from skinlib.evaluate.metrics import row_l1
from skinlib.graph import HybridGraph, build_graph
from skinlib.head import Head, HeadError
from skinlib.model import Critic, SkinningModel
from skinlib.model.confidence import fit_calibration
from skinlib.model.inputs import content_hash, mesh_input, skeleton_input
from skinlib.training import parallel
from skinlib.training.checkpoint import STATE, load_model, save_model
from skinlib.training.config import TrainConfig
from skinlib.training.propagation import Propagation
from skinlib.training.state import read_state, uninterrupted, write_state
from skinlib.training.terms import D_S, D_U, Sample, Terms


def train(
    config: TrainConfig,
    labelled: Sequence[Head],
    out: str | Path,
    unlabelled: Sequence[Head] = (),
    validation: Sequence[Head] | None = None,
    start: SkinningModel | None = None,
) -> SkinningModel:
    """Train a model and keep it, with all that is needed to go on, in `out`.

    Called again with the same arguments after an interrupt it goes on where it was;
    called after the end it returns the finished model.

    Args:
        labelled: heads with weights.
        out: a folder; `load_model(out)` reads the best model so far, from the first
            validation on.
        unlabelled: heads whose weights the averaged model guesses while it learns.
        validation: heads to judge by; None holds out whole topology groups.
        start: a model to begin from, such as a shipped checkpoint, or a new one of
            another architecture, which `config.model` then says nothing about.

    Raises:
        HeadError: a head without weights, or `out` holds another run.
        KeyboardInterrupt: passed on, after the state has been written.
    """
    with parallel.processes(config) as config:
        trainer = Trainer(config, labelled, out, unlabelled, validation, start)
        if validation is None and not trainer.validation and parallel.is_first():
            tqdm.write(
                "All heads are learnt from, none is left to judge by: the last network "
                "is kept. --validation names heads to judge by."
            )
        return trainer.run()


class Trainer:
    """One training run; see `train`. `step()` is one step, for a look inside."""

    clock = staticmethod(time.monotonic)  # what the minutes of a run are read from

    def __init__(
        self,
        config: TrainConfig,
        labelled: Sequence[Head],
        out: str | Path,
        unlabelled: Sequence[Head] = (),
        validation: Sequence[Head] | None = None,
        start: SkinningModel | None = None,
    ):
        labelled = list(labelled)
        _check_labelled(labelled)
        if validation is None:
            train_ids, held_out = group_split(
                labelled, config.validation_share, config.seed
            )
            validation = [labelled[i] for i in held_out]
            labelled = [labelled[i] for i in train_ids]
        self.config, self.out = config, Path(out)
        self.labelled, self.unlabelled = labelled, list(unlabelled)
        self.validation = list(validation)
        _check_weights(self.validation, "judge by skinned heads")
        self.graphs: dict[int, HybridGraph] = {}
        self.copies: dict[tuple[int, int], tuple[Head, HybridGraph]] = {}
        self.carried = self._carry()

        torch.manual_seed(config.seed)
        network = type(start) if start else SkinningModel
        self.model = network(start.config if start else config.model)
        if start:
            self.model.load_state_dict(start.state_dict())
        self.model.to(config.device)
        self.average = copy.deepcopy(self.model).requires_grad_(False)
        self.critics = {
            name: Critic(config.critic).to(config.device)
            for name in (D_S, D_U)
            if getattr(config.terms, name) and (name == D_S or self.unlabelled)
        }
        self.terms = Terms(config, self.model, self.critics)
        self.networks = {"model": self.model} | self.critics
        self.parameters = [
            parameter
            for network in self.networks.values()
            for parameter in network.parameters()
        ]
        self.optimizers = _optimizers(self.model, config)
        self.critic_optimizers = _critic_optimizers(self.critics, config)
        # What a resumed run needs beside the tensors.
        self.steps_done, self.seconds = 0, 0.0
        self.best = float("inf")
        self.recent: dict[str, float] = {}  # running means of row-L1 and of the terms
        self.history: list[dict] = []
        self._pool = None
        if (self.out / STATE).exists():
            self._resume()

    # -- the run -------------------------------------------------------------------

    def run(self) -> SkinningModel:
        """Train to the end of the budget and return the best model."""
        self.out.mkdir(parents=True, exist_ok=True)
        if (words := self.describe_unlabelled()) and parallel.is_first():
            tqdm.write(words)
        saved = time.monotonic()
        with self._bar() as bar, ThreadPoolExecutor(self.config.threads) as pool:
            self._pool = pool
            try:
                while not self.finished:
                    # First, as the run may have been stopped when it was due.
                    if self._validation_due():
                        self.validate()
                    began = self.clock()
                    self.step()
                    self.seconds += self.clock() - began
                    self.seconds = parallel.from_first(self.seconds)
                    self._show(bar)
                    if time.monotonic() - saved > self.config.save_seconds:
                        self.save()
                        saved = time.monotonic()
            except KeyboardInterrupt:
                self.save()
                tqdm.write(f"Stopped; the same call goes on from {self.out / STATE}.")
                raise
            finally:
                self._pool = None
        if not self.history or self.history[-1]["step"] != self.steps_done:
            self.validate()
        self.save()
        if self.validation and parallel.is_first():
            words = "the heads that this run was validated by"
            model = load_model(self.out)
            fit_calibration(model, self.validation, fitted_on=words).write(self.out)
        parallel.wait()  # for the process that writes
        return load_model(self.out).to(self.config.device)

    @property
    def progress(self) -> float:
        """0 .. 1, the part of the budget, steps or time, that is spent."""
        if self.config.steps is not None:
            return min(1.0, self.steps_done / max(1, self.config.steps))
        return min(1.0, self.seconds / max(1e-9, self.config.minutes * 60))

    @property
    def finished(self) -> bool:
        """Whether the budget is spent."""
        return self.progress >= 1

    @property
    def learning_rate(self) -> float:
        """The learning rate of the next step: warm-up, constant, linear cool-down."""
        rate = self.config.learning_rate
        rate *= min(1.0, (self.steps_done + 1) / max(1, self.config.warmup))
        return rate * min(1.0, (1 - self.progress) / max(1e-9, self.config.cooldown))

    def step(self) -> dict[str, float]:
        """One step over `batch` heads; returns means of row-L1 and of the terms."""
        first = self.steps_done * self.config.batch
        draws = range(first, first + self.config.batch)
        mine = parallel.share_draws(draws)
        mapped = (self._pool.map if self._pool else map)(self._gradient, mine)
        every = parallel.gather_draws(list(mapped), len(draws), self.parameters)
        gradients, shown = zip(*every, strict=True)
        for parameter, *parts in zip(self.parameters, *gradients, strict=True):
            parameter.grad = sum(parts) / len(parts)
        for name, network in self.networks.items():
            norm = nn.utils.clip_grad_norm_(network.parameters(), self.config.clip)
            if not torch.isfinite(norm):
                raise FloatingPointError(
                    f"the gradient of step {self.steps_done} ({name}) is not finite: "
                    f"lower learning_rate ({self.config.learning_rate})"
                )
        means = _means(shown)
        with uninterrupted():
            self._update()
            for name, value in means.items():
                before = self.recent.get(name, value)
                self.recent[name] = 0.98 * before + 0.02 * value
        return means

    @property
    def generator_due(self) -> bool:
        """Whether the generator moves in the next step; the critics always do."""
        return not self.critics or (self.steps_done + 1) % self.config.critic_steps == 0

    @property
    def mixed(self) -> bool:
        """Whether unlabelled heads are drawn, too: after a first part of the run."""
        return bool(self.useful) and self.progress >= self.config.unlabelled_start

    @property
    def useful(self) -> list[int]:
        """The unlabelled heads from which something can be learnt."""
        config, terms = self.config, self.config.terms
        if config.pseudo or terms.adversarial_u or terms.consistency or terms.physical:
            return list(range(len(self.unlabelled)))
        return [i for i, (_, known) in enumerate(self.carried) if known.any()]

    def describe_unlabelled(self) -> str:
        """What the labelled heads know about the unlabelled ones, in words."""
        known = [mask.mean() for _, mask in self.carried if mask.any()]
        if known:
            return (
                f"{len(known)} of {len(self.carried)} unlabelled heads share "
                f"{np.mean(known):.0%} of their vertices with labelled ones."
            )
        if self.carried and not self.useful:
            return (
                "No unlabelled head shares vertices with a labelled one: they lend "
                "their proportions and nothing else."
            )
        return ""

    def _update(self) -> None:
        """Follow the gradients; the averaged parameters follow slowly."""
        moving = self.optimizers if self.generator_due else []
        for optimizer in [*moving, *self.critic_optimizers]:
            for group in optimizer.param_groups:
                group["lr"] = self.learning_rate * group["ratio"]
            optimizer.step()
        self.steps_done += 1
        if not moving:
            return
        decay = min(self.config.ema, self.steps_done / (self.steps_done + 10))
        with torch.no_grad():
            pairs = zip(self.average.parameters(), self.model.parameters(), strict=True)
            for slow, fast in pairs:
                slow.lerp_(fast, 1 - decay)

    def _gradient(self, draw: int) -> tuple[list[Tensor], dict[str, float]]:
        """Gradients, and numbers to show, of one head; `draw` decides which and how."""
        if self.config.device == "cpu":
            torch.set_num_threads(1)
        rng = np.random.default_rng([self.config.seed, 1, draw])
        head, graph, labelled, known = self._draw(draw, rng)
        others = self.labelled + self.unlabelled
        changes = self.config.augment
        # Nobody could tell any longer which vertices are known.
        changes = changes if labelled else changes.on_the_same_mesh
        head = augment(head, rng, changes, others)
        if not changes.keeps_mesh:
            graph = build_graph(head, self.model.config.graph)
            known = np.ones(len(graph), bool)
        mix = float(rng.random())
        sample = Sample(head, graph, labelled, known, self.mixed, mix)
        losses = self.terms.losses(sample, rng)
        gradients = []
        for name, network in self.networks.items():
            loss = losses.generator if name == "model" else losses.critics
            due = name != "model" or self.generator_due
            if loss is not None and loss.requires_grad and due:
                gradients += torch.autograd.grad(
                    loss,
                    list(network.parameters()),
                    retain_graph=name != "model",
                    materialize_grads=True,
                )
            else:
                gradients += [torch.zeros_like(p) for p in network.parameters()]
        return gradients, losses.shown

    def _draw(
        self, draw: int, rng: np.random.Generator
    ) -> tuple[Head, HybridGraph, bool, np.ndarray]:
        """Head with weights, graph, is it labelled, and (N,) which nodes are known.

        Labelled heads come in shuffled epochs.
        """
        if self.mixed and rng.random() < self.config.unlabelled_share:
            place = self.useful[int(rng.integers(len(self.useful)))]
            head, (weights, known) = self.unlabelled[place], self.carried[place]
            graph = self._graph(len(self.labelled) + place, head)
            if self.config.pseudo or not known.any():
                weights = np.where(known[:, None], weights, self._guess(head, graph))
            head = head.replace(weights=weights)
            return head, graph, False, known[graph.vertex_of_node]
        epoch, place = divmod(draw, len(self.labelled))
        shuffle = np.random.default_rng([self.config.seed, 2, epoch])
        place = int(shuffle.permutation(len(self.labelled))[place])
        copies, share = self.config.remeshed, self.config.remeshed_share
        if copies and rng.random() < share:
            head, graph = self._copy(place, int(rng.integers(copies)))
        else:
            head = self.labelled[place]
            graph = self._graph(place, head)
        return head, graph, True, np.ones(len(graph), bool)

    def _copy(self, place: int, number: int) -> tuple[Head, HybridGraph]:
        """A labelled head on another mesh; each copy is made when it is first drawn."""
        if (place, number) not in self.copies:
            rng = np.random.default_rng([self.config.seed, 3, place, number])
            head = another_mesh(self.labelled[place], rng)
            graph = build_graph(head, self.model.config.graph)
            self.copies[place, number] = head, graph
        return self.copies[place, number]

    def _carry(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """(V, J) weights and (V,) known ones of each unlabelled head."""
        if not self.unlabelled:
            return []
        painted = Propagation(self.labelled)
        carried = [painted.rows(head) for head in self.unlabelled]
        if not self.config.propagate:
            return [(weights, np.zeros_like(known)) for weights, known in carried]
        return carried

    @torch.no_grad()
    def _guess(self, head: Head, graph: HybridGraph) -> np.ndarray:
        """(V, J) weights that the averaged model gives an undisturbed head."""
        device = self.config.device
        mesh = mesh_input(head, graph).to(device)
        return self.average(mesh, skeleton_input(head).to(device)).cpu().numpy()

    def _graph(self, key: int, head: Head) -> HybridGraph:
        if key not in self.graphs:
            self.graphs[key] = build_graph(head, self.model.config.graph)
        return self.graphs[key]

    def _bar(self):
        total, done, unit = self.config.steps, self.steps_done, "step"
        if total is None:
            total, done = round(self.config.minutes * 60), round(self.seconds)
            done, unit = min(done, total), "s"
        hidden = not parallel.is_first()
        return tqdm(total=total, initial=done, unit=unit, disable=hidden)

    def _show(self, bar) -> None:
        done = self.steps_done if self.config.steps is not None else int(self.seconds)
        bar.update(max(0, min(done, bar.total) - bar.n))
        numbers = {"step": self.steps_done}
        if "row_l1" in self.recent:
            numbers["row_l1"] = f"{self.recent['row_l1']:.4f}"
        if np.isfinite(self.best):
            numbers["validation"] = f"{self.best:.4f}"
        bar.set_postfix(numbers, refresh=False)

    # -- judging and keeping -------------------------------------------------------

    def _validation_due(self) -> bool:
        done = len(self.history) + 1
        return self.progress >= done / max(1, self.config.validations)

    def validate(self) -> float:
        """Row-L1 on the validation heads; the best model so far is kept."""
        errors = [
            float(row_l1(self.average.predict(head), head.weights).mean())
            for head in self.validation
        ]
        error = float(np.mean(errors)) if errors else float("nan")
        # In this order: whoever is stopped in between validates once more.
        if error < self.best or not errors:
            trained = asdict(self.config) | {"model": self.average.describe()}
            if parallel.is_first():
                save_model(self.average, self.out, {"training": trained})
            self.best = error
        recent = {name: round(value, 5) for name, value in self.recent.items()}
        self.history.append(
            {
                "step": self.steps_done,
                "minutes": round(self.seconds / 60, 3),
                "train_row_l1": recent.pop("row_l1", None),
                "validation_row_l1": round(error, 5) if errors else None,
                "terms": recent,
            }
        )
        return error

    def save(self) -> None:
        """Write the state to resume from; a crash meanwhile leaves the older one."""
        if not parallel.is_first():
            return
        progress = {
            "run": self._identity(),
            "steps_done": self.steps_done,
            "seconds": self.seconds,
            "best": self.best,
            "recent": self.recent,
            "history": self.history,
        }
        write_state(self.out, self._all_networks(), self._memory(), progress)

    def _resume(self) -> None:
        progress = read_state(
            self.out, self._all_networks(), self._memory(), self._identity()
        )
        self.steps_done, self.seconds = progress["steps_done"], progress["seconds"]
        self.best, self.history = progress["best"], progress["history"]
        self.recent = progress["recent"]

    def _all_networks(self) -> dict[str, nn.Module]:
        return {"average": self.average, **self.networks}

    def _memory(self) -> list[tuple[nn.Parameter, dict]]:
        return [(parameter, self._moments(parameter)) for parameter in self.parameters]

    def _moments(self, parameter: Tensor) -> dict[str, Tensor]:
        """What the optimizer in charge of a parameter remembers of it."""
        for optimizer in [*self.optimizers, *self.critic_optimizers]:
            if any(parameter is p for g in optimizer.param_groups for p in g["params"]):
                return optimizer.state[parameter]
        raise AssertionError("every parameter has an optimizer")

    def _identity(self) -> dict:
        """What has to be the same for a run to be the same."""
        machine = ("threads", "device", "save_seconds")
        settings = {k: v for k, v in asdict(self.config).items() if k not in machine}
        if type(self.model) is not SkinningModel:
            settings["model"] = {"network": type(self.model).__name__}
            settings["model"] |= self.model.describe()
        graph = self.model.config.graph
        groups = {
            "labelled": self.labelled,
            "unlabelled": self.unlabelled,
            "validation": self.validation,
        }
        heads = {
            group: [
                f"{head.name} {content_hash(head, graph)} {_checksum(head.weights)}"
                for head in members
            ]
            for group, members in groups.items()
        }
        return json.loads(json.dumps(settings | heads))


def _optimizers(model: SkinningModel, config: TrainConfig):
    """AdamW for all parameters, or Muon for matrices between features and AdamW.

    Muon makes the update of a matrix orthogonal, so that no direction of it starves.
    Source: Jordan et al. 2024, Muon: an optimizer for hidden layers in neural networks.
    """
    if config.optimizer not in ("muon", "adamw"):
        raise ValueError(f"optimizer is {config.optimizer!r}: use muon or adamw")
    shared = {"lr": config.learning_rate, "weight_decay": config.weight_decay}
    matrices = [
        module.weight
        for module in model.modules()
        if isinstance(module, nn.Linear) and min(module.weight.shape) > 12
    ]
    if config.optimizer == "adamw" or not matrices:
        return [_with_ratio(AdamW(model.parameters(), betas=(0.9, 0.98), **shared))]
    chosen = {id(matrix) for matrix in matrices}
    rest = [p for p in model.parameters() if id(p) not in chosen]
    return [
        _with_ratio(Muon(matrices, adjust_lr_fn="match_rms_adamw", **shared)),
        _with_ratio(AdamW(rest, betas=(0.9, 0.98), **shared)),
    ]


def _critic_optimizers(critics: Mapping[str, Critic], config: TrainConfig) -> list:
    """One AdamW a critic, without momentum, which a moving goal only misleads."""
    ratio = config.critic_learning_rate / config.learning_rate
    return [
        _with_ratio(AdamW(critic.parameters(), lr=1.0, betas=(0.0, 0.9)), ratio)
        for critic in critics.values()
    ]


def _with_ratio(optimizer: torch.optim.Optimizer, ratio: float = 1.0):
    """The optimizer, which is to step at `ratio` times the schedule's rate."""
    for group in optimizer.param_groups:
        group["ratio"] = ratio
    return optimizer


def _means(shown: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean of each number over the heads that have it."""
    names = dict.fromkeys(name for numbers in shown for name in numbers)
    return {
        name: float(np.mean([part[name] for part in shown if name in part]))
        for name in names
    }


def _checksum(weights: np.ndarray | None) -> int:
    return 0 if weights is None else zlib.crc32(weights.tobytes())


def _check_labelled(heads: Sequence[Head]) -> None:
    if not heads:
        raise HeadError(
            "labelled", "there is no head to learn from", "give at least one head"
        )
    _check_weights(
        heads, "train on skinned heads; put heads without weights in --unlabelled"
    )


def _check_weights(heads: Sequence[Head], fix: str) -> None:
    for head in heads:
        if head.weights is None:
            raise HeadError("weights", f"head {head.name!r} has none", fix)
