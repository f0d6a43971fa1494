"""Pictures of virtual bones and of what they move, and labs for them.

Symbols: T frames, V vertices of the garment, N virtual bones.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from skinlib.garments.garment import Garment
from skinlib.garments.loose import LooseGarment
from skinlib.garments.motion import Motion, walk
from skinlib.garments.outfit import Outfit
from skinlib.garments.simulation import (
    Predictability,
    SimulationConfig,
    Simulator,
    predictability,
)
from skinlib.garments.virtual_bones import (
    KERNELS,
    REDUCTIONS,
    bone_distances,
    bone_spacing,
    heat_weights,
    hybrid_skinning,
    looseness,
    place_bones,
    virtual_bind,
)
from skinlib.head import Head
from skinlib.views import garments, scenes
from skinlib.views.picture import FAINT, ColourBar, Picture, new_figure
from skinlib.views.picture import rasterise as rasterised
from skinlib.views.plots import OURS, SERIES
from skinlib.views.widgets import SliderLab, playable, slider_lab

LOWER = scenes.View(30.0, 6.0, zoom=1.9, centre=(0.0, 0.0, -0.13), upright=True)
TILE = (250, 260)
FAR = 150.0  # mm: the darkest colour of an error

SPHERE = trimesh.creation.icosphere(subdivisions=1, radius=0.013)


# ---- virtual bones and their weights


@functools.lru_cache(maxsize=64)
def placed(outfit: Outfit, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Virtual bones (N,) of an outfit, and the distances (V, N) from them, metres."""
    bones = place_bones(outfit.vertices, outfit.faces, count, seed)
    return bones, bone_distances(outfit.vertices, outfit.faces, bones)


def draw_bones(
    outfit: Outfit,
    points: np.ndarray,
    cloth: np.ndarray,
    balls: np.ndarray,
    *,
    vertices: np.ndarray | None = None,
    view: scenes.View = LOWER,
    size: tuple[int, int] = TILE,
) -> np.ndarray:
    """(H, W, 3) uint8: a painted garment on a body at rest, a ball at each bone.

    Args:
        points: (N, 3) where the bones stand. cloth: (V, 3) colours. balls: (N, 3).
        vertices: (V, 3) of the garment; at rest without.
    """
    scene = _with_balls(outfit, len(points))
    skin = outfit.body.head.vertices
    vertices = outfit.vertices if vertices is None else vertices
    corners = points[:, None] + SPHERE.vertices  # (N, S, 3)
    colours = np.repeat(balls, len(SPHERE.vertices), axis=0)
    return scenes.render(
        scene,
        np.concatenate([np.tile(garments.SKIN, (len(skin), 1)), cloth, colours]),
        vertices=np.concatenate([skin, vertices, corners.reshape(-1, 3)]),
        view=view,
        size=size,
    )


@functools.lru_cache(maxsize=64)
def _with_balls(outfit: Outfit, count: int) -> Head:
    """Body, garment and `count` balls as one mesh; their places do not matter."""
    scene = garments.dressed(outfit)
    size = len(SPHERE.vertices)
    first = len(scene.vertices) + size * np.arange(count)
    faces = (first[:, None, None] + SPHERE.faces).reshape(-1, 3)
    balls = np.tile(SPHERE.vertices, (count, 1))
    return Head.create(
        np.concatenate([scene.vertices, balls]),
        np.concatenate([scene.faces, faces]),
        scene.skeleton,
        name=scene.name,
    )


def weights_picture(
    outfit: Outfit,
    *,
    count: int = 24,
    spread: float = 1.0,
    influences: int = 4,
    kernel: str = "gauss",
    bone: int = 0,
    view_from: float = 30.0,
    size: tuple[int, int] = TILE,
) -> Picture:
    """Virtual bones, whose cloth is whose at the left, one bone's weights at the right.

    Args:
        spread: alpha, as a multiple of the bones' spacing.
        bone: the one at the right; counted on from 0 after the last.
    """
    bones, distances = placed(outfit, count)
    alpha = spread * bone_spacing(distances, bones)
    weights = heat_weights(distances, alpha, influences, kernel)
    colours, bone = palette(count), bone % count
    points, view = outfit.vertices[bones], replace(LOWER, azimuth=view_from)
    look = {"view": view, "size": size}
    heat = scenes.colour_by_value(weights[:, bone])
    return garments.grid(
        [
            draw_bones(outfit, points, weights @ colours, 0.6 * colours, **look),
            draw_bones(outfit, points[[bone]], heat, np.zeros((1, 3)), **look),
        ],
        [f"alpha = {1000 * alpha:.0f} mm", f"weight of bone {bone}"],
        colour_bar=ColourBar("weight", 0, 1),
    )


def palette(count: int) -> np.ndarray:
    """(N, 3) colours far from each other."""
    return scenes._distinct_colours(count)


def weights_lab(outfit: Outfit, **start) -> SliderLab:
    """How many virtual bones, how far their heat reaches, how many share a vertex."""
    return slider_lab(
        functools.partial(weights_picture, outfit),
        start={"count": 24, "spread": 1.0, "influences": 4, "view_from": 30.0} | start,
        count=(2, 48),
        spread=(0.1, 4.0, 0.1),
        influences=(1, 8),
        kernel=list(KERNELS),
        bone=(0, 47),
        view_from=(-180.0, 180.0, 5.0),
    )


def moved_by_hand(
    loose: LooseGarment,
    bone: int,
    out: float = 0.0,
    up: float = 0.0,
    turn: float = 0.0,
) -> np.ndarray:
    """(V, 3) the garment at rest, one of its virtual bones elsewhere.

    Args:
        out: mm away from the axis of the body. up: mm.
        turn: degrees about the direction that leads out.
    """
    points = loose.points
    binds, offsets = virtual_bind(points)
    away = points[bone] * [1, 1, 0]
    away = away / max(np.linalg.norm(away), 1e-9)
    binds[bone, :3, 3] += (out * away + [0, 0, up]) / 1000
    binds[bone, :3, :3] = Rotation.from_rotvec(np.radians(turn) * away).as_matrix()
    return hybrid_skinning(loose.rest, loose.weights, binds, offsets)


def hand_picture(
    loose: LooseGarment,
    *,
    bone: int = 0,
    out: float = 0.0,
    up: float = 0.0,
    turn: float = 0.0,
    view_from: float = 30.0,
    size: tuple[int, int] = TILE,
) -> Picture:
    """A virtual bone moved by hand; its weights are painted on what follows."""
    count = len(loose.bones)
    bone = bone % count
    vertices = moved_by_hand(loose, bone, out, up, turn)
    points = loose.points[:count].copy()
    points[bone] = vertices[loose.bones[bone]]
    balls = np.full((count, 3), 0.55)
    balls[bone] = 0
    view = replace(LOWER, azimuth=view_from)
    image = draw_bones(
        hung(loose),
        points,
        scenes.colour_by_value(loose.weights[:, bone]),
        balls,
        vertices=vertices,
        view=view,
        size=size,
    )
    return garments.grid([image], [f"bone {bone}"], colour_bar=ColourBar("weight"))


def hand_lab(loose: LooseGarment, **start) -> SliderLab:
    """Take a virtual bone and pull."""
    return slider_lab(
        functools.partial(hand_picture, loose),
        start={"out": 0.0, "up": 0.0, "turn": 0.0, "view_from": 30.0} | start,
        bone=(0, len(loose.bones) - 1),
        out=(-100.0, 200.0, 10.0),
        up=(-150.0, 150.0, 10.0),
        turn=(-90.0, 90.0, 5.0),
        view_from=(-180.0, 180.0, 5.0),
    )


@functools.lru_cache(maxsize=4)
def hung(loose: LooseGarment) -> Outfit:
    """Body and garment as it hangs at rest."""
    cut = loose.garment
    return Outfit(loose.body, (Garment(loose.rest, cut.faces, cut.pinned, cut.name),))


# ---- looseness


def looseness_picture(
    outfit: Outfit,
    skinned: np.ndarray,
    simulated: np.ndarray,
    *,
    threshold: float = 3.0,
    ramp: float = 10.0,
    reduce: str = "mean",
    view_from: float = 30.0,
    size: tuple[int, int] = TILE,
) -> Picture:
    """How loose a garment is, painted from 0 to 1.

    Args:
        skinned, simulated: (T, V, 3) in one frame, see `looseness`.
        threshold: mm off from which on a vertex is loose. ramp: mm from there until it
            is loose altogether.
    """
    slope = 1000 / max(ramp, 1e-3)
    loose = looseness(skinned, simulated, threshold / 1000, slope, reduce)
    head = outfit.body.head
    still = Motion.create(np.zeros((1, len(head.skeleton), 3)), head.skeleton.names)
    image = garments.draw(
        outfit,
        still,
        outfit.vertices[None],
        values=loose[None],
        view=replace(LOWER, azimuth=view_from),
        size=size,
    )
    note = f"tight {100 * (loose == 0).mean():.0f} %, "
    note += f"loose altogether {100 * (loose == 1).mean():.0f} %"
    return garments.grid([image], [note], colour_bar=ColourBar("looseness I"))


def looseness_lab(
    outfit: Outfit, skinned: np.ndarray, simulated: np.ndarray, **start
) -> SliderLab:
    """Where joints end and virtual bones begin."""
    return slider_lab(
        functools.partial(looseness_picture, outfit, skinned, simulated),
        start={"threshold": 3.0, "ramp": 10.0, "view_from": 30.0} | start,
        threshold=(0.0, 100.0, 1.0),
        ramp=(1.0, 100.0, 1.0),
        reduce=list(REDUCTIONS),
        view_from=(-180.0, 180.0, 5.0),
    )


# ---- what nobody can predict


@functools.lru_cache(maxsize=4)
def periodic(
    garment: Garment,
    head: Head,
    smoothing: float,
    cycles: int = 5,
    fps: float = 15.0,
) -> tuple[np.ndarray, Predictability]:
    """(cycles, frames, V, 3) a garment in a walk of identical steps, one a second.

    Simulated now; two further cycles before let it forget how it began.

    Args:
        smoothing: see `SimulationConfig`.
    """
    period = round(fps)
    motion = walk(head.skeleton, cycles + 2, speed=1.0, stride=30, fps=fps)
    simulator = Simulator(garment, head, SimulationConfig(smoothing=smoothing))
    frames = simulator.frames(motion, simulator.settled())
    posed = np.stack(list(frames))[2 * period :]
    found = predictability(posed, period)
    return posed.reshape(cycles, period, *posed.shape[1:]), found


def cycles_plot(
    garment: Garment,
    posed: np.ndarray,
    found: Predictability,
    smoothing: float,
) -> Picture:
    """The hem before the left knee, a line for each of some identical steps.

    Args:
        posed: (cycles, frames, V, 3). found: what `periodic` gave with it.
    """
    knee = (garment.vertices @ [-0.5, 1, 1]).argmin()
    side = 1000 * posed[:, :, knee, 1]
    side = side - side.mean()
    floor, deviation = (round(1000 * metres) for metres in found)
    with new_figure(4.6, 3.0) as figure:
        axes = figure.subplots()
        phase = np.linspace(0, 1, side.shape[1], endpoint=False)
        for line, alpha in zip(side, np.linspace(0.4, 1, len(side)), strict=True):
            axes.plot(phase, line, color=SERIES[0], alpha=alpha)
        axes.set(
            xlabel="part of a cycle", ylabel="back and forth, mm", ylim=(-120, 120)
        )
        title = f"smoothing {smoothing:g}: floor {floor} mm of {deviation} mm"
        axes.set_title(title, weight="bold")
        return rasterised(figure, title)


def cycles_picture(
    garment: Garment, head: Head, *, smoothing: float = 300.0, cycles: int = 5
) -> Picture:
    """`cycles_plot` of a walk that is simulated now."""
    return cycles_plot(garment, *periodic(garment, head, smoothing, cycles), smoothing)


def cycles_lab(garment: Garment, head: Head, **start) -> SliderLab:
    """A walk of identical steps, simulated when Run is pressed."""
    return slider_lab(
        functools.partial(cycles_picture, garment, head),
        run_button=True,
        start={"smoothing": 300.0, "cycles": 5} | start,
        smoothing=(0.0, 600.0, 20.0),
        cycles=(2, 10),
    )


# ---- side by side


def frame_picture(
    outfit: Outfit,
    motion: Motion,
    ways: Mapping[str, np.ndarray],
    *,
    frame: int = 0,
    paint: str = "cloth",
    view_from: float = 30.0,
    size: tuple[int, int] = TILE,
) -> Picture:
    """One frame, moved in several ways; the first of them is the truth.

    Args:
        ways: (T, V, 3) by name. paint: "cloth", or "error" in mm from the truth.
    """
    view = replace(LOWER, azimuth=view_from)
    return garments.grid(
        [
            _tile(outfit, motion, posed, off, frame, paint, view, size)
            for posed, off in zip(ways.values(), _off(ways), strict=True)
        ],
        list(ways),
        columns=len(ways),
        colour_bar=ColourBar("mm off", 0, FAR) if paint == "error" else None,
    )


def playback(
    outfit: Outfit, motion: Motion, ways: Mapping[str, np.ndarray], **start
) -> SliderLab:
    """A motion to play and to stop, moved in several ways side by side."""
    lab = slider_lab(
        functools.partial(frame_picture, outfit, motion, ways, size=(180, 220)),
        start={"view_from": 30.0} | start,
        frame=(0, len(motion) - 1),
        paint=["cloth", "error"],
        view_from=(-180.0, 180.0, 5.0),
    )
    return playable(lab, motion.fps)


def strip(
    outfit: Outfit,
    motion: Motion,
    ways: Mapping[str, np.ndarray],
    frames: Sequence[int],
    *,
    paint: str = "cloth",
    view: scenes.View = LOWER,
    size: tuple[int, int] = (140, 170),
    title: str | None = None,
) -> Picture:
    """Some frames of a motion, a row for each way to move the garment."""
    return garments.grid(
        [
            _tile(outfit, motion, posed, off, frame, paint, view, size)
            for posed, off in zip(ways.values(), _off(ways), strict=True)
            for frame in frames
        ],
        [f"frame {frame}" for frame in frames],
        columns=len(frames),
        row_titles=list(ways),
        title=title,
        colour_bar=ColourBar("mm off", 0, FAR) if paint == "error" else None,
    )


def _off(ways: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """(T, V) millimetres from the first of them, for each."""
    truth, *_ = ways.values()
    return [1000 * np.linalg.norm(posed - truth, axis=-1) for posed in ways.values()]


def _tile(outfit, motion, posed, off, frame, paint, view, size) -> np.ndarray:
    values = {"cloth": None, "error": off}[paint]
    return garments.draw(
        outfit, motion, posed, frame, values, high=FAR, view=view, size=size
    )


def error_bars(
    errors: Mapping[str, float],
    ours: str = "virtual bones",
    title: str = "How far off, on walks that nobody learnt from",
) -> Picture:
    """A bar for each way to move a garment, in mm, the largest at the top."""
    names = sorted(errors, key=lambda name: errors[name])
    with new_figure(6.2, 0.9 + 0.34 * len(names)) as figure:
        axes = figure.subplots()
        values = [errors[name] for name in names]
        colours = [OURS if name == ours else FAINT for name in names]
        bars = axes.barh(names, values, color=colours, height=0.62)
        axes.bar_label(bars, fmt="%.0f", padding=3)
        axes.set_xlabel("root mean square distance to the simulation, mm")
        axes.set_title(title, weight="bold")
        axes.margins(x=0.1)
        return rasterised(figure, title)
