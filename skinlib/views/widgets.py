"""Sliders for notebooks: each lab is a pure function of its values, drawn again when
a slider is let go.

A lab shows its picture in an image widget, not through captured output, so nothing
leaks into other cells. Readers without a running kernel see no widgets: put
`lab.twin(...)` into the next cell, the same function at a few chosen values.
"""

import functools
import html
from collections.abc import Callable, Mapping, Sequence

import ipywidgets
import numpy as np
from numpy.typing import ArrayLike

from skinlib.graph import SPACE, GraphConfig, build_graph
from skinlib.head import Head, HeadError
from skinlib.skinning import PRESET_POSES, preset_pose
from skinlib.views import plots, scenes
from skinlib.views.picture import Picture, picture_grid


class SliderLab(ipywidgets.VBox):
    """Controls above a picture; `slider_lab` makes one.

    Attributes:
        controls: the widgets by the name of the function's argument.
        picture: what is shown now; None before the first run.
    """

    def __init__(
        self,
        function: Callable,
        controls: Mapping[str, ipywidgets.Widget],
        run_button: bool = False,
    ):
        self.function = function
        self.controls = dict(controls)
        self.picture: Picture | None = None
        self._image = ipywidgets.Image(
            format="jpeg", layout={"max_width": "100%", "align_self": "flex-start"}
        )
        self._message = ipywidgets.HTML()
        grid = ipywidgets.Box(
            list(self.controls.values()), layout={"flex_flow": "row wrap"}
        )
        above = [grid]
        if run_button:
            self.run_button = ipywidgets.Button(description="Run", icon="play")
            self.run_button.on_click(lambda _: self.update())
            above.append(self.run_button)
        super().__init__([*above, self._message, self._image])
        for control in self.controls.values():
            if run_button:
                control.observe(self._mark_stale, names="value")
            else:
                control.observe(lambda _: self.update(), names="value")
        self.update()

    def __repr__(self) -> str:
        return f"<SliderLab {', '.join(self.controls)}>"

    @property
    def values(self) -> dict:
        """What the controls say now."""
        return {name: control.value for name, control in self.controls.items()}

    def update(self) -> None:
        """Call the function with the controls' values and show its picture."""
        try:
            self.picture = _as_picture(self.function(**self.values))
        except Exception as error:
            # An exception in a browser's event reaches only the server's log.
            self._message.value = f"<b>{html.escape(str(error))}</b>"
            raise
        self._image.value = self.picture.jpeg()
        self._message.value = ""

    def twin(self, *settings: Mapping, titles: Sequence[str] | None = None) -> Picture:
        """The same function at chosen values, side by side, for readers on paper.

        Args:
            settings: values that differ from the controls' present ones.
        """
        pictures = [
            _as_picture(self.function(**{**self.values, **chosen}))
            for chosen in settings or ({},)
        ]
        if titles is None and settings:
            titles = [
                ", ".join(f"{k} = {v}" for k, v in chosen.items())
                for chosen in settings
            ]
        return picture_grid([p.image for p in pictures], titles, width=None)

    def _mark_stale(self, _) -> None:
        self._message.value = "<i>changed: press Run</i>"


def _as_picture(result) -> Picture:
    return result if isinstance(result, Picture) else Picture(np.asarray(result))


def slider_lab(
    function: Callable,
    *,
    run_button: bool = False,
    start: Mapping | None = None,
    **ranges,
) -> SliderLab:
    """Put a control on each argument of a function that returns a picture.

    Args:
        function: `f(**values)` to a `Picture` or an (H, W, 3) uint8 array.
        run_button: draw when the button is pressed, not when a slider moves; for
            what takes longer than 200 ms.
        start: first values; the low end, the first option or the bool itself without.
        ranges: by argument, `(low, high)` or `(low, high, step)` for a slider, whole
            numbers when low, high and step are; a list of options, or of pairs
            `(label, option)`, for a menu; a bool for a box.

    Raises:
        ValueError: a range that is none of these.

    >>> grey = lambda level, big: np.full((8, 16 if big else 8, 3), level, np.uint8)
    >>> lab = slider_lab(grey, level=(0, 255), big=False)
    >>> lab.controls["level"].value = 200
    >>> lab.picture.image[0, 0].tolist()
    [200, 200, 200]
    """
    start = start or {}
    controls = {
        name: _control(name, spread, start.get(name)) for name, spread in ranges.items()
    }
    return SliderLab(function, controls, run_button)


def playable(lab: SliderLab, fps: float) -> SliderLab:
    """The same lab with a button that plays its slider `frame`, in slow motion.

    Args:
        fps: frames per second of the motion.
    """
    frame = lab.controls["frame"]
    play = ipywidgets.Play(max=frame.max, step=max(1, round(fps / 8)), interval=300)
    ipywidgets.link((play, "value"), (frame, "value"))
    lab.children = (play, *lab.children)
    return lab


def _control(name: str, spread, value) -> ipywidgets.Widget:
    common = {
        "description": name.replace("_", " "),
        "style": {"description_width": "90px"},
        "layout": {"width": "330px"},
    }
    if isinstance(spread, bool):
        checked = spread if value is None else bool(value)
        return ipywidgets.Checkbox(checked, indent=True, **common)
    if isinstance(spread, list) and spread:
        chosen = {} if value is None else {"value": value}
        return ipywidgets.Dropdown(options=spread, **chosen, **common)
    if isinstance(spread, tuple) and len(spread) in (2, 3):
        low, high = spread[:2]
        whole = all(isinstance(number, int) for number in spread)
        step = spread[2] if len(spread) == 3 else 1 if whole else (high - low) / 20
        kind = ipywidgets.IntSlider if whole else ipywidgets.FloatSlider
        return kind(
            value=low if value is None else value,
            min=low,
            max=high,
            step=step,
            continuous_update=False,
            **common,
        )
    raise ValueError(
        f"{name}={spread!r}; use (low, high[, step]), a list of options or a bool"
    )


# ---- posing


def pose_picture(
    head: Head,
    weights: np.ndarray,
    *,
    bone: str = "",
    angle: float = 0.0,
    view_from: float = 22.0,
    by_bone: bool = True,
    size: tuple[int, int] = scenes.SIZE,
    **poses: float,
) -> Picture:
    """The head bent by its skin weights.

    Args:
        bone, angle: one bone to nod by so many degrees; none when empty.
        view_from: the camera's azimuth in degrees.
        by_bone: colour the head by bone, not like clay.
        poses: amounts of `skinlib.skinning.PRESET_POSES`, 0 rest, 1 the whole pose.
    """
    turns = {bone: angle} if bone else None
    vertices = scenes.pose_vertices(head, weights, poses, turns)
    image = scenes.render(
        head,
        scenes.colour_by_bone(weights, head.skeleton) if by_bone else None,
        vertices=vertices,
        view=scenes.View(azimuth=view_from, zoom=0.88),  # room to lean out
        size=size,
    )
    bent = [f"{name} {amount:g}" for name, amount in poses.items() if amount]
    bent += [f"{bone} {angle:g} degrees"] if bone and angle else []
    return Picture(image, f"{head.name or 'head'}: {', '.join(bent) or 'rest pose'}")


def known_poses(head: Head) -> list[str]:
    """The preset poses whose bones this head's skeleton has."""
    known = []
    for name in PRESET_POSES:
        try:
            preset_pose(head, name, 0.0)
        except HeadError:
            continue
        known.append(name)
    return known


def pose_sliders(head: Head, weights: np.ndarray | None = None) -> SliderLab:
    """Bend a head: a slider for each pose its skeleton knows, and any bone by hand."""
    weights = scenes.checked_weights(head, weights)
    ranges = {
        name: (-1.0 if name == "head_turn" else 0.0, 1.0, 0.05)
        for name in known_poses(head)
    }
    return slider_lab(
        functools.partial(pose_picture, head, weights),
        start=dict.fromkeys(ranges, 0.0) | {"view_from": 22.0, "angle": 0.0},
        **ranges,
        bone=[("none", ""), *((name, name) for name in _by_load(head, weights))],
        angle=(-40.0, 40.0, 1.0),
        view_from=(-90.0, 90.0, 1.0),
        by_bone=True,
    )


def _by_load(head: Head, weights: np.ndarray) -> list[str]:
    """Bone names, those that carry most weight first."""
    order = np.argsort(-weights.sum(axis=0), kind="stable")
    return [head.skeleton.names[bone] for bone in order]


# ---- looking at weights


def bone_picture(
    head: Head, weights: np.ndarray, *, bone: str, view_from: float = 22.0
) -> Picture:
    """One bone's column of the weights on the surface."""
    return scenes.show_weights(head, bone, weights, view=scenes.View(azimuth=view_from))


def bone_picker(head: Head, weights: np.ndarray | None = None) -> SliderLab:
    """Choose a bone, see which vertices follow it."""
    weights = scenes.checked_weights(head, weights)
    return slider_lab(
        functools.partial(bone_picture, head, weights),
        start={"view_from": 22.0},
        bone=_by_load(head, weights),
        view_from=(-90.0, 90.0, 1.0),
    )


# ---- the hybrid graph


def knn_picture(
    head: Head,
    *,
    region: str | None = None,
    nearest: int = 8,
    min_cosine: float = 0.5,
    max_detour: float = 1.6,
    radius: float = 0.3,
) -> Picture:
    """The hybrid graph around one bone, for one setting of its gates."""
    config = GraphConfig(nearest=nearest, min_cosine=min_cosine, max_detour=max_detour)
    graph = build_graph(head, config)
    edges = len(graph.vertex_edges(SPACE))
    return scenes.show_graph(
        head,
        graph,
        region,
        radius=radius,
        title=f"{nearest} nearest, cosine >= {min_cosine:g}, detour <= {max_detour:g}",
        caption=f"{edges} edges through space pass the gates on the whole head",
    )


def knn_slider(head: Head, region: str | None = None) -> SliderLab:
    """The hybrid graph's gates: how many neighbours, and which are refused.

    Behind a Run button above 2,500 vertices, where building the graph takes a while.
    """
    return slider_lab(
        functools.partial(knn_picture, head, region=region),
        run_button=len(head.vertices) > 2500,
        start={"nearest": 8, "min_cosine": 0.5, "max_detour": 1.6},
        nearest=(1, 16),
        min_cosine=(-1.0, 1.0, 0.1),
        max_detour=(1.0, 6.0, 0.1),
    )


# ---- cross-attention on a toy


def attention_weights(
    scores: ArrayLike,
    distances: ArrayLike,
    temperature: float = 1.0,
    bias: float = 0.0,
) -> np.ndarray:
    """(V, J) w_vj = softmax_j(s_vj / temperature - bias d_vj), the toy of notebook 05.

    >>> attention_weights([[0.0, 0.0]], [[0.0, np.log(3)]], bias=1.0).round(2).tolist()
    [[0.75, 0.25]]
    """
    logits = np.asarray(scores, np.float64) / temperature
    logits = logits - bias * np.asarray(distances, np.float64)
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True)


def attention_sliders(
    scores: ArrayLike,
    distances: ArrayLike,
    vertices: Sequence[str],
    bones: Sequence[str],
) -> SliderLab:
    """What temperature and a bias by distance do to a softmax over bones.

    Args:
        scores: (V, J) query times key. distances: (V, J) vertex to bone.
        vertices, bones: V and J names.
    """

    def draw(temperature: float, distance_bias: float) -> Picture:
        weights = attention_weights(scores, distances, temperature, distance_bias)
        return plots.small_matrix(
            weights,
            vertices,
            bones,
            title=f"temperature {temperature:g}, distance bias {distance_bias:g}",
        )

    return slider_lab(
        draw,
        start={"temperature": 1.0},
        temperature=(0.1, 5.0, 0.1),
        distance_bias=(0.0, 5.0, 0.1),
    )
