"""Pictures of heads in three dimensions.

Two painters draw the same scene: VTK through pyvista, off-screen, and matplotlib where
VTK cannot run. `SKINLIB_3D` chooses: `static` (pyvista), `matplotlib`, or `trame`
(pyvista, and every picture is also shown as a view to turn with the mouse).
Without it pyvista is tried, in a child process: on a machine without OpenGL libraries
VTK does not raise, it kills the process.
"""

import dataclasses
import functools
import importlib.util
import logging
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection, TriMesh
from matplotlib.tri import Triangulation
from numpy.typing import ArrayLike
from PIL import Image
from scipy.optimize import isotonic_regression
from scipy.spatial.transform import Rotation

from skinlib.geometry import Frame, canonical_frame, vertex_normals
from skinlib.graph import MESH, SPACE, HybridGraph, seam_nodes
from skinlib.head import Head, Skeleton
from skinlib.skinning import forward_kinematics, linear_blend_skinning, preset_pose
from skinlib.views.picture import (
    FAINT,
    INK,
    WEIGHT_MAP,
    ColourBar,
    Picture,
    picture_grid,
    pixel_figure,
    rasterise,
)

logger = logging.getLogger(__name__)

CLAY = (0.86, 0.82, 0.77)
BACKENDS = ("static", "matplotlib", "trame")
SIZE = (400, 480)
SUPERSAMPLING = 2
AMBIENT = 0.4
# Direction towards each light in view coordinates, and its strength: a key light from
# the upper left, and a weak one from the right for the far cheek.
LIGHTS = (((-0.45, 0.45, 0.77), 0.62), ((0.85, 0.1, 0.5), 0.2))

_PROBE = """
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkRenderingCore import vtkRenderWindow, vtkRenderer
window = vtkRenderWindow()
window.SetOffScreenRendering(1)
window.SetSize(16, 16)
window.AddRenderer(vtkRenderer())
window.Render()
"""


@functools.cache
def backend() -> str:
    """Which painter draws: `"static"`, `"trame"` or `"matplotlib"`; decided once.

    Raises:
        ValueError: `SKINLIB_3D` is set to something else.
    """
    wanted = os.environ.get("SKINLIB_3D", "")
    if wanted and wanted not in BACKENDS:
        raise ValueError(f"SKINLIB_3D={wanted!r}; use one of {', '.join(BACKENDS)}")
    if wanted == "matplotlib":
        return wanted
    if _find_opengl():
        return wanted or "static"
    logger.warning(
        "3-D pictures are drawn by matplotlib, because pyvista cannot open an "
        "off-screen window here. For smoother ones: pip install pyvista, and on "
        "Debian or Ubuntu apt install libosmesa6."
    )
    return "matplotlib"


def _find_opengl() -> bool:
    """Whether VTK can render; leaves the environment set to the way that works."""
    if importlib.util.find_spec("pyvista") is None:
        return False
    variable = "VTK_DEFAULT_OPENGL_WINDOW"
    candidates = [os.environ.get(variable)]
    if candidates == [None] and sys.platform == "linux":
        # OSMesa first: it needs no X server, prints nothing and draws the same
        # pixels on every machine.
        candidates.insert(0, "vtkOSOpenGLRenderWindow")
    for candidate in candidates:
        setting = {variable: candidate} if candidate else {}
        try:
            child = subprocess.run(
                [sys.executable, "-c", _PROBE],
                env=os.environ | setting,
                capture_output=True,
                timeout=60,
            )
        except subprocess.TimeoutExpired:
            continue
        if child.returncode == 0:
            os.environ.update(setting)
            return True
    return False


# ---- where the camera stands


@dataclass(frozen=True)
class View:
    """Where the camera stands, in the head's own frame; (0, 0) looks at the face.

    Attributes:
        azimuth: degrees to the subject's left (the right of the picture).
        elevation: degrees upwards.
        zoom: 1 shows the whole head.
        centre: (3,) file coordinates in the middle of the picture; the middle of
            the head's bounding box without it.
        upright: trust the file, Z up and the face towards -Y, as for a body; without
            it the head's frame is found from its shape.
    """

    azimuth: float = 22.0
    elevation: float = 6.0
    zoom: float = 1.0
    centre: tuple[float, float, float] | None = None
    upright: bool = False


FRONT = View(azimuth=0.0, elevation=0.0)
THREE_QUARTER = View()


@dataclass(frozen=True)
class _Camera:
    """Orthographic: view coordinates x right, y up, z towards the camera.

    y is -1 at the bottom of the picture and 1 at its top.
    """

    rotation: np.ndarray
    centre: np.ndarray
    scale: float
    size: tuple[int, int]

    def place(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) file coordinates to view coordinates."""
        points = np.asarray(points, np.float64)
        return (points - self.centre) @ self.rotation.T / self.scale

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """(N, 2) pixel positions, from the top left corner."""
        placed = self.place(points)[:, :2] * [1, -1]
        width, height = self.size
        return placed * height / 2 + np.array([width, height]) / 2


def _camera(head: Head, view: View, size: tuple[int, int]) -> _Camera:
    up, forward = np.eye(3)[2], -np.eye(3)[1]
    if not view.upright:
        up, forward = head_frame(head).rotation[1:]
    right = np.cross(up, forward)
    azimuth, elevation = np.radians([view.azimuth, view.elevation])
    towards = np.cos(azimuth) * forward + np.sin(azimuth) * right
    side = np.cos(azimuth) * right - np.sin(azimuth) * forward
    towards, up = (
        np.cos(elevation) * towards + np.sin(elevation) * up,
        np.cos(elevation) * up - np.sin(elevation) * towards,
    )
    rotation = np.stack([side, up, towards])
    turned = head.vertices @ rotation.T.astype(np.float64)
    low, high = turned.min(axis=0), turned.max(axis=0)
    centre = (low + high) / 2 @ rotation if view.centre is None else view.centre
    extent = max(high[1] - low[1], (high[0] - low[0]) * size[1] / size[0])
    margin = 0.54  # half the extent and a little air
    scale = (extent or 1.0) * margin / view.zoom
    return _Camera(rotation, np.asarray(centre, np.float64), scale, size)


@functools.lru_cache(maxsize=16)
def head_frame(head: Head) -> Frame:
    """`canonical_frame` of a head, remembered: every slider move asks for it."""
    skeleton = head.skeleton
    return canonical_frame(head.vertices, head.faces, skeleton.joints, skeleton.parents)


@functools.lru_cache(maxsize=16)
def _seam_nodes(head: Head) -> np.ndarray:
    return seam_nodes(head)


def _normals(head: Head, vertices: np.ndarray | None) -> np.ndarray:
    """(V, 3) normals of the rest or a posed surface, smooth across texture seams."""
    nodes = _seam_nodes(head)
    vertex_of_node = np.zeros(nodes.max() + 1, np.int64)
    vertex_of_node[nodes] = np.arange(len(nodes))
    positions = np.asarray(head.vertices if vertices is None else vertices)
    return vertex_normals(positions[vertex_of_node], nodes[head.faces])[nodes]


# ---- the two painters


def render(
    head: Head,
    colours: ArrayLike | Sequence[float] | None = None,
    *,
    vertices: np.ndarray | None = None,
    view: View = THREE_QUARTER,
    size: tuple[int, int] = SIZE,
) -> np.ndarray:
    """Draw a head on white.

    Args:
        colours: (V, 3) or (3,) red, green, blue in 0 .. 1; clay without it.
        vertices: (V, 3) posed positions; the camera stays where the rest pose put it.
        view: where the camera stands.
        size: width and height in pixels.

    Returns:
        (H, W, 3) uint8.
    """
    camera = _camera(head, view, size)
    placed = camera.place(head.vertices if vertices is None else vertices)
    normals = _normals(head, vertices) @ camera.rotation.T
    colours = np.broadcast_to(CLAY if colours is None else colours, placed.shape)
    return _paint(placed, head.faces, colours, normals, size)


def _paint(points, faces, colours, normals, size) -> np.ndarray:
    """Draw triangles in view coordinates; flat colours when `normals` is None."""
    width, height = (side * SUPERSAMPLING for side in size)
    if len(faces) == 0:
        return np.full((size[1], size[0], 3), 255, np.uint8)
    painter = _paint_matplotlib if backend() == "matplotlib" else _paint_vtk
    large = painter(points, faces, np.clip(colours, 0, 1), normals, (width, height))
    return np.asarray(Image.fromarray(large).reduce(SUPERSAMPLING))


def _paint_matplotlib(points, faces, colours, normals, size) -> np.ndarray:
    """Painter's algorithm: far triangles first, colours interpolated in each."""
    corners = points[faces]  # (F, 3, 3)
    order = np.argsort(corners[:, :, 2].mean(axis=1), kind="stable")
    faces, corners = faces[order], corners[order].reshape(-1, 3)
    shaded = colours[faces].reshape(-1, 3)
    if normals is not None:
        a, b, c = corners.reshape(-1, 3, 3)[:, :, :2].transpose(1, 0, 2)
        winding = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        facing = np.where(winding < 0, -1.0, 1.0)  # light both sides of a sheet
        facing = normals[faces] * facing[:, None, None]
        shaded = shaded * _lambert(facing.reshape(-1, 3))[:, None]
    with pixel_figure(*size) as figure:
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.set_xlim(-size[0] / size[1], size[0] / size[1])
        axes.set_ylim(-1, 1)
        triangles = np.arange(len(corners)).reshape(-1, 3)
        mesh = TriMesh(Triangulation(corners[:, 0], corners[:, 1], triangles))
        mesh.set_facecolor(np.column_stack([shaded, np.ones(len(shaded))]))
        axes.add_collection(mesh, autolim=False)
        return rasterise(figure).image


def _lambert(normals: np.ndarray) -> np.ndarray:
    """Brightness in 0 .. 1 of (N, 3) normals under the lights and some sky."""
    brightness = np.full(len(normals), AMBIENT)
    for direction, strength in LIGHTS:
        towards = np.array(direction) / np.linalg.norm(direction)
        brightness += strength * np.clip(normals @ towards, 0, None)
    return np.clip(brightness, 0, 1)


def _paint_vtk(points, faces, colours, normals, size) -> np.ndarray:
    plotter = _plotter()
    plotter.suppress_rendering = True  # else each line here draws the scene again
    plotter.window_size = size
    plotter.clear_actors()
    lit = normals is not None
    actor = plotter.add_mesh(
        _polydata(points, faces, colours, normals),
        scalars="colours",
        rgb=True,
        ambient=AMBIENT if lit else 1.0,
        diffuse=1.0 if lit else 0.0,
    )
    actor.prop.interpolation = "Phong"
    camera = plotter.camera
    near = float(points[:, 2].max()) + 1
    camera.position, camera.up = (0, 0, near), (0, 1, 0)
    camera.focal_point = (0, 0, near - 1)
    camera.parallel_projection, camera.parallel_scale = True, 1.0
    # As tight as the head is deep: closed lips are told apart by the depth buffer.
    camera.clipping_range = (0.5, near - float(points[:, 2].min()) + 0.5)
    plotter.suppress_rendering = False
    plotter.render()
    return plotter.screenshot(return_img=True)[..., :3]


def _polydata(points, faces, colours, normals):
    import pyvista

    mesh = pyvista.PolyData.from_regular_faces(points.astype(np.float32), faces)
    mesh.point_data["colours"] = np.round(colours * 255).astype(np.uint8)
    if normals is not None:
        mesh.point_data["Normals"] = normals.astype(np.float32)
        mesh.point_data.active_normals_name = "Normals"
    return mesh


@functools.cache
def _plotter():
    """One window for the whole process: opening one costs more than ten pictures."""
    import pyvista

    plotter = pyvista.Plotter(off_screen=True, lighting="none")
    plotter.set_background("white")
    plotter.disable_anti_aliasing()  # the picture is supersampled
    for direction, strength in LIGHTS:
        light = pyvista.Light(
            position=direction, intensity=strength, light_type="scene light"
        )
        light.positional = False
        plotter.add_light(light)
    return plotter


def _show_interactive(
    head: Head, colours, vertices=None, view: View = THREE_QUARTER
) -> None:
    """Under `SKINLIB_3D=trame`, also show a view that turns with the mouse."""
    if backend() != "trame":
        return
    missing = [m for m in ("trame", "trame_vtk") if not importlib.util.find_spec(m)]
    if missing:
        raise ModuleNotFoundError(
            f"SKINLIB_3D=trame needs {', '.join(missing)}: pip install "
            "'pyvista[jupyter]', or set SKINLIB_3D=static"
        )
    import pyvista
    from IPython.display import display

    # Its WebAssembly client is fetched from the network; offline that prints a trace.
    sys.modules.setdefault("trame.widgets.vtklocal", None)
    camera = _camera(head, view, SIZE)
    placed = camera.place(head.vertices if vertices is None else vertices)
    colours = np.broadcast_to(CLAY if colours is None else colours, placed.shape)
    normals = _normals(head, vertices) @ camera.rotation.T
    plotter = pyvista.Plotter(window_size=SIZE)
    mesh = _polydata(placed, head.faces, np.clip(colours, 0, 1), normals)
    actor = plotter.add_mesh(mesh, scalars="colours", rgb=True)
    actor.prop.interpolation = "Phong"
    plotter.view_xy()
    display(plotter.show(jupyter_backend="trame", return_viewer=True))


# ---- colours


@functools.lru_cache(maxsize=16)
def bone_palette(skeleton: Skeleton) -> np.ndarray:
    """(J, 3) red, green, blue in 0 .. 1: one colour a bone, made to be told apart.

    The bone with most children, which carries the skull, is the colour of clay. The
    others get colours that lie far apart in Oklab (Ottosson 2020, a space in which
    distance is how different two colours look); of those left, each bone takes the
    one least like the colours of its parent and of the bones near it. The order of
    the bones does not matter.
    """
    count, children, depths = len(skeleton), skeleton.children(), skeleton.depths
    order = sorted(range(count), key=lambda b: (depths[b], skeleton.names[b]))
    middle = max(order, key=lambda b: len(children[b]))
    colours = _distinct_colours(count)
    lab = _oklab(colours)

    tips = (skeleton.joints + skeleton.tails) / 2
    apart = np.linalg.norm(tips[:, None] - tips[None], axis=2)
    near = np.exp(-apart / (0.1 * np.ptp(tips, axis=0).max() or 1.0))
    related = skeleton.parents[:, None] == np.arange(count)
    near += related | related.T

    given = np.full(count, -1)
    given[middle] = 0
    left = list(range(1, count))
    for bone in order:
        if given[bone] >= 0:
            continue
        done = given >= 0
        # (colours left, bones done): how alike, where the bones are near
        squared = ((lab[left][:, None] - lab[given[done]][None]) ** 2).sum(axis=2)
        clash = (near[bone, done] / (squared + 1e-4)).sum(axis=1)
        given[bone] = left.pop(int(np.argmin(clash)))
    return colours[given]


def _distinct_colours(count: int) -> np.ndarray:
    """(count, 3) colours, clay first, each as far as can be from those before it."""
    level = np.linspace(0, 1, 17)
    grid = np.stack(np.meshgrid(level, level, level, indexing="ij"), -1).reshape(-1, 3)
    lab = _oklab(grid)
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    # Too dark hides the shape of the face, too light the colour, too grey is clay.
    usable = (lab[:, 0] > 0.5) & (lab[:, 0] < 0.88) & (chroma > 0.07) & (chroma < 0.2)
    colours = np.concatenate([[CLAY], grid[usable]])
    lab = _oklab(colours)
    chosen, distance = [0], np.linalg.norm(lab - lab[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(lab - lab[chosen[-1]], axis=1))
    return colours[chosen]


def _oklab(colours: ArrayLike) -> np.ndarray:
    """(N, 3) sRGB in 0 .. 1 to Oklab: lightness, green-red, blue-yellow."""
    colours = np.asarray(colours, np.float64)
    linear = np.where(
        colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4
    )
    to_cones = [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
    to_lab = [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
    return np.cbrt(linear @ np.transpose(to_cones)) @ np.transpose(to_lab)


def colour_by_bone(weights: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """(V, 3) colours: the bones' palette, blended by each vertex's (V, J) weights."""
    return np.asarray(weights, np.float64) @ bone_palette(skeleton)


def colour_by_value(
    values: ArrayLike, low: float = 0.0, high: float = 1.0, colours=WEIGHT_MAP
) -> np.ndarray:
    """(V, 3) colours of (V,) values; what lies outside low .. high is clipped."""
    return colours(np.clip((np.asarray(values) - low) / ((high - low) or 1), 0, 1))[
        :, :3
    ]


def bone_legend(
    skeleton: Skeleton, weights: np.ndarray | None = None, count: int = 40
) -> dict[str, tuple[float, ...]]:
    """Colour by bone name, for `picture_grid`; bones that carry most weight first."""
    carried = np.ones(len(skeleton)) if weights is None else weights.sum(axis=0)
    order = np.argsort(-carried, kind="stable")[:count]
    palette = bone_palette(skeleton)
    return {
        skeleton.names[b]: tuple(palette[b].tolist()) for b in order if carried[b] > 0
    }


# ---- pictures


def show_head(
    head: Head,
    colours: ArrayLike | Sequence[float] | None = None,
    *,
    vertices: np.ndarray | None = None,
    view: View = THREE_QUARTER,
    size: tuple[int, int] = SIZE,
    title: str | None = None,
    caption: str | None = None,
) -> Picture:
    """A head in clay, or in `colours`; arguments as in `render`."""
    _show_interactive(head, colours, vertices, view)
    image = render(head, colours, vertices=vertices, view=view, size=size)
    return picture_grid([image], title=title or head.name or "head", caption=caption)


def show_bones(
    head: Head,
    weights: np.ndarray | None = None,
    *,
    view: View = THREE_QUARTER,
    size: tuple[int, int] = SIZE,
    title: str | None = None,
) -> Picture:
    """Each vertex in the colours of the bones that move it; the head's own weights
    when there are none given."""
    weights = checked_weights(head, weights)
    colours = colour_by_bone(weights, head.skeleton)
    _show_interactive(head, colours, view=view)
    images = [
        render(
            head, colours, view=dataclasses.replace(view, azimuth=azimuth), size=size
        )
        for azimuth in (view.azimuth, view.azimuth + 65)
    ]
    return picture_grid(
        images,
        title=title or f"{head.name or 'head'}: skin weights, coloured by bone",
        legend=bone_legend(head.skeleton, weights),
    )


def show_values(
    head: Head,
    values: ArrayLike,
    label: str,
    *,
    low: float = 0.0,
    high: float | None = None,
    vertices: np.ndarray | None = None,
    view: View = THREE_QUARTER,
    size: tuple[int, int] = SIZE,
    title: str | None = None,
    caption: str | None = None,
) -> Picture:
    """One number a vertex on the surface, with its colour bar.

    Args:
        values: (V,). label: the quantity and its unit, beside the colour bar.
        low, high: the ends of the colour bar; `high` is the largest value without it.
    """
    high = float(np.max(values)) if high is None else high
    colours = colour_by_value(values, low, high)
    _show_interactive(head, colours, vertices, view)
    image = render(head, colours, vertices=vertices, view=view, size=size)
    return picture_grid(
        [image],
        title=title or head.name or "head",
        caption=caption,
        colour_bar=ColourBar(label, low, high),
    )


def show_weights(
    head: Head,
    bone: str | int | Sequence[str],
    weights: np.ndarray | None = None,
    *,
    view: View = THREE_QUARTER,
    size: tuple[int, int] = SIZE,
    title: str | None = None,
    columns: int | None = None,
) -> Picture:
    """One bone's column of the weights on the surface; or several bones', side by side.

    Raises:
        ValueError: no such bone, or no weights.
    """
    weights = checked_weights(head, weights)
    bones = [bone] if isinstance(bone, str | int | np.integer) else list(bone)
    ids = [_bone_id(head.skeleton, b) for b in bones]
    names = [head.skeleton.names[b] for b in ids]
    all_colours = [colour_by_value(weights[:, b]) for b in ids]
    _show_interactive(head, all_colours[0], view=view)
    images = [render(head, colours, view=view, size=size) for colours in all_colours]
    return picture_grid(
        images,
        names if len(names) > 1 else None,
        columns=columns,
        title=title or f"Skin weights of {', '.join(names[:4])}",
        colour_bar=ColourBar("skin weight, 0 to 1"),
        caption="0: the vertex ignores the bone; 1: it follows that bone alone",
    )


def compare_heads(
    heads: Sequence[Head],
    titles: Sequence[str] | None = None,
    weights: Sequence[np.ndarray | None] | None = None,
    *,
    view: View = THREE_QUARTER,
    size: tuple[int, int] = (300, 360),
    columns: int | None = None,
    title: str | None = None,
    caption: str | None = None,
) -> Picture:
    """Heads side by side, coloured by bone where there are weights, else in clay.

    Args:
        weights: (V, J) for each head; the heads' own without it.
    """
    weights = [head.weights for head in heads] if weights is None else weights
    images = [
        render(
            head,
            None if skin is None else colour_by_bone(skin, head.skeleton),
            view=view,
            size=size,
        )
        for head, skin in zip(heads, weights, strict=True)
    ]
    titles = [head.name for head in heads] if titles is None else titles
    return picture_grid(images, titles, columns=columns, title=title, caption=caption)


def show_skeleton(
    head: Head,
    *,
    labels: bool = True,
    view: View = THREE_QUARTER,
    size: tuple[int, int] = (440, 520),
    title: str | None = None,
) -> Picture:
    """The bones drawn over a pale head, each with its name beside it."""
    skeleton = head.skeleton
    camera = _camera(head, view, size)
    _show_interactive(head, None, view=view)
    image = render(head, view=view, size=size).astype(np.float64)
    image = np.uint8(255 - (255 - image) * 0.45)
    joints, tails = camera.pixels(skeleton.joints), camera.pixels(skeleton.tails)
    palette = bone_palette(skeleton)
    side = 150 if labels else 0
    width, height = size[0] + 2 * side, size[1] + 34

    with pixel_figure(width, height) as figure:
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.set_xlim(-side, size[0] + side)
        axes.set_ylim(size[1], -34)
        axes.imshow(image, extent=(0, size[0], size[1], 0), zorder=0)
        children = np.flatnonzero(skeleton.parents >= 0)
        links = np.stack([joints[skeleton.parents[children]], joints[children]], axis=1)
        axes.add_collection(
            LineCollection(links, colors=FAINT, linewidths=0.7, linestyles=":")
        )
        bones = np.stack([joints, tails], axis=1)
        axes.add_collection(LineCollection(bones, colors=INK, linewidths=4.2))
        axes.add_collection(LineCollection(bones, colors=palette, linewidths=2.6))
        axes.scatter(
            *joints.T, s=26, c=palette, edgecolors=INK, linewidths=0.8, zorder=4
        )
        if labels:
            tips = np.clip((joints + tails) / 2, 0, size)
            _label(axes, tips, skeleton.names, palette, size)
        heading = title or f"{head.name or 'head'}: {len(skeleton)} bones"
        axes.text(size[0] / 2, -17, heading, size=12, weight="bold", ha="center",
                  va="center")  # fmt: skip
        return rasterise(figure, heading)


def _label(axes, points, names, palette, size) -> None:
    """Names in two columns beside the picture, in the order of the points' heights."""
    width, height = size
    by_x = np.argsort(points[:, 0], kind="stable")
    for right, ids in ((False, by_x[: len(by_x) // 2]), (True, by_x[len(by_x) // 2 :])):
        ids = ids[np.argsort(points[ids, 1], kind="stable")]
        step = min(20.0, (height - 16) / max(len(ids), 1))
        slots = step * np.arange(len(ids))
        # The heights nearest to the points' own that keep one step between names.
        heights = isotonic_regression(points[ids, 1] - slots).x
        heights = np.clip(heights, 8, height - 8 - slots[-1:]) + slots
        x = width + 6 if right else -6
        for bone, y in zip(ids, heights, strict=True):
            axes.plot([points[bone, 0], x], [points[bone, 1], y], color=FAINT,
                      linewidth=0.5, zorder=3)  # fmt: skip
            axes.text(x + (12 if right else -12), y, names[bone],
                      ha="left" if right else "right", va="center",
                      size=min(8.0, step * 0.6 + 0.5))  # fmt: skip
            axes.scatter([x + (4 if right else -4)], [y], s=16, color=[palette[bone]],
                         marker="s", zorder=4)  # fmt: skip


EDGE_COLOURS = {"mesh edge": "#4b5563", "neighbour in space": "#d9480f"}


def show_graph(
    head: Head,
    graph: HybridGraph,
    region: str | ArrayLike | Sequence[float] | None = None,
    *,
    radius: float = 0.3,
    view: View | None = None,
    size: tuple[int, int] = (560, 460),
    title: str | None = None,
    caption: str | None = None,
) -> Picture:
    """The hybrid graph on the surface: mesh edges grey, gated neighbours orange.

    Only edges whose two ends can be seen are drawn.

    Args:
        graph: from `skinlib.graph.build_graph`.
        region: what to look at: a bone's name, or (3,) file coordinates; the whole
            head without it.
        radius: how much around the region is shown, in head units (`Frame.scale`).
        view: where the camera stands; its zoom and centre come from the region.
    """
    view = view or FRONT
    if region is not None:
        if isinstance(region, str):
            bone = _bone_id(head.skeleton, region)
            region = (head.skeleton.joints[bone] + head.skeleton.tails[bone]) / 2
        centre = tuple(np.asarray(region, float).tolist())
        view = dataclasses.replace(view, zoom=1.0, centre=centre)
        shown = radius * head_frame(head).scale
        zoom = float(_camera(head, view, size).scale / shown)
        view = dataclasses.replace(view, zoom=zoom)
    camera = _camera(head, view, size)
    image = render(head, view=view, size=size)
    seen = visible_vertices(head, view=view, size=size)
    pixels = camera.pixels(head.vertices)

    heading = title or f"{head.name or 'head'}: hybrid graph"
    legend = {}
    with pixel_figure(*size) as figure:
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.set_xlim(0, size[0])
        axes.set_ylim(size[1], 0)
        axes.imshow(image, extent=(0, size[0], size[1], 0), zorder=0)
        closeness = np.clip(view.zoom / 4, 0.35, 1.0)
        for kind, (name, colour) in zip(
            (MESH, SPACE), EDGE_COLOURS.items(), strict=True
        ):
            edges = graph.vertex_edges(kind)
            edges = edges[seen[edges].all(axis=1)]
            legend[f"{name} ({len(edges)} in sight)"] = colour
            axes.add_collection(
                LineCollection(
                    pixels[edges],
                    colors=colour,
                    linewidths=closeness * (0.9 if kind == MESH else 1.1),
                )
            )
        axes.scatter(*pixels[seen].T, s=7 * closeness, color=INK, zorder=3)
        drawn = rasterise(figure)
    return picture_grid([drawn], title=heading, caption=caption, legend=legend)


def visible_vertices(
    head: Head,
    *,
    view: View = THREE_QUARTER,
    size: tuple[int, int] = SIZE,
    tolerance: float = 0.03,
) -> np.ndarray:
    """(V,) bool: which vertices the surface does not hide.

    The head is painted once more with its depth as its colour, and each vertex
    compared with what the picture holds at its place.

    Args:
        tolerance: how far below the surface still counts, in half picture heights.
    """
    camera = _camera(head, view, size)
    placed = camera.place(head.vertices)
    width, height = size
    inside = (np.abs(placed[:, 0]) <= width / height) & (np.abs(placed[:, 1]) <= 1)
    if not inside.any() or len(head.faces) == 0:
        return inside
    near = placed[inside, 2].max()
    depth_range = min(np.ptp(placed[inside, 2]), 2.0) or 1.0
    depth = 1 - (near - placed[:, 2]) / depth_range  # 1 nearest, 0 and less: far
    grey = np.repeat(np.clip(depth, 0, 1)[:, None], 3, axis=1)
    image = _paint(placed, head.faces, grey, None, size)[..., 0] / 255
    x, y = camera.pixels(head.vertices).astype(int).T
    # The least hidden of the pixels around: at a silhouette one pixel is a cliff.
    around = [
        image[np.clip(y + dy, 0, height - 1), np.clip(x + dx, 0, width - 1)]
        for dy in (-1, 0, 1)
        for dx in (-1, 0, 1)
    ]
    return inside & (
        depth >= np.min(around, axis=0) - tolerance / depth_range - 1 / 255
    )


# ---- poses and the demo's picture


def pose_vertices(
    head: Head,
    weights: np.ndarray,
    poses: Mapping[str, float],
    turns: Mapping[str, float] | None = None,
) -> np.ndarray:
    """(V, 3) float64 positions under named poses, each with its amount in 0 .. 1.

    Args:
        weights: (V, J). poses: names of `skinlib.skinning.PRESET_POSES`.
        turns: degrees by bone name, about the ear-to-ear axis through the joint;
            positive nods.
    """
    motions = np.tile(np.eye(4), (len(head.skeleton), 1, 1))
    for name, amount in poses.items():
        if amount:
            motions = motions @ preset_pose(head, name, float(amount))
    for bone, degrees in (turns or {}).items():
        turn = np.eye(4)
        axis = np.radians(degrees) * head_frame(head).rotation[0]
        turn[:3, :3] = Rotation.from_rotvec(axis).as_matrix()
        motions[_bone_id(head.skeleton, bone)] @= turn
    transforms = forward_kinematics(head.skeleton, motions)
    return linear_blend_skinning(
        head.vertices.astype(np.float64), np.asarray(weights, np.float64), transforms
    )


DEMO_POSES = {
    "rest pose, coloured by bone": {},
    "jaw open": {"jaw_open": 1.0},
    "blink": {"blink": 1.0},
    "head turned": {"head_turn": 1.0},
}


def demo_picture(
    head: Head,
    ours: np.ndarray,
    artist: np.ndarray,
    path: str | Path | None = None,
    *,
    title: str = "Skin weights: predicted by skinlib, and painted by an artist",
    row_titles: Sequence[str] = ("skinlib", "artist"),
    caption: str | None = None,
    width: int = 1600,
) -> Picture:
    """The front page: two rows of weights, four columns of poses.

    Args:
        ours, artist: (V, J) weights. path: also saved there, as .png or .jpg.
    """
    images = []
    for weights in (ours, artist):
        colours = colour_by_bone(weights, head.skeleton)
        for poses in DEMO_POSES.values():
            vertices = pose_vertices(head, weights, poses)
            view = View(azimuth=22.0 if "head_turn" not in poses else 0.0)
            images.append(
                render(head, colours, vertices=vertices, view=view, size=(384, 440))
            )
    return picture_grid(
        images,
        list(DEMO_POSES),
        path,
        columns=4,
        row_titles=row_titles,
        title=title,
        caption=caption,
        legend=bone_legend(head.skeleton, artist),
        width=width,
    )


def _bone_id(skeleton: Skeleton, bone) -> int:
    if isinstance(bone, str):
        if bone not in skeleton.names:
            raise ValueError(
                f"no bone {bone!r}; there are {', '.join(skeleton.names[:8])} ..."
            )
        return skeleton.names.index(bone)
    return int(bone)


def checked_weights(head: Head, weights: np.ndarray | None) -> np.ndarray:
    weights = head.weights if weights is None else weights
    if weights is None:
        raise ValueError(f"{head.name or 'this head'} has no weights; pass some")
    if np.shape(weights) != (len(head.vertices), len(head.skeleton)):
        raise ValueError(
            f"weights of shape {np.shape(weights)} for {len(head.vertices)} vertices "
            f"and {len(head.skeleton)} bones"
        )
    return np.asarray(weights)
