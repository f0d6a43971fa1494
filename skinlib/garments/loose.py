"""A loose garment on its virtual bones: learnt from simulations, posed, streamed, kept.

`virtual_bones` has the parts, this puts them together: `train` binds a garment that was
simulated (see `simulation`), teaches the network and keeps all in a folder, from which
a `LooseGarment` moves with any motion of its body, or goes into a file as a rig.

Symbols: V vertices, N virtual bones, K joints that move the garment besides, C = N + K,
J joints of the body, T frames, B windows. Metres.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np
import torch
from torch import Tensor, nn

from skinlib.animation import AnimatedMesh, write_animation
from skinlib.garments.binding import closest_point_weights, smooth
from skinlib.garments.body import Body, read_body, write_body
from skinlib.garments.collision import nearest, take
from skinlib.garments.energies import collision_energy
from skinlib.garments.fitting import SkinningError
from skinlib.garments.garment import Garment, read_garment, write_garment
from skinlib.garments.motion import Motion, training_motions, walk
from skinlib.garments.outfit import BODY, CLOTH_COLOURS, FRAMES, SKIN_COLOUR
from skinlib.garments.simulation import (
    Simulated,
    obstacle,
    read_simulated,
    root_frame,
)
from skinlib.garments.virtual_bones import (
    KERNELS,
    LEAST_TOTAL,
    SLOPE,
    THRESHOLD,
    VirtualBonesConfig,
    VirtualBonesNet,
    bone_distances,
    bone_spacing,
    carriers,
    heat_weights,
    hybrid_skinning,
    hybrid_weights,
    in_root_frame,
    looseness,
    place_bones,
    pose_features,
    prune_joints,
    virtual_bind,
)
from skinlib.head import HeadError, Skeleton
from skinlib.skinning import linear_blend_skinning
from skinlib.training.checkpoint import (
    CONFIG,
    WEIGHTS,
    reading_finished,
    replace_file,
    write_tensors,
)
from skinlib.training.run import Run

GARMENT = "garment.npz"
KIND = "virtual bones"
CARRIED = 50  # rounds of smoothing of the weights that carry the virtual bones
LOOKED_AT = 1000  # frames that tell how loose the garment is
WALKS = {
    "speed": (0.6, 1.2),
    "stride": (12, 32),
    "crouch": (0, 30),
    "turn_rate": (-60, 60),
    "arm_swing": (0, 40),
}
"""What `random_walks` draws from; see `skinlib.garments.motion.walk`."""


# --- what to simulate -----------------------------------------------------------------


def random_walks(
    skeleton: Skeleton, seed: int, count: int, seconds: float = 3.5
) -> list[Motion]:
    """Walks of random speed, stride, crouch and turn; more of them begin alike."""
    rng = np.random.default_rng(seed)
    return [
        walk(skeleton, seconds, **{k: rng.uniform(*ends) for k, ends in WALKS.items()})
        for _ in range(count)
    ]


def simulation_motions(skeleton: Skeleton, seed: int, count: int) -> list[Motion]:
    """What a skirt learns from: walks, and each fourth time one of `training_motions`.

    More of them begin alike, so that a data set may grow.
    """
    walks = iter(random_walks(skeleton, seed, count))
    others = iter(training_motions(skeleton, seed, count // 4))
    return [next(others if i % 4 == 3 else walks) for i in range(count)]


def read_simulations(folder: str | Path) -> list[Simulated]:
    """All that `simulate_motions` wrote into a folder, in its order.

    Raises:
        HeadError: there is nothing, or a file is damaged.
    """
    paths = sorted(Path(folder).glob("motion_*.npz"))
    if not paths:
        raise HeadError(
            "simulated",
            "there is no simulation in it",
            "give a folder that `skinlib garment simulate --out` wrote",
            folder,
        )
    return [read_simulated(path) for path in paths]


# --- the garment ----------------------------------------------------------------------


@dataclass(frozen=True)
class LooseConfig:
    """What a training run is; with the same simulations it gives the same network."""

    bones: int = 24  # virtual ones
    influences: int = 8  # of them on a vertex, at most
    fade: bool = True  # they fade out before others take their place, see `fading_heat`
    alpha: float | None = None  # metres that heat reaches; None: as bones are apart
    kernel: str = KERNELS[0]
    hybrid: bool = True  # joints move what is tight; else virtual bones move all
    carry: bool = True  # joints carry the virtual bones; else the root alone does
    threshold: float = THRESHOLD  # metres off, from where a vertex is loose
    slope: float = SLOPE  # per metre: from there to loose altogether
    reduce: str = "mean"  # over the frames, or "p90"
    least: float = LEAST_TOTAL  # vertices that a joint moves, or it is left out
    steps: int = 1600
    batch: int = 8  # windows a step
    window: int = 32  # frames
    unscored: int = 8  # of them: the memory begins with nothing
    edges: float = 10.0  # weight of the errors of edges, beside those of vertices
    collision: float = 30.0  # and of what is under the skin of the body
    gap: float = 0.004  # metres that cloth keeps from the skin
    touched: int = 4  # frames a step in which collisions are looked for
    learning_rate: float = 2e-3  # falls to 1 % along a cosine
    seed: int = 0  # of bones, parameters and windows
    threads: int = 2  # another number, other last bits
    device: str = "cpu"
    save_seconds: float = 60.0  # how often the state to resume from is written
    network: VirtualBonesConfig = field(default_factory=VirtualBonesConfig)

    def __post_init__(self):
        ones = dict.fromkeys(("steps", "batch", "window", "touched"), 1)
        zeros = dict.fromkeys(("unscored", "edges", "collision", "gap"), 0)
        for name, least in (ones | zeros).items():
            if not least <= getattr(self, name) < np.inf:
                fix = f"give a number of {least} or more"
                raise HeadError(name, f"it is {getattr(self, name)}", fix)
        if self.unscored >= self.window:
            raise HeadError(
                "unscored",
                f"{self.unscored} of {self.window} frames",
                "score at least one frame of a window",
            )


class Inputs(NamedTuple):
    """What a garment has to know of each frame, as the root sees it.

    Attributes:
        features: (T, F). carrier: (T, N, 4, 4). joints: (T, K, 4, 4).
    """

    features: Tensor
    carrier: Tensor
    joints: Tensor


@dataclass(frozen=True, eq=False)
class LooseGarment:
    """A garment, what moves it, and the network; `bind` makes one.

    Attributes:
        garment: as it was cut. rest: (V, 3) as it hangs at rest.
        drape: (V, 3) its mean in all it has learnt, in the frame of the root.
        bones: (N,) the vertices where virtual bones sit.
        weights: (V, C) of virtual bones, then of `joints`.
        joints: (K,) ids of the joints that move it besides.
        read: (L,) ids of those that the network reads.
        carried: (N, J) weights by which joints carry the virtual bones.
    """

    ARRAYS = ("rest", "drape", "bones", "weights", "joints", "read", "carried")

    body: Body
    garment: Garment
    network: VirtualBonesNet
    rest: np.ndarray
    drape: np.ndarray
    bones: np.ndarray
    weights: np.ndarray
    joints: np.ndarray
    read: np.ndarray
    carried: np.ndarray

    @cached_property
    def points(self) -> np.ndarray:
        """(C, 3) where virtual bones and joints are at rest."""
        return np.concatenate(
            [self.rest[self.bones], self.body.head.skeleton.joints[self.joints]]
        )

    @cached_property
    def _binds(self) -> np.ndarray:
        """(K, 4, 4) of the joints."""
        return virtual_bind(self.points[len(self.bones) :])[0]

    @cached_property
    def _tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Rest, weights and offset matrices."""
        arrays = self.rest, self.weights, virtual_bind(self.points)[1]
        return tuple(torch.tensor(array, dtype=torch.float32) for array in arrays)

    def inputs(
        self, transforms: np.ndarray, fps: float, before: np.ndarray | None = None
    ) -> Inputs:
        """What the network reads and what joints do, in successive frames.

        Args:
            transforms: (T, J, 4, 4) of the body, from rest.
            before: (4, 4) of the root one frame before; without it, it starts still.
        """
        skeleton, count = self.body.head.skeleton, len(self.bones)
        local = in_root_frame(transforms)
        found = (
            pose_features(transforms, skeleton, self.read, fps, before, local=local),
            carriers(local, self.carried, self.points[:count]),
            local[:, self.joints] @ self._binds,
        )
        arrays = (part.astype(np.float32, copy=False) for part in found)
        return Inputs(*map(torch.from_numpy, arrays))

    def pose(self, motion: Motion) -> np.ndarray:
        """(T, V, 3) float32 the garment in each frame of a motion.

        Raises:
            HeadError: the bones of the motion are not those of the body.
        """
        transforms = motion.transforms(self.body.head.skeleton)
        inputs = self.inputs(transforms, motion.fps)
        with torch.inference_mode():
            placed = self.place(inputs)
            roots = torch.from_numpy(transforms[:, 0])
            pairs = zip(placed.split(FRAMES), roots.split(FRAMES), strict=True)
            return torch.cat([self.skin(*pair) for pair in pairs]).numpy()

    def stream(
        self, transforms: Iterable[np.ndarray], fps: float
    ) -> Iterator[np.ndarray]:
        """(V, 3) float32 for each (J, 4, 4) of the body as it comes, like `pose`."""
        before = state = None
        for frame in transforms:
            with torch.inference_mode():
                inputs = self.inputs(frame[None], fps, before)
                bones, state = self.network.step(inputs[0], inputs[1], state)
                placed = torch.cat([bones, inputs[2]], dim=1)
                posed = self.skin(placed, torch.from_numpy(frame[None, 0]))
            before = frame[0]
            yield posed[0].numpy()

    def place(self, inputs: Inputs) -> Tensor:
        """(T, C, 4, 4) where virtual bones and joints stand, in the root's frame."""
        features, carrier, joints = inputs
        bones = self.network(features[None], carrier[None])[0]
        return torch.cat([bones, joints], dim=1)

    def skin(self, placed: Tensor, roots: Tensor) -> Tensor:
        """(T, V, 3) from (T, C, 4, 4) in the frame of the root, (T, 4, 4)."""
        rest, weights, offsets = self._tensors
        return hybrid_skinning(rest, weights, roots[:, None] @ placed, offsets)

    def baselines(self, motion: Motion) -> dict[str, np.ndarray]:
        """(T, V, 3) by simpler means: what the network has to be better than."""
        transforms = motion.transforms(self.body.head.skeleton)
        roots = transforms[:, :1]
        nearest = joint_weights(self.garment, self.rest, self.body)
        smoothed = smooth(nearest, self.garment.faces, CARRIED)
        one = np.ones((len(self.rest), 1), np.float32)
        return {
            "skinning alone": linear_blend_skinning(self.rest, nearest, transforms),
            "skinning, smooth": linear_blend_skinning(self.rest, smoothed, transforms),
            "rigid": linear_blend_skinning(self.rest, one, roots),
            "mean drape": linear_blend_skinning(self.drape, one, roots),
        }

    def export(self, path: str | Path, motion: Motion) -> None:
        """Write body and garment in motion to a `.glb`, whole or not at all.

        The virtual bones are bones of the file, children of the root: an engine needs
        nothing else to play it.

        Raises:
            HeadError: the bones of the motion are not those of the body, or the file
                cannot be written.
        """
        head, count = self.body.head, len(self.bones)
        body = head.skeleton
        inputs = self.inputs(motion.transforms(body), motion.fps)
        with torch.inference_mode():
            placed = self.place(inputs)[:, :count].numpy()
        skeleton = Skeleton.from_heads_and_tails(
            np.concatenate([body.joints, self.points[:count]]),
            np.concatenate([body.tails, self.points[:count]]),
            np.concatenate([body.parents, np.zeros(count, np.int64)]),
            [*body.names, *_bone_names(body.names, count)],
        )
        rotations = np.concatenate([motion.matrices(), placed[..., :3, :3]], axis=1)
        moved = np.zeros((len(motion), len(skeleton), 3), np.float32)
        moved[:, 0] = motion.translations
        moved[:, len(body) :] = placed[..., :3, 3] - self.points[:count]
        skin = np.pad(head.weights, ((0, 0), (0, count)))
        cloth = np.zeros((len(self.rest), len(skeleton)), np.float32)
        cloth[:, len(body) :] = self.weights[:, :count]
        cloth[:, self.joints] = self.weights[:, count:]
        name, faces = self.garment.name, self.garment.faces
        meshes = [
            AnimatedMesh(
                head.name, head.vertices, head.faces, skin, colour=SKIN_COLOUR
            ),
            AnimatedMesh(name, self.rest, faces, cloth, colour=CLOTH_COLOURS[0]),
        ]
        write_animation(path, skeleton, rotations, moved, motion.fps, meshes)


def _bone_names(taken: Sequence[str], count: int) -> list[str]:
    """`virtual_00` and so on, longer where a body has such names itself."""
    prefix = "virtual_"
    while any(name.startswith(prefix) for name in taken):
        prefix += "_"
    return [f"{prefix}{bone:02d}" for bone in range(count)]


def joint_weights(garment: Garment, rest: np.ndarray, body: Body) -> np.ndarray:
    """(V, J) of the points of the body closest to a garment that hangs at rest."""
    settled = Garment(rest, garment.faces, garment.pinned, garment.name)
    return closest_point_weights(settled, body.head)


def bind(
    config: LooseConfig, body: Body, garment: Garment, simulated: Sequence[Simulated]
) -> LooseGarment:
    """Place virtual bones and share out the garment; nothing is learnt yet.

    Raises:
        HeadError: the simulations are not of this garment, or of other bones; or a
            setting out of range.
    """
    rest = _checked_rest(body, garment, simulated)
    skeleton = body.head.skeleton
    nearest = joint_weights(garment, rest, body)
    every = max(1, sum(len(s.motion) for s in simulated) // LOOKED_AT)
    seen, skinned, drape = [], [], np.zeros(rest.shape)
    for motion, posed, _ in simulated:
        transforms = motion.transforms(skeleton)
        seen.append(root_frame(posed, transforms[:, 0])[::every])
        local = in_root_frame(transforms[::every])
        skinned.append(linear_blend_skinning(rest, nearest, local))
        drape += seen[-1].sum(axis=0)
    seen, skinned = np.concatenate(seen), np.concatenate(skinned)
    loose = np.ones(len(rest), np.float32)
    if config.hybrid:
        loose = looseness(skinned, seen, config.threshold, config.slope, config.reduce)

    around = _loose_faces(garment.faces, loose, config.bones)
    bones = place_bones(rest, around, config.bones, config.seed)
    distances = bone_distances(rest, garment.faces, bones)
    alpha = config.alpha
    if alpha is None:
        alpha = bone_spacing(distances, bones)
    shares = fading_heat if config.fade else heat_weights
    heat = shares(distances, alpha, config.influences, config.kernel)
    _, read = prune_joints(nearest, config.least)
    weights = hybrid_weights(loose, heat, nearest)
    weights, columns = prune_joints(weights, config.least, len(bones))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = VirtualBonesNet(9 * len(read) + 9, len(bones), config.network)
    carried = smooth(nearest, garment.faces, CARRIED)[bones]
    if not config.carry:
        carried = np.eye(1, len(skeleton), dtype=np.float32).repeat(len(bones), axis=0)
    return LooseGarment(
        body=body,
        garment=garment,
        network=network,
        rest=rest,
        drape=(drape / len(seen)).astype(np.float32),
        bones=bones,
        weights=weights,
        joints=columns[len(bones) :] - len(bones),
        read=read,
        carried=carried,
    )


def _loose_faces(faces: np.ndarray, loose: np.ndarray, count: int) -> np.ndarray:
    """(G, 3) those on which `count` virtual bones are of use: joints hold the others.

    All of them, where too little of a garment is loose.
    """
    found = faces[(loose[faces] > 0.5).all(axis=1)]
    return found if len(np.unique(found)) >= count else faces


def fading_heat(
    distances: np.ndarray, alpha: float, influences: int = 8, kernel: str = KERNELS[0]
) -> np.ndarray:
    """(V, N) float32 like `heat_weights`, but without a step. Equation `fading_heat`.

    Of the hottest bones that count, each loses the heat of the hottest one that does
    not: so a bone has faded out where another takes its place. Else the cloth is torn
    there into steps, which the mean error hardly tells.

    Raises:
        HeadError: as for `heat_weights`.

    >>> fading_heat(np.array([[0.0, 1, 1], [0, 1, 1.1]]), 1.0, 2).round(3)
    array([[1.  , 0.  , 0.  ],
           [0.91, 0.09, 0.  ]], dtype=float32)
    """
    cut = heat_weights(distances, alpha, influences, kernel)
    if influences >= distances.shape[1]:
        return cut
    heat = heat_weights(distances, alpha, influences + 1, kernel).astype(np.float64)
    heat = heat - np.partition(heat, -influences - 1)[:, [-influences - 1]]
    heat = np.maximum(heat, 0)
    total = heat.sum(axis=1, keepdims=True)
    # As far from all of them: nothing is left.
    left = np.where(total > 1e-6, heat / np.maximum(total, 1e-6), cut)
    return left.astype(np.float32)


def _checked_rest(
    body: Body, garment: Garment, simulated: Sequence[Simulated]
) -> np.ndarray:
    """(V, 3) the garment as it hung at rest in all simulations."""
    if not simulated:
        raise HeadError("simulated", "there is nothing", "simulate some motions first")
    rest = simulated[0].rest
    for motion, posed, other in simulated:
        if posed.shape[1:] != garment.vertices.shape:
            raise HeadError(
                "simulated",
                f"{posed.shape[1]} vertices, and {len(garment.vertices)} in the mesh",
                "give the mesh that was simulated",
            )
        if not np.array_equal(rest, other):
            raise HeadError(
                "simulated",
                "the garment does not hang alike at the start of all of them",
                "give simulations of one garment on one body",
            )
        if motion.fps != simulated[0].motion.fps:
            raise HeadError(
                "simulated",
                f"{motion.fps:g} and {simulated[0].motion.fps:g} frames a second",
                "simulate all motions at one rate",
            )
    return rest


# --- training -------------------------------------------------------------------------


def train(
    config: LooseConfig,
    body: Body,
    garment: Garment,
    simulated: Sequence[Simulated],
    out: str | Path,
) -> LooseGarment:
    """Train a network for a garment and keep it, with all it needs, in `out`.

    Called again with the same arguments after an interrupt it goes on where it was;
    called after the end it returns the trained garment.

    Args:
        garment: as it was cut, before it hung on the body.
        simulated: what to learn, of this garment on this body.

    Raises:
        HeadError: `out` holds another run, or as for `bind`.
        FloatingPointError: the error of a step is not finite.
        KeyboardInterrupt: passed on, after the state has been written.
    """
    trainer = LooseTrainer(config, body, garment, simulated, out)
    trainer.run()
    return trainer.garment


class LooseTrainer(Run):
    """One training run; see `train`. `step()` is one step, for a look inside.

    Attributes:
        garment: with the network as it is by now.
    """

    def __init__(
        self,
        config: LooseConfig,
        body: Body,
        garment: Garment,
        simulated: Sequence[Simulated],
        out: str | Path,
    ):
        self.garment = bind(config, body, garment, simulated)
        self.simulated = simulated
        lengths = np.array([len(item.motion) for item in simulated])
        if lengths.min() < config.window:
            raise HeadError(
                "simulated",
                f"a motion of {lengths.min()} frames",
                f"simulate motions of {config.window} frames or more",
            )
        ends = np.cumsum(lengths)
        # The first frames of all windows, among the frames of all motions.
        self.starts = np.concatenate(
            [
                np.arange(end - length, end - config.window + 1)
                for end, length in zip(ends, lengths, strict=True)
            ]
        )
        device, parts, truth, bodies = config.device, [], [], []
        for motion, posed, _ in simulated:
            transforms = motion.transforms(body.head.skeleton)
            parts.append(self.garment.inputs(transforms, motion.fps))
            truth.append(root_frame(posed, transforms[:, 0]))
            bodies.append(in_root_frame(transforms).astype(np.float32))
        self.data = [torch.cat(kind).to(device) for kind in zip(*parts, strict=True)]
        given = self.garment.rest, self.garment.weights, garment.faces
        truth = np.concatenate(truth)
        self.error = SkinningError(*given, truth).to(device)
        self.loss = SkinningError(*given, truth, config.edges).to(device)
        self.garment.network.standardise(self.data[0].cpu())
        self.network = self.garment.network.to(device)
        self.tensors = [part.to(device) for part in self.garment._tensors]
        self.obstacle = obstacle(garment, body.head).to(device)
        self.body = torch.from_numpy(np.concatenate(bodies)).to(device)
        self._start(config, out, [{"params": list(self.network.parameters())}])

    def step(self) -> dict[str, float]:
        """One step; returns the root mean square distance to the truth, in mm."""
        config = self.config
        rng = np.random.default_rng((config.seed, 2, self.steps_done))
        starts = rng.choice(self.starts, config.batch)
        frames = torch.from_numpy(starts[:, None] + np.arange(config.window))
        features, carrier, joints = (part[frames.to(part.device)] for part in self.data)
        placed = torch.cat([self.network(features, carrier), joints], dim=2)
        scored = slice(config.unscored, None)
        placed, frames = placed[:, scored], frames[:, scored]
        moved = placed @ self.tensors[2]
        with torch.no_grad():
            error = self.error(moved, frames).mean()
        # The error of a vertex does not tell whether cloth is torn; edges do.
        loss = self.loss(moved, frames).mean()
        if config.collision:
            late = rng.integers(config.window - config.unscored, size=config.touched)
            some = np.arange(config.touched) % config.batch, late
            pressed = self._collision(placed[some], frames[some])
            loss = loss + config.collision * pressed
        self.optimizer.zero_grad()
        loss.backward()
        if not torch.isfinite(loss):
            raise FloatingPointError(
                f"the error of step {self.steps_done} is not finite: lower "
                f"learning_rate ({config.learning_rate})"
            )
        nn.utils.clip_grad_norm_(self.parameters, 1.0)
        told = {"mm": 1000 * error.item() ** 0.5}
        self._update(told)
        return told

    def _collision(self, placed: Tensor, frames: Tensor) -> Tensor:
        """m^2, mean over vertices, see `collision_energy`.

        Args:
            placed: (B, C, 4, 4) in the frame of the root. frames: (B,).
        """
        rest, weights, offsets = self.tensors
        posed = hybrid_skinning(rest, weights, placed, offsets)
        with torch.no_grad():
            skin, normals = self.obstacle.pose(self.body[frames])
        under = nearest(posed, skin)
        near = take(skin, under), take(normals, under)
        return collision_energy(posed, *near, self.config.gap).mean() / len(rest)

    def _finish(self) -> nn.Module:
        self.network.cpu().eval()
        told = {"training": asdict(self.config), "seconds": round(self.seconds)}
        save_loose(self.out, self.garment, told)
        return self.network

    def _identity(self) -> dict:
        machine = ("threads", "device", "save_seconds")
        settings = {k: v for k, v in asdict(self.config).items() if k not in machine}
        garment, head = self.garment.garment, self.garment.body.head
        arrays = {
            "body vertices": [head.vertices],
            "body weights": [head.weights],
            "body joints": [head.skeleton.joints],
            "garment": [garment.vertices, self.garment.rest],
            "faces": [garment.faces],
            "pinned": [garment.pinned],
            "motions": [s.motion.rotations for s in self.simulated],
            "translations": [s.motion.translations for s in self.simulated],
            "simulated": [s.posed for s in self.simulated],
        }
        sums = {}
        for name, parts in arrays.items():
            sums[name] = 0
            for part in parts:
                sums[name] = crc32(np.ascontiguousarray(part), sums[name])
        return json.loads(json.dumps(settings | sums))


# --- folders --------------------------------------------------------------------------


def save_loose(folder: str | Path, garment: LooseGarment, extra: dict) -> None:
    """Write body, garment and network into a folder, each file whole or not at all."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_body(folder / BODY, garment.body)
    write_garment(folder / GARMENT, garment.garment)
    settings = {
        "kind": KIND,
        "network": asdict(garment.network.config),
        "name": garment.garment.name,
    }
    config = json.dumps(settings | extra, indent=1)
    tensors = {
        f"network.{key}": value.cpu().contiguous()
        for key, value in garment.network.state_dict().items()
    }
    for name in LooseGarment.ARRAYS:
        array = np.ascontiguousarray(getattr(garment, name))
        tensors[name] = torch.from_numpy(array.copy())
    write_tensors(folder / WEIGHTS, tensors, {"config": config})
    replace_file(folder / CONFIG, f"{config}\n".encode())


def is_loose(folder: str | Path) -> bool:
    """Whether a folder holds a garment on virtual bones, not another one or nothing."""
    try:
        return json.loads((Path(folder) / CONFIG).read_bytes()).get("kind") == KIND
    except (OSError, ValueError, AttributeError):
        return False


def load_loose(folder: str | Path) -> LooseGarment:
    """The garment that `train` wrote into a folder.

    Raises:
        HeadError: there is none, it is not finished, or a file is damaged.
    """
    folder = Path(folder)
    kind, command = "garment on virtual bones", "skinlib garment train"
    with reading_finished(folder, "garment", kind, command) as (tensors, metadata):
        stored = json.loads(metadata["config"])
        arrays = {name: tensors.pop(name).numpy() for name in LooseGarment.ARRAYS}
        state = {key.removeprefix("network."): v for key, v in tensors.items()}
        config = VirtualBonesConfig(**stored["network"])
        inputs = 9 * len(arrays["read"]) + 9
        network = VirtualBonesNet(inputs, len(arrays["bones"]), config)
        network.load_state_dict(state)
        name = str(stored["name"])
    cut = read_garment(folder / GARMENT)
    cut = Garment(cut.vertices, cut.faces, cut.pinned, name)
    garment = LooseGarment(read_body(folder / BODY), cut, network.eval(), **arrays)
    if not _belong_together(garment):
        raise HeadError(
            "garment",
            "body, garment and network do not belong together",
            "copy all files of one folder that `skinlib garment train` wrote",
            folder,
        )
    return garment


def _belong_together(loose: LooseGarment) -> bool:
    vertices, count = loose.garment.vertices, len(loose.body.head.skeleton)
    shapes = {
        "rest": vertices.shape,
        "drape": vertices.shape,
        "weights": (len(vertices), len(loose.bones) + len(loose.joints)),
        "carried": (len(loose.bones), count),
    }
    ids = ((loose.bones, len(vertices)), (loose.joints, count), (loose.read, count))
    return all(
        getattr(loose, key).shape == shape for key, shape in shapes.items()
    ) and (all(len(a) == 0 or 0 <= a.min() <= a.max() < size for a, size in ids))


# --- how good it is -------------------------------------------------------------------


def errors(
    garment: LooseGarment, simulated: Sequence[Simulated], baselines: bool = True
) -> dict[str, float]:
    """Root mean square distance to the truth over frames and vertices, in mm.

    Args:
        simulated: what it has not learnt, of the same garment.
        baselines: judge those of `LooseGarment.baselines`, too.

    Raises:
        HeadError: simulations of another garment.
    """
    _checked_rest(garment.body, garment.garment, simulated)
    squares: dict[str, list[float]] = {}
    frames = [len(item.motion) for item in simulated]
    for motion, posed, _ in simulated:
        ways = garment.baselines(motion) if baselines else {}
        for name, found in (ways | {KIND: garment.pose(motion)}).items():
            square = np.square(found - posed).sum(axis=-1).mean()
            squares.setdefault(name, []).append(float(square))
    return {
        name: 1000 * float(np.sqrt(np.average(values, weights=frames)))
        for name, values in squares.items()
    }
