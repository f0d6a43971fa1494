"""How well a garment moves, measured where the answer is known."""

from dataclasses import asdict

import numpy as np
import pytest
from test_body import NAMES, SIDES, bends, sleeve, small_body
from test_outfit import band

from skinlib.garments.measures import (
    Measures,
    inside_out,
    joined,
    measure,
    skinned,
    turned_over,
)
from skinlib.garments.motion import Motion
from skinlib.garments.outfit import Outfit
from skinlib.skinning import linear_blend_skinning

HALF = np.pi / SIDES  # from a corner of the post to the middle of a side


@pytest.fixture(scope="module")
def outfit() -> Outfit:
    return Outfit(small_body(), (sleeve(0.115),))


@pytest.fixture(scope="module")
def layers() -> Outfit:
    return Outfit(small_body(), (sleeve(0.115), band(0.13)))


def still(frames: int) -> Motion:
    """The rest pose."""
    return Motion.create(np.zeros((frames, 3, 3)), NAMES)


def frames(*poses) -> np.ndarray:
    return np.stack(poses).astype(np.float32)


def as_wide_as(outfit: Outfit, radius: float) -> np.ndarray:
    """All garments of an outfit pressed or stretched to one radius."""
    points = outfit.vertices.copy()
    points[:, :2] *= radius / np.linalg.norm(points[:, :2], axis=1, keepdims=True)
    return points


def test_a_garment_at_rest_is_perfect(outfit):
    found = asdict(measure(outfit, still(2), frames(*[outfit.vertices] * 2)))
    # Of 35 rows of hinges, 12 diagonal, 11 level and 12 upright, those bend by 15
    # degrees.
    bend = found.pop("bend")
    assert bend == pytest.approx(12 / 35 * (1 - np.cos(2 * HALF)), rel=1e-4)
    assert found == pytest.approx(dict.fromkeys(found, 0.0), abs=1e-4)


def test_ten_millimetres_inside_in_one_of_two_frames(outfit):
    pressed = as_wide_as(outfit, 0.09)
    found = measure(outfit, still(1), frames(pressed))
    assert (found.inside, found.deep) == (100, 100)
    assert found.deepest == pytest.approx(10 * np.cos(HALF), rel=0.01)
    found = measure(outfit, still(2), frames(pressed, outfit.vertices))
    assert (found.inside, found.deep) == (50, 50)
    assert found.deepest == pytest.approx(10 * np.cos(HALF), rel=0.01)
    found = measure(outfit, still(1), frames(as_wide_as(outfit, 0.097)))
    assert (found.inside, found.deep) == (100, 0)  # 3 mm
    assert found.deepest == pytest.approx(3 * np.cos(HALF), rel=0.01)


def test_a_tenth_larger(outfit):
    edges = outfit.cloth.rest_lengths.mean().item()
    found = measure(outfit, still(1), frames(1.1 * outfit.vertices))
    assert found.elongation == pytest.approx(10, abs=1e-3)
    assert found.stretch == pytest.approx(100 * edges, rel=1e-4)
    found = measure(outfit, still(1), frames(0.9 * outfit.vertices))
    assert found.elongation == pytest.approx(10, abs=1e-3)  # shorter counts, too


def test_a_garment_is_judged_as_it_is_cut_for_a_shape(outfit):
    shape = {"tall": 1}
    posed = skinned(outfit, still(2), shape)
    assert np.ptp(posed[0, :, 2]) > 1.02 * np.ptp(outfit.vertices[:, 2])
    found = measure(outfit, still(2), posed, shape)
    assert found.elongation == pytest.approx(0, abs=1e-3)
    assert (found.inside, found.turned) == (0, 0)
    assert measure(outfit, still(2), posed).elongation > 1
    # The bones of that body are longer, too.
    bent = bends(3, angle=0.5)
    assert measure(outfit, bent, skinned(outfit, bent, shape), shape).inside == 0


@pytest.mark.parametrize(("radius", "turned"), [(0.115, 2), (0.13, 0)])
def test_a_corner_of_the_hem_folded_down_turns_two_faces(radius, turned):
    outfit = Outfit(small_body(), (sleeve(radius),))
    folded = outfit.vertices.copy()
    folded[-SIDES + 3, 2] -= 0.1  # two rings down
    found = measure(outfit, still(1), frames(folded))
    # 3 cm away from the skin, nobody says which side should look out.
    assert found.turned == pytest.approx(100 * turned / len(outfit.faces))
    # The cloth itself does.
    assert found.flipped == pytest.approx(100 * 2 / len(outfit.faces))


def test_a_mirror_turns_all_faces_and_a_motion_none(outfit):
    mirrored = outfit.vertices * np.float32([-1, 1, 1])
    found = measure(outfit, still(1), frames(mirrored))
    assert (found.turned, found.flipped) == (100, 0)  # as a whole
    motion = bends(3, angle=0.2)
    found = measure(outfit, motion, skinned(outfit, motion))
    assert (found.turned, found.flipped) == (0, 0)


def crease(gap: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two skins that face each other: floor of bone 0, ceiling of 1 `gap` above."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    body = np.concatenate([square, square + np.array([0, 0, gap])])
    return body, np.concatenate([faces, 4 + faces[:, ::-1]]), np.eye(2)[[0, 0, 1, 1]]


@pytest.mark.parametrize("height", [0.003, 0.01, 0.017])
@pytest.mark.parametrize("bone", [0, 1])
def test_in_a_crease_cloth_is_judged_by_its_own_skin(height, bone):
    """The other side of the crease may be nearer: it sees the outside, rightly."""
    body, faces, moves = crease(0.02)
    centres, right = np.array([[0.1, 0.2, height]]), np.array([[0, 0, 1.0 - 2 * bone]])
    cloth = centres, right, body, faces, np.eye(2)[[bone]], moves
    assert not inside_out(*cloth)[0]
    assert inside_out(centres, -right, *cloth[2:])[0]
    # It has to be near its own skin, too.
    body, faces, moves = crease(0.05)
    far = np.array(
        [[0, 0, 0.025 + (0.5 - bone) * 0.03]]
    )  # 40 mm off it, 10 off the other
    assert not inside_out(far, -right, body, faces, np.eye(2)[[bone]], moves)[0]


def test_a_triangle_that_looks_back_is_turned_over():
    """A fan of four, of which one is folded under its neighbour; a pleat is none."""
    rest = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    up = np.array([0, 0, 1.0])
    assert not turned_over(np.array([[up] * 4]), rest, faces).any()
    assert not turned_over(np.array([[-up] * 4]), rest, faces).any()  # all of it
    under = turned_over(np.array([[up, up, -up, up], [up] * 4]), rest, faces)
    assert under.tolist() == [[False, False, True, False], [False] * 4]
    # Folded in the middle, it has no side that is the wrong one.
    assert not turned_over(np.array([[up, -up, -up, up]]), rest, faces).any()


def test_the_body_is_where_the_motion_puts_it(outfit):
    motion = bends(3, angle=0.2)
    assert np.abs(motion.translations).max() > 1
    assert measure(outfit, motion, skinned(outfit, motion)).inside == 0
    away = skinned(outfit, still(3))
    assert measure(outfit, motion, away).deepest == 0


def test_a_shape_of_the_body_counts(outfit):
    posed = frames(outfit.vertices)
    found = measure(outfit, still(1), posed, {"wide": 1})  # radius 0.12
    assert found.inside == 100
    assert found.deepest == pytest.approx(5 * np.cos(HALF), rel=0.01)
    assert measure(outfit, still(1), posed, {"wide": -1}).inside == 0


def test_an_outer_garment_inside_an_inner_one(layers):
    rest = layers.vertices
    assert measure(layers, still(1), frames(rest)).through == 0
    through = rest.copy()
    outer = layers.parts[1]
    through[outer, :2] *= 0.11 / 0.13
    assert measure(layers, still(1), frames(through)).through == 100
    assert measure(layers, still(2), frames(rest, through)).through == 50
    half = rest.copy()
    half[outer.start : outer.start + 2 * SIDES] = through[
        outer.start : outer.start + 2 * SIDES
    ]
    found = measure(layers, still(1), frames(half))
    assert found.through == pytest.approx(100 * 2 / 7)  # two rings of seven
    assert found.inside == 0


def test_skinning_alone_has_the_weights_of_the_closest_points(outfit):
    motion = bends(3)
    transforms = motion.transforms(outfit.body.head.skeleton)
    weights = outfit.blend_weights(0)
    posed = skinned(outfit, motion)
    assert posed.dtype == np.float32
    for frame in range(3):
        expected = linear_blend_skinning(outfit.vertices, weights, transforms[frame])
        assert np.abs(posed[frame] - expected).max() < 1e-5


def test_motions_are_joined_one_after_the_other():
    first, second = bends(2), bends(3, seed=1)
    both = joined([first, second])
    assert len(both) == 5 and both.bone_names == first.bone_names
    assert np.array_equal(both.rotations[2:], second.rotations)
    assert np.array_equal(both.translations[:2], first.translations)


def test_all_numbers_are_in_the_line():
    measures = Measures(1, 2, 3, 4, 5, 6, 7, 8)
    assert measures.line().split(", ") == [
        "elongation 1.000",
        "stretch 2.000",
        "bend 3.000",
        "turned 4.000",
        "flipped 5.000",
        "inside 6.000",
        "deep 7.000",
        "deepest 8.000",
        "through 0.000",
    ]
