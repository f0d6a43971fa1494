"""Ground truth for loose clothes: a cloth simulation, and the data sets it fills.

Small-step extended position based dynamics (Macklin et al., Small Steps in Physics
Simulation, SCA 2019; Macklin, Mueller and Chentanez, XPBD, MIG 2016) as NVIDIA Warp
kernels, on a CPU or on CUDA. Edges keep their lengths, springs across each inner edge
resist bending, pinned vertices follow the bones, the body is an obstacle with friction.
Cloth does not collide with itself.

An undamped skirt is chaotic: after one period of a periodic walk it is somewhere else,
and no network could learn where. `SimulationConfig.smoothing` takes energy out of the
finest motion; `predictability` says what is left that nobody can predict.

Constraints of one colour share no vertex and no kernel adds atomically, so the same
input gives the same bits on the same machine.

Symbols: T frames, V garment vertices, B body vertices, J bones.
"""

import json
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from multiprocessing import get_context, parent_process
from pathlib import Path
from threading import Thread
from types import SimpleNamespace
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm.auto import tqdm

from skinlib.garments.binding import closest_point_weights, signed_distance
from skinlib.garments.collision import Collider
from skinlib.garments.energies import GRAVITY, Cloth
from skinlib.garments.garment import Garment
from skinlib.garments.motion import Motion
from skinlib.geometry import mesh_edges
from skinlib.head import Head, HeadError, Skeleton
from skinlib.io import atomic
from skinlib.skinning import linear_blend_skinning
from skinlib.training.checkpoint import replace_file

LIES_ON = 0.002
"""Share of the garment that has to lie on a bone for the bone to be an obstacle."""

DEEPEST = 0.04
"""Metres under the skin from where cloth still finds its way out."""

FALLING = 2.0  # m/s: a garment this fast when it should have settled has no hold
SETTLE_FPS = 30.0
RUN = "simulation.json"


@dataclass(frozen=True)
class SimulationConfig:
    """Material and solver; lengths in metres.

    Raises:
        HeadError: a value out of its range.
    """

    rate: float = 1440.0  # substeps a second, each with one pass over the constraints
    searches: float = 360.0  # a second, for the skin below each vertex
    density: float = 0.3  # kg/m^2
    stretch: float = 0.0  # m/N, how far edges give way
    bend: float = 0.1  # m/N, how far springs from vertex to vertex across edges do
    damping: float = 1.0  # 1/s, by the air
    smoothing: float = 300.0  # 1/s, at which velocities get like those of neighbours
    thickness: float = 0.006  # that the cloth keeps from the skin
    friction: float = 0.3
    fastest: float = 10.0  # m/s
    settle: float = 3.0  # seconds at rest before anything moves
    lead: float = 2 / 3  # seconds from the rest pose to the first frame
    bones: tuple[str, ...] = ()  # that cloth collides with; none: see `touched_bones`

    def __post_init__(self):
        ranges = {"rate": (1, 1e5), "searches": (1, 1e5), "density": (1e-6, 1e6)}
        for name, value in asdict(self).items():
            if name == "bones":
                continue
            low, high = ranges.get(name, (0, np.inf))
            if not (low <= value <= high and np.isfinite(value)):
                raise HeadError(
                    name, f"it is {value:g}", f"give a number from {low:g} to {high:g}"
                )


class Simulation(NamedTuple):
    """What a simulation gives.

    Attributes:
        posed: (T, V, 3) float32, metres.
        rest: (V, 3) float32: the garment as it hangs at rest, which is what to bind.
    """

    posed: np.ndarray
    rest: np.ndarray


def simulate(
    garment: Garment,
    head: Head,
    motion: Motion,
    config: SimulationConfig | None = None,
    start: np.ndarray | None = None,
    device: str = "cpu",
) -> Simulation:
    """Let a garment move with a body.

    It settles at rest first; then the body takes `config.lead` seconds to its first
    pose, without a change of place or heading, so that nothing is torn.

    Args:
        head: a body at rest, closed, with weights.
        start: (V, 3) the settled garment, if known; or a disturbed one.
        device: "cpu" or "cuda:0".

    Raises:
        HeadError: Warp is not installed; the body has no weights; the motion is one of
            other bones; nothing holds the garment.
        FloatingPointError: a position is not finite.
    """
    simulator = Simulator(garment, head, config or SimulationConfig(), device)
    rest = simulator.settled() if start is None else np.asarray(start, np.float32)
    return Simulation(np.stack(list(simulator.frames(motion, rest))), rest)


class Simulator:
    """A garment on a body, ready to move; see `simulate`.

    Attributes:
        obstacle: the part of the body that the garment collides with.
    """

    def __init__(
        self,
        garment: Garment,
        head: Head,
        config: SimulationConfig,
        device: str = "cpu",
    ):
        self.kernels = _kernels()
        self.garment, self.head, self.config = garment, head, config
        self.weights = closest_point_weights(garment, head)
        self.obstacle = obstacle(garment, head, config.bones)
        self.device = device
        cloth = Cloth(garment.vertices, garment.faces, config.density)
        masses = cloth.masses.numpy()
        if not (masses > 0).all():
            raise HeadError(
                "vertices",
                f"vertex {int((masses > 0).argmin())} is in no triangle",
                "leave such vertices out",
            )
        edges = mesh_edges(garment.faces)
        self._inverse = self._array(np.where(garment.pinned, 0, 1 / masses))
        self._springs = [
            (*self._coloured(pairs), compliance)
            for pairs, compliance in (
                (_opposite(cloth), config.bend),
                (edges, config.stretch),
            )
        ]
        starts, ids, shares = _viscosity(edges, masses)
        self._near = (
            self._array(starts, int),
            self._array(ids, int),
            self._array(shares),
        )

    def settled(self) -> np.ndarray:
        """(V, 3) float32: the garment when it has hung at rest for a while.

        Raises:
            HeadError: it falls off the body.
        """
        frames = round(self.config.settle * SETTLE_FPS)
        if frames == 0:
            return self.garment.vertices
        count = len(self.head.skeleton)
        still = np.broadcast_to(np.eye(4, dtype=np.float32), (frames + 1, count, 4, 4))
        *_, before, last = self._run(still, self.garment.vertices, SETTLE_FPS)
        speed = np.median(np.linalg.norm(last - before, axis=1)) * SETTLE_FPS
        if speed > FALLING:
            raise HeadError(
                "pinned",
                f"nothing holds the garment: it falls, at {speed:.1f} m/s",
                "pin some of its vertices, or put it where it lies on the body",
            )
        return last

    def frames(self, motion: Motion, start: np.ndarray) -> Iterator[np.ndarray]:
        """(V, 3) float32 for each frame, one after the other.

        Args:
            start: (V, 3) the garment on the body at rest.

        Raises:
            HeadError: the motion is one of other bones, `start` is no such garment.
            FloatingPointError: a position is not finite.
        """
        if start.shape != self.garment.vertices.shape or not np.isfinite(start).all():
            raise HeadError(
                "start",
                f"values of shape {start.shape}, or one is not finite",
                f"give {len(self.garment.vertices)} x 3 finite numbers",
            )
        skeleton = self.head.skeleton
        transforms = motion.transforms(skeleton)
        lead = _lead(motion, skeleton, round(self.config.lead * motion.fps))
        turned = lead.transforms(skeleton)
        root = int(np.flatnonzero(skeleton.parents < 0)[0])
        heading = turned[0, root]
        start = start @ heading[:3, :3].T + heading[:3, 3]
        # The last frame of the lead is the first of the motion.
        both = np.concatenate([turned[:-1], transforms])
        frames = self._run(both, start, motion.fps)
        for number, posed in enumerate(frames):
            if number >= len(turned) - 1:
                yield posed

    # -- the solver ----------------------------------------------------------------

    def _run(
        self, transforms: np.ndarray, start: np.ndarray, fps: float
    ) -> Iterator[np.ndarray]:
        """(V, 3) in each frame of the bones' transforms (T, J, 4, 4).

        Positions are taken from where the root begins the frame: float32 is too coarse
        for the steps of a body that has walked away.
        """
        skeleton = self.head.skeleton
        root = int(np.flatnonzero(skeleton.parents < 0)[0])
        turned, moved = transforms[:, root, :3, :3], transforms[:, root, :3, 3]
        origins = turned @ skeleton.joints[root] + moved  # (T, 3)

        bodies, pins = self._skinned(transforms[0], origins[0])
        arrays = self._arrays(start - origins[0], bodies, pins)
        substeps = max(1, round(self.config.rate / fps))
        every = max(1, round(self.config.rate / self.config.searches))
        program = self._program(arrays, fps, substeps)
        yield start.astype(np.float32)
        for number in range(1, len(transforms)):
            origin = origins[number - 1]
            shift = origin - origins[max(number - 2, 0)]
            arrays.x.assign(arrays.x.numpy() - shift)
            arrays.body.assign(bodies - shift)
            arrays.pin.assign(pins - shift)
            bodies, pins = self._skinned(transforms[number], origin)
            arrays.body_next.assign(bodies)
            arrays.pin_next.assign(pins)
            arrays.now.zero_()
            for left in reversed(range(substeps)):
                # The search takes longer than all else; the last one is never stale.
                for call in program[left % every == 0]:
                    call()
            posed = arrays.x.numpy() + origin
            if not np.isfinite(posed).all():
                raise FloatingPointError(
                    f"the garment's positions are not finite in frame {number}: raise "
                    f"rate ({self.config.rate:g})"
                )
            yield posed

    def _arrays(
        self, start: np.ndarray, bodies: np.ndarray, pins: np.ndarray
    ) -> SimpleNamespace:
        """What changes from one substep to the next."""
        import warp as wp

        x, body, pin = self._points(start), self._points(bodies), self._points(pins)
        skin, motion = wp.clone(body), wp.zeros_like(body)
        faces = self._array(self.obstacle.faces.numpy().ravel(), int)
        count, device = len(start), self.device
        return SimpleNamespace(
            x=x,
            before=wp.clone(x),
            v=wp.zeros_like(x),
            smoothed=wp.zeros_like(x),
            body=body,
            body_next=wp.clone(body),
            pin=pin,
            pin_next=wp.clone(pin),
            now=wp.zeros(1, dtype=wp.float32, device=device),
            skin=skin,
            motion=motion,
            mesh=wp.Mesh(points=skin, indices=faces, velocities=motion),
            contact=(
                wp.full(count, -1, dtype=wp.int32, device=device),
                wp.zeros(count, dtype=wp.vec2, device=device),
                wp.zeros(count, dtype=wp.vec3, device=device),
            ),
        )

    def _program(
        self, arrays: SimpleNamespace, fps: float, substeps: int
    ) -> tuple[list, list]:
        """The calls of a substep, without and with a search for the skin."""
        import warp as wp

        def launch(kernel, count, *inputs):
            options = {"device": self.device, "record_cmd": True}
            return wp.launch(kernel, dim=count, inputs=inputs, **options).launch

        a, k, config, inverse = arrays, self.kernels, self.config, self._inverse
        count, step = len(a.x), 1 / (fps * substeps)
        kept, calm = (
            float(np.exp(-rate * step)) for rate in (config.damping, config.smoothing)
        )
        speeds = a.smoothed if config.smoothing else a.v
        pins = a.pin, a.pin_next, a.now
        bodies = a.body, a.body_next, a.now
        first = [
            launch(k.clock, 1, a.now, 1 / substeps),
            launch(k.move_body, len(a.body), *bodies, fps, a.skin, a.motion),
            a.mesh.refit,
            launch(k.advance, count, a.x, a.before, speeds, inverse, *pins, step, kept),
        ]
        for colours, ids, lengths, compliance in self._springs:
            soft = compliance / step**2
            first += [
                launch(k.project, size, a.x, inverse, ids, lengths, place, soft)
                for place, size in colours
            ]
        mesh, touch = a.mesh.id, (config.thickness, config.friction)
        reach = config.thickness + DEEPEST
        search = launch(k.search, count, mesh, a.x, inverse, reach, *a.contact)
        last = [
            launch(k.push, count, mesh, a.x, a.before, *a.contact, step, *touch),
            launch(k.measure, count, a.x, a.before, a.v, step, config.fastest),
        ]
        if config.smoothing:
            last.append(
                launch(k.calm, count, a.v, a.smoothed, inverse, *self._near, 1 - calm)
            )
        return [*first, *last], [*first, search, *last]

    def _skinned(
        self, transforms: np.ndarray, origin: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(B, 3) of the obstacle and (V, 3) of the garment: where bones bring them."""
        points, weights = self.obstacle.points.numpy(), self.obstacle.weights.numpy()
        transforms = transforms.copy()
        transforms[:, :3, 3] -= origin
        return (
            linear_blend_skinning(points, weights, transforms),
            linear_blend_skinning(self.garment.vertices, self.weights, transforms),
        )

    def _coloured(self, pairs: np.ndarray) -> tuple[list, Any, Any]:
        """Places and sizes of the colours, the pairs colour after colour, lengths."""
        colours = colour_pairs(pairs)
        pairs = pairs[np.argsort(colours, kind="stable")]
        sizes = np.bincount(colours)
        places = zip(np.cumsum(sizes) - sizes, sizes, strict=True)
        a, b = self.garment.vertices[pairs.T].astype(np.float64)
        return (
            [(int(first), int(size)) for first, size in places],
            self._array(pairs, int),
            self._array(np.linalg.norm(a - b, axis=1)),
        )

    def _array(self, values: np.ndarray, kind: type = float) -> Any:
        import warp as wp

        precision = np.int32 if kind is int else np.float32
        return wp.array(np.ascontiguousarray(values, precision), device=self.device)

    def _points(self, values: np.ndarray) -> Any:
        import warp as wp

        values = np.ascontiguousarray(values, np.float32)
        return wp.array(values, dtype=wp.vec3, device=self.device)


@contextmanager
def quiet() -> Iterator[None]:
    """Without what native code writes to stderr, past Python: Warp misses a GPU."""
    kept, sink = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(sink)


@cache
def _kernels() -> SimpleNamespace:
    """Warp's kernels; compiled once, which takes some seconds, and then read from disk.

    Raises:
        HeadError: Warp is not installed.
    """
    try:
        import warp as wp
    except ImportError as error:
        raise HeadError(
            "simulation",
            "the package warp-lang is not installed",
            "run `pip install warp-lang`",
        ) from error
    level, wp.config.log_level = wp.config.log_level, wp.LOG_ERROR
    with quiet():
        wp.init()  # else it writes what devices there are
    wp.config.log_level = max(level, wp.LOG_WARNING)
    gravity = wp.constant(GRAVITY)

    @wp.kernel(enable_backward=False)
    def clock(now: wp.array[float], step: float):
        """How much of the frame has gone, at the end of the substep."""
        now[0] = now[0] + step

    @wp.kernel(enable_backward=False)
    def move_body(
        start: wp.array[wp.vec3],
        end: wp.array[wp.vec3],
        now: wp.array[float],
        fps: float,
        skin: wp.array[wp.vec3],
        motion: wp.array[wp.vec3],
    ):
        i = wp.tid()
        skin[i] = wp.lerp(start[i], end[i], now[0])
        motion[i] = (end[i] - start[i]) * fps

    @wp.kernel(enable_backward=False)
    def advance(
        x: wp.array[wp.vec3],
        before: wp.array[wp.vec3],
        v: wp.array[wp.vec3],
        inverse: wp.array[float],
        pin: wp.array[wp.vec3],
        pin_next: wp.array[wp.vec3],
        now: wp.array[float],
        step: float,
        kept: float,
    ):
        """Where vertices would go without constraints; pins go with the bones."""
        i = wp.tid()
        before[i] = x[i]
        if inverse[i] > 0.0:
            x[i] = x[i] + step * kept * (v[i] - wp.vec3(0.0, 0.0, step * gravity))
        else:
            x[i] = wp.lerp(pin[i], pin_next[i], now[0])

    @wp.kernel(enable_backward=False)
    def project(
        x: wp.array[wp.vec3],
        inverse: wp.array[float],
        pairs: wp.array2d[int],
        lengths: wp.array[float],
        first: int,
        soft: float,
    ):
        """Bring the pairs of one colour back to their distance."""
        k = first + wp.tid()
        a = pairs[k, 0]
        b = pairs[k, 1]
        across = x[a] - x[b]
        length = wp.length(across)
        total = inverse[a] + inverse[b]
        if total > 0.0 and length > 0.0:
            force = (lengths[k] - length) / (total + soft) / length
            x[a] = x[a] + across * (force * inverse[a])
            x[b] = x[b] - across * (force * inverse[b])

    @wp.kernel(enable_backward=False)
    def search(
        mesh: wp.uint64,
        x: wp.array[wp.vec3],
        inverse: wp.array[float],
        reach: float,
        face: wp.array[int],
        place: wp.array[wp.vec2],
        normals: wp.array[wp.vec3],
    ):
        """The point of the skin closest to each vertex, and the way out from there."""
        i = wp.tid()
        face[i] = -1
        if inverse[i] == 0.0:
            return
        found = wp.mesh_query_point_sign_normal(mesh, x[i], reach)
        if found.result:
            face[i] = found.face
            place[i] = wp.vec2(found.u, found.v)
            skin = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
            away = (x[i] - skin) * found.sign
            if wp.length(away) > 1.0e-6:
                normals[i] = wp.normalize(away)
            else:
                normals[i] = wp.mesh_eval_face_normal(mesh, found.face)

    @wp.kernel(enable_backward=False)
    def push(
        mesh: wp.uint64,
        x: wp.array[wp.vec3],
        before: wp.array[wp.vec3],
        face: wp.array[int],
        place: wp.array[wp.vec2],
        normals: wp.array[wp.vec3],
        step: float,
        thickness: float,
        friction: float,
    ):
        """Push vertices out of the skin and let it drag them along."""
        i = wp.tid()
        f = face[i]
        if f < 0:
            return
        u = place[i][0]
        v = place[i][1]
        normal = normals[i]
        skin = wp.mesh_eval_position(mesh, f, u, v)
        depth = thickness - wp.dot(x[i] - skin, normal)
        if depth > 0.0:
            out = x[i] + depth * normal
            slide = out - before[i] - step * wp.mesh_eval_velocity(mesh, f, u, v)
            slide = slide - wp.dot(slide, normal) * normal
            far = wp.length(slide)
            if far > 0.0:
                out = out - slide * wp.min(1.0, friction * depth / far)
            x[i] = out

    @wp.kernel(enable_backward=False)
    def measure(
        x: wp.array[wp.vec3],
        before: wp.array[wp.vec3],
        v: wp.array[wp.vec3],
        step: float,
        fastest: float,
    ):
        """Velocities, none above the fastest."""
        i = wp.tid()
        speed = (x[i] - before[i]) / step
        v[i] = speed * wp.min(1.0, fastest / wp.max(wp.length(speed), fastest))

    @wp.kernel(enable_backward=False)
    def calm(
        v: wp.array[wp.vec3],
        smoothed: wp.array[wp.vec3],
        inverse: wp.array[float],
        starts: wp.array[int],
        ids: wp.array[int],
        shares: wp.array[float],
        amount: float,
    ):
        """Let velocities come closer to those of the neighbours."""
        i = wp.tid()
        mean = wp.vec3(0.0, 0.0, 0.0)
        if inverse[i] > 0.0:
            for k in range(starts[i], starts[i + 1]):
                mean += shares[k] * (v[ids[k]] - v[i])
        smoothed[i] = v[i] + amount * mean

    return SimpleNamespace(
        clock=clock,
        move_body=move_body,
        advance=advance,
        project=project,
        search=search,
        push=push,
        measure=measure,
        calm=calm,
    )


def colour_pairs(pairs: np.ndarray) -> np.ndarray:
    """(P,) int64: colours such that no two pairs (P, 2) of one share a vertex.

    Each in turn gets the first colour that is free.

    >>> colour_pairs(np.array([[0, 1], [1, 2], [2, 3], [3, 0]])).tolist()
    [0, 1, 0, 1]
    """
    used = [0] * (int(pairs.max(initial=-1)) + 1)  # by vertex, a bit for each colour
    colours = np.zeros(len(pairs), np.int64)
    for number, (a, b) in enumerate(pairs.tolist()):
        taken = used[a] | used[b]
        bit = ~taken & (taken + 1)  # the lowest that is not set
        used[a] |= bit
        used[b] |= bit
        colours[number] = bit.bit_length() - 1
    return colours


def _opposite(cloth: Cloth) -> np.ndarray:
    """(H, 2) the vertices that face each other across the inner edges."""
    faces, hinges = cloth.faces.numpy(), cloth.hinges.numpy()
    ends = cloth.hinge_edges.numpy().sum(axis=1)
    return np.stack([faces[hinges[:, i]].sum(axis=1) - ends for i in range(2)], axis=1)


def _viscosity(edges: np.ndarray, masses: np.ndarray) -> tuple:
    """(V + 1,), (2E,), (2E,): where a vertex's neighbours start, their ids and shares.

    m_i s_ij is symmetric, so momentum is kept; the shares of a vertex sum to 1 or less,
    so energy is not gained.
    """
    a, b = np.concatenate([edges, edges[:, ::-1]]).T
    degree = np.bincount(a, minlength=len(masses))
    shares = np.minimum(masses[b] / masses[a], 1) / np.maximum(degree[a], degree[b])
    order = np.lexsort((b, a))
    return np.cumsum([0, *degree]), b[order], shares[order]


# --- the body -----------------------------------------------------------------------


def touched_bones(garment: Garment, head: Head) -> np.ndarray:
    """(J,) bool: the bones that a garment at rest lies on, and what prolongs them.

    A bone that is its parent's only child prolongs it. So a skirt touches pelvis, legs
    down to the feet, and spine, but neither arms, whose hands would swing into it at
    each step, nor head; a shirt touches arms down to the hands.

    Raises:
        HeadError: the body has no weights.
    """
    skeleton = head.skeleton
    touched = closest_point_weights(garment, head).mean(axis=0) > LIES_ON
    children = skeleton.children()
    for bone in skeleton.order.tolist():
        if touched[bone] and len(children[bone]) == 1:
            touched[children[bone][0]] = True
    return touched


def obstacle(garment: Garment, head: Head, bones: Sequence[str] = ()) -> Collider:
    """The part of a body that moves mostly with some bones.

    Args:
        bones: their names; when there are none, those of `touched_bones`.

    Raises:
        HeadError: an unknown bone, one without skin, or a body without weights.
    """
    names = head.skeleton.names
    unknown = sorted(set(bones) - set(names))
    if unknown:
        raise HeadError(
            "bones",
            f"the body has no bone {unknown[0]!r}",
            f"choose from {', '.join(names)}",
        )
    touched = touched_bones(garment, head)
    if bones:
        touched = np.isin(names, bones)
    part = Collider(head, np.flatnonzero(head.weights[:, touched].sum(axis=1) > 0.5))
    if len(part.faces) == 0:
        raise HeadError("bones", "no triangle moves with them", "name bones with skin")
    return part


def _lead(motion: Motion, skeleton: Skeleton, frames: int) -> Motion:
    """From the rest pose to the first frame, at the place and heading of the latter."""
    root = int(np.flatnonzero(skeleton.parents < 0)[0])
    first = motion.rotations[0].astype(np.float64)
    turn = Rotation.from_rotvec(first[root])
    # The part of the turn that is about the vertical.
    quaternion = turn.as_quat() * [0, 0, 1, 1]
    faces_somewhere = np.linalg.norm(quaternion) > 1e-6
    heading = Rotation.from_quat(quaternion if faces_somewhere else [0, 0, 0, 1])
    share = np.linspace(0, 1, frames + 1)
    share = (3 - 2 * share) * share**2
    rotations = share[:, None, None] * first
    lean = (heading.inv() * turn).as_rotvec()
    rotations[:, root] = [
        (heading * Rotation.from_rotvec(part * lean)).as_rotvec() for part in share
    ]
    rotations[-1] = first
    moved = np.repeat(motion.translations[:1], frames + 1, axis=0)
    return Motion.create(rotations, motion.bone_names, moved, motion.fps)


# --- data sets ----------------------------------------------------------------------


class Simulated(NamedTuple):
    """One file of a data set: the motion of the body, and the garment in it."""

    motion: Motion
    posed: np.ndarray  # (T, V, 3) float32
    rest: np.ndarray  # (V, 3) float32, settled


def simulate_motions(
    garment: Garment,
    head: Head,
    motions: Sequence[Motion],
    out: str | Path,
    config: SimulationConfig | None = None,
    workers: int = 1,
    device: str = "cpu",
) -> list[Path]:
    """Simulate a garment in many motions: one file each, in their order.

    Called again after an interrupt it makes the files that are missing; they are the
    same to the bit as those of a run without one, on one machine. More motions may be
    added at the end.

    Args:
        out: a folder, made if need be. workers: processes.

    Raises:
        HeadError: `out` holds another data set; or as for `simulate`.
    """
    config, out = config or SimulationConfig(), Path(out)
    paths = [out / f"motion_{number:04d}.npz" for number in range(len(motions))]
    for motion in motions:
        motion.transforms(head.skeleton)  # rather now than after an hour
    _begin(out, garment, head, config)
    missing = []
    for motion, path in zip(motions, paths, strict=True):
        if path.exists():
            _check_same(motion, path)
        else:
            missing.append((motion, path))
    bar = tqdm(total=len(motions), initial=len(motions) - len(missing), unit="motion")
    with bar:
        if not missing:
            return paths
        simulator = Simulator(garment, head, config, device)
        rest = simulator.settled()
        if workers < 2:
            for motion, path in missing:
                _write(path, motion, simulator, rest)
                bar.update()
            return paths
        # A forked process could not use CUDA.
        context = get_context("spawn")
        with ProcessPoolExecutor(workers, context, _end_with_parent) as pool:
            job = garment, head, config, device, rest
            pending = [pool.submit(_simulate_to, *job, *pair) for pair in missing]
            try:
                for done in as_completed(pending):
                    done.result()
                    bar.update()
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    return paths


def read_simulated(path: str | Path) -> Simulated:
    """Read a file that `simulate_motions` wrote.

    Raises:
        HeadError: it cannot be read, or holds something else.
    """
    path = Path(path)
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            fields = {key: arrays[key] for key in arrays.files}
        motion = Motion.create(
            fields["rotations"],
            fields["bone_names"].tolist(),
            fields["translations"],
            float(fields["fps"]),
            str(fields["name"]),
            path,
        )
        posed, rest = fields["posed"], fields["rest"]
    except Exception as error:  # whatever a damaged archive makes the libraries raise
        raise HeadError(
            "simulation",
            f"it cannot be read ({type(error).__name__}: {str(error)[:200]})",
            "delete the file and run the same simulation again",
            path,
        ) from error
    fits = posed.shape == (len(motion), *rest.shape) and rest.shape[1:] == (3,)
    if not fits or not (np.isfinite(posed).all() and np.isfinite(rest).all()):
        raise HeadError(
            "simulation",
            f"posed of shape {posed.shape}, rest of shape {rest.shape} for "
            f"{len(motion)} frames, or a number that is not finite",
            "delete the file and run the same simulation again",
            path,
        )
    return Simulated(motion, posed.astype(np.float32), rest.astype(np.float32))


def _end_with_parent() -> None:
    """A process of a pool would wait for ever when the command has been killed."""

    def watch():
        parent_process().join()
        os._exit(1)

    Thread(target=watch, daemon=True).start()


def _simulate_to(garment, head, config, device, rest, motion, path) -> None:
    _write(path, motion, Simulator(garment, head, config, device), rest)


def _write(path: Path, motion: Motion, simulator: Simulator, rest: np.ndarray) -> None:
    posed = np.stack(list(simulator.frames(motion, rest)))
    with atomic(path) as file:
        np.savez_compressed(
            file,
            rotations=motion.rotations,
            translations=motion.translations,
            bone_names=np.array(motion.bone_names),
            fps=np.float64(motion.fps),
            name=np.array(motion.name),
            posed=posed,
            rest=rest,
        )


def _begin(out: Path, garment: Garment, head: Head, config: SimulationConfig) -> None:
    """Note in the folder what is simulated there.

    Raises:
        HeadError: something else is.
    """
    run = json.loads(json.dumps(asdict(config) | _checksums(garment, head)))
    path = out / RUN
    if not path.exists():
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise HeadError(
                "out",
                f"no folder can be made ({error.strerror})",
                "choose another",
                out,
            ) from error
        replace_file(path, f"{json.dumps(run, indent=1)}\n".encode())
        return
    before = _begun(path)
    differs = [key for key in run if before.get(key) != run[key]]
    if differs:
        raise HeadError(
            ", ".join(differs),
            "another simulation, with other settings or meshes, was begun here",
            "continue it with the arguments it was begun with, or choose a new folder",
            out,
        )


def check_simulated(folder: str | Path, garment: Garment, head: Head) -> None:
    """Make sure that `simulate_motions` filled a folder with this garment and body.

    A folder that it has not begun, as of another simulator, may hold anything.

    Raises:
        HeadError: it was another one.
    """
    path = Path(folder) / RUN
    if not path.exists():
        return
    before = _begun(path)
    for name, checksum in _checksums(garment, head).items():
        if before.get(name) != checksum:
            raise HeadError(
                name,
                "it is another one than in the simulation",
                "give the mesh, the pins and the body that were simulated",
                path,
            )


def _begun(path: Path) -> dict:
    """What `_begin` noted."""
    try:
        return dict(json.loads(path.read_bytes()))
    except (OSError, ValueError, TypeError) as error:
        raise HeadError(
            "simulation", "it cannot be read", "choose a new folder", path
        ) from error


def _checksums(garment: Garment, head: Head) -> dict[str, int]:
    arrays = {
        "garment": (garment.vertices, garment.faces, garment.pinned),
        "body": (head.vertices, head.faces, head.weights, head.skeleton.joints),
    }
    return {
        name: crc32(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))
        for name, parts in arrays.items()
        if all(part is not None for part in parts)
    }


def _check_same(motion: Motion, path: Path) -> None:
    before = read_simulated(path).motion
    same = before.fps == motion.fps and all(
        np.array_equal(a, b)
        for a, b in (
            (before.rotations, motion.rotations),
            (before.translations, motion.translations),
        )
    )
    if not same:
        raise HeadError(
            "motion",
            "another one was simulated here",
            "give the same motions in the same order, or choose a new folder",
            path,
        )


# --- how good it is -----------------------------------------------------------------


class Strain(NamedTuple):
    """|l - l0| / l0 over all edges and frames: mean, percentiles and the largest."""

    mean: float
    p95: float
    p99: float
    largest: float


def strain(posed: np.ndarray, rest: np.ndarray, faces: np.ndarray) -> Strain:
    """How much longer or shorter the edges are than they were cut.

    Args:
        posed: (T, V, 3). rest: (V, 3) as cut, not settled. faces: (F, 3).

    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> round(strain(1.1 * corners[None], corners, np.array([[0, 1, 2]])).p99, 6)
    0.1
    """
    a, b = mesh_edges(faces).T
    lengths = np.linalg.norm(posed[:, a] - posed[:, b], axis=-1)
    rest_lengths = np.linalg.norm(rest[a] - rest[b], axis=-1)
    off = np.abs(lengths / rest_lengths - 1)
    return Strain(
        float(off.mean()), *np.percentile(off, (95, 99)).tolist(), float(off.max())
    )


def inside(posed: np.ndarray, motion: Motion, head: Head, part: Collider) -> np.ndarray:
    """(T,) the share of vertices under the skin of a part of the body.

    By the true signed distance, which the simulation does not use.

    Args:
        posed: (T, V, 3). part: see `obstacle`.
    """
    transforms = motion.transforms(head.skeleton)
    points, weights = part.points.numpy(), part.weights.numpy()
    faces = part.faces.numpy()
    shares = [
        (signed_distance(frame, linear_blend_skinning(points, weights, bones), faces))
        for frame, bones in zip(posed, transforms, strict=True)
    ]
    return (np.stack(shares) < 0).mean(axis=1)


def root_frame(posed: np.ndarray, roots: np.ndarray) -> np.ndarray:
    """(T, V, 3) posed vertices as the root sees them: R^T (x - t).

    Args:
        posed: (T, V, 3). roots: (T, 4, 4), transforms of the root bone.
    """
    return (posed - roots[:, None, :3, 3]) @ roots[:, :3, :3]


class Predictability(NamedTuple):
    """What nobody can predict, and how much there is to predict, both in metres.

    Attributes:
        floor: root mean square of x(t + period) - x(t).
        deviation: of x(t) from the mean over time.
    """

    floor: float
    deviation: float


def predictability(posed: np.ndarray, period: int) -> Predictability:
    """How far a garment is from itself one period later, when the body is not.

    A floor above half of the deviation cannot be learnt.

    Args:
        posed: (T, V, 3) in the root's frame, see `root_frame`; without the start, when
            the garment has yet to forget how it hung at rest.
        period: frames, after which the motion repeats.

    Raises:
        HeadError: the motion is not longer than a period.
    """
    if not 0 < period < len(posed):
        raise HeadError(
            "period",
            f"{period} frames of {len(posed)}",
            "give the frames of one cycle, and a longer motion",
        )
    return Predictability(
        rms(posed[period:], posed[:-period]), rms(posed, posed.mean(axis=0))
    )


def rms(posed: np.ndarray, other: np.ndarray) -> float:
    """Root mean square over frames and vertices of the distance, in metres."""
    return float(np.sqrt(np.square(posed - other).sum(axis=-1).mean()))
