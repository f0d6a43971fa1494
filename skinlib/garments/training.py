"""Training PBNS: potential energies in, a garment out; no simulated cloth is needed.

Step s of a run depends on the seed, s and the parameters alone, so a run that was
interrupted ends in the same bits as one that was not, if the threads are as many.
"""

import copy
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from zlib import crc32

import numpy as np
import torch
from torch import Tensor

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
from skinlib.training.checkpoint import STATE
from skinlib.training.run import Run

POSES = "poses.npz"
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
