"""`Picture`, an image a notebook shows and a script saves, and grids of pictures.

Figures are made without pyplot: nothing is left open and no global state is touched.
"""

import io
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image

INK = "#1f2328"
FAINT = "#6b7280"
PAPER = "#ffffff"
DPI = 110
STYLE = {
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "axes.grid": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "image.cmap": "viridis",
}

# Light to dark without a turn, so that it reads in grey; no weight is the colour of
# plaster, so that the shape of the face stays visible where the bone does nothing.
WEIGHT_MAP = LinearSegmentedColormap.from_list(
    "weight", ["#d8d6d1", "#fbd98a", "#f79a4b", "#d9443f", "#93145a", "#3d0a45"]
)


@dataclass(frozen=True, eq=False)
class Picture:
    """An image with a caption; a notebook shows it when a cell ends with it.

    Attributes:
        image: (H, W, 3) uint8.
        caption: what is to be seen; also the text where no image can be shown.
        max_bytes: what it may cost in a notebook. Lossless where that is small
            enough, JPEG of falling quality otherwise.

    >>> Picture(np.zeros((2, 3, 3), np.uint8), "black")
    <Picture 3 x 2: black>
    """

    image: np.ndarray
    caption: str = ""
    max_bytes: int = 90_000

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.array(self.image, dtype=dtype)

    def __repr__(self) -> str:
        height, width = self.image.shape[:2]
        return f"<Picture {width} x {height}: {self.caption}>"

    def encode(self) -> tuple[str, bytes]:
        """The image as `("image/png" or "image/jpeg", bytes)`, within `max_bytes`."""
        data = _compress(self.image, format="png")
        if len(data) <= self.max_bytes:
            return "image/png", data
        for quality in (92, 85, 75, 60):
            data = self.jpeg(quality)
            if len(data) <= self.max_bytes:
                break
        return "image/jpeg", data

    def jpeg(self, quality: int = 90) -> bytes:
        """The image as JPEG, ten times sooner than as PNG."""
        return _compress(self.image, format="jpeg", quality=quality, subsampling=0)

    def save(self, path: str | Path) -> Path:
        """Write a .png or .jpg, whichever the path's ending says."""
        path = Path(path)
        Image.fromarray(self.image).save(path, quality=92, optimize=True)
        return path

    def _repr_mimebundle_(self, include=None, exclude=None) -> dict:
        kind, data = self.encode()
        return {kind: data, "text/plain": repr(self)}


def _compress(image: np.ndarray, **options) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, **options)
    return stream.getvalue()


@contextmanager
def new_figure(width: float, height: float, layout: str | None = "constrained"):
    """A `Figure` of so many inches in this project's style; it belongs to no window."""
    with rc_context(STYLE):
        figure = Figure(figsize=(width, height), dpi=DPI, layout=layout)
        FigureCanvasAgg(figure)
        if layout == "constrained":
            figure.get_layout_engine().set(w_pad=0.09, h_pad=0.09)
        yield figure


def pixel_figure(width: int, height: int):
    """A figure of exactly so many pixels, without a layout."""
    # matplotlib rounds down, and width / DPI * DPI may fall just short of width.
    return new_figure((width + 0.01) / DPI, (height + 0.01) / DPI, layout=None)


def rasterise(figure: Figure, caption: str = "", note: str | None = None) -> Picture:
    """The figure as a `Picture`; `note` is printed small below it."""
    if note:
        figure.supxlabel(note, fontsize=8, color=FAINT)
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    return Picture(np.ascontiguousarray(pixels), caption)


class ColourBar(NamedTuple):
    """What the colours of a picture mean: `label` names the quantity and its unit."""

    label: str
    low: float = 0.0
    high: float = 1.0
    colours: Colormap = WEIGHT_MAP


def picture_grid(
    images: Sequence,
    titles: Sequence[str] | None = None,
    path: str | Path | None = None,
    *,
    columns: int | None = None,
    row_titles: Sequence[str] | None = None,
    title: str | None = None,
    caption: str | None = None,
    legend: Mapping[str, Sequence[float] | str] | None = None,
    colour_bar: ColourBar | None = None,
    width: int | None = None,
) -> Picture:
    """Put images side by side, in rows of `columns`, and name them.

    Args:
        images: (H, W, 3) uint8 arrays or `Picture`s; cells are as large as the first.
        titles: a title above each image, or above each column when there are no
            more titles than columns.
        path: also save the result there, as .png or .jpg.
        row_titles: text to the left of each row.
        legend: colour by name, written below.
        colour_bar: drawn at the right.
        width: of the result, in pixels; the images' own size without it.

    Raises:
        ValueError: no images, or more titles than images.

    >>> tile = np.full((60, 80, 3), 200, np.uint8)
    >>> picture_grid([tile, tile], ["a", "b"], title="two tiles")
    <Picture 184 x 128: two tiles>
    """
    images = [np.asarray(image) for image in images]
    if not images:
        raise ValueError("picture_grid needs at least one image")
    titles = list(titles or [])
    if len(titles) > len(images):
        raise ValueError(f"{len(titles)} titles for {len(images)} images")
    columns = columns or min(len(images), 4)
    rows = -(-len(images) // columns)

    gap, side = 8, 30 if row_titles else 0
    bar = 88 if colour_bar else 0
    cell_h, cell_w = images[0].shape[:2]
    fixed = side + bar + gap * (columns + 1)
    if width is None:
        width = fixed + columns * cell_w
    else:
        cell_h = round(cell_h * (width - fixed) / columns / cell_w)
        cell_w = (width - fixed) / columns
    each_row = len(titles) > columns
    title_h = 22 * max((t.count("\n") + 1 for t in titles), default=0)
    top = gap + (30 * (title.count("\n") + 1) if title else 0)
    foot = 20 * (caption.count("\n") + 1) if caption else 0
    per_line = max(1, int((width - 2 * gap) // 150))
    legend_rows = -(-len(legend or ()) // per_line)
    legend_h = 17 * legend_rows + 10 if legend else 0
    row_h = cell_h + gap + (title_h if each_row else 0)
    head_h = 0 if each_row else title_h
    height = round(top + head_h + rows * row_h + legend_h + foot)

    with pixel_figure(width, height) as figure:

        def at(x, y):
            return x / width, 1 - y / height

        if title:
            figure.text(*at(width / 2, top / 2 + 2), title, size=12, ha="center",
                        va="center", weight="bold")  # fmt: skip
        for i, image in enumerate(images):
            row, column = divmod(i, columns)
            x = side + gap + column * (cell_w + gap)
            y = top + head_h + row * row_h + (title_h if each_row else 0)
            box = (*at(x, y + cell_h), cell_w / width, cell_h / height)
            axes = figure.add_axes(box)
            axes.set_axis_off()
            axes.imshow(image, interpolation="antialiased")
            if i < len(titles):
                figure.text(*at(x + cell_w / 2, y - title_h / 2), titles[i], size=10,
                            ha="center", va="center")  # fmt: skip
        for row, text in enumerate(row_titles or []):
            y = top + head_h + row * row_h + (title_h if each_row else 0) + cell_h / 2
            figure.text(*at(gap + side / 2, y), text, size=11, rotation=90, ha="center",
                        va="center", weight="bold")  # fmt: skip
        if colour_bar:
            tall = min(rows * row_h * 0.8, 260)
            middle = top + head_h + rows * row_h / 2
            box = (*at(width - bar + gap, middle + tall / 2), 14 / width, tall / height)
            _draw_colour_bar(figure, figure.add_axes(box), colour_bar)
        if legend:
            figure.legend(
                [Patch(color=colour) for colour in legend.values()], list(legend),
                ncols=-(-len(legend) // legend_rows), loc="lower center",
                bbox_to_anchor=at(width / 2, height - foot), borderpad=0.2,
                handlelength=1.0, handleheight=1.0, columnspacing=1.2,
                labelspacing=0.25,
            )  # fmt: skip
        if caption:
            figure.text(*at(width / 2, height - foot / 2 - 3), caption, size=8.5,
                        color=FAINT, ha="center", va="center")  # fmt: skip
        picture = rasterise(figure, title or caption or ", ".join(titles))
    if path is not None:
        picture.save(path)
    return picture


def _draw_colour_bar(figure: Figure, axes, bar: ColourBar) -> None:
    scale = ScalarMappable(Normalize(bar.low, bar.high), bar.colours)
    drawn = figure.colorbar(scale, cax=axes)
    drawn.outline.set_visible(False)
    drawn.set_label(bar.label, size=9)
    axes.tick_params(length=2, labelsize=8)
