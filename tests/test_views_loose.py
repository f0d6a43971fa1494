"""Pictures of virtual bones: what is painted and moved, and labs at their ends."""

import functools

import numpy as np
import pytest

from skinlib.garments.body import read_body
from skinlib.garments.loose import LooseConfig, bind
from skinlib.garments.motion import walk
from skinlib.garments.outfit import Outfit
from skinlib.garments.patterns import skirt
from skinlib.garments.simulation import Predictability, Simulated
from skinlib.views import loose, scenes

SMALL = (90, 96)


@functools.cache
def kilt():
    return skirt(read_body().head, length=0.4, rings=6, segments=16)


@functools.cache
def garment():
    """A kilt in a walk, which it follows as a bell that grows wider; nothing learnt."""
    body, cut = read_body(), kilt()
    motion = walk(body.head.skeleton, 1, fps=12)
    sway = np.linspace(0, 0.05, len(motion))[:, None, None]
    low = cut.vertices[:, 2:].max() - cut.vertices[:, 2:]
    posed = (cut.vertices + sway * low).astype(np.float32)
    config = LooseConfig(bones=6, window=4, unscored=0)
    return bind(config, body, cut, [Simulated(motion, posed, cut.vertices)])


@functools.cache
def ways():
    motion = walk(garment().body.head.skeleton, 1, fps=12)
    return motion, {"truth": garment().pose(motion)} | garment().baselines(motion)


@functools.cache
def outfit() -> Outfit:
    return loose.hung(garment())


@pytest.fixture(autouse=True)
def fallback(monkeypatch):
    """The painter that runs everywhere."""
    monkeypatch.setenv("SKINLIB_3D", "matplotlib")
    scenes.backend.cache_clear()
    yield
    scenes.backend.cache_clear()


def ends(lab):
    """All settings in which one slider is at an end and the others are at the start."""
    for name, control in lab.controls.items():
        options = getattr(control, "options", None)
        for value in options or (control.min, control.max):
            yield {name: value}


def drawn(lab, **fixed) -> list[np.ndarray]:
    settings = [{**lab.values, **chosen, **fixed} for chosen in ends(lab)]
    return [np.asarray(lab.function(**chosen)) for chosen in settings]


def test_bones_are_placed_once():
    bones, distances = loose.placed(outfit(), 5)
    assert bones.shape == (5,) and distances.shape == (96, 5)
    assert (distances[bones, np.arange(5)] == 0).all()
    assert loose.placed(outfit(), 5)[1] is distances


def test_a_ball_stands_where_its_bone_does():
    count = len(kilt().vertices)
    cloth = np.tile([0.2, 0.2, 0.9], (count, 1))
    red = np.array([[1.0, 0, 0]])
    front = kilt().vertices[(kilt().vertices @ [0, 1, 0.2]).argmin()]

    def reds(point):
        view = scenes.View(0, 0, 1.9, (0, 0, 0), upright=True)
        look = {"view": view, "size": (180, 192)}
        image = loose.draw_bones(outfit(), point[None], cloth, red, **look)
        image = image.astype(int)
        return np.argwhere((image[..., 0] > 90) & (image[..., 1:].max(axis=-1) < 40))

    low, high = reds(front), reds(front + np.array([0, 0, 0.1]))
    assert len(low) > 4 and len(high) > 4
    assert high[:, 0].mean() < low[:, 0].mean() - 3
    assert len(reds(np.array([0, 0.5, 0.1]))) == 0  # behind the body


def test_colours_of_bones_differ():
    colours = loose.palette(24)
    apart = np.abs(colours[:, None] - colours).sum(axis=-1) + 9 * np.eye(24)
    assert colours.shape == (24, 3) and apart.min() > 0.05


def test_more_heat_is_painted_with_a_wider_alpha():
    narrow, wide = (
        np.asarray(loose.weights_picture(outfit(), count=6, spread=s, size=SMALL))
        for s in (0.1, 4.0)
    )
    assert narrow.shape == wide.shape and (narrow != wide).any()


def test_a_bone_moved_by_hand():
    made = garment()
    np.testing.assert_allclose(loose.moved_by_hand(made, 3), made.rest, atol=1e-6)
    bone = int(made.weights[:, :6].max(axis=0).argmax())
    lifted = loose.moved_by_hand(made, bone, up=100) - made.rest
    expected = 0.1 * made.weights[:, bone]
    np.testing.assert_allclose(lifted[:, 2], expected, atol=1e-6)
    np.testing.assert_allclose(lifted[:, :2], 0, atol=1e-6)
    out = loose.moved_by_hand(made, bone, out=100)
    middle = made.bones[bone]
    radius = [np.linalg.norm(points[middle, :2]) for points in (made.rest, out)]
    weight = made.weights[middle, bone]
    assert radius[1] - radius[0] == pytest.approx(0.1 * weight, abs=1e-5)


def test_a_turn_leaves_the_bones_own_vertex():
    made = garment()
    bone = int(made.weights[:, :6].max(axis=0).argmax())
    turned = loose.moved_by_hand(made, bone, turn=90)
    off = np.linalg.norm(turned - made.rest, axis=1)
    assert off[made.bones[bone]] < 1e-6 < off.max()


def test_looseness_says_how_much_is_tight():
    still = np.tile(outfit().vertices, (2, 1, 1))
    moved = still.copy()
    moved[:, :48, 0] += 0.02
    picture = functools.partial(loose.looseness_picture, outfit(), still, moved)
    assert (np.asarray(picture()) != np.asarray(picture(threshold=50))).any()


def test_every_end_of_the_sliders_draws():
    weights = loose.weights_lab(outfit(), count=6)
    hand = loose.hand_lab(garment())
    motion, shown = ways()
    posed = garment().baselines(motion)["rigid"]
    ramps = loose.looseness_lab(outfit(), shown["skinning alone"], posed)
    for lab in (weights, hand, ramps):
        for image in drawn(lab, size=SMALL):
            assert image.ndim == 3 and image.std() > 5


def test_playback_draws_every_way():
    motion, shown = ways()
    player = loose.playback(outfit(), motion, shown)
    play = player.children[0]
    play.value = len(motion) - 1
    assert player.values["frame"] == len(motion) - 1
    for image in drawn(player):
        assert image.std() > 5
    rows = loose.strip(outfit(), motion, shown, [0, 5], paint="error", size=SMALL)
    columns = loose.strip(outfit(), motion, shown, [0], size=SMALL)
    assert np.asarray(rows).shape[1] > np.asarray(columns).shape[1]


def test_errors_are_distances_from_the_first():
    truth = np.zeros((2, 3, 3))
    off = loose._off({"truth": truth, "ours": truth + np.array([0.003, 0, 0.004])})
    np.testing.assert_allclose(off[0], 0)
    np.testing.assert_allclose(off[1], 5)


def test_bars_and_cycles():
    bars = loose.error_bars({"skinning": 100.0, "virtual bones": 20.0})
    fewer = loose.error_bars({"skinning": 100.0})
    assert np.asarray(bars).shape[0] > np.asarray(fewer).shape[0]
    posed = np.zeros((3, 15, len(kilt().vertices), 3))
    plot = loose.cycles_plot(kilt(), posed, Predictability(0.002, 0.03), 300.0)
    assert "floor 2 mm of 30 mm" in plot.caption


def test_identical_steps_are_simulated():
    pytest.importorskip("warp")
    head = read_body().head
    posed, found = loose.periodic(kilt(), head, 300.0, 2, 8.0)
    assert posed.shape == (2, 8, len(kilt().vertices), 3)
    assert 0 < found.floor < found.deviation
    again = loose.periodic(kilt(), head, 300.0, 2, 8.0)
    assert again[0] is posed
