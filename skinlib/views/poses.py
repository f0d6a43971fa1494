"""Pictures of pose transfer: who is given, what comes out, and what is lost on the way.

Points are normalised, as `skinlib.pose_transfer.data` gives them, and in the order of a
mesh, if not said otherwise. Symbols: B items, T poses, M vertices of a source, N of an
identity.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike
from torch import Tensor

from skinlib.head import Head, Skeleton
from skinlib.pose_transfer.data import Cast, Pairs, normalised, vertex_shares
from skinlib.pose_transfer.networks import NPT, DSFFNet, FFAdaIN
from skinlib.views import garments, scenes
from skinlib.views.picture import FAINT, ColourBar, Picture, new_figure, rasterise
from skinlib.views.plots import DASHES, OURS
from skinlib.views.widgets import SliderLab, slider_lab

BOX = scenes.View(25.0, 6.0, zoom=0.92, centre=(0.0, 0.0, 0.0), upright=True)
TILE = (150, 168)
FAR = 15.0  # percent of the height: the darkest colour of an error
GIVEN = (0.66, 0.74, 0.80)  # what is not the network's work
LAYERS = ("1a", "1b", "2a", "2b", "3a", "3b", "out")
"""After the first and the second half of each block of a decoder, and at its end."""


# ---- one mesh


def mesh_of(cast: Cast, who: int = 0) -> Head:
    """The mesh that a cast is on, as one of its identities at rest; it has no rig."""
    bone = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["none"])
    return Head.create(cast.rest[who].cpu(), cast.faces.cpu(), bone)


@functools.lru_cache(maxsize=32)
def stage(mesh: Head) -> Head:
    """The mesh at rest in the cube from -1 to 1: it says where the camera stands."""
    return mesh.replace(vertices=normalised(mesh.vertices)[0])


def draw(
    mesh: Head,
    points: ArrayLike,
    values: ArrayLike | None = None,
    *,
    colours: ArrayLike | Sequence[float] | None = None,
    high: float = FAR,
    view: scenes.View = BOX,
    size: tuple[int, int] = TILE,
) -> np.ndarray:
    """(H, W, 3) uint8: a mesh whose vertices are at `points`.

    Args:
        mesh: at rest, in any unit. points: (N, 3). values: (N,), painted from 0 to
            `high`. colours: (N, 3) or (3,), without values.
    """
    if values is not None:
        colours = scenes.colour_by_value(np.asarray(values), 0, high)
    points = np.asarray(points, np.float64)
    return scenes.render(stage(mesh), colours, vertices=points, view=view, size=size)


# ---- pairs


def in_mesh_order(points: Tensor, order: Tensor) -> np.ndarray:
    """(B, N, 3) points in the order of their mesh.

    Args:
        points: (B, N, 3) as in `Pairs`. order: (B, N), which vertex each one is.
    """
    back = order.argsort(dim=1)[..., None].expand(-1, -1, 3)
    return points.detach().gather(1, back).cpu().numpy()


def strip(
    sources: Head,
    targets: Head,
    pairs: Pairs,
    ways: Mapping[str, Tensor],
    *,
    paint: str = "clay",
    title: str | None = None,
    size: tuple[int, int] = TILE,
) -> Picture:
    """A column for each item: source, identity, what each way makes of them, truth.

    Args:
        sources, targets: the meshes that the pairs are of, at rest.
        ways: (B, N, 3) by name, in the order of `pairs.truth`.
        paint: "clay", or "error": the ways only, painted by the distance from the truth
            in percent of the height.

    Raises:
        ValueError: another paint.
    """
    if paint not in ("clay", "error"):
        raise ValueError(f"paint={paint!r}; use clay or error")
    truth = in_mesh_order(pairs.truth, pairs.order)
    made = {name: in_mesh_order(p, pairs.order) for name, p in ways.items()}
    look = {"size": size}
    rows = {}
    if paint == "clay":
        source = in_mesh_order(pairs.source, pairs.source_order)
        identity = in_mesh_order(pairs.identity, pairs.order)
        rows["source"] = [draw(sources, p, colours=GIVEN, **look) for p in source]
        rows["identity"] = [draw(targets, p, colours=GIVEN, **look) for p in identity]
        rows |= {n: [draw(targets, p, **look) for p in ps] for n, ps in made.items()}
        rows["truth"] = [draw(targets, p, colours=GIVEN, **look) for p in truth]
    else:
        height = pairs.height.cpu().numpy()[:, None]
        for name, points in made.items():
            off = 100 * np.linalg.norm(points - truth, axis=-1) / height
            parts = zip(points, off, strict=True)
            rows[name] = [draw(targets, p, v, **look) for p, v in parts]
    return garments.grid(
        [tile for row in rows.values() for tile in row],
        columns=len(truth),
        row_titles=list(rows),
        title=title,
        colour_bar=ColourBar("off, % of height", 0, FAR) if paint == "error" else None,
    )


# ---- what is left of the pose


@torch.no_grad()
def pose_shares(
    network: DSFFNet | NPT,
    sources: Tensor,
    identity: Tensor,
    faces: ArrayLike,
    told: int | None = None,
) -> np.ndarray:
    """(7,) after each of `LAYERS`: the share of the features' spread due to the pose.

    The features of one identity in T poses are normalised over the vertices, as the
    next layer does. Their variance over the poses is divided by that over poses and
    vertices: 0 where all poses give the same features.

    Args:
        sources: (T, N, 3), T at least 2. identity: (N, 3). faces: (F, 3) of all.
        told: only so many `FFAdaIN`, the first ones, are given the code of each pose;
            the others get the mean of the codes. All of them without.

    Raises:
        ValueError: a single pose.
    """
    if len(sources) < 2:
        raise ValueError("one pose differs from no other; give two or more")
    layers = []
    for block in network.blocks:
        half = block.conv1 if isinstance(network, DSFFNet) else block.convs[0]
        layers += [half, block]
    layers.append(network.convs[-1])
    found = {}
    hooks = [
        layer.register_forward_hook(
            lambda _, __, features, i=i: found.__setitem__(i, pose_share(features))
        )
        for i, layer in enumerate(layers)
    ]
    fused = [m for m in network.modules() if isinstance(m, FFAdaIN)]
    hooks += [
        layer.register_forward_pre_hook(_mean_code)
        for layer in fused[len(fused) if told is None else told :]
    ]
    try:
        both = sources, identity.expand(len(sources), -1, -1)
        triangles = torch.tensor(np.asarray(faces))
        network(*both, *(vertex_shares(points, triangles) for points in both))
    finally:
        for hook in hooks:
            hook.remove()
    return np.array([found[i] for i in range(len(layers))])


def _mean_code(_, given: tuple) -> tuple:
    h, points, code, *rest = given
    return (h, points, code.mean(dim=0, keepdim=True).expand_as(code), *rest)


def pose_share(features: Tensor) -> float:
    """Variance over poses, by that over poses and vertices, each channel normalised.

    Args:
        features: (T, C, N) of T poses.

    A constant that all vertices share does not count; what changes sign with the pose
    is all pose:

    >>> features = torch.tensor([[[0.0, 1, 2]], [[9.0, 10, 11]]])
    >>> round(pose_share(features), 4)
    0.0
    >>> round(pose_share(features * torch.tensor([[[1.0]], [[-1.0]]])), 4)
    1.0
    """
    h = F.instance_norm(features)
    return float(h.var(dim=0, correction=0).mean() / h.square().mean())


def shares_plot(
    shares: Mapping[str, ArrayLike], ours: str = "DSFFNet", title: str = ""
) -> Picture:
    """Lines over `LAYERS`, in percent, on a logarithmic axis.

    Args:
        shares: (7,) by name, as `pose_shares` gives them.
    """
    with new_figure(6.2, 3.2) as figure:
        axes = figure.subplots()
        for i, (name, values) in enumerate(shares.items()):
            look = {"color": FAINT, "linestyle": DASHES[i % len(DASHES)]}
            if name == ours:
                look |= {"color": OURS, "linewidth": 2.2}
            look |= {"marker": "os^*"[i % 4], "label": name}
            axes.plot(LAYERS, 100 * np.asarray(values), **look)
        axes.set(xlabel="layer of the decoder", ylabel="spread due to the pose, %")
        axes.set_yscale("log")
        axes.set_title(title, weight="bold")
        axes.legend()
        return rasterise(figure, title)


# ---- poses between poses


def mix_picture(
    network: DSFFNet,
    mesh: Head,
    identity: Tensor,
    sources: Tensor,
    *,
    first: int = 0,
    second: int = 1,
    mix: float = 0.5,
    view_from: float = 25.0,
    size: tuple[int, int] = TILE,
) -> Picture:
    """The identity in a pose whose code lies between those of two sources.

    Args:
        mesh: of all. identity: (N, 3). sources: (T, N, 3).
        first, second: two of these. mix: 0 is the first, 1 the second; beyond both the
            line between the codes goes on.
    """
    ends = sources[first], sources[second]
    posed = mixed(network, identity, *ends, mesh.faces, [mix])[0]
    view = replace(BOX, azimuth=view_from)
    return Picture(draw(mesh, posed, view=view, size=size), f"mix {mix:g}")


@torch.no_grad()
def mixed(
    network: DSFFNet,
    identity: Tensor,
    first: Tensor,
    second: Tensor,
    faces: ArrayLike,
    amounts: Sequence[float],
) -> np.ndarray:
    """(A, N, 3) the identity in the poses of the codes (1 - t) z1 + t z2.

    Args:
        identity, first, second: (N, 3). faces: (F, 3) of all three. amounts: t, A of
            them.
    """
    points = torch.stack([identity, first, second])
    shares = vertex_shares(points, torch.tensor(np.asarray(faces)))
    one, other = network.encode(points[1:], shares[1:]).split(1)
    t = torch.as_tensor(amounts, dtype=one.dtype)[:, None, None]
    codes = one + t * (other - one)
    many = points[:1].expand(len(codes), -1, -1), shares[:1].expand(len(codes), -1)
    return network.decode(codes, *many).numpy()


def mix_lab(
    network: DSFFNet, mesh: Head, identity: Tensor, sources: Tensor, **start
) -> SliderLab:
    """Two poses, and all between them."""
    last = len(sources) - 1
    return slider_lab(
        functools.partial(
            mix_picture, network, mesh, identity, sources, size=(200, 230)
        ),
        start={"second": last, "mix": 0.5, "view_from": 25.0} | start,
        first=(0, last),
        second=(0, last),
        mix=(-0.5, 1.5, 0.05),
        view_from=(-180.0, 180.0, 5.0),
    )


# ---- while it learns


def mixing_plot(
    runs: Mapping[str, ArrayLike], steps: Sequence[int], title: str = ""
) -> Picture:
    """alpha and beta of each layer over the steps, a panel for each run.

    Args:
        runs: (S, L, 2) by name, `DSFFNet.mixing` at S moments.
        steps: S, when these were.
    """
    names = (r"$\alpha$, the scale", r"$\beta$, the shift")
    looks = ({"color": OURS}, {"color": FAINT, "linestyle": "--"})
    with new_figure(5.2, 2.3) as figure:
        panels = figure.subplots(1, len(runs), squeeze=False)[0]
        for axes, (name, values) in zip(panels, runs.items(), strict=True):
            values = np.asarray(values)
            for side, (what, look) in enumerate(zip(names, looks, strict=True)):
                lines = axes.plot(steps[: len(values)], values[..., side], **look)
                lines[0].set_label(what)
            axes.set(xlabel="step", title=name)
        panels[0].set_ylabel("share of the mixed side")
        panels[0].legend()
        figure.suptitle(title, weight="bold", size=10)
        return rasterise(figure, title)
