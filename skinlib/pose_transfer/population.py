"""Who takes part in pose transfer: identities, their meshes and their poses, by a seed.

The source text and NPT train on 16 identities in 400 poses, and judge 14 others, in
poses of which half were trained on. So does a `Population`, with bodies in place of
SMPL's, which may not be shipped.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from skinlib.datasets.folder import load_folder
from skinlib.datasets.remesh import halve
from skinlib.garments.body import read_body
from skinlib.garments.measures import joined
from skinlib.garments.motion import JOINTS, Motion, Range, bend, random_poses
from skinlib.head import Head, HeadError, Skeleton
from skinlib.pose_transfer.data import (
    Cast,
    PosePairs,
    anny_bodies,
    drawn_bodies,
    on_mesh,
)

OTHERS = 1000  # seeds between those who train and those who judge
TURN = 12.0  # degrees, standard deviation of a face bone's turn about each axis
NPT_LIMITS: dict[str, tuple[Range, Range, Range]] = {
    "root": ((-2, 2), (-2, 2), (0, 0)),
    "spine": ((-5, 5),) * 3,
    "neck": ((-4, 4),) * 3,
    "shoulder": ((-30, 60), (-30, 60), (0, 0)),
    "elbow": ((-30, 30), (0, 0), (0, 0)),
    "wrist": ((-20, 20), (-10, 10), (0, 0)),
    "hip": ((0, 90), (0, 35), (0, 0)),
    "knee": ((0, 100), (0, 0), (0, 0)),
    "ankle": ((-10, 10), (-8, 8), (-10, 10)),
}
"""Flexion, abduction and twist in degrees, about as wide as NPT draws them for SMPL,
which starts from other angles of the arms; within `skinlib.garments.motion.JOINTS`."""

STRAIGHT = {"hip": ((0, 5), (0, 5), (0, 0)), "knee": ((0, 10), (0, 0), (0, 0))}
"""What every second pose has instead: it stands."""

KEPT_BACK = 4  # of the heads in a folder, every fourth judges


@dataclass(frozen=True)
class Population:
    """What is learnt, and what it is judged by. Everything follows from the seed.

    Raises:
        HeadError: numbers below 1, a negative seed, or so many identities that those
            who judge would be among them.
    """

    people: str = "shipped"
    """`shipped`: the shipped body in random shapes; `anny`: bodies of Anny's own
    distribution; else a folder of skinned heads or bodies that share a mesh; fewer than
    four of them judge themselves."""

    vertices: tuple[int, ...] = (1229,)
    """Of each mesh that their surface is given, by edge collapse; sources and targets
    are drawn from all of them. Empty: the mesh they have."""

    identities: int = 16  # to train; of a folder, three quarters
    judges: int = 14  # identities that training never sees; of a folder, the others
    poses: int = 400  # to train; as many again judge
    limits: Literal["npt", "wide"] = "npt"
    """How far a body's joints go: as in `NPT_LIMITS`, or all that they can. A face has
    neither; see `expressions`."""

    seed: int = 0

    def __post_init__(self):
        for name, least in (("identities", 1), ("judges", 1), ("poses", 1)):
            if getattr(self, name) < least:
                raise HeadError(name, f"{getattr(self, name)}", f"give {least} or more")
        if self.identities > OTHERS:
            raise HeadError(
                "identities", f"{self.identities}", f"give {OTHERS} or fewer"
            )
        if self.seed < 0:
            raise HeadError("seed", f"{self.seed}", "give 0 or more")
        for count in self.vertices:
            if count < 4:
                raise HeadError("vertices", f"{count}", "give 4 or more")

    def describe(self) -> dict:
        """The settings, as plain values."""
        return asdict(self)

    @classmethod
    def read(cls, told: dict, file: str | Path) -> "Population":
        """The one that `skinlib pose train` kept in a `config.json`.

        Raises:
            HeadError: there is none, or it is damaged.
        """
        try:
            settings = dict(told["population"])
            vertices = tuple(map(int, settings.pop("vertices")))
            return cls(vertices=vertices, **settings)
        except (KeyError, TypeError, ValueError) as error:
            raise HeadError(
                "population",
                f"there is none that could be read ({type(error).__name__})",
                "use a folder that `skinlib pose train` wrote",
                file,
            ) from error

    def casts(
        self, part: Literal["train", "judge"], device: torch.device | str = "cpu"
    ) -> list[Cast]:
        """One cast for each mesh, all with the same identities and poses.

        Poses 0 to `poses` - 1 are those of the training; casts that judge have as many
        others after them.
        """
        # Somebody who is the same for both parts: so are the axes of his joints, and
        # the meshes made of him.
        first = self.heads("train")[0]
        heads = self.heads(part)
        motion = self._motion(first.skeleton, self.seed)
        if part == "judge":
            unseen = self._motion(first.skeleton, self.seed + OTHERS)
            motion = joined([motion, unseen])
        return [Cast(group, motion, device) for group in self._on_meshes(heads, first)]

    def heads(self, part: Literal["train", "judge"]) -> list[Head]:
        """The identities at rest, on the mesh that they come with."""
        train = part == "train"
        count = self.identities if train else self.judges
        seed = self.seed if train else self.seed + OTHERS
        if self.people == "anny":
            return anny_bodies(count, seed, "notoes")
        if self.people == "shipped":
            return drawn_bodies(read_body(), count, seed)
        heads = load_folder(Path(self.people))
        _check_alike(heads, Path(self.people))
        if len(heads) < KEPT_BACK:
            return heads
        return [h for i, h in enumerate(heads) if (i % KEPT_BACK != 3) == train][:count]

    def _motion(self, skeleton: Skeleton, seed: int) -> Motion:
        moved = {bone for joint in JOINTS.values() for bone in joint.bones}
        draw = npt_poses if self.limits == "npt" else random_poses
        if not moved <= set(skeleton.names):
            draw = expressions
        return draw(skeleton, self.poses, seed)

    def _on_meshes(self, heads: Sequence[Head], first: Head) -> list[Sequence[Head]]:
        if not self.vertices:
            return [heads]
        groups = []
        for number, count in enumerate(self.vertices):
            keep = count / len(first.vertices)
            if keep > 1:
                raise HeadError(
                    "vertices",
                    f"{count} for people who have {len(first.vertices)}",
                    "give fewer, or none for the mesh they have",
                )
            mesh = halve(first, np.random.default_rng((self.seed, number)), keep)
            groups.append(on_mesh(heads, first, mesh))
        return groups


def pairs(
    casts: Sequence[Cast], count: int, seed: int = 0, **settings
) -> list[PosePairs]:
    """Pairs from each mesh to each, `count` in all; `settings` as for `PosePairs`.

    Raises:
        HeadError: as `PosePairs`.
    """
    kinds = list(product(casts, casts))
    counts = [len(part) for part in np.array_split(np.arange(count), len(kinds))]
    return [
        PosePairs(sources, targets, many, seed + number, **settings)
        for number, ((sources, targets), many) in enumerate(
            zip(kinds, counts, strict=True)
        )
        if many
    ]


def judging(
    population: Population, count: int, seed: int = 0, **settings
) -> tuple[list[PosePairs], list[PosePairs]]:
    """`count` pairs of people who do not train, in seen and in unseen poses."""
    casts = population.casts("judge")
    half = population.poses
    return (
        pairs(casts, count, seed, poses=range(half), **settings),
        pairs(casts, count, seed, poses=range(half, 2 * half), **settings),
    )


def expressions(
    skeleton: Skeleton, count: int, seed: int, degrees: float = TURN
) -> Motion:
    """Independent poses for bones that are no body's, such as those of a face.

    Each bone but the roots is turned about each axis by a normally distributed angle.
    Pose i depends on the seed and on i alone.

    Args:
        degrees: standard deviation.
    """
    still = skeleton.parents < 0
    rotations = np.stack(
        [
            np.random.default_rng((seed, pose)).normal(0, degrees, (len(still), 3))
            for pose in range(count)
        ]
    )
    rotations[:, still] = 0
    return Motion.create(np.radians(rotations), skeleton.names, name="expressions")


def npt_poses(skeleton: Skeleton, count: int, seed: int) -> Motion:
    """Independent poses as NPT draws them, each angle uniform within `NPT_LIMITS`.

    Every second one stands. Pose i depends on the seed and on i alone.

    Raises:
        HeadError: a skeleton without the bones of `JOINTS`.
    """
    poses = []
    for pose in range(count):
        rng = np.random.default_rng((seed, pose))
        limits = NPT_LIMITS if pose % 2 == 0 else NPT_LIMITS | STRAIGHT
        low, high = np.array([limits[name.partition(".")[0]] for name in JOINTS]).T
        angles = rng.uniform(low, high).T
        poses.append(bend(skeleton, dict(zip(JOINTS, angles, strict=True))))
    return Motion.create(np.stack(poses), skeleton.names, name="poses as NPT's")


def _check_alike(heads: Sequence[Head], folder: Path) -> None:
    first = heads[0]
    for head in heads:
        if head.weights is None:
            raise HeadError("weights", f"{head.name} has none", "skin it first", folder)
        if (
            not np.array_equal(head.faces, first.faces)
            or head.skeleton.names != first.skeleton.names
        ):
            raise HeadError(
                "people",
                f"{head.name} has other triangles or bones than {first.name}",
                "give heads or bodies that share a mesh and a skeleton, in one order",
                folder,
            )
