"""Poses and motions for a body: drawn within joint limits, or procedural, looping.

A pose turns joints by angles in degrees from the A-pose: flexion, abduction and twist
about the three axes of `joint_axes`. Bones that form one joint, such as the spine,
share its angles. Bones are found by Anny's names (see `skinlib.garments.body`); Z is
up, the face looks towards -Y, the left hand is at +X.

Symbols: T frames, J bones, V vertices.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation
from tqdm.auto import tqdm

from skinlib.geometry import safe_normalize, vertex_normals
from skinlib.head import Head, HeadError, Skeleton
from skinlib.io import atomic
from skinlib.skinning import descendants, forward_kinematics, linear_blend_skinning

MOST_TURNED = 4 * np.pi
"""Radians: a longer rotation vector is most likely one in degrees."""

FORWARD, UP = np.array([0.0, -1, 0]), np.array([0.0, 0, 1])


@dataclass(frozen=True, eq=False)
class Motion:
    """T poses of J bones, independent ones or the frames of a sequence.

    Build one with `Motion.create`.

    Attributes:
        rotations: (T, J, 3) float32 rotation vectors in radians: how each bone turns
            about its own joint, in the axes of the file; children follow their parents.
        translations: (T, 3) float32, how far the root moves, in metres.
        bone_names: J strings.
        fps: frames per second.
        name: shown to people.
    """

    rotations: np.ndarray
    translations: np.ndarray
    bone_names: tuple[str, ...]
    fps: float
    name: str = ""

    @classmethod
    def create(
        cls,
        rotations: ArrayLike,
        bone_names: Sequence[str],
        translations: ArrayLike | None = None,
        fps: float = 30.0,
        name: str = "",
        file: str | Path | None = None,
    ) -> "Motion":
        """Check everything and make a `Motion`; the root stays when not translated.

        Raises:
            HeadError: a wrong shape, NaN, no frame, a frame rate not above 0, or
                rotations of several turns, as those in degrees are.

        >>> Motion.create(np.zeros((2, 1, 3)), ["head"]).matrices()[0, 0].tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        """
        names = tuple(str(name) for name in bone_names)
        rotations = _numbers(rotations, "rotations", (None, len(names), 3), file)
        if translations is None:
            translations = np.zeros((len(rotations), 3))
        shape = (len(rotations), 3)
        translations = _numbers(translations, "translations", shape, file)
        angle = np.linalg.norm(rotations.astype(np.float64), axis=-1)
        if angle.max() > MOST_TURNED:
            frame, bone = np.unravel_index(angle.argmax(), angle.shape)
            raise HeadError(
                "rotations",
                f"{names[bone]!r} turns by {angle.max():.3g} radians in frame {frame}",
                "give rotation vectors in radians: a whole turn is 6.28 long",
                file,
            )
        if not (np.isfinite(fps) and fps > 0):
            raise HeadError("fps", f"it is {fps:g}", "give frames per second", file)
        return cls(rotations, translations, names, float(fps), str(name))

    def __len__(self) -> int:
        return len(self.rotations)

    def matrices(self) -> np.ndarray:
        """(T, J, 3, 3) float32 rotation matrices."""
        turns = Rotation.from_rotvec(self.rotations.reshape(-1, 3)).as_matrix()
        return turns.reshape(*self.rotations.shape, 3).astype(np.float32)

    def transforms(self, skeleton: Skeleton) -> np.ndarray:
        """(T, J, 4, 4) float32 for `linear_blend_skinning`.

        Raises:
            HeadError: the bones are not those of the skeleton, in its order.
        """
        for mine, other in zip(self.bone_names, skeleton.names, strict=False):
            if mine != other:
                raise HeadError(
                    "bone_names",
                    f"the motion has {mine!r} where the skeleton has {other!r}",
                    "use a motion made for this skeleton",
                )
        if len(self.bone_names) != len(skeleton):
            raise HeadError(
                "bone_names",
                f"a motion of {len(self.bone_names)} bones, a skeleton of "
                f"{len(skeleton)}",
                "use a motion made for this skeleton",
            )
        moved = np.zeros_like(self.rotations)
        moved[:, skeleton.parents < 0] = self.translations[:, None]
        return forward_kinematics(skeleton, self.matrices(), moved)


def _numbers(values, field, shape, file) -> np.ndarray:
    """`values` as a read-only float32 array of that shape (None: one or more)."""
    array = np.asarray(values)
    fits = array.ndim == len(shape) and all(
        size > 0 if wanted is None else size == wanted
        for wanted, size in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in "iuf":
        wanted = ", ".join("1 or more" if n is None else str(n) for n in shape)
        raise HeadError(
            field,
            f"{array.dtype} values of shape {array.shape}",
            f"give numbers of shape ({wanted})",
            file,
        )
    with np.errstate(over="ignore"):
        array = np.array(array, np.float32)
    bad = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
    if bad.any():
        raise HeadError(
            field,
            f"{bad.sum()} frames hold NaN or infinity, the first is frame "
            f"{bad.argmax()}",
            "give finite numbers",
            file,
        )
    array.flags.writeable = False
    return array


def read_motion(path: str | Path) -> Motion:
    """Read a motion from a `.npz` file that `write_motion` wrote.

    Fields: `rotations` (T, J, 3), `bone_names` (J,), and, where given, `translations`
    (T, 3) and `fps`. Its name is the file's stem.

    Raises:
        HeadError: it cannot be read, or holds no motion.
    """
    path = Path(path)
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            fields = {key: arrays[key] for key in arrays.files}
            rotations, names = fields["rotations"], fields["bone_names"]
            fps = float(fields.get("fps", 30.0))
    except Exception as error:  # whatever a damaged archive makes the libraries raise
        raise HeadError(
            "motion",
            f"it cannot be read ({type(error).__name__}: {str(error)[:200]})",
            "save rotations and bone_names with numpy.savez, without pickles",
            path,
        ) from error
    if names.ndim != 1 or names.dtype.kind != "U":
        raise HeadError(
            "bone_names",
            f"{names.dtype} values of shape {names.shape}",
            "store one string per bone",
            path,
        )
    translations = fields.get("translations")
    return Motion.create(rotations, names.tolist(), translations, fps, path.stem, path)


def write_motion(path: str | Path, motion: Motion) -> None:
    """Write a motion to a compressed `.npz` file, whole or not at all.

    Raises:
        HeadError: the file cannot be written.
    """
    with atomic(path) as file:
        np.savez_compressed(
            file,
            rotations=motion.rotations,
            translations=motion.translations,
            bone_names=np.array(motion.bone_names),
            fps=np.float64(motion.fps),
        )


# --- joints -------------------------------------------------------------------------

Range = tuple[float, float]


class Joint(NamedTuple):
    """What a joint can do, in degrees from the A-pose, and which bones do it.

    Attributes:
        flexion, abduction, twist: lowest and highest angle.
        bones: the part that each bone has in the three; they sum to 1 where it moves.
        start, end: the bones whose joints begin and end the limb that moves; none for
            the trunk, which stands upright.
    """

    flexion: Range
    abduction: Range
    twist: Range
    bones: Mapping[str, tuple[float, float, float]]
    start: str = ""
    end: str = ""


def _alike(*bones: str) -> dict[str, tuple[float, float, float]]:
    return dict.fromkeys(bones, (1 / len(bones),) * 3)


_SPINE = _alike("spine05", "spine04", "spine03", "spine02", "spine01")
_NECK = _alike("neck01", "neck02", "neck03", "head")
_MIDDLE = {
    "root": Joint((-10, 30), (-10, 10), (0, 0), _alike("root")),
    "spine": Joint((-20, 45), (-20, 20), (-30, 30), _SPINE),
    "neck": Joint((-30, 35), (-25, 25), (-50, 50), _NECK),
}
# The collar bone and the shoulder blade lift with the arm. Where two bones lie in one
# segment, the upper one swings it and the lower one twists it.
_SHOULDER = {
    "clavicle": (0.1, 0.15, 0),
    "shoulder01": (0.1, 0.1, 0),
    "upperarm01": (0.8, 0.75, 0),
    "upperarm02": (0, 0, 1),
}
_HIP = {"upperleg01": (1, 1, 0), "upperleg02": (0, 0, 1)}
_ELBOW = {"lowerarm01": (1, 1, 0), "lowerarm02": (0, 0, 1)}
_SIDED = {
    "shoulder": Joint(
        (-30, 95), (-35, 65), (-35, 35), _SHOULDER, "upperarm01", "lowerarm01"
    ),
    "elbow": Joint((-35, 95), (0, 0), (-45, 45), _ELBOW, "lowerarm01", "wrist"),
    "wrist": Joint(
        (-35, 35), (-15, 15), (0, 0), _alike("wrist"), "lowerarm01", "wrist"
    ),
    "hip": Joint((-20, 90), (-12, 35), (-20, 20), _HIP, "upperleg01", "lowerleg01"),
    "knee": Joint((0, 120), (0, 0), (0, 0), _alike("lowerleg01"), "lowerleg01", "foot"),
    "ankle": Joint((-35, 25), (-8, 8), (-10, 10), _alike("foot"), "lowerleg01", "foot"),
}


def _on_side(joint: Joint, side: str) -> Joint:
    return joint._replace(
        bones={bone + side: part for bone, part in joint.bones.items()},
        start=joint.start + side,
        end=joint.end + side,
    )


JOINTS: dict[str, Joint] = _MIDDLE | {
    name + side: _on_side(joint, side)
    for side in (".L", ".R")
    for name, joint in _SIDED.items()
}
"""The joints by name: `root`, `spine`, `neck`, and `shoulder.L`, `elbow.L`, `wrist.L`,
`hip.L`, `knee.L`, `ankle.L` and those of the right.

Flexion swings a limb or bends the trunk forwards; it bends elbows, knees and wrists,
and lifts the toes. Abduction lifts a limb sideways and bends the trunk to the left.
Twist turns a limb's front inwards, and the trunk to the left. In the A-pose the arms
hang 48 degrees below the horizontal and the elbows are bent by 42: abduction of 48
lifts an arm to the horizontal, and elbow flexion of -35 nearly straightens it. The
ranges were chosen by eye on the shipped body.
"""

LIMITS: dict[str, np.ndarray] = {
    bone: np.outer(part, (1, 1)) * np.array(joint[:3], float)
    for joint in JOINTS.values()
    for bone, part in joint.bones.items()
}
"""By bone, (3, 2): lowest and highest flexion, abduction and twist in degrees, the
components of its rotation vector along the axes of its joint. Other bones stay."""


def joint_axes(skeleton: Skeleton) -> dict[str, np.ndarray]:
    """By joint, (3, 3) unit rows at right angles: axes of flexion, abduction, twist.

    Angles are right-handed about them. Twist is about the limb from its joint to the
    next; flexion about what is perpendicular to it and to the forward direction, for
    elbows perpendicular to both halves of the bent arm. They come from the skeleton,
    so they fit each body shape. Right axes are the left ones in the mirror.

    Raises:
        HeadError: the skeleton lacks a bone of `JOINTS`.
    """
    joints = {
        name: point.astype(np.float64)
        for name, point in zip(skeleton.names, skeleton.joints, strict=True)
    }
    missing = sorted(set(LIMITS) - set(joints))
    if missing:
        raise HeadError(
            "bone_names",
            f"the skeleton has no {', '.join(missing[:3])}",
            "use a body with Anny's bone names, such as the shipped one",
        )
    axes = {}
    for name, joint in JOINTS.items():
        limb = joints[joint.end] - joints[joint.start] if joint.start else UP
        along, side = safe_normalize(limb), name[-2:]
        if name.startswith(("elbow", "wrist")):
            upper = joints["lowerarm01" + side] - joints["upperarm01" + side]
            flexion = safe_normalize(np.cross(upper, along))
        else:
            flexion = safe_normalize(np.cross(along, FORWARD))
            if name.startswith("knee"):
                flexion = -flexion
        abduction = np.cross(flexion, along)
        if name.startswith("knee") or not joint.start:
            abduction = -abduction
        mirror = -1 if side == ".R" else 1
        axes[name] = np.stack([flexion, mirror * abduction, mirror * along])
    return axes


def bend(skeleton: Skeleton, angles: Mapping[str, ArrayLike]) -> np.ndarray:
    """(..., J, 3) float32 rotation vectors of a body whose joints are bent.

    Args:
        angles: by joint, (..., 3) flexion, abduction and twist in degrees; joints that
            are left out stay as in the A-pose.

    Raises:
        HeadError: an unknown joint, or an angle beyond its limits.
    """
    axes = joint_axes(skeleton)
    angles = {name: np.asarray(value, np.float64) for name, value in angles.items()}
    frames = np.broadcast_shapes(*(value.shape[:-1] for value in angles.values()))
    rotations = np.zeros((*frames, len(skeleton), 3), np.float32)
    place = {name: bone for bone, name in enumerate(skeleton.names)}
    for name, value in angles.items():
        if name not in JOINTS:
            raise HeadError(
                "pose", f"no joint {name!r}", f"choose from {', '.join(JOINTS)}"
            )
        joint = JOINTS[name]
        for movement, (low, high), angle in zip(
            joint._fields, joint[:3], np.moveaxis(value, -1, 0), strict=False
        ):
            beyond = ~((low <= angle) & (angle <= high))
            if beyond.any():
                raise HeadError(
                    "pose",
                    f"{movement} of {name} is {np.atleast_1d(angle[beyond])[0]:.4g} "
                    "degrees",
                    f"keep it within {low:g} to {high:g}",
                )
        for bone, part in joint.bones.items():
            rotations[..., place[bone], :] = np.radians(value * part) @ axes[name]
    return rotations


# --- self-intersection --------------------------------------------------------------

PARTS = {
    "left arm": "upperarm01.L",
    "right arm": "upperarm01.R",
    "left leg": "upperleg01.L",
    "right leg": "upperleg01.R",
    "head": "neck01",
}
"""The parts of a body that must stay out of each other, by the bone each begins with;
what remains is the torso."""

# A vertex that this much of the weights of one part moves is clear of the joint, where
# skin folds into itself in any case.
CLEAR = 0.99


class _Part(NamedTuple):
    """A part of the body as a closed mesh: its skin, and a fan over each cut.

    Attributes:
        ids: (n,) the body's vertices. clear: (n,) bool, far from other parts.
        skin: (f, 3) faces, in places of `ids`. caps: (c, 3) further ones; place n + i
            is the middle of the i-th cut. cuts: the places around each.
    """

    ids: np.ndarray
    clear: np.ndarray
    skin: np.ndarray
    caps: np.ndarray
    cuts: list[np.ndarray]

    def closed(self, points: np.ndarray) -> np.ndarray:
        """(n + cuts, 3) the posed points (n, 3) of the part and the middles."""
        return np.vstack([points, *(points[cut].mean(axis=0) for cut in self.cuts)])


def self_intersection(
    head: Head, transforms: np.ndarray, gap: float = 0.0
) -> np.ndarray:
    """(T,) metres: how deep a limb is in the torso, the head or another limb.

    The largest distance from a vertex of one of the `PARTS` that is inside another one
    to that one's skin; 0 when none is. Vertices near the joint of two parts, which both
    move, are left out, and a limb folded upon itself does not count.

    Args:
        head: a body with weights, closed. transforms: (T, J, 4, 4).
        gap: metres that limbs have to stay apart: the vertices are moved outwards by
            as much before they are looked at.

    Raises:
        HeadError: it has no weights, or lacks a bone of `PARTS`.
    """
    import igl  # here, since it takes long to load

    parts = _parts(head)
    depths = np.zeros(len(transforms))
    bar = tqdm(transforms, "poses", leave=False, delay=2)
    for frame, transform in enumerate(bar):
        posed = linear_blend_skinning(head.vertices, head.weights, transform)
        points = [posed[part.ids].astype(np.float64) for part in parts]
        raised = points
        if gap:
            posed = posed + gap * vertex_normals(posed, head.faces)
            raised = [posed[part.ids].astype(np.float64) for part in parts]
        for i, part in enumerate(parts):
            low, high = points[i].min(axis=0), points[i].max(axis=0)
            others = np.concatenate(
                [raised[j][other.clear] for j, other in enumerate(parts) if j != i]
            )
            near = others[((others > low) & (others < high)).all(axis=1)]
            if len(near) == 0:
                continue
            shell = part.closed(points[i])
            faces = np.concatenate([part.skin, part.caps])
            inside = near[igl.fast_winding_number(shell, faces, near) > 0.5]
            if len(inside):
                squared, _, _ = igl.point_mesh_squared_distance(
                    inside, points[i], part.skin
                )
                depths[frame] = max(depths[frame], np.sqrt(squared.max()))
    return depths


def _parts(head: Head) -> list[_Part]:
    skeleton = head.skeleton
    if head.weights is None:
        raise HeadError("weights", "the body has none", "skin it first")
    owner = np.zeros(len(skeleton), np.int64)  # 0: the torso
    for number, bone in enumerate(PARTS.values(), start=1):
        if bone not in skeleton.names:
            raise HeadError(
                "bone_names", f"the skeleton has no {bone}", "use Anny's bone names"
            )
        owner[descendants(skeleton, [skeleton.names.index(bone)])] = number
    shares = head.weights @ np.eye(len(PARTS) + 1)[owner]  # (V, parts)
    part_of = shares.argmax(axis=1)
    clear = shares.max(axis=1) > CLEAR

    parts = []
    for number in range(len(PARTS) + 1):
        ids = np.flatnonzero(part_of == number)
        place = np.zeros(len(part_of), np.int64)
        place[ids] = np.arange(len(ids))
        skin = place[head.faces[(part_of[head.faces] == number).all(axis=1)]]
        parts.append(_Part(ids, clear[ids], skin, *_caps(skin, len(ids))))
    return parts


def _caps(faces: np.ndarray, count: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Fans that close a mesh of `count` vertices, and the vertices around each cut."""
    sides = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    key, opposite = sides @ [count, 1], sides @ [1, count]
    border = sides[~np.isin(key, opposite)]
    graph = coo_matrix((np.ones(len(border)), tuple(border.T)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    labels, cut = np.unique(label[border[:, 0]], return_inverse=True)
    caps = np.stack([border[:, 1], border[:, 0], count + cut], axis=1)
    return caps, [np.flatnonzero(label == number) for number in labels]


# --- random poses -------------------------------------------------------------------

DEEPEST = 0.005  # metres that a limb may be in another, less than its skin gives way
ATTEMPTS = 200


def random_poses(
    skeleton: Skeleton,
    count: int,
    seed: int,
    head: Head | None = None,
    gap: float = 0.0,
) -> Motion:
    """Independent poses within the limits of all joints, left and right on their own.

    Every second pose is wide, with each angle uniform within `JOINTS`, and the others
    are moderate, with half of such angles. Pose i depends on the seed and on i alone.

    Args:
        count: 1 or more. seed: 0 or more.
        head: a body: poses that put one of its limbs more than 5 mm into another (see
            `self_intersection`) are drawn again.
        gap: metres that its limbs have to stay apart, all but 5 mm of it: between an
            arm and the chest there must be room for two layers of cloth.

    Raises:
        HeadError: no count, a negative seed, a skeleton without the bones of `JOINTS`,
            or a body whose limbs are in each other whatever the pose.
    """
    if count < 1 or seed < 0:
        raise HeadError(
            "poses",
            f"{count} poses with seed {seed}",
            "ask for 1 or more, with a seed of 0 or more",
        )
    rotations = np.stack([_drawn(skeleton, seed, i, 0) for i in range(count)])
    pending = np.arange(count) if head is not None else np.arange(0)
    for attempt in range(1, ATTEMPTS + 1):
        if len(pending) == 0:
            break
        drawn = Motion.create(rotations[pending], skeleton.names)
        depth = self_intersection(head, drawn.transforms(skeleton), gap)
        pending = pending[depth > DEEPEST]
        for pose in pending.tolist():
            rotations[pose] = _drawn(skeleton, seed, pose, attempt)
    else:
        raise HeadError(
            "poses",
            f"{ATTEMPTS} poses in a row put a limb more than 5 mm into another",
            "use a body whose limbs are apart at rest",
        )
    return Motion.create(rotations, skeleton.names, name="random poses")


def _drawn(skeleton: Skeleton, seed: int, pose: int, attempt: int) -> np.ndarray:
    rng = np.random.default_rng((seed, pose, attempt))
    size = 1.0 if pose % 2 == 0 else 0.5
    angles = {}
    for name, joint in JOINTS.items():
        low, high = np.transpose(joint[:3])
        angles[name] = size * rng.uniform(low, high)
    return bend(skeleton, angles)


SIDES = {".L": ".R", ".R": ".L"}


def mirrored(motion: Motion) -> Motion:
    """The same poses with left and right exchanged, as a mirror at x = 0 shows them.

    Bones are exchanged by the ends of their names, .L and .R; others stay.

    >>> lift = Motion.create([[[1, 2, 3], [0, 0, 0]]], ["hand.L", "hand.R"])
    >>> mirrored(lift).rotations[0].tolist()
    [[0.0, -0.0, -0.0], [1.0, -2.0, -3.0]]
    """
    names = motion.bone_names
    place = {name: bone for bone, name in enumerate(names)}
    other = [
        place.get(name[:-2] + SIDES.get(name[-2:], name[-2:]), bone)
        for bone, name in enumerate(names)
    ]
    # A rotation is no arrow: the mirror turns its axis round, but for what is along x.
    rotations = motion.rotations[:, other] * np.float32([1, -1, -1])
    translations = motion.translations * np.float32([-1, 1, 1])
    return Motion.create(rotations, names, translations, motion.fps, motion.name)


# --- procedural motions -------------------------------------------------------------


def walk(
    skeleton: Skeleton,
    seconds: float = 4.0,
    speed: float = 0.9,
    stride: float = 25.0,
    arm_swing: float = 20.0,
    arm_raise: float = -25.0,
    crouch: float = 0.0,
    turn_rate: float = 0.0,
    travel: bool = False,
    fps: float = 30.0,
) -> Motion:
    """Walking, in place unless it travels; the lower ankle keeps its height.

    Args:
        seconds: how long; rounded to whole cycles, so that it loops.
        speed: cycles of two steps per second, 0.2 to 3.
        stride: swing of the thighs to the front, 0 to 40 degrees; to the back at most
            20.
        arm_swing: swing of the arms to the front, 0 to 60 degrees; to the back half.
        arm_raise: lift of the arms from the A-pose, -35 (beside the body) to 65.
        crouch: bend kept in the knees, 0 to 40 degrees.
        turn_rate: degrees per second to the left, -90 to 90; the loop then goes on in
            another direction.
        travel: whether the root moves forward, by the steps' length.
    """
    _within("stride", stride, 0, 40)
    _within("arm_swing", arm_swing, 0, 60)
    _within("crouch", crouch, 0, 40)
    _within("turn_rate", turn_rate, -90, 90)
    phase, period = _cycles(seconds, speed, fps)
    angles = {}
    for side, part in ((".L", 0.0), (".R", 0.5)):
        leg = (phase + part) % 1  # 0: the heel of this leg touches the floor
        swing = np.cos(2 * np.pi * leg)
        hip = np.where(swing > 0, stride, min(stride, 20)) * swing + crouch / 2
        # The knee gives way under the load, and lifts the foot as it swings forward.
        knee = crouch + stride * (0.4 * _bump(leg, 0.12) + 1.8 * _bump(leg, 0.72))
        level = knee - hip  # would keep the foot level
        ankle = (level + crouch / 2) / 2 - 0.8 * stride * _bump(leg, 0.62)
        arm = np.where(swing < 0, arm_swing, arm_swing / 2) * -swing
        angles |= {
            f"hip{side}": _degrees(hip),
            f"knee{side}": _degrees(knee),
            f"ankle{side}": _degrees(np.clip(ankle, *JOINTS["ankle.L"].flexion)),
            f"shoulder{side}": _degrees(arm, arm_raise),
            f"elbow{side}": _degrees(arm / 2 + crouch / 2),
        }
    # The shoulders turn against the hips.
    counter = np.cos(2 * np.pi * phase) * stride
    angles["spine"] = _degrees(crouch / 4, 0, 0.3 * counter)
    angles["neck"] = _degrees(-crouch / 4, 0, -0.3 * counter)
    heading = np.radians(turn_rate) * np.arange(len(phase)) / fps
    rotations = bend(skeleton, angles)
    moved = _on_the_floor(skeleton, rotations)
    rotations = _turned(skeleton, rotations, heading)
    if travel:
        foot, hip = _place(skeleton, "foot.L"), _place(skeleton, "upperleg01.L")
        leg = np.linalg.norm(skeleton.joints[foot] - skeleton.joints[hip])
        step = leg * (np.sin(np.radians(stride)) + np.sin(np.radians(min(stride, 20))))
        ahead = np.stack([np.sin(heading), -np.cos(heading)], axis=1)
        moved[1:, :2] = np.cumsum(2 * step / period * ahead[:-1], axis=0)
    return Motion.create(rotations, skeleton.names, moved, fps, "walk")


def turn(
    skeleton: Skeleton,
    seconds: float = 4.0,
    speed: float = 0.25,
    trunk: float = 25.0,
    head: float = 40.0,
    arm_raise: float = 30.0,
    elbow: float = 0.0,
    fps: float = 30.0,
) -> Motion:
    """Turning trunk and head to the left and to the right, arms held sideways.

    Args:
        seconds: how long; rounded to whole cycles, so that it loops.
        speed: cycles per second, 0.05 to 3.
        trunk: twist of the spine to either side, 0 to 30 degrees.
        head: twist of the neck, which runs ahead of the trunk, 0 to 50 degrees.
        arm_raise: lift of the arms from the A-pose, -35 (beside the body) to 65.
        elbow: flexion of the elbows from the A-pose, -35 (straight) to 95.
    """
    phase, _ = _cycles(seconds, speed, fps)
    ahead = np.sin(2 * np.pi * (phase + 0.06))
    angles = {
        "spine": _degrees(0, 0, trunk * np.sin(2 * np.pi * phase)),
        "neck": _degrees(0, 0, head * ahead),
    }
    for side in (".L", ".R"):
        angles["shoulder" + side] = _degrees(0, arm_raise)
        angles["elbow" + side] = _degrees(elbow)
    rotations = bend(skeleton, angles)
    return Motion.create(rotations, skeleton.names, fps=fps, name="turn")


def squat(
    skeleton: Skeleton,
    seconds: float = 4.0,
    speed: float = 0.5,
    depth: float = 75.0,
    lean: float = 20.0,
    arms: float = 60.0,
    stance: float = 0.0,
    fps: float = 30.0,
) -> Motion:
    """Knee bends with level feet on the floor, the arms going forward.

    Args:
        seconds: how long; rounded to whole cycles, so that it loops.
        speed: cycles per second, 0.05 to 3.
        depth: bend of the knees at the lowest point, 0 to 85 degrees.
        lean: of the trunk at the lowest point, 0 to 25 degrees.
        arms: lift of the arms to the front at the lowest point, -30 to 95 degrees.
        stance: how far the legs are apart, more than in the A-pose, -5 to 20 degrees.
    """
    _within("depth", depth, 0, 85)
    _within("lean", lean, 0, 25)
    phase, _ = _cycles(seconds, speed, fps)
    down = (1 - np.cos(2 * np.pi * phase)) / 2
    ankle = 22 / 85 * depth
    angles = {
        "root": _degrees(lean * down),
        "spine": _degrees(lean / 2 * down),
        "neck": _degrees(-lean * down),
    }
    for side in (".L", ".R"):
        # The angles from the pelvis to the foot cancel: the foot stays level.
        angles["hip" + side] = _degrees((depth + lean - ankle) * down, stance)
        angles["knee" + side] = _degrees(depth * down)
        angles["ankle" + side] = _degrees(ankle * down, -np.clip(stance, -8, 8))
        angles["shoulder" + side] = _degrees(arms * down, 30 * down - 20)
        angles["elbow" + side] = _degrees(-30 * down)
    rotations = bend(skeleton, angles)
    moved = _on_the_floor(skeleton, rotations)
    return Motion.create(rotations, skeleton.names, moved, fps, "squat")


def reach(
    skeleton: Skeleton,
    seconds: float = 4.0,
    speed: float = 0.25,
    amount: float = 1.0,
    lag: float = 0.0,
    lean: float = 10.0,
    fps: float = 30.0,
) -> Motion:
    """Reaching forward, sideways and up, one after the other, from hanging arms.

    Args:
        seconds: how long; rounded to whole cycles, so that it loops.
        speed: cycles of three reaches per second, 0.05 to 3.
        amount: how far, 0 (arms hang) to 1 (forward to the horizontal, up above it).
        lag: part of a cycle that the right arm is behind the left, 0 to 1.
        lean: of the trunk after the arms, 0 to 20 degrees.
    """
    _within("amount", amount, 0, 1)
    _within("lag", lag, 0, 1)
    _within("lean", lean, 0, 20)
    phase, _ = _cycles(seconds, speed, fps)
    angles, reaches = {}, {}
    for side, late in ((".L", 0.0), (".R", lag)):
        arm = (phase - late) % 1
        pulse = amount * np.sin(3 * np.pi * arm) ** 2
        forward, aside, up = (pulse * (arm * 3 // 1 == third) for third in range(3))
        hanging = 1 - forward - aside - up
        lift = 50 * aside + 65 * up - 20 * hanging
        angles["shoulder" + side] = _degrees(85 * forward + 60 * up, lift)
        angles["elbow" + side] = _degrees(-30 * pulse)
        reaches[side] = forward, aside
    (ahead, left), (also, right) = reaches.values()
    angles["spine"] = _degrees(
        lean * (ahead + also) / 2, lean * (left - right), lean * (also - ahead) / 2
    )
    rotations = bend(skeleton, angles)
    return Motion.create(rotations, skeleton.names, fps=fps, name="reach")


MOTIONS: dict[str, Callable[..., Motion]] = {
    "walk": walk,
    "turn": turn,
    "squat": squat,
    "reach": reach,
}
"""The procedural motions by name; each takes a skeleton and its own amounts."""


def held_out_motions(skeleton: Skeleton) -> list[Motion]:
    """Eight fixed sequences of 60 to 120 frames for benchmarks, never trained on."""
    return [
        walk(skeleton, 3, speed=1.0),
        walk(skeleton, 3.6, speed=0.84, stride=32, arm_swing=45, turn_rate=30),
        walk(skeleton, 2, speed=1.4, stride=15, crouch=35, arm_raise=-10),
        turn(skeleton, 4, speed=0.25),
        turn(skeleton, 2.5, speed=0.4, trunk=30, head=50, arm_raise=55, elbow=60),
        squat(skeleton, 3, speed=0.34, depth=85, arms=80),
        squat(skeleton, 4, speed=0.5, depth=50, lean=25, arms=0, stance=18),
        reach(skeleton, 4, speed=0.25, lag=1 / 3),
    ]


def training_motions(skeleton: Skeleton, seed: int, count: int = 8) -> list[Motion]:
    """`count` sequences of about 3 seconds with random amounts, each kind in turn."""
    rng = np.random.default_rng(seed)
    ranges: dict[str, dict[str, Range]] = {
        "walk": {
            "speed": (0.6, 1.6),
            "stride": (10, 38),
            "arm_swing": (0, 50),
            "arm_raise": (-25, 40),
            "crouch": (0, 40),
        },
        "turn": {
            "speed": (0.3, 0.8),
            "trunk": (10, 30),
            "head": (10, 50),
            "arm_raise": (-25, 60),
            "elbow": (-30, 80),
        },
        "squat": {
            "speed": (0.3, 0.8),
            "depth": (20, 85),
            "lean": (5, 25),
            "arms": (-10, 90),
            "stance": (0, 20),
        },
        "reach": {
            "speed": (0.3, 0.6),
            "amount": (0.5, 1),
            "lag": (0, 1),
            "lean": (0, 20),
        },
    }
    motions = []
    for number in range(count):
        kind = list(MOTIONS)[number % len(MOTIONS)]
        amounts = {name: rng.uniform(*ends) for name, ends in ranges[kind].items()}
        motions.append(MOTIONS[kind](skeleton, 3, **amounts))
    return motions


def _cycles(seconds: float, speed: float, fps: float) -> tuple[np.ndarray, int]:
    """The phase of each frame, 0 to 1, over whole cycles, and the frames of a cycle."""
    _within("fps", fps, 1, 1000)
    _within("seconds", seconds, 1 / fps, 3600)
    _within("speed", speed, 0.05, 3)
    period = max(1, round(fps / speed))
    frames = period * max(1, round(seconds * fps / period))
    return np.arange(frames) % period / period, period


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise HeadError(name, f"it is {value:g}", f"give {low:g} to {high:g}")


def _bump(phase: np.ndarray, centre: float) -> np.ndarray:
    """1 at the centre, falling smoothly to 0.002 half a cycle away."""
    return np.exp(3 * np.cos(2 * np.pi * (phase - centre)) - 3)


def _degrees(*angles: ArrayLike) -> np.ndarray:
    """(..., 3) of flexion, abduction and twist, 0 where left out."""
    padded = (*angles, 0, 0)[:3]
    return np.stack(np.broadcast_arrays(*padded), axis=-1)


def _place(skeleton: Skeleton, bone: str) -> int:
    return skeleton.names.index(bone)


def _on_the_floor(skeleton: Skeleton, rotations: np.ndarray) -> np.ndarray:
    """(T, 3) how the root moves up or down so that the lower ankle keeps its height."""
    feet = [_place(skeleton, "foot.L"), _place(skeleton, "foot.R")]
    posed = Motion.create(rotations, skeleton.names).transforms(skeleton)[:, feet]
    ankles = skeleton.joints[feet]
    now = (posed[..., :3, :3] @ ankles[..., None])[..., 0] + posed[..., :3, 3]
    rise = (now - ankles)[..., 2].min(axis=1)
    return np.stack([np.zeros_like(rise), np.zeros_like(rise), -rise], axis=1)


def _turned(
    skeleton: Skeleton, rotations: np.ndarray, heading: np.ndarray
) -> np.ndarray:
    """The motion with its root turned to the left by (T,) radians besides."""
    root = _place(skeleton, "root")
    turned = Rotation.from_rotvec(heading[:, None] * UP)
    turned = turned * Rotation.from_rotvec(rotations[:, root])
    rotations = rotations.copy()
    rotations[:, root] = turned.as_rotvec()
    return rotations
