"""Training PBNS: potential energies in, a garment out; no simulated cloth is needed.

Step s of a run depends on the seed, s and the parameters alone, so a run that was
interrupted ends in the same bits as one that was not, if the threads are as many.
"""

import copy
import json
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from zlib import crc32

import numpy as np
import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from skinlib.garments.collision import nearest, take, vertex_normals
from skinlib.garments.energies import (
    Cloth,
    EnergyWeights,
    bend_energy,
    collision_energy,
    edge_energy,
    gravity_energy,
    pin_energy,
    total_energy,
)
from skinlib.garments.motion import (
    Motion,
    mirrored,
    random_poses,
    read_motion,
    write_motion,
)
from skinlib.garments.outfit import EASE_RANGE, Outfit, save_outfit
from skinlib.garments.pbns import PBNS, PBNSConfig
from skinlib.head import Head, HeadError
from skinlib.training.checkpoint import STATE, read_tensors, replace_file, write_tensors
from skinlib.training.trainer import uninterrupted

POSES = "poses.npz"
HISTORY = "history.json"
RECORD = 100  # steps from one entry of the history to the next
SLID = 0.15  # metres that a garment may hang lower than it was drafted
SHAPE_RANGE = 0.6


@dataclass(frozen=True)
class GarmentConfig:
    """What a training run is; with the same outfit it gives the same network."""

    steps: int = 10_000
    poses: int = 8_000  # drawn once, see `random_poses`; their mirror images are added
    gap: float = 0.015  # metres between the limbs in them: room for the cloth
    batch: int = 16  # poses a step
    learning_rate: float = 2e-3  # falls to 1 % along a cosine
    weights_rate: float = 10.0  # times that for learnt blend weights
    smoothing: int = 10  # of the blend weights; 50 for a skirt
    epsilon: float = 0.004  # metres that the cloth keeps from the body, and layers
    # Metres: what comes so near in a pose is an obstacle, such as a hand. 0: what is
    # near at rest; hands go into a skirt in many poses, and it cannot evade them all.
    touch: float = 0.06
    shapes: bool = False  # learn the shapes of the body and looser cuts, too
    seed: int = 0  # of parameters, poses and their order
    threads: int = 2  # another number, other last bits
    device: str = "cpu"
    save_seconds: float = 60.0  # how often the state to resume from is written
    energies: EnergyWeights = field(default_factory=EnergyWeights)
    network: PBNSConfig = field(default_factory=PBNSConfig)


def train(
    config: GarmentConfig, outfit: Outfit, out: str | Path, poses: Motion | None = None
) -> PBNS:
    """Train a network for an outfit and keep it, with all it needs, in `out`.

    Called again with the same arguments after an interrupt it goes on where it was;
    called after the end it returns the trained network.

    Args:
        poses: what to learn; random poses of the body when left out.

    Raises:
        HeadError: `out` holds another run, or the body has no shapes to learn.
        FloatingPointError: a step's energy is not finite.
        KeyboardInterrupt: passed on, after the state has been written.
    """
    trainer = Trainer(config, outfit, out, poses)
    return trainer.run()


def training_poses(body: Head, count: int, seed: int, gap: float) -> Motion:
    """`count` random poses of a body, and their mirror images: twice as many.

    Args:
        gap: metres between the limbs, see `random_poses`.
    """
    drawn = random_poses(body.skeleton, count, seed, body, gap)
    other = mirrored(drawn)
    return Motion.create(
        np.concatenate([drawn.rotations, other.rotations]),
        drawn.bone_names,
        np.concatenate([drawn.translations, other.translations]),
        name=drawn.name,
    )


class Run(ABC):
    """What all training runs have in common: they go on exactly where they stopped.

    One step is `step()`, its end `_finish()`, and what makes it the same run
    `_identity()`. `config` has steps, learning_rate, threads and save_seconds.
    """

    network: nn.Module

    def _start(self, config, out: str | Path, groups: list[dict]) -> None:
        """Begin, or go on where it stopped.

        Args:
            groups: of parameters, for Adam; `scale` times the learning rate.
        """
        self.config, self.out = config, Path(out)
        self.parameters = list(self.network.parameters())
        self.optimizer = torch.optim.Adam(groups)
        self.steps_done, self.seconds = 0, 0.0
        self.recent: dict[str, float] = {}  # running means of what a step tells
        self.history: list[dict] = []
        if (self.out / STATE).exists():
            self._resume()

    @abstractmethod
    def step(self) -> dict[str, float]:
        """One step."""

    def _update(self, told: dict[str, float]) -> None:
        """Change the parameters by their gradients, and remember what a step tells."""
        fall = 0.5 * (1 + np.cos(np.pi * self.steps_done / self.config.steps))
        for group in self.optimizer.param_groups:
            rate = self.config.learning_rate * group.get("scale", 1.0)
            group["lr"] = rate * (0.01 + 0.99 * fall)
        with uninterrupted():
            self.optimizer.step()
            self.steps_done += 1
            for name, value in told.items():
                before = self.recent.get(name, value)
                self.recent[name] = 0.98 * before + 0.02 * value
            if self.steps_done % RECORD == 0:
                self._look()
                self.history.append({"step": self.steps_done, **self.recent})

    def _look(self) -> None:  # noqa: B027  # most runs have nothing to look at
        """Look at the network before an entry of the history is made."""

    @abstractmethod
    def _finish(self) -> nn.Module:
        """Keep what was trained, and return it."""

    @abstractmethod
    def _identity(self) -> dict:
        """What has to be the same for a run to be the same."""

    # -- the run -------------------------------------------------------------------

    def run(self) -> nn.Module:
        """Train to the last step and return the network."""
        self.out.mkdir(parents=True, exist_ok=True)
        saved = time.monotonic()
        threads = torch.get_num_threads()
        torch.set_num_threads(self.config.threads)
        try:
            with self._bar() as bar:
                while self.steps_done < self.config.steps:
                    began = time.monotonic()
                    self.step()
                    self.seconds += time.monotonic() - began
                    bar.update()
                    bar.set_postfix(self._shown(), refresh=False)
                    if time.monotonic() - saved > self.config.save_seconds:
                        self.save()
                        saved = time.monotonic()
        except KeyboardInterrupt:
            self.save()
            tqdm.write(f"Stopped; the same call goes on from {self.out / STATE}.")
            raise
        finally:
            torch.set_num_threads(threads)
        self.save()
        return self._finish()

    # -- what is shown and kept ----------------------------------------------------

    def _bar(self) -> tqdm:
        return tqdm(
            total=self.config.steps,
            initial=self.steps_done,
            desc="garment",
            unit="step",
        )

    def _shown(self) -> dict[str, str]:
        return {name: f"{value:.4f}" for name, value in self.recent.items()}

    def save(self) -> None:
        """Write the state to resume from; a crash meanwhile leaves the older one."""
        tensors = {f"network.{k}": v for k, v in self.network.state_dict().items()}
        for i, parameter in enumerate(self.parameters):
            for key, value in self.optimizer.state.get(parameter, {}).items():
                tensors[f"optimizer.{i}.{key}"] = value
        progress = {
            "run": self._identity(),
            "steps_done": self.steps_done,
            "seconds": self.seconds,
            "recent": self.recent,
            "history": self.history,
        }
        tensors = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
        write_tensors(self.out / STATE, tensors, {"progress": json.dumps(progress)})
        replace_file(self.out / HISTORY, json.dumps(self.history, indent=1).encode())

    def _resume(self) -> None:
        tensors, metadata = read_tensors(self.out / STATE)
        try:
            progress = json.loads(metadata["progress"])
            run, mine = progress["run"], self._identity()
            differs = [key for key in mine if run.get(key) != mine[key]]
            if differs:
                raise HeadError(
                    ", ".join(differs),
                    "another run, with other settings or meshes, was begun here",
                    "continue it with the arguments it was begun with, or choose a new "
                    "folder for this one",
                    self.out,
                )
            self.network.load_state_dict(
                {
                    key.removeprefix("network."): value
                    for key, value in tensors.items()
                    if key.startswith("network.")
                }
            )
            for i, parameter in enumerate(self.parameters):
                prefix = f"optimizer.{i}."
                state = {
                    key.removeprefix(prefix): value.to(
                        "cpu" if key.endswith("step") else parameter.device
                    )
                    for key, value in tensors.items()
                    if key.startswith(prefix)
                }
                if state:
                    self.optimizer.state[parameter].update(state)
            self.steps_done, self.seconds = progress["steps_done"], progress["seconds"]
            self.recent, self.history = progress["recent"], progress["history"]
        except HeadError:
            raise
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise HeadError(
                "checkpoint",
                f"a file that is no state of a run ({type(error).__name__})",
                "copy the file again, or delete it and train anew",
                self.out / STATE,
            ) from error


class Trainer(Run):
    """One training run; see `train`. `step()` is one step, for a look inside."""

    def __init__(
        self,
        config: GarmentConfig,
        outfit: Outfit,
        out: str | Path,
        poses: Motion | None = None,
    ):
        if config.shapes and not outfit.body.shape_names:
            raise HeadError("shapes", "the body has none", "train without --shapes")
        # Before the run begins: poses may be those that it has kept.
        self.config, self.outfit, self.out = config, outfit, Path(out)
        self.body = outfit.body.head
        if poses is None:
            poses = self._random_poses()
        device = config.device
        collider = outfit.collider_in(poses, config.smoothing, config.touch)
        self.network = outfit.network(
            config.network, config.smoothing, config.shapes, config.seed, collider
        ).to(device)
        self.cloth = copy.deepcopy(outfit.cloth).to(device)
        self.collider = copy.deepcopy(collider).to(device)
        self.pinned = torch.from_numpy(outfit.pinned).to(device)
        self._draw(poses)
        parameters, change = self.network.parameters(), self.network.weight_change
        groups = [{"params": [p for p in parameters if p is not change]}]
        if change is not None:
            groups.append({"params": [change], "scale": config.weights_rate})
        self._start(config, out, groups)

    def _random_poses(self) -> Motion:
        """Those of the configuration; kept in `out`, as drawing them takes minutes."""
        path = self.out / POSES
        if path.exists() and (self.out / STATE).exists():
            return read_motion(path)
        config = self.config
        poses = training_poses(self.body, config.poses, config.seed, config.gap)
        self.out.mkdir(parents=True, exist_ok=True)
        write_motion(path, poses)
        return poses

    def _draw(self, poses: Motion) -> None:
        """All that the steps need of each pose, once."""
        config, body, device = self.config, self.outfit.body, self.config.device
        skeleton, count = self.body.skeleton, len(poses)
        self.poses, self.shapes, self.ease = poses, None, np.zeros(count)
        if config.shapes:
            rng = np.random.default_rng((config.seed, 1))
            shapes = rng.uniform(-1, 1, (count, len(body.shape_names))) * SHAPE_RANGE
            self.ease = rng.uniform(*EASE_RANGE, count)
            self.shapes = torch.tensor(shapes, dtype=torch.float32, device=device)
            self.inputs = self.network.inputs(poses.rotations, shapes, self.ease)
            transforms = body.transforms(poses, shapes)
            carried = body.shape_vertices[:, self.collider.vertices]
            self.body_shapes = torch.tensor(carried, device=device)
        else:
            transforms = poses.transforms(skeleton)
            self.inputs = self.network.inputs(poses.rotations)
        self.transforms = torch.from_numpy(transforms).to(device)
        self.ease = torch.tensor(self.ease, dtype=torch.float32, device=device)

    def step(self) -> dict[str, float]:
        """One step over `batch` poses; returns the mean weighted energies in joules."""
        config = self.config
        rng = np.random.default_rng((config.seed, 2, self.steps_done))
        ids = rng.integers(0, len(self.poses), config.batch)
        terms = self.energies(ids)
        loss = total_energy(terms, config.energies).mean()
        self.optimizer.zero_grad()
        loss.backward()
        if not torch.isfinite(loss):
            found = ", ".join(f"{k} {v.mean():.3g}" for k, v in terms.items())
            raise FloatingPointError(
                f"the energy of step {self.steps_done} is not finite ({found}): lower "
                f"learning_rate ({config.learning_rate})"
            )
        weights = asdict(config.energies)
        means = {k: weights[k] * v.mean().item() for k, v in terms.items()}
        self.ids = ids
        self._update(means)
        return means

    def _look(self) -> None:
        """Stop when a garment slides off: gravity alone would go on for ever."""
        if not self.config.energies.collision:
            return  # it falls through the body, as was asked for
        with torch.no_grad():
            drop = -self.network.offsets(self.inputs[self.ids])[..., 2].mean(0)
        for garment, part in zip(self.outfit.garments, self.outfit.parts, strict=True):
            if drop[part].mean() > SLID:
                raise HeadError(
                    "pinned",
                    f"{garment.name or 'the garment'} has slid down by "
                    f"{drop[part].mean():.2f} m after {self.steps_done} steps",
                    "pin it at the waist (--pin-top, --pin-above) and begin in a new "
                    "folder",
                )

    def energies(self, ids: np.ndarray) -> dict[str, Tensor]:
        """The energies (B,) of the poses with the ids `ids` (B,), not yet weighted."""
        config, transforms = self.config, self.transforms[ids]
        shape = None if self.shapes is None else self.shapes[ids]
        with torch.no_grad():
            grown = None
            if shape is not None:
                grown = torch.tensordot(shape, self.body_shapes, 1)
            body, normals = self.collider.pose(transforms, grown)
            lengths = self._rest_lengths(shape, self.ease[ids])
        posed, offsets = self.network(self.inputs[ids], transforms, shape)
        under = nearest(posed, body)
        terms = {
            "edge": edge_energy(posed, self.cloth, lengths),
            "bend": bend_energy(posed, self.cloth),
            "collision": collision_energy(
                posed, take(body, under), take(normals, under), config.epsilon
            ),
            "gravity": gravity_energy(posed, self.cloth),
            "pin": pin_energy(offsets, self.pinned),
        }
        if len(self.outfit.garments) > 1 and config.energies.layer:
            terms["layer"] = layer_energy(
                posed, self.cloth, self.outfit.overlaps, config.epsilon
            )
        return terms

    def _rest_lengths(self, shape: Tensor | None, ease: Tensor) -> Tensor | None:
        """(B, E) metres: the edges of the garment as it is cut for each body."""
        if shape is None:
            return None
        cut = self.network.graded(shape)[:, self.cloth.edges]  # (B, E, 2, 3)
        return (cut[:, :, 0] - cut[:, :, 1]).norm(dim=-1) * (1 + ease[:, None])

    def _finish(self) -> PBNS:
        network = self.network.baked()
        told = {"training": asdict(self.config), "seconds": round(self.seconds)}
        save_outfit(self.out, self.outfit, network, told)
        return network

    def _identity(self) -> dict:
        """What has to be the same for a run to be the same."""
        machine = ("threads", "device", "save_seconds")
        settings = {k: v for k, v in asdict(self.config).items() if k not in machine}
        body, outfit = self.outfit.body, self.outfit
        arrays = {
            "body vertices": self.body.vertices,
            "body weights": self.body.weights,
            "body joints": self.body.skeleton.joints,
            "shape vertices": body.shape_vertices,
            "shape joints": body.shape_joints,
            "garments": outfit.vertices,
            "faces": outfit.faces,
            "pinned": outfit.pinned,
            "rotations": self.poses.rotations,
            "translations": self.poses.translations,
        }
        meshes = {name: crc32(array.tobytes()) for name, array in arrays.items()}
        return json.loads(json.dumps(settings | meshes))


def layer_energy(
    vertices: Tensor, cloth: Cloth, overlaps: Sequence[tuple], epsilon: float
) -> Tensor:
    """(B,) m^2: how far garments are inside those below. Equation `pbns_layers`.

    Both sides give way: the outer one is pushed out and the inner one in.

    Args:
        vertices: (B, V, 3) of all garments. overlaps: see `Outfit.overlaps`.
        epsilon: metres that the layers keep.
    """
    total = torch.zeros(len(vertices), device=vertices.device)
    normals = vertex_normals(vertices, cloth.faces)
    for inner, outer, _ in overlaps:
        below, above = vertices[:, inner], vertices[:, outer]
        under = nearest(above, below)
        total = total + collision_energy(
            above, take(below, under), take(normals[:, inner], under), epsilon
        )
    return total
