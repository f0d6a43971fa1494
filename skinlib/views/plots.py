"""Charts: weights as a matrix, training, errors, methods, skeleton trees, toy graphs.

Each function takes plain arrays and returns a `Picture`; nothing stays open.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from skinlib.head import Skeleton
from skinlib.views.picture import (
    FAINT,
    INK,
    WEIGHT_MAP,
    Picture,
    new_figure,
    rasterise,
)

# Okabe and Ito's colours, told apart by colour-blind readers; the dashes tell them
# apart in grey.
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6b7280")
DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
OURS = "#d55e00"


def weight_matrix(
    weights: ArrayLike,
    names: Sequence[str],
    *,
    title: str = "Skin weights: a row a vertex, a column a bone",
    note: str | None = "rows sorted by their strongest bone; each row sums to 1",
) -> Picture:
    """Heat map of (V, J) weights, vertices sorted by their strongest bone.

    Bones come in the order of how many vertices they lead, so that a good skin shows
    as a staircase. Thousands of rows are averaged in bands to fit the picture.
    """
    weights = np.asarray(weights)
    leads = np.bincount(weights.argmax(axis=1), minlength=weights.shape[1])
    columns = np.lexsort((-weights.sum(axis=0), -leads))
    weights, names = weights[:, columns], [names[c] for c in columns]
    lead = weights.argmax(axis=1)
    rows = np.lexsort((-weights[np.arange(len(lead)), lead], lead))
    bands = np.array_split(weights[rows], min(len(rows), 420))
    image = np.stack([band.mean(axis=0) for band in bands])
    with new_figure(max(4.0, 1.8 + 0.19 * len(names)), 4.4) as figure:
        axes = figure.subplots()
        drawn = axes.imshow(
            image, aspect="auto", cmap=WEIGHT_MAP, vmin=0, vmax=1,
            interpolation="nearest", extent=(-0.5, len(names) - 0.5, len(rows), 0),
        )  # fmt: skip
        axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
        axes.set_xlabel("bone")
        axes.set_ylabel("vertex (sorted)")
        axes.set_title(title, weight="bold")
        figure.colorbar(drawn, ax=axes, label="skin weight, 0 to 1", fraction=0.04)
        return rasterise(figure, title, note)


def small_matrix(
    values: ArrayLike,
    rows: Sequence[str],
    columns: Sequence[str],
    *,
    title: str,
    label: str = "skin weight, 0 to 1",
    low: float | None = 0.0,
    high: float | None = 1.0,
    row_label: str = "vertex",
    column_label: str = "bone",
) -> Picture:
    """A matrix small enough to read: its numbers are written in the cells."""
    values = np.asarray(values, np.float64)
    low = float(values.min()) if low is None else low
    high = float(values.max()) if high is None else high
    width, height = 2.2 + 0.62 * values.shape[1], 1.3 + 0.36 * values.shape[0]
    with new_figure(max(width, 3.6), max(height, 2.0)) as figure:
        axes = figure.subplots()
        drawn = axes.imshow(values, cmap=WEIGHT_MAP, vmin=low, vmax=high, aspect="auto")
        for (i, j), value in np.ndenumerate(values):
            shade = (value - low) / ((high - low) or 1)
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", size=8.5,
                      color="white" if shade > 0.55 else INK)  # fmt: skip
        axes.set_xticks(range(len(columns)), columns)
        axes.set_yticks(range(len(rows)), rows)
        axes.set_xlabel(column_label)
        axes.set_ylabel(row_label)
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0)
        axes.set_title(title, weight="bold")
        figure.colorbar(drawn, ax=axes, label=label)
        return rasterise(figure, title)


def training_curves(
    curves: Mapping[str, Sequence[float] | tuple[Sequence[float], Sequence[float]]],
    *,
    title: str = "Training",
    x_label: str = "step",
    y_label: str = "row-L1 (0 = perfect, 2 = all wrong)",
    log: bool = False,
    targets: Mapping[str, float] | None = None,
    note: str | None = None,
) -> Picture:
    """Lines by name, each a sequence of values or a pair `(steps, values)`.

    Args:
        log: logarithmic vertical axis.
        targets: horizontal lines by name, for instance the best baseline.
    """
    with new_figure(6.4, 3.4) as figure:
        axes = figure.subplots()
        for i, (name, curve) in enumerate(curves.items()):
            pair = isinstance(curve, tuple) and len(curve) == 2 and np.ndim(curve[0])
            steps, values = curve if pair else (range(1, len(curve) + 1), curve)
            axes.plot(steps, values, label=name, color=SERIES[i % len(SERIES)],
                      linestyle=DASHES[i % len(DASHES)], linewidth=1.6)  # fmt: skip
        for name, value in (targets or {}).items():
            axes.axhline(value, color=FAINT, linewidth=0.9, linestyle=":")
            axes.annotate(f"{name}: {value:.3g}", (1, value), size=8, color=FAINT,
                          xycoords=("axes fraction", "data"), ha="right",
                          va="bottom")  # fmt: skip
        if log:
            axes.set_yscale("log")
        elif axes.dataLim.y0 >= 0:
            axes.set_ylim(bottom=0)
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label)
        axes.grid(axis="y", color="#e5e7eb", linewidth=0.7)
        axes.set_title(title, weight="bold")
        axes.legend()
        return rasterise(figure, title, note)


def error_histogram(
    errors: Mapping[str, ArrayLike],
    *,
    title: str = "How wrong is each vertex?",
    x_label: str = "row-L1 of a vertex (0 = perfect, 2 = all wrong)",
    high: float | None = None,
    note: str | None = "lines: mean; the share of vertices is on a logarithmic axis",
) -> Picture:
    """Histograms of (V,) errors by method, over each other, with their means."""
    longest = max(float(np.max(e)) for e in errors.values()) if high is None else high
    edges = np.linspace(0, longest or 1.0, 41)
    with new_figure(6.4, 3.4) as figure:
        axes = figure.subplots()
        for i, (name, values) in enumerate(errors.items()):
            share = np.full(len(values), 1 / len(values))
            colour, dash = SERIES[i % len(SERIES)], DASHES[i % len(DASHES)]
            axes.hist(np.clip(values, 0, edges[-1]), edges, weights=share,
                      histtype="step", linewidth=1.6, color=colour, linestyle=dash,
                      label=f"{name}, mean {np.mean(values):.3f}")  # fmt: skip
            axes.axvline(float(np.mean(values)), color=colour, linewidth=0.9)
        axes.set_yscale("log")
        axes.set_ylim(0.7 / max(len(values) for values in errors.values()), 1.4)
        axes.set_xlabel(x_label)
        axes.set_ylabel("share of the vertices")
        axes.set_title(title, weight="bold")
        axes.legend()
        return rasterise(figure, title, note)


def method_bars(
    results: Mapping,
    measure: str = "row_l1_mean",
    *,
    label: str = "row-L1, mean over vertices (0 = perfect, 2 = all wrong)",
    ours: str = "skinlib",
    title: str = "Methods on heads that were not trained on",
) -> Picture:
    """A bar a method, the best at the top, and a dot a head.

    Args:
        results: what `skinlib evaluate --json` writes,
            `{"methods": {NAME: {"mean": {...}, "heads": {STEM: {...}}}}}`.
        measure: which of the numbers. ours: the method drawn in colour.
    """
    methods = {
        name: ([head[measure] for head in method["heads"].values()], method["mean"])
        for name, method in results["methods"].items()
    }
    names = sorted(methods, key=lambda name: methods[name][1][measure])
    count = max((len(heads) for heads, _ in methods.values()), default=0)
    with new_figure(6.8, 1.1 + 0.34 * len(names)) as figure:
        axes = figure.subplots()
        for y, name in enumerate(names):
            heads, mean = methods[name]
            axes.barh(y, mean[measure], height=0.62, zorder=1,
                      color=OURS if name == ours else "#b6c2cf")  # fmt: skip
            axes.scatter(heads, np.full(len(heads), y), s=7, color=INK, zorder=2,
                         alpha=0.55, linewidths=0)  # fmt: skip
            right = max([mean[measure], *heads])
            axes.annotate(f"{mean[measure]:.3f}", (right, y), (5, 0), size=8,
                          textcoords="offset points", va="center",
                          weight="bold" if name == ours else "normal")  # fmt: skip
        axes.set_yticks(range(len(names)), [n.replace("_", " ") for n in names])
        axes.invert_yaxis()
        axes.margins(x=0.12)
        axes.set_xlim(left=0)
        axes.set_xlabel(label)
        axes.set_title(title, weight="bold")
        return rasterise(figure, title, f"bar: mean; dot: one of {count} heads")


def method_scatter(
    results: Mapping,
    measure: str = "row_l1_mean",
    *,
    label: str = "row-L1, mean (0 = perfect, 2 = all wrong)",
    ours: str = "skinlib",
    title: str = "Good and fast is at the lower left",
) -> Picture:
    """Error against seconds a head, both logarithmic, a named point a method.

    Args:
        results: as in `method_bars`; `seconds` is the horizontal axis.
    """
    with new_figure(6.4, 3.8) as figure:
        axes = figure.subplots()
        means = [method["mean"] for method in results["methods"].values()]
        points = np.array([[mean["seconds"], mean[measure]] for mean in means])
        points = np.maximum(points, 1e-4)
        for point, name in zip(points, results["methods"], strict=True):
            mine = name == ours
            axes.scatter(*point, s=64 if mine else 36, zorder=2,
                         marker="D" if mine else "o",
                         color=OURS if mine else "#5b6b7b")  # fmt: skip
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.margins(0.2)
        axes.set_xlim(right=20 * points[:, 0].max())  # room for the names
        axes.grid(color="#e5e7eb", linewidth=0.7)
        axes.set_axisbelow(True)
        axes.set_xlabel("time a head (s)")
        axes.set_ylabel(label)
        axes.set_title(title, weight="bold")
        # Names go beside their points, the lowest first, up to where there is room.
        figure.draw_without_rendering()
        taken = []
        for i in np.argsort(points[:, 1]):
            name = list(results["methods"])[i]
            weight = "bold" if name == ours else "normal"
            text = axes.annotate(
                name.replace("_", " "),
                points[i],
                (7, -3),
                textcoords="offset points",
                size=8.5,
                weight=weight,
            )
            while any(text.get_window_extent().overlaps(box) for box in taken):
                text.set_position((7, text.get_position()[1] + 2))
            taken.append(text.get_window_extent())
        return rasterise(figure, title)


def skeleton_tree(
    skeleton: Skeleton,
    colours: ArrayLike | None = None,
    *,
    title: str | None = None,
    note: str | None = "parents at the left, children at the right",
) -> Picture:
    """The skeleton as a tree that grows to the right; roots are squares.

    Args:
        colours: (J, 3) of the bones, for instance `scenes.bone_palette(skeleton)`.
    """
    children, depths = skeleton.children(), skeleton.depths
    height = np.zeros(len(skeleton))
    row = 0
    # Children first: a leaf takes the next row, a parent the middle of its children.
    stack = [(bone, False) for bone in np.flatnonzero(skeleton.parents < 0)[::-1]]
    while stack:
        bone, ready = stack.pop()
        if not children[bone]:
            height[bone], row = row, row + 1
        elif ready:
            height[bone] = np.mean([height[c] for c in children[bone]])
        else:
            stack.append((bone, True))
            stack.extend((c, False) for c in reversed(children[bone]))
    colours = [to_rgb(SERIES[0])] * len(skeleton) if colours is None else colours
    title = title or f"{len(skeleton)} bones, depth 0 to {depths.max()}"
    with new_figure(
        1.9 + 1.35 * (depths.max() + 1), 0.9 + 0.27 * max(row, 4)
    ) as figure:
        axes = figure.subplots()
        for bone, parent in enumerate(skeleton.parents):
            if parent >= 0:
                x0, x1 = depths[parent], depths[bone]
                axes.plot([x0, x1 - 0.42, x1 - 0.2, x1],
                          [height[parent], height[parent], height[bone], height[bone]],
                          color="#9ca3af", linewidth=0.8, zorder=1)  # fmt: skip
            axes.scatter([depths[bone]], [height[bone]], s=38, color=[colours[bone]],
                         marker="s" if parent < 0 else "o", edgecolors=INK,
                         linewidths=0.6, zorder=2)  # fmt: skip
            inner = bool(children[bone])
            axes.annotate(skeleton.names[bone], (depths[bone], height[bone]),
                          (0, 8) if inner else (8, 0), textcoords="offset points",
                          ha="center" if inner else "left", va="center",
                          size=8, zorder=3)  # fmt: skip
        axes.set_xlim(-0.5, depths.max() + 1.2)
        axes.set_ylim(max(row, 1) - 0.3, -0.9)
        axes.set_xticks(range(depths.max() + 1))
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.set_xlabel("depth (bones above it)")
        axes.set_title(title, weight="bold")
        return rasterise(figure, title, note)


def toy_graph(
    points: ArrayLike,
    edges: Mapping[str, ArrayLike],
    *,
    normals: ArrayLike | None = None,
    names: Sequence[str] | None = None,
    title: str = "A graph to compute by hand",
    note: str | None = None,
) -> Picture:
    """Points in the plane, edges by kind, and normals as arrows.

    Args:
        points: (N, 2). edges: (E, 2) ids by the name of their kind; a kind whose name
            starts with "no" or "rejected" is drawn dotted. normals: (N, 2).
    """
    points = np.asarray(points, np.float64)
    with new_figure(5.6, 3.6) as figure:
        axes = figure.subplots()
        handles = []
        for i, (kind, pairs) in enumerate(edges.items()):
            refused = kind.lower().startswith(("no", "rejected"))
            style = {
                "color": "#b91c1c" if refused else ("#4b5563", *SERIES[1:])[i % 7],
                "linestyle": ":" if refused else ("-", "--", "-.")[i % 3],
                "linewidth": 1.6,
            }
            for a, b in np.asarray(pairs, np.int64).reshape(-1, 2):
                axes.plot(*points[[a, b]].T, zorder=1, **style)
            handles.append(Line2D([], [], label=f"{kind} ({len(pairs)})", **style))
        if normals is not None:
            reach = 0.12 * np.ptp(points, axis=0).max()
            axes.quiver(*points.T, *(np.asarray(normals) * reach).T, angles="xy",
                        scale_units="xy", scale=1, width=0.005, color="#009e73",
                        zorder=2)  # fmt: skip
            handles.append(Line2D([], [], color="#009e73", label="normal"))
        axes.scatter(*points.T, s=150, color="white", edgecolors=INK, zorder=3)
        for i, point in enumerate(points):
            axes.annotate(names[i] if names else str(i), point, ha="center",
                          va="center", size=8, zorder=4)  # fmt: skip
        axes.set_aspect("equal")
        axes.margins(0.15)
        axes.set_xlabel("x (units)")
        axes.set_ylabel("y (units)")
        axes.set_title(title, weight="bold")
        if handles:
            axes.legend(handles=handles, loc="center left", bbox_to_anchor=(1, 0.5))
        return rasterise(figure, title, note)


def bone_bars(
    values: ArrayLike,
    names: Sequence[str],
    colours: ArrayLike | None = None,
    *,
    title: str = "One vertex's skin weights",
    label: str = "skin weight, 0 to 1",
    high: float | None = 1.0,
) -> Picture:
    """One bar a bone, with its number: a row of the weights, or of the logits."""
    values = np.asarray(values, np.float64)
    colours = [to_rgb(SERIES[0])] * len(values) if colours is None else colours
    with new_figure(max(3.2, 0.9 + 0.5 * len(values)), 2.7) as figure:
        axes = figure.subplots()
        axes.bar(
            range(len(values)), values, color=colours, edgecolor=INK, linewidth=0.5
        )
        for i, value in enumerate(values):
            axes.annotate(f"{value:.2f}", (i, max(value, 0)), (0, 3), size=8,
                          ha="center", textcoords="offset points")  # fmt: skip
        crowded = len(values) > 8
        axes.set_xticks(range(len(values)), names, rotation=90 if crowded else 0)
        if high is not None:
            axes.set_ylim(min(0, values.min()), high * 1.1)
        axes.set_xlabel("bone")
        axes.set_ylabel(label)
        axes.set_title(title, weight="bold")
        return rasterise(figure, title)
