"""Pictures of clothes: what is painted, and labs that answer at their ends."""

import functools

import numpy as np
import pytest
import torch

from skinlib.garments.body import read_body
from skinlib.garments.energies import EnergyWeights
from skinlib.garments.garment import read_garment
from skinlib.garments.measures import measure, skinned
from skinlib.garments.motion import Motion
from skinlib.garments.outfit import Outfit
from skinlib.garments.patterns import skirt
from skinlib.garments.pbns import PBNSConfig
from skinlib.paths import sample
from skinlib.views import garments, scenes

SMALL = (90, 96)


@functools.cache
def outfit() -> Outfit:
    return Outfit.create(read_body(), [read_garment(sample("t_shirt.npz"))])


@functools.cache
def kilt() -> Outfit:
    body = read_body()
    return Outfit.create(body, [skirt(body.head, length=0.4, rings=8, segments=20)])


@functools.cache
def network():
    made = outfit().network(PBNSConfig(8, 4), smoothing=10, shapes=False, seed=0)
    with torch.no_grad():
        made.columns.normal_(0, 0.002)
    return made.eval()


@pytest.fixture(autouse=True)
def fallback(monkeypatch):
    """The painter that runs everywhere."""
    monkeypatch.setenv("SKINLIB_3D", "matplotlib")
    scenes.backend.cache_clear()
    yield
    scenes.backend.cache_clear()


def test_sizes_are_drawn_on_their_bodies():
    learnt = outfit().network(PBNSConfig(8, 4), smoothing=10, shapes=True, seed=0)

    def drawn(**shapes):
        found = garments.sizes(outfit(), learnt, rest(), shapes, size=SMALL)
        return np.asarray(found)

    assert np.array_equal(drawn(a={}), drawn(a={}))
    assert not np.array_equal(drawn(a={"height": 1.0}), drawn(a={}))
    assert drawn(a={}, b={}, c={}).shape[1] > 2 * drawn(a={}).shape[1]


def rest() -> Motion:
    return garments.posture(outfit(), elbow=0.0)


def test_depth_counts_what_the_measures_count():
    motion = garments.posture(outfit(), shoulder_lift=-33, shoulder_forward=60)
    posed = skinned(outfit(), motion)
    depth = garments.depth_inside(outfit(), motion, posed)
    judged = measure(outfit(), motion, posed)
    assert 100 * (depth > 0).mean() == pytest.approx(judged.inside)
    assert depth.max() == pytest.approx(judged.deepest)
    assert judged.inside > 1  # or this pose would show nothing


def test_stretch_by_hand():
    posed = outfit().vertices[None]
    assert np.abs(garments.stretch(outfit(), posed)).max() < 1e-3
    np.testing.assert_allclose(garments.stretch(outfit(), 1.1 * posed), 10, atol=1e-3)
    pulled = posed.copy()
    pulled[0, 0] += 0.02
    ends = outfit().cloth.edges.numpy()
    near = np.unique(ends[(ends == 0).any(axis=1)])
    assert set(np.flatnonzero(garments.stretch(outfit(), pulled)[0] > 1e-3)) == set(
        near
    )


def test_the_face_looks_at_the_camera():
    front = scenes.View(0, 0, upright=True)
    camera = scenes._camera(outfit().body.head, front, SMALL)
    np.testing.assert_allclose(camera.rotation, [[1, 0, 0], [0, 0, 1], [0, -1, 0]])


def test_values_are_painted_and_uncover_the_cloth():
    posed, size = outfit().vertices[None], {"size": SMALL}
    plain = garments.draw(outfit(), rest(), posed, **size)
    none = garments.draw(outfit(), rest(), posed, values=np.zeros((1, 1900)), **size)
    dark = garments.draw(outfit(), rest(), posed, values=np.ones((1, 1900)), **size)
    assert plain.shape == (96, 90, 3)
    assert dark.mean() < none.mean() - 5
    covered, bare = (len(garments.dressed(outfit(), c).faces) for c in (True, False))
    assert bare < covered


def test_an_unknown_paint_is_refused():
    with pytest.raises(ValueError, match="depth"):
        garments.painted(outfit(), rest(), outfit().vertices[None], "love")


def test_no_steps_is_smoothed_skinning_and_steps_go_downhill():
    motion = garments.posture(kilt(), hip=40.0)
    start, history = garments.drape(kilt(), motion, EnergyWeights(), steps=0)
    transforms = motion.transforms(kilt().body.head.skeleton)
    skin = kilt().blend_weights(50)
    alone = garments.linear_blend_skinning(kilt().vertices, skin, transforms)
    np.testing.assert_allclose(start, alone, atol=1e-6)
    assert history == {}
    end, history = garments.drape(kilt(), motion, EnergyWeights(), steps=20)
    total = np.sum(list(history.values()), axis=0)
    assert end.shape == start.shape and len(total) == 20 and total[-1] < total[0]


def test_a_weight_of_zero_lets_go():
    motion = garments.posture(kilt(), hip=0.0)
    held, free = (
        garments.drape(kilt(), motion, EnergyWeights(pin=pin, gravity=4.0), steps=30)[0]
        for pin in (40.0, 0.0)
    )
    waist = kilt().pinned
    assert free[0, waist, 2].mean() < held[0, waist, 2].mean() - 0.003


def test_a_pressed_in_vertex_by_hand():
    before, after, left = garments.press_out(depth=8, epsilon=4, steps=0)
    assert left == pytest.approx(25 * 0.012**2 * 1000)
    np.testing.assert_array_equal(before, after)
    middle = len(before) // 2
    np.testing.assert_allclose(before[middle], [0, 42], atol=1e-9)
    _, after, left = garments.press_out(depth=8, epsilon=4, steps=100)
    assert after[middle, 1] == pytest.approx(54, abs=0.2) and left < 1e-3
    outside = garments.press_out(-4, 4, 10)
    np.testing.assert_allclose(outside[0], outside[1], atol=0.1)
    alone = garments.press_out(8, 4, 100, {"collision": 0})[1]
    assert alone[middle, 1] < 54


def test_columns_and_their_use():
    motion = Motion.create(
        np.random.default_rng(0).normal(0, 0.3, (3, 36, 3)),
        outfit().body.head.skeleton.names,
    )
    used, moves = garments.column_use(network(), motion)
    assert used.shape == (3, 4) and moves.shape == (4, 1900) and used.min() >= 0
    column = network().columns[2].detach().numpy().reshape(-1, 3)
    lengths = 1000 * np.linalg.norm(column, axis=1)
    np.testing.assert_allclose(moves[2], lengths, rtol=1e-5)
    picture = garments.columns_picture(outfit(), network(), motion, 2, size=SMALL)
    assert np.asarray(picture).std() > 5


def labs():
    motion = Motion.create(np.zeros((3, 36, 3)), outfit().body.head.skeleton.names)
    posed = np.repeat(outfit().vertices[None], 3, axis=0)
    step = garments.posture(kilt(), hip=40.0)
    return {
        "pose": lambda: garments.pose_lab(outfit(), network(), elbow=40.0),
        "playback": lambda: garments.playback(outfit(), motion, posed, size=SMALL),
        "drape": lambda: garments.drape_lab(kilt(), step, size=SMALL),
        "press": garments.press_lab,
    }


@pytest.mark.parametrize("name", ["pose", "playback", "drape", "press"])
def test_a_lab_answers_at_both_ends_of_every_control(name):
    lab = labs()[name]()
    run = getattr(lab, "run_button", None)
    for key, control in lab.controls.items():
        first = control.value
        options = getattr(control, "options", None)
        ends = [options[0], options[-1]] if options else [control.min, control.max]
        for end in ends:
            if key == "steps" and name == "drape":
                end = min(end, 10)
            control.value = end
            if run:
                run.click()
            assert np.asarray(lab.picture).std() > 5
        control.value = first


def test_play_moves_the_frames():
    lab = labs()["playback"]()
    old = np.asarray(lab.picture)
    lab.children[0].value = 2
    assert lab.controls["frame"].value == 2
    assert (np.asarray(lab.picture) != old).any()


def test_a_strip_names_its_frames():
    motion = Motion.create(np.zeros((2, 36, 3)), outfit().body.head.skeleton.names)
    posed = np.repeat(outfit().vertices[None], 2, axis=0)
    strip = garments.strip(outfit(), motion, posed, [0, 1], size=SMALL)
    assert strip.caption == "frame 0, frame 1"
