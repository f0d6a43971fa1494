"""Pictures of clothes on a body, and labs for them: poses, playback, draping.

Symbols: T frames, V vertices of all garments of an outfit.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np
import torch
from numpy.typing import ArrayLike

from skinlib.garments.binding import signed_distance
from skinlib.garments.collision import nearest, take
from skinlib.garments.energies import (
    EnergyWeights,
    bend_energy,
    collision_energy,
    edge_energy,
    gravity_energy,
    pin_energy,
    total_energy,
)
from skinlib.garments.measures import skinned
from skinlib.garments.motion import JOINTS, Motion, bend
from skinlib.garments.outfit import Outfit
from skinlib.garments.pbns import PBNS
from skinlib.garments.training import GarmentConfig
from skinlib.head import Head
from skinlib.skinning import linear_blend_skinning
from skinlib.views import scenes
from skinlib.views.picture import FAINT, ColourBar, Picture, new_figure, picture_grid
from skinlib.views.picture import rasterise as rasterised
from skinlib.views.plots import SERIES
from skinlib.views.widgets import SliderLab, playable, slider_lab

SKIN = (0.87, 0.74, 0.65)
CLOTHS = ((0.36, 0.55, 0.72), (0.72, 0.42, 0.36), (0.65, 0.6, 0.42))
COVER = 0.03
"""Metres: skin that close below the cloth at rest is left out of an uncovered scene."""

UPPER = scenes.View(20.0, 4.0, zoom=1.75, centre=(0.0, 0.0, 0.42), upright=True)
WHOLE = scenes.View(20.0, 4.0, zoom=0.9, upright=True)
TILE = (240, 256)

# What is painted -> the label of its colour bar and its upper end.
PAINTS = {"depth": ("mm inside the body", 10.0), "stretch": ("edges off by, %", 25.0)}


# ---- what is painted


def depth_inside(outfit: Outfit, motion: Motion, posed: np.ndarray) -> np.ndarray:
    """(T, V) millimetres: how deep each vertex is in the body, 0 outside.

    Args:
        posed: (T, V, 3), the outfit in the frames of the motion.
    """
    head = outfit.body.head
    bodies = _bodies(outfit, motion)
    pairs = zip(posed, bodies, strict=True)
    depths = [signed_distance(points, skin, head.faces) for points, skin in pairs]
    return -1000 * np.minimum(depths, 0)


def stretch(outfit: Outfit, posed: np.ndarray) -> np.ndarray:
    """(T, V) percent: how far the edges round each vertex are from their rest lengths.

    The mean of |l - l0| / l0, as in `skinlib.garments.measures`.
    """
    ends, rest = outfit.cloth.edges.numpy(), outfit.cloth.rest_lengths.numpy()
    lengths = np.linalg.norm(posed[:, ends[:, 0]] - posed[:, ends[:, 1]], axis=-1)
    off = 100 * np.abs(lengths / rest - 1)  # (T, E)
    count = np.bincount(ends.ravel(), minlength=posed.shape[1])
    sums = [np.bincount(ends.ravel(), np.repeat(row, 2), len(count)) for row in off]
    return np.array(sums) / count


# ---- one scene


@functools.lru_cache(maxsize=16)
def dressed(outfit: Outfit, covered: bool = True) -> Head:
    """Body and garments as one mesh at rest, the body first.

    Args:
        covered: with the skin below the cloth. Without it, cloth that is inside the
            body can be seen.
    """
    head = outfit.body.head
    faces = head.faces
    if not covered:
        below = signed_distance(head.vertices, outfit.vertices, outfit.faces)
        below = np.abs(below) < COVER
        faces = faces[~below[faces].all(axis=1)]
    return Head.create(
        np.concatenate([head.vertices, outfit.vertices]),
        np.concatenate([faces, outfit.faces + len(head.vertices)]),
        head.skeleton,
        name=", ".join(garment.name for garment in outfit.garments),
    )


def draw(
    outfit: Outfit,
    motion: Motion,
    posed: np.ndarray,
    frame: int = 0,
    values: ArrayLike | None = None,
    *,
    high: float = 1.0,
    view: scenes.View = UPPER,
    size: tuple[int, int] = TILE,
) -> np.ndarray:
    """(H, W, 3) uint8: a body and what it wears, in one frame of a motion.

    Args:
        posed: (T, V, 3), the outfit in all frames.
        values: (T, V), painted on the cloth from 0 to `high`; the skin below the cloth
            is left out then, so that nothing hides what is inside the body.
    """
    scene = dressed(outfit, covered=values is None)
    if values is None:
        parts = zip(outfit.garments, CLOTHS * len(outfit.garments), strict=False)
        cloth = [np.tile(colour, (len(g.vertices), 1)) for g, colour in parts]
    else:
        cloth = [scenes.colour_by_value(np.asarray(values)[frame], 0, high)]
    skin = _bodies(outfit, motion, frame)[0]
    return scenes.render(
        scene,
        np.concatenate([np.tile(SKIN, (len(skin), 1)), *cloth]),
        vertices=np.concatenate([skin, posed[frame]]),
        view=view,
        size=size,
    )


def painted(
    outfit: Outfit, motion: Motion, posed: np.ndarray, paint: str, frame: int = 0, **how
) -> np.ndarray:
    """One frame in plain `"cloth"`, or painted by `"depth"` or `"stretch"`.

    Args:
        how: `view` and `size` of `draw`.
    """
    if paint == "cloth":
        return draw(outfit, motion, posed, frame, **how)
    if paint not in PAINTS:
        raise ValueError(f"no paint {paint!r}; choose cloth, {', '.join(PAINTS)}")
    one = Motion.create(
        motion.rotations[[frame]], motion.bone_names, motion.translations[[frame]]
    )
    still = posed[[frame]]
    values = (
        depth_inside(outfit, one, still) if paint == "depth" else stretch(outfit, still)
    )
    return draw(outfit, one, still, 0, values, high=PAINTS[paint][1], **how)


def grid(images: Sequence, titles: Sequence[str] | None = None, **how) -> Picture:
    """`picture_grid` in 60 kB: bodies are smooth, and a page shows many of them."""
    return replace(picture_grid(images, titles, **how), max_bytes=60_000)


def colour_bar(paint: str) -> ColourBar | None:
    """What the colours of a paint mean; nothing for `"cloth"`."""
    if paint == "cloth":
        return None
    label, high = PAINTS[paint]
    return ColourBar(label, 0, high)


def _bodies(outfit: Outfit, motion: Motion, frame: int | None = None) -> np.ndarray:
    """(T, B, 3) the skin in all frames, or in one."""
    head = outfit.body.head
    transforms = motion.transforms(head.skeleton)
    if frame is not None:
        transforms = transforms[[frame]]
    return linear_blend_skinning(head.vertices, head.weights, transforms)


# ---- posing by hand


# Slider -> joints and which of flexion, abduction and twist it turns.
BENDS = {
    "shoulder_lift": (("shoulder.L", "shoulder.R"), 1),
    "shoulder_forward": (("shoulder.L", "shoulder.R"), 0),
    "elbow": (("elbow.L", "elbow.R"), 0),
    "spine_forward": (("spine",), 0),
    "spine_twist": (("spine",), 2),
    "hip": (("hip.L",), 0),
}


def posture(outfit: Outfit, **degrees: float) -> Motion:
    """A motion of one frame with the joints of `BENDS` bent by so many degrees."""
    angles: dict[str, np.ndarray] = {}
    for name, angle in degrees.items():
        joints, movement = BENDS[name]
        for joint in joints:
            angles.setdefault(joint, np.zeros(3))[movement] = angle
    skeleton = outfit.body.head.skeleton
    return Motion.create(bend(skeleton, angles)[None], skeleton.names)


def posture_picture(
    outfit: Outfit,
    network: PBNS,
    *,
    paint: str = "cloth",
    view_from: float = 20.0,
    size: tuple[int, int] = TILE,
    **degrees: float,
) -> Picture:
    """One posture: skinning alone at the left, the network at the right."""
    motion = posture(outfit, **degrees)
    view = replace(UPPER, azimuth=view_from)
    both = skinned(outfit, motion), outfit.pose(network, motion)
    return grid(
        [painted(outfit, motion, p, paint, view=view, size=size) for p in both],
        ["skinning alone", "PBNS"],
        colour_bar=colour_bar(paint),
    )


def pose_lab(outfit: Outfit, network: PBNS, **start: float) -> SliderLab:
    """Bend the body, and see its clothes with and without the network.

    Args:
        start: degrees to begin with, by the names of `BENDS`.
    """
    limits = {
        name: (*map(float, JOINTS[joints[0]][movement]), 1.0)
        for name, (joints, movement) in BENDS.items()
    }
    return slider_lab(
        functools.partial(posture_picture, outfit, network),
        start=dict.fromkeys(BENDS, 0.0) | {"view_from": 20.0} | start,
        **limits,
        paint=["cloth", *PAINTS],
        view_from=(-180.0, 180.0, 5.0),
    )


# ---- one network, other bodies


def sizes(
    outfit: Outfit,
    network: PBNS,
    motion: Motion,
    shapes: Mapping[str, Mapping[str, float]],
    *,
    frame: int = 0,
    view: scenes.View = WHOLE,
    size: tuple[int, int] = TILE,
    title: str | None = None,
) -> Picture:
    """A frame of a motion on bodies of other shapes, each in clothes of its size.

    Args:
        network: one that has learnt shapes.
        shapes: amounts of the body's shapes, by the title that each is to have.
    """
    tiles = []
    for shape in shapes.values():
        body = replace(outfit.body, head=outfit.body.shaped(shape))
        posed = outfit.pose(network, motion, shape)
        tiles.append(
            draw(replace(outfit, body=body), motion, posed, frame, view=view, size=size)
        )
    return grid(tiles, list(shapes), columns=len(tiles), title=title)


# ---- playback


def strip(
    outfit: Outfit,
    motion: Motion,
    posed: np.ndarray,
    frames: Sequence[int],
    *,
    paint: str = "cloth",
    view: scenes.View = WHOLE,
    size: tuple[int, int] = (130, 260),
    title: str | None = None,
) -> Picture:
    """Some frames of a motion side by side."""
    return grid(
        [
            painted(outfit, motion, posed, paint, f, view=view, size=size)
            for f in frames
        ],
        [f"frame {frame}" for frame in frames],
        columns=len(frames),
        title=title,
        colour_bar=colour_bar(paint),
    )


def playback(
    outfit: Outfit,
    motion: Motion,
    posed: np.ndarray,
    *,
    view: scenes.View = WHOLE,
    size: tuple[int, int] = (260, 420),
) -> SliderLab:
    """A motion to play and to stop, and a slider over its frames.

    Args:
        posed: (T, V, 3), from `Outfit.pose` or `skinned`.
    """

    def show(frame: int, paint: str) -> Picture:
        image = painted(outfit, motion, posed, paint, frame, view=view, size=size)
        bar = colour_bar(paint)
        return grid([image], [f"frame {frame}"], colour_bar=bar)

    lab = slider_lab(show, frame=(0, len(motion) - 1), paint=["cloth", *PAINTS])
    return playable(lab, motion.fps)


# ---- the energies at work on one pose


def drape(
    outfit: Outfit,
    motion: Motion,
    weights: EnergyWeights,
    steps: int = 60,
    *,
    epsilon: float = 0.004,
    rate: float = 1.5e-3,
) -> tuple[np.ndarray, dict[str, list[float]]]:
    """Lower the energy of one pose by moving its vertices, without any network.

    What a network is trained to do for all poses at once, done for one: Adam on the
    offsets dt at rest, from 0. Layers of an outfit do not feel each other here.

    Args:
        motion: its first frame is the pose. rate: metres that a vertex moves a step.

    Returns:
        (1, V, 3) posed vertices, and each energy in joules, weighted, before each step.
    """
    transforms = torch.from_numpy(motion.transforms(outfit.body.head.skeleton)[:1])
    smoothing = 50 if outfit.pinned.any() else 10
    touch = 0.0 if outfit.pinned.any() else GarmentConfig.touch
    obstacle = outfit.collider_in(motion, smoothing, touch)
    body, normals = obstacle.pose(transforms)
    skin = torch.from_numpy(outfit.blend_weights(smoothing))
    rest, pinned = torch.from_numpy(outfit.vertices), torch.from_numpy(outfit.pinned)
    offsets = torch.zeros(1, *rest.shape, requires_grad=True)
    optimizer = torch.optim.Adam([offsets], lr=rate)
    history: dict[str, list[float]] = {}
    for _ in range(steps):
        posed = linear_blend_skinning(rest + offsets, skin, transforms)
        under = nearest(posed, body)
        terms = {
            "edge": edge_energy(posed, outfit.cloth),
            "bend": bend_energy(posed, outfit.cloth),
            "collision": collision_energy(
                posed, take(body, under), take(normals, under), epsilon
            ),
            "gravity": gravity_energy(posed, outfit.cloth),
            "pin": pin_energy(offsets, pinned),
        }
        for name, value in terms.items():
            joules = asdict(weights)[name] * value.item()
            history.setdefault(name, []).append(joules)
        optimizer.zero_grad()
        total_energy(terms, weights).sum().backward()
        optimizer.step()
    with torch.no_grad():
        posed = linear_blend_skinning(rest + offsets, skin, transforms)
    return posed.numpy(), history


def drape_picture(
    outfit: Outfit,
    motion: Motion,
    *,
    edge: float = EnergyWeights.edge,
    bend: float = EnergyWeights.bend,
    collision: float = EnergyWeights.collision,
    gravity: float = EnergyWeights.gravity,
    pin: float = EnergyWeights.pin,
    steps: int = 60,
    paint: str = "cloth",
    view: scenes.View = UPPER,
    size: tuple[int, int] = TILE,
) -> Picture:
    """One pose after so many steps downhill, and how deep and how stretched it is."""
    weights = EnergyWeights(edge, bend, collision, gravity, pin)
    posed, _ = drape(outfit, motion, weights, steps)
    inside = depth_inside(outfit, motion, posed) > 0
    return grid(
        [painted(outfit, motion, posed, paint, view=view, size=size)],
        caption=f"inside {100 * inside.mean():.1f} %, "
        f"edges off by {stretch(outfit, posed).mean():.1f} %",
        colour_bar=colour_bar(paint),
    )


def drape_lab(outfit: Outfit, motion: Motion, **how) -> SliderLab:
    """A slider for the weight of each energy; press Run to let the cloth settle.

    Args:
        how: `view` and `size` of `drape_picture`.
    """
    powers = {"bend": [0.0, 5e-5, 5e-4, 5e-3, 2e-2]}
    return slider_lab(
        functools.partial(drape_picture, outfit, motion, **how),
        run_button=True,
        start={k: v for k, v in asdict(EnergyWeights()).items() if k != "layer"}
        | {"steps": 60},
        edge=(0.0, 60.0, 1.0),
        bend=powers["bend"],
        collision=(0.0, 1000.0, 25.0),
        gravity=(0.0, 4.0, 0.25),
        pin=(0.0, 40.0, 1.0),
        steps=(0, 150, 10),
        paint=["cloth", *PAINTS],
    )


# ---- a pressed-in vertex, in cross-section


def press_out(
    depth: float,
    epsilon: float,
    steps: int,
    weights: Mapping[str, float] | None = None,
) -> tuple[np.ndarray, np.ndarray, float]:
    """A strip of cloth on a round limb, one vertex pressed in, and steps downhill.

    Args:
        depth: millimetres that the middle vertex begins below the skin.
        epsilon: millimetres that the cloth has to keep.
        steps: of gradient descent on the collision and edge energies.
        weights: N/m of `"collision"` and `"edge"`, 25 and 15 without.

    Returns:
        (N, 2) the strip before, (N, 2) after, in millimetres round the limb's axis, and
        the collision energy after, in millijoules.
    """
    weights = {"collision": 25.0, "edge": 15.0} | dict(weights or {})
    angles = np.radians(np.linspace(20, 160, 21))
    radius = np.full(len(angles), 0.05 + max(epsilon, 1) / 1000)
    rest = _ring(angles, radius)
    lengths = (rest[1:] - rest[:-1]).norm(dim=-1)
    radius[len(radius) // 2] = 0.05 - depth / 1000
    start = _ring(angles, radius)
    around = np.linspace(0, np.pi, 121)
    body, normals = _ring(around, np.full(121, 0.05)), _ring(around, np.ones(121))

    def energy(points):
        under = nearest(points[None], body[None])[0]
        return collision_energy(
            points[None], body[under][None], normals[under][None], epsilon / 1000
        )

    points = start.clone().requires_grad_()
    for _ in range(steps):
        spring = ((points[1:] - points[:-1]).norm(dim=-1) - lengths).square().sum()
        loss = weights["collision"] * energy(points) + weights["edge"] * spring
        (slope,) = torch.autograd.grad(loss.sum(), points)
        # Below the inverse of the largest curvature, so that no step overshoots.
        rate = 0.5 / (weights["collision"] + 4 * weights["edge"] + 1e-9)
        points = (points - rate * slope).detach().requires_grad_()
    left = 1000 * weights["collision"] * energy(points).item()
    return start[:, :2].numpy() * 1000, points[:, :2].detach().numpy() * 1000, left


def _ring(angles: np.ndarray, radius: np.ndarray) -> torch.Tensor:
    x, y = radius * np.cos(angles), radius * np.sin(angles)
    return torch.tensor(np.stack([x, y, np.zeros_like(x)], axis=1))


def press_picture(
    *,
    depth: float = 8.0,
    epsilon: float = 4.0,
    steps: int = 0,
    collision: float = 25.0,
    edge: float = 15.0,
) -> Picture:
    """The strip of `press_out`, before in grey and after in blue."""
    weights = {"collision": collision, "edge": edge}
    before, after, left = press_out(depth, epsilon, steps, weights)
    arc = np.linspace(0, np.pi, 200)
    circle = np.stack([np.cos(arc), np.sin(arc)])
    with new_figure(4.4, 3.1) as figure:
        axes = figure.subplots()
        axes.fill(*(50 * circle), facecolor=SKIN, edgecolor=FAINT, label="body")
        axes.plot(*((50 + epsilon) * circle), ":", color=FAINT, label="epsilon")
        axes.plot(*before.T, ".-", color=FAINT, linewidth=0.8, label="pressed in")
        axes.plot(*after.T, ".-", color=SERIES[0], label=f"after {steps} steps")
        axes.set(xlim=(-42, 42), ylim=(22, 66), xlabel="mm", ylabel="mm")
        axes.set_aspect("equal")
        axes.set_title(f"collision energy {left:.3f} mJ", weight="bold")
        axes.legend(loc="lower right")
        return rasterised(figure, f"{steps} steps, energy {left:.3f} mJ")


def press_lab() -> SliderLab:
    """How deep a vertex is pressed in, what it should keep, and steps out of it."""
    return slider_lab(
        press_picture,
        start={"depth": 8.0, "epsilon": 4.0, "collision": 25.0, "edge": 15.0},
        depth=(-4.0, 20.0, 1.0),
        epsilon=(0.0, 10.0, 1.0),
        steps=(0, 100),
        collision=(0.0, 100.0, 5.0),
        edge=(0.0, 60.0, 5.0),
    )


# ---- the columns of D


def columns_picture(
    outfit: Outfit,
    network: PBNS,
    motion: Motion,
    count: int = 5,
    *,
    high: float = 30.0,
    size: tuple[int, int] = (170, 196),
    title: str | None = None,
) -> Picture:
    """The strongest columns of D: what each moves, and the pose that uses it most.

    Args:
        motion: poses in which columns are looked for.
        high: millimetres at the upper end of the colours.
    """
    used, moves = column_use(network, motion)
    reach = used.max(axis=0) * moves.max(axis=1)
    strongest = np.argsort(-reach, kind="stable")[:count]
    frames = used[:, strongest].argmax(axis=0)
    posed = outfit.pose(network, motion)
    still = posture(outfit, hip=0.0)
    rest = outfit.vertices[None]
    tiles = [
        draw(
            outfit, still, rest, 0, (used[f, h] * moves[h])[None], high=high, size=size
        )
        for h, f in zip(strongest, frames, strict=True)
    ]
    tiles += [draw(outfit, motion, posed, int(f), size=size) for f in frames]
    return grid(
        tiles,
        [f"column {h}" for h in strongest],
        columns=count,
        row_titles=["moves", "most used"],
        title=title,
        colour_bar=ColourBar("mm, at its largest amount", 0, high),
    )


def column_use(network: PBNS, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """(T, |X|) the amount of each column of D in each pose, and (|X|, V) what an amount
    of 1 moves each vertex by, in millimetres."""
    with torch.inference_mode():
        used = network.embed(network.inputs(motion.rotations)).numpy()
        columns = network.columns.unflatten(-1, (-1, 3))
        return used, 1000 * columns.norm(dim=-1).numpy()
