"""What notebooks show: pictures of heads, charts, sliders."""

import ast
import functools
import logging
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

import skinlib
from skinlib import Head, Skeleton
from skinlib.graph import build_graph
from skinlib.views import Picture, picture_grid, plots, scenes, widgets

SMALL = (120, 144)
has_opengl = functools.cache(scenes._find_opengl)


@pytest.fixture(scope="module")
def head() -> Head:
    """An egg that faces +z, with a jaw, two lids and smooth weights."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices = ball.vertices * [0.8, 1.1, 0.9]
    nose = np.exp(-20 * ((vertices - [0, 0, 0.9]) ** 2).sum(axis=1))
    vertices = vertices + 0.3 * nose[:, None] * [0, 0, 1]
    skeleton = Skeleton.from_heads_and_tails(
        [[0, -1.3, 0], [0, -0.3, 0], [0, -0.3, 0.2], [0.3, 0.3, 0.6], [-0.3, 0.3, 0.6]],
        [[0, -0.3, 0], [0, 1, 0], [0, -0.8, 0.8], [0.3, 0.3, 0.9], [-0.3, 0.3, 0.9]],
        [-1, 0, 1, 1, 1],
        ["neck", "head", "jaw", "lid_upper.L", "lid_upper.R"],
    )
    distance = np.linalg.norm(vertices[:, None] - skeleton.tails, axis=2)
    weights = np.exp(-6 * distance)
    weights /= weights.sum(axis=1, keepdims=True)
    return Head.create(vertices, ball.faces, skeleton, weights, name="egg")


@pytest.fixture(params=["matplotlib", "static"])
def painter(request, monkeypatch) -> str:
    if request.param == "static" and not has_opengl():
        pytest.skip("no off-screen OpenGL on this machine")
    _choose(monkeypatch, request.param)
    yield request.param
    scenes.backend.cache_clear()


@pytest.fixture
def fallback(monkeypatch):
    """The painter that runs everywhere."""
    _choose(monkeypatch, "matplotlib")
    yield
    scenes.backend.cache_clear()


def _choose(monkeypatch, name: str) -> None:
    monkeypatch.setenv("SKINLIB_3D", name)
    scenes.backend.cache_clear()


def _is_drawn(picture) -> bool:
    image = np.asarray(picture)
    return image.dtype == np.uint8 and image.shape[2] == 3 and image.std() > 5


def _difference(a, b) -> float:
    return float(np.abs(np.asarray(a, float) - np.asarray(b, float)).mean())


# ---- rendering


def test_render_draws_a_shaded_head_on_white(head, painter):
    image = scenes.render(head, size=SMALL)
    assert image.shape == (144, 120, 3) and image.dtype == np.uint8
    assert (image[0, 0] == 255).all() and (image[-1, -1] == 255).all()
    assert (image[72, 60] < 250).any()
    assert len(np.unique(image[:, 60, 0])) > 20


def test_render_is_deterministic(head, painter):
    images = [scenes.render(head, size=SMALL) for _ in range(2)]
    assert np.array_equal(*images)


def test_render_follows_size_after_size(head, painter):
    first = scenes.render(head, size=SMALL)
    assert scenes.render(head, size=(200, 100)).shape == (100, 200, 3)
    assert np.array_equal(scenes.render(head, size=SMALL), first)


@pytest.mark.parametrize("side", [57, 58, 111, 143, 229])
def test_render_has_exactly_the_size_asked_for(head, fallback, side):
    assert scenes.render(head, size=(side, 2 * side)).shape == (2 * side, side, 3)
    tile = np.zeros((side, side, 3), np.uint8)
    assert picture_grid([tile], width=side + 16).image.shape[1] == side + 16


def test_render_shows_the_pose(head, painter):
    open_jaw = scenes.pose_vertices(head, head.weights, {"jaw_open": 1.0})
    rest = scenes.render(head, size=SMALL)
    assert _difference(rest, scenes.render(head, vertices=open_jaw, size=SMALL)) > 0.2


def test_rest_pose_moves_nothing(head):
    rest = scenes.pose_vertices(head, head.weights, {"jaw_open": 0.0}, {"jaw": 0.0})
    np.testing.assert_allclose(rest, head.vertices, atol=1e-6)


def test_a_turn_nods(head):
    nodded = scenes.pose_vertices(head, head.weights, {}, {"neck": 20.0})
    top, nose = head.vertices[:, 1].argmax(), head.vertices[:, 2].argmax()
    assert nodded[top, 2] > head.vertices[top, 2]
    assert nodded[nose, 1] < head.vertices[nose, 1]


def test_colours_reach_the_picture(head, painter):
    red = scenes.render(head, (1.0, 0.0, 0.0), size=SMALL)
    assert red[72, 60, 0] > 150 and (red[72, 60, 1:] < 10).all()


def test_both_painters_draw_the_same_scene(head, monkeypatch):
    if not has_opengl():
        pytest.skip("no off-screen OpenGL on this machine")
    images = []
    for name in ("static", "matplotlib"):
        _choose(monkeypatch, name)
        colours = scenes.colour_by_bone(head.weights, head.skeleton)
        images.append(scenes.render(head, colours, size=SMALL))
    scenes.backend.cache_clear()
    assert _difference(*images) < 4


@pytest.mark.parametrize(
    "turn", [("x", 90), ("x", -90), ("z", 90), ("y", 180)], ids=str
)
def test_the_camera_finds_the_face_for_any_up_axis(head, fallback, turn):
    rotation = Rotation.from_euler(*turn, degrees=True).as_matrix().round()
    bones = head.skeleton
    turned = Head.create(
        head.vertices @ rotation.T * 100 + 7,
        head.faces,
        Skeleton.from_heads_and_tails(
            bones.joints @ rotation.T * 100 + 7,
            bones.tails @ rotation.T * 100 + 7,
            bones.parents,
            bones.names,
        ),
    )
    upright = scenes.render(head, size=SMALL)
    assert _difference(upright, scenes.render(turned, size=SMALL)) < 1


def test_visible_vertices_are_those_in_front(head, painter):
    seen = scenes.visible_vertices(head, view=scenes.FRONT)
    towards = head.normals[:, 2]
    assert seen[towards > 0.3].mean() > 0.98
    assert not seen[towards < -0.2].any()


def test_smallest_heads_can_be_shown(fallback):
    bone = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["only"])
    dot = Head.create([[0, 0, 0]], np.zeros((0, 3), int), bone, weights=[[1.0]])
    for picture in (
        scenes.show_head(dot),
        scenes.show_bones(dot),
        scenes.show_skeleton(dot),
        scenes.show_graph(dot, build_graph(dot), "only"),
        plots.skeleton_tree(bone),
        plots.weight_matrix(dot.weights, bone.names),
    ):
        assert picture.image.dtype == np.uint8


# ---- choosing the painter


def test_without_opengl_matplotlib_draws_and_says_so(head, monkeypatch, caplog):
    monkeypatch.delenv("SKINLIB_3D", raising=False)
    monkeypatch.setattr(scenes, "_find_opengl", lambda: False)
    scenes.backend.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert _is_drawn(scenes.show_head(head))
        assert _is_drawn(scenes.show_bones(head))
    scenes.backend.cache_clear()
    assert [r.message.count("libosmesa6") for r in caplog.records] == [1]


@pytest.mark.parametrize(
    "crash", ["import os; os.kill(os.getpid(), 11)", "raise RuntimeError"]
)
def test_a_crash_of_the_probe_is_survived(monkeypatch, crash):
    monkeypatch.setattr(scenes, "_PROBE", crash)
    assert scenes._find_opengl() is False


def test_an_unknown_painter_is_refused(monkeypatch):
    _choose(monkeypatch, "crayons")
    with pytest.raises(ValueError, match=r"crayons.*matplotlib"):
        scenes.backend()
    scenes.backend.cache_clear()


# ---- colours


@pytest.mark.parametrize("count", [1, 2, 35, 120])
def test_palette_tells_bones_apart(count):
    rng = np.random.default_rng(0)
    parents = [-1, *(int(rng.integers(0, i)) for i in range(1, count))]
    skeleton = Skeleton.from_heads_and_tails(
        rng.normal(size=(count, 3)), None, parents, [f"bone {i}" for i in range(count)]
    )
    palette = scenes.bone_palette(skeleton)
    assert palette.shape == (count, 3)
    assert palette.min() >= 0 and palette.max() <= 1
    lab = scenes._oklab(palette)
    apart = np.linalg.norm(lab[:, None] - lab[None], axis=2)
    np.fill_diagonal(apart, 1)
    assert apart.min() > (0.05 if count <= 35 else 0.02)
    child = np.arange(1, count)
    assert (apart[child, skeleton.parents[child]] > 0.1).all()


def test_palette_does_not_depend_on_the_order_of_bones(head):
    order = np.array([4, 2, 0, 1, 3])
    np.testing.assert_array_equal(
        scenes.bone_palette(head.skeleton.reordered(order)),
        scenes.bone_palette(head.skeleton)[order],
    )


def test_oklab_of_known_colours():
    # White is (1, 0, 0); red as in Ottosson's table.
    lab = scenes._oklab([[1, 1, 1], [1, 0, 0]])
    np.testing.assert_allclose(lab[0], [1, 0, 0], atol=1e-4)
    np.testing.assert_allclose(lab[1], [0.628, 0.225, 0.126], atol=1e-3)


def test_colour_by_bone_blends(head):
    palette = scenes.bone_palette(head.skeleton)
    weights = np.array([[0, 1, 0, 0, 0], [0.5, 0, 0.5, 0, 0]])
    colours = scenes.colour_by_bone(weights, head.skeleton)
    np.testing.assert_allclose(colours[0], palette[1])
    np.testing.assert_allclose(colours[1], (palette[0] + palette[2]) / 2)


def test_legend_names_the_bones_that_carry_weight(head):
    weights = np.eye(5)[[2, 2, 1]]
    assert list(scenes.bone_legend(head.skeleton, weights)) == ["jaw", "head"]


# ---- pictures


def _pictures(head):
    graph = build_graph(head)
    yield scenes.show_head(head)
    yield scenes.show_bones(head)
    yield scenes.show_weights(head, "jaw")
    yield scenes.show_weights(head, ["jaw", "head", "neck"], size=SMALL)
    yield scenes.show_values(head, head.vertices[:, 1], "height (units)", low=-1.0)
    yield scenes.show_skeleton(head)
    yield scenes.show_graph(head, graph)
    yield scenes.show_graph(head, graph, "jaw", view=scenes.View(30.0, -10.0))
    yield scenes.compare_heads([head, head], ["a", "b"], [None, head.weights])


def test_every_picture_is_drawn_and_small(head, painter):
    captions = []
    for picture in _pictures(head):
        assert _is_drawn(picture), picture
        assert len(picture.encode()[1]) <= 90_000, picture
        captions.append(picture.caption)
    assert all(captions)


def test_no_figure_stays_open(head, fallback):
    list(_pictures(head))
    plots.bone_bars([0.2, 0.8], ["a", "b"])
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or pyplot.get_fignums() == []


def test_demo_picture_has_two_rows_of_four(head, fallback, tmp_path):
    ours = np.full_like(head.weights, 1 / 5)
    path = tmp_path / "demo.png"
    picture = scenes.demo_picture(head, ours, head.weights, path)
    assert picture.image.shape[1] == 1600
    assert np.array_equal(np.asarray(Image.open(path)), picture.image)
    upper, lower = np.array_split(picture.image[60:-60], 2)
    assert _difference(upper[: len(lower)], lower) > 1


def test_missing_weights_and_bones_are_named(head):
    with pytest.raises(ValueError, match=r"'nose'.*neck"):
        scenes.show_weights(head, "nose")
    with pytest.raises(ValueError, match="egg has no weights"):
        scenes.show_bones(head.replace(weights=None))
    with pytest.raises(ValueError, match=r"\(3, 5\) for 642 vertices"):
        scenes.show_bones(head, np.ones((3, 5)))


def test_a_picture_shows_itself(tmp_path):
    grey = Picture(np.full((20, 30, 3), 99, np.uint8), "grey")
    bundle = grey._repr_mimebundle_()
    assert bundle["text/plain"] == "<Picture 30 x 20: grey>"
    assert bundle["image/png"].startswith(b"\x89PNG")
    assert np.array_equal(
        np.asarray(Image.open(grey.save(tmp_path / "a.png"))), grey.image
    )


def test_a_picture_too_large_for_png_becomes_jpeg():
    noise = np.random.default_rng(0).integers(0, 255, (200, 200, 3), np.uint8)
    kind, data = Picture(noise, max_bytes=60_000).encode()
    assert kind == "image/jpeg" and len(data) <= 60_000


def test_grid_keeps_the_pixels_and_the_order():
    tiles = [np.full((40, 50, 3), grey, np.uint8) for grey in (0, 90, 180)]
    image = picture_grid(tiles, ["a", "b", "c"], columns=2, row_titles=["x", "y"]).image
    counts = [(image == grey).all(axis=2).sum() for grey in (0, 90, 180)]
    assert min(counts) > 0.95 * 40 * 50
    first, second, third = (
        np.argwhere((image == grey).all(axis=2)).mean(axis=0) for grey in (0, 90, 180)
    )
    assert first[1] < second[1] and third[0] > first[0] + 40


def test_grid_refuses_nothing_and_too_many_titles():
    with pytest.raises(ValueError, match="at least one"):
        picture_grid([])
    with pytest.raises(ValueError, match="2 titles for 1"):
        picture_grid([np.zeros((4, 4, 3), np.uint8)], ["a", "b"])


# ---- charts


RESULTS = {
    "methods": {
        name: {
            "mean": {"row_l1_mean": mean, "seconds": seconds},
            "heads": {"a": {"row_l1_mean": mean}, "b": {"row_l1_mean": mean * 1.2}},
        }
        for name, mean, seconds in [("skinlib", 0.05, 0.3), ("nearest_bone", 1.7, 0.0)]
    }
}


@pytest.mark.parametrize(
    "draw",
    [
        lambda head: plots.weight_matrix(head.weights, head.skeleton.names),
        lambda head: plots.small_matrix(
            [[1, 2], [3, 4]], "ab", "cd", title="logits", low=None, high=None
        ),
        lambda head: plots.training_curves(
            {"train": [1.0, 0.5], "validation": ([1, 2], [1.0, 0.6])},
            targets={"copy": 0.3},
        ),
        lambda head: plots.training_curves({"critic": [1.0, -0.5]}),
        lambda head: plots.training_curves({"train": [1.0, 0.5]}, log=True),
        lambda head: plots.error_histogram({"ours": np.array([0.0, 0.1, 2.0])}),
        lambda head: plots.method_bars(RESULTS),
        lambda head: plots.method_scatter(RESULTS),
        lambda head: plots.skeleton_tree(
            head.skeleton, scenes.bone_palette(head.skeleton)
        ),
        lambda head: plots.toy_graph(
            np.array([[0, 0], [1, 0], [0, 1]]),
            {"mesh edge": np.array([[0, 1]]), "rejected": np.zeros((0, 2))},
            normals=np.array([[0, 1], [0, 1], [1, 0]]),
        ),
        lambda head: plots.bone_bars(head.weights[0], head.skeleton.names),
    ],
)
def test_charts_are_drawn_and_small(head, draw):
    picture = draw(head)
    assert _is_drawn(picture) and picture.caption
    assert len(picture.encode()[1]) <= 90_000
    assert (picture.image[0] == 255).all(), "opaque, white to the edge"


def test_the_shape_of_a_tree_does_not_depend_on_the_order_of_bones(head):
    order = np.array([4, 2, 0, 1, 3])
    a, b = (
        plots.skeleton_tree(s).image
        for s in (head.skeleton, head.skeleton.reordered(order))
    )
    assert a.shape == b.shape


# ---- sliders


def _ends(control):
    if hasattr(control, "min"):
        return [control.min, control.max]
    if hasattr(control, "options"):
        return [o[1] if isinstance(o, tuple) else o for o in control.options]
    return [False, True]


LABS = {
    "pose": lambda head: widgets.pose_sliders(head),
    "bone": lambda head: widgets.bone_picker(head),
    "knn": lambda head: widgets.knn_slider(head, "jaw"),
    "attention": lambda head: widgets.attention_sliders(
        np.array([[2, 1], [0, 1.0]]), np.array([[0, 1], [1, 0.0]]), "ab", ["x", "y"]
    ),
}


@pytest.mark.parametrize("lab", LABS)
def test_a_lab_answers_at_both_ends_of_every_control(head, fallback, lab):
    lab = LABS[lab](head)
    for control in lab.controls.values():
        seen = []
        for value in _ends(control):
            control.value = value
            assert _is_drawn(lab.picture)
            assert lab._message.value == ""
            seen.append(lab.picture.image)
        control.value = _ends(control)[-1]
    assert repr(lab).startswith("<SliderLab ")


@pytest.mark.parametrize("name", ["jaw_open", "blink", "head_turn", "angle"])
def test_pose_sliders_bend_the_head(head, fallback, name):
    lab = widgets.pose_sliders(head)
    lab.controls["bone"].value = "neck"
    before = lab.picture.image
    lab.controls[name].value = lab.controls[name].max
    assert _difference(before, lab.picture.image) > 0.1


def test_pose_sliders_leave_out_what_the_skeleton_cannot_do(head):
    assert widgets.known_poses(head) == ["jaw_open", "blink", "head_turn"]


def test_a_twin_is_the_lab_on_paper(head, fallback):
    lab = widgets.pose_sliders(head)
    picture = lab.twin({"jaw_open": 0.0}, {"jaw_open": 1.0})
    assert _is_drawn(picture)
    assert picture.image.shape[1] > 2 * lab.picture.image.shape[1]
    assert lab.values["jaw_open"] == 0.0


def test_a_run_button_waits():
    calls = []

    def draw(level):
        calls.append(level)
        return np.full((4, 4, 3), level, np.uint8)

    lab = widgets.slider_lab(draw, run_button=True, level=(0, 9))
    lab.controls["level"].value = 5
    assert calls == [0] and "Run" in lab._message.value
    lab.run_button.click()
    assert calls == [0, 5] and lab._message.value == ""


def test_an_error_is_shown_and_raised():
    def draw(level):
        if level > 5:
            raise RuntimeError("too <loud>")
        return np.zeros((4, 4, 3), np.uint8)

    lab = widgets.slider_lab(draw, level=(0, 9))
    with pytest.raises(RuntimeError):
        lab.controls["level"].value = 9
    assert "too &lt;loud&gt;" in lab._message.value


def test_controls_by_the_kind_of_range():
    import ipywidgets

    lab = widgets.slider_lab(
        lambda **values: np.zeros((4, 4, 3), np.uint8),
        start={"b": 0.5},
        a=(0, 4),
        b=(0.0, 1.0),
        c=["x", "y"],
        d=True,
    )
    kinds = [type(control) for control in lab.controls.values()]
    assert kinds == [
        ipywidgets.IntSlider,
        ipywidgets.FloatSlider,
        ipywidgets.Dropdown,
        ipywidgets.Checkbox,
    ]
    assert lab.values == {"a": 0, "b": 0.5, "c": "x", "d": True}
    assert not lab.controls["a"].continuous_update
    with pytest.raises(ValueError, match="a='wide'"):
        widgets.slider_lab(lambda a: a, a="wide")


def test_attention_weights_by_hand():
    scores, distances = [[0.0, np.log(2)]], [[0.0, 1.0]]
    cold = widgets.attention_weights(scores, distances, temperature=0.5)
    np.testing.assert_allclose(cold, [[0.2, 0.8]])
    biased = widgets.attention_weights(scores, distances, bias=np.log(2))
    np.testing.assert_allclose(biased, [[0.5, 0.5]])


# ---- the room's walls


def test_nothing_outside_views_imports_what_draws():
    package = Path(skinlib.__file__).parent
    for path in sorted(package.rglob("*.py")):
        if path.is_relative_to(package / "views"):
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = [a.name for a in getattr(node, "names", [])]
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            elif not isinstance(node, ast.Import):
                continue
            roots = {name.split(".")[0] for name in names}
            assert not roots & {"matplotlib", "pyvista", "ipywidgets"}, path
