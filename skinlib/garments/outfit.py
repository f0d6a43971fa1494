"""What somebody wears: garments on a body, innermost first, and the network that
moves them. A folder holds all of it, so that it plays without anything else."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, cycle, pairwise
from pathlib import Path

import numpy as np
import torch

from skinlib.animation import AnimatedMesh, write_animation
from skinlib.garments.binding import (
    check_fit,
    closest_point_values,
    closest_point_weights,
    layers_apart,
    smooth,
)
from skinlib.garments.body import Body, read_body, write_body
from skinlib.garments.collision import NEAR, Collider, near, reached
from skinlib.garments.energies import Cloth
from skinlib.garments.garment import Garment, read_garment, write_garment
from skinlib.garments.motion import Motion
from skinlib.garments.pbns import PBNS, PBNSConfig
from skinlib.head import HeadError
from skinlib.painting import limit_influences
from skinlib.paths import trained
from skinlib.training.checkpoint import (
    CONFIG,
    WEIGHTS,
    reading_finished,
    replace_file,
    write_tensors,
)

INFLUENCES = 8  # bones a vertex: two sets in glTF
CARRIED = 20  # rounds of smoothing of what the body's shapes do to the cloth
MOVES = 0.5
"""A bone counts when the weights it has add up to more than half a vertex."""

LOOKED_AT, SPACING = 2000, 0.008
"""Poses in which we look what a garment touches: a few seconds; and metres between the
points of that: fingers are modelled finer than cloth can feel."""

EASE_RANGE = (-0.05, 0.1)
"""By how much cloth is cut wider in training with shapes."""

BEFORE = {"slope": 0.0, "rounding": 0.0}
"""What networks had that were written before these settings."""

BODY = "body.npz"
FRAMES = 64  # posed at once
CLOTH_COLOURS = ((0.12, 0.3, 0.5, 1.0), (0.55, 0.2, 0.15, 1.0), (0.5, 0.45, 0.3, 1.0))
SKIN_COLOUR = (0.7, 0.52, 0.42, 1.0)


@dataclass(frozen=True, eq=False)
class Outfit:
    """One or more garments on a body, the innermost first; see `Outfit.create`."""

    body: Body
    garments: tuple[Garment, ...]

    @classmethod
    def create(cls, body: Body, garments: Sequence[Garment]) -> "Outfit":
        """Check that the garments fit the body and each other.

        Raises:
            HeadError: none, one far from the body or inside it, or layers that already
                are in each other.
        """
        if not garments:
            raise HeadError("garments", "there are none", "name at least one mesh")
        for garment in garments:
            check_fit(garment, body.head)
        for inner, outer in combinations(garments, 2):
            layers_apart(inner, outer)
        return cls(body, tuple(garments))

    @cached_property
    def parts(self) -> list[slice]:
        """Where the vertices of each garment are among those of all."""
        ends = np.cumsum([0, *(len(garment.vertices) for garment in self.garments)])
        return [slice(*pair) for pair in pairwise(ends.tolist())]

    @cached_property
    def vertices(self) -> np.ndarray:
        """(V, 3) rest positions, garment after garment."""
        return np.concatenate([garment.vertices for garment in self.garments])

    @cached_property
    def faces(self) -> np.ndarray:
        """(F, 3) ids among the vertices of all."""
        pairs = zip(self.garments, self.parts, strict=True)
        return np.concatenate([garment.faces + part.start for garment, part in pairs])

    @cached_property
    def pinned(self) -> np.ndarray:
        """(V,) bool."""
        return np.concatenate([garment.pinned for garment in self.garments])

    @cached_property
    def cloth(self) -> Cloth:
        """Springs, hinges and masses of all garments."""
        return Cloth(self.vertices, self.faces)

    def blend_weights(self, smoothing: int) -> np.ndarray:
        """(V, J) float32: the weights of the closest points of the body, smoothed.

        Args:
            smoothing: rounds of averaging over neighbours: 10 calms a tight garment, a
                skirt takes 50. At most `INFLUENCES` bones a vertex are kept.
        """
        each = [closest_point_weights(g, self.body.head) for g in self.garments]
        weights = smooth(np.concatenate(each), self.faces, smoothing)
        return limit_influences(weights, INFLUENCES).astype(np.float32)

    def network(
        self,
        config: PBNSConfig,
        smoothing: int,
        shapes: bool,
        seed: int,
        collider: Collider | None = None,
    ) -> PBNS:
        """An untrained network: linear blend skinning.

        Args:
            shapes: let it learn the shapes of the body, too.
            collider: what the garments can touch; it reads the bones that move it.
        """
        weights, obstacle = self.blend_weights(smoothing), collider or self.collider
        # The bones that move the cloth or what it lies on; not the root, see `inputs`.
        moved = obstacle.weights.numpy().sum(0) + weights.sum(0) > MOVES
        moved &= self.body.head.skeleton.parents >= 0
        carried = np.zeros((0, len(weights), 3), np.float32)
        if shapes:
            carried = self._carried(self.body.shape_vertices)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return PBNS(self.vertices, weights, np.flatnonzero(moved), carried, config)

    def _carried(self, shapes: np.ndarray) -> np.ndarray:
        """(K, V, 3) what the shapes of the body do to the cloth: what they do below."""
        flat = shapes.transpose(1, 0, 2).reshape(shapes.shape[1], -1)
        moved = closest_point_values(self.vertices, self.body.head, flat)
        moved = smooth(moved, self.faces, CARRIED)
        return moved.reshape(len(moved), -1, 3).transpose(1, 0, 2)

    def graded(self, shape: Mapping[str, float]) -> np.ndarray:
        """(V, 3) the garments at rest, cut for a body of another shape."""
        if not shape:
            return self.vertices
        amounts = self.body.coefficients(shape)
        moved = self._carried(self.body.shape_vertices)
        return self.vertices + np.tensordot(amounts, moved, 1)

    @cached_property
    def collider(self) -> Collider:
        """The part of the body that the garments can touch at rest."""
        return Collider(self.body.head, near(self.body.head, self.vertices))

    def collider_in(self, motion: Motion, smoothing: int, touch: float) -> Collider:
        """The part that they can touch at rest or in one of the poses.

        Args:
            smoothing: of the blend weights that move them meanwhile.
            touch: metres within which what is skinned so is touched; 0 for `collider`.
        """
        if not touch:
            return self.collider
        head, step = self.body.head, -(-len(motion) // LOOKED_AT)
        transforms = motion.transforms(head.skeleton)[::step]
        weights = self.blend_weights(smoothing)
        touched = reached(head, self.vertices, weights, transforms, touch)
        everything = np.union1d(touched, near(head, self.vertices, NEAR))
        return Collider(head, everything, SPACING)

    @cached_property
    def overlaps(self) -> list[tuple[slice, slice, np.ndarray]]:
        """Of each two layers the vertices, inner and outer, and the inner faces."""
        layers = zip(self.parts, self.garments, strict=True)
        return [
            (inner, outer, garment.faces)
            for (inner, garment), (outer, _) in combinations(layers, 2)
        ]

    def pose(
        self,
        network: PBNS,
        motion: Motion,
        shape: Mapping[str, float] | None = None,
        ease: float = 0.0,
    ) -> np.ndarray:
        """(T, V, 3) float32 the posed vertices of all garments; see `parts`.

        Args:
            shape: amounts of the body's shapes, such as `{"weight": 0.5}`.
            ease: by how much the cloth is cut wider, -0.05 to 0.1, which is 10 %.

        Raises:
            HeadError: the bones of the motion are not those of the body, a shape for a
                network that has not learnt any, or an ease that it has not learnt.
        """
        inputs, transforms, amounts = self._read(network, motion, shape, ease)
        with torch.inference_mode():
            batches = (part.split(FRAMES) for part in (inputs, transforms, amounts))
            posed = [network(*batch)[0] for batch in zip(*batches, strict=True)]
        return torch.cat(posed).numpy()

    def _read(self, network, motion, shape, ease):
        frames = len(motion)
        if (shape or ease) and not len(network.shapes):
            raise HeadError(
                "shape", "this garment was made for one body", "train it with --shapes"
            )
        low, high = EASE_RANGE
        if not low <= ease <= high:
            raise HeadError("ease", f"it is {ease:g}", f"give {low:g} to {high:g}")
        amounts = np.tile(self.body.coefficients(shape or {}), (frames, 1))
        transforms = torch.from_numpy(self.body.transforms(motion, amounts))
        inputs = network.inputs(motion.rotations, amounts, np.full(frames, ease))
        return inputs, transforms, torch.from_numpy(amounts)

    def export(
        self,
        path: str | Path,
        network: PBNS,
        motion: Motion,
        shape: Mapping[str, float] | None = None,
        ease: float = 0.0,
    ) -> None:
        """Write body and garments in motion to a `.glb`, whole or not at all.

        The garments carry the columns of D as morph targets, driven by X frame by
        frame, then their skin: an engine does what the network does.
        """
        head = self.body.shaped(shape or {})
        inputs, _, amounts = self._read(network, motion, shape, ease)
        with torch.inference_mode():
            embedding = network.embed(inputs).numpy()
            columns = network.columns.unflatten(-1, (-1, 3)).numpy()
            weights = network.blend_weights.numpy()
            rest = np.broadcast_to(network.graded(amounts[0]), columns.shape[1:])
        meshes = [
            AnimatedMesh(
                head.name, head.vertices, head.faces, head.weights, colour=SKIN_COLOUR
            )
        ]
        layers = zip(self.garments, self.parts, cycle(CLOTH_COLOURS), strict=False)
        for garment, part, colour in layers:
            mesh = AnimatedMesh(
                garment.name,
                rest[part],
                garment.faces,
                weights[part],
                columns[:, part],
                embedding,
                colour,
            )
            meshes.append(mesh)
        write_animation(
            path,
            head.skeleton,
            motion.matrices(),
            motion.translations,
            motion.fps,
            meshes,
        )


def save_outfit(
    folder: str | Path, outfit: Outfit, network: PBNS, extra: Mapping
) -> None:
    """Write body, garments and network into a folder, each file whole or not at all."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_body(folder / BODY, outfit.body)
    names = [f"garment_{i}.npz" for i in range(len(outfit.garments))]
    for name, garment in zip(names, outfit.garments, strict=True):
        write_garment(folder / name, garment)
    labels = [garment.name for garment in outfit.garments]
    settings = {"network": network.describe(), "garments": names, "names": labels}
    config = json.dumps(settings | dict(extra), indent=1)
    tensors = {k: v.cpu().contiguous() for k, v in network.state_dict().items()}
    write_tensors(folder / WEIGHTS, tensors, {"config": config})
    replace_file(folder / CONFIG, f"{config}\n".encode())


def load_outfit(name: str | Path) -> tuple[Outfit, PBNS]:
    """The outfit and the network that `skinlib garment train` wrote, or shipped ones.

    Args:
        name: a folder, or a name in `checkpoints/`.

    Raises:
        HeadError: there is none, it is not finished, or a file is damaged.
    """
    folder, command = trained(name), "skinlib garment train"
    with reading_finished(folder, "outfit", "outfit", command) as (tensors, metadata):
        stored = json.loads(metadata["config"])
        config = PBNSConfig(**BEFORE | stored["network"])
        names = list(zip(stored["garments"], stored["names"], strict=True))
        buffers = [tensors[key].numpy() for key in PBNS.BUFFERS]
        network = PBNS(*buffers, config)
        network.load_state_dict(tensors)
    garments = tuple(
        replace(read_garment(folder / Path(name).name), name=str(label))
        for name, label in names
    )
    outfit = Outfit(read_body(folder / BODY), garments)
    if not _belong_together(outfit, network):
        raise HeadError(
            "outfit",
            "body, garments and network do not belong together",
            "copy all files of one folder that `skinlib garment train` wrote",
            folder,
        )
    return outfit, network.eval()


def _belong_together(outfit: Outfit, network: PBNS) -> bool:
    shapes, bones = len(network.shapes), network.weights.shape[1]
    return (
        np.array_equal(outfit.vertices, network.template.numpy())
        and bones == len(outfit.body.head.skeleton)
        and shapes in (0, len(outfit.body.shape_names))
    )
