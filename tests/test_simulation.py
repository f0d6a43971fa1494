"""Cloth falls, hangs, lies and slides as it should, twice to the same bit."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shapes import sphere
from test_body import NAMES, sleeve, small_body

from skinlib.garments import simulation
from skinlib.garments.binding import closest_point_weights, signed_distance
from skinlib.garments.body import read_body
from skinlib.garments.energies import GRAVITY, Cloth
from skinlib.garments.garment import Garment, read_garment
from skinlib.garments.motion import Motion
from skinlib.garments.simulation import (
    Simulation,
    SimulationConfig,
    check_simulated,
    colour_pairs,
    inside,
    obstacle,
    predictability,
    quiet,
    read_simulated,
    rms,
    root_frame,
    simulate,
    simulate_motions,
    strain,
    touched_bones,
)
from skinlib.head import Head, HeadError, Skeleton
from skinlib.paths import sample
from skinlib.skinning import linear_blend_skinning

pytest.importorskip("warp")

AT_ONCE = SimulationConfig(settle=0, lead=0)
IDEAL = replace(AT_ONCE, damping=0, smoothing=0)


@pytest.fixture(scope="module")
def head() -> Head:
    return small_body().head


def still(frames: int, bones: tuple[str, ...] = NAMES) -> Motion:
    return Motion.create(np.zeros((frames, len(bones), 3)), bones)


def sheet(side: int = 7, size: float = 0.3, at=(5, 0, 5), pinned=False) -> Garment:
    """A level square; pinned along its first edge or not at all."""
    along = np.linspace(-size / 2, size / 2, side)
    x, y = (n.ravel() for n in np.meshgrid(along, along, indexing="ij"))
    i, j = (n.ravel() for n in np.mgrid[: side - 1, : side - 1])
    a, b, c = i * side + j, (i + 1) * side + j, i * side + j + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, b + 1, c], 1)])
    vertices = np.stack([x, y, 0 * x], 1) + at
    return Garment.create(vertices, faces, pinned & (x == x.min()), "sheet")


def swinging(seed: int = 0, pinned: float = 0.5) -> Motion:
    """The small body bends to and fro and turns about the vertical."""
    phase = np.linspace(0, 2 * np.pi, 13)
    rotations = np.zeros((13, 3, 3))
    rotations[:, 1, 0] = pinned * np.sin(phase)
    rotations[:, 0, 2] = 0.3 * np.sin(phase + seed)
    return Motion.create(rotations, NAMES, name="swing")


# --- physics --------------------------------------------------------------------------


def test_a_sheet_falls_freely(head):
    posed, rest = simulate(sheet(), head, still(13), IDEAL)
    assert posed.shape == (13, 49, 3) and posed.dtype == np.float32
    time = np.arange(13) / 30
    fallen = (posed - rest)[..., 2]
    assert fallen == pytest.approx(
        np.repeat(-GRAVITY * time[:, None] ** 2 / 2, 49, axis=1), rel=0.03, abs=1e-4
    )
    assert np.abs((posed - rest)[..., :2]).max() < 1e-4


def test_the_air_slows_it_down(head):
    heights = [
        simulate(sheet(), head, still(13), replace(IDEAL, damping=damping)).posed[-1]
        for damping in (0.0, 5.0)
    ]
    # x'' = -g - k x' from rest
    time, k = 12 / 30, 5.0
    fallen = -GRAVITY / k * (time - (1 - np.exp(-k * time)) / k)
    assert (heights[1][:, 2] - 5).mean() == pytest.approx(fallen, rel=0.02)
    assert heights[0][:, 2].mean() < heights[1][:, 2].mean() - 0.2


def test_springs_and_smoothing_keep_the_centre_of_mass_on_its_way(head):
    garment = sheet(at=(0.6, 0, 1))  # near the root, where float32 is finest
    start = garment.vertices + np.random.default_rng(0).normal(0, 0.003, (49, 3))
    config = replace(IDEAL, smoothing=300.0, fastest=1e4)
    posed = simulate(garment, head, still(9), config, start).posed
    masses = Cloth(garment.vertices, garment.faces).masses.numpy()
    centre = np.average(posed, axis=1, weights=masses)
    fallen = GRAVITY * (np.arange(9) / 30) ** 2 / 2
    assert centre[:, 2] == pytest.approx(centre[0, 2] - fallen, abs=6e-3)
    assert np.ptp(centre[:, :2], axis=0).max() < 1e-4
    assert strain(posed[-1:], garment.vertices, garment.faces).p99 < 0.01


def test_a_pinned_sheet_swings_down_and_hangs(head):
    garment = sheet(pinned=True)
    posed, rest = simulate(garment, head, still(90), replace(AT_ONCE, damping=4))
    pinned = garment.pinned
    assert np.array_equal(posed[-1, pinned], rest[pinned])
    hanging = posed[-1] - rest[pinned].mean(axis=0)
    assert hanging[:, 2].min() == pytest.approx(-0.3, rel=0.03)
    assert np.abs(hanging[:, 0]).max() < 0.03
    assert strain(posed[-1:], rest, garment.faces).p99 < 0.03


def test_energy_does_not_grow(head):
    garment = sheet(pinned=True)
    posed = simulate(garment, head, still(60), IDEAL).posed.astype(np.float64)
    masses = Cloth(garment.vertices, garment.faces).masses.numpy()[:, None]
    speed = np.diff(posed, axis=0) * 30
    kinetic = (masses * speed**2).sum(axis=(1, 2)) / 2
    middle = (posed[1:] + posed[:-1])[..., 2] / 2 - 5
    total = kinetic + GRAVITY * (masses[:, 0] * middle).sum(axis=1)
    scale = GRAVITY * masses.sum() * 0.3
    assert total.max() < 0.03 * scale
    assert kinetic.max() > 0.1 * scale  # it did move


def test_smoothing_takes_out_the_finest_motion_only(head):
    garment = sheet()
    start = garment.vertices.copy()
    start[::2, 2] += 0.01
    rough, smooth = (
        simulate(garment, head, still(6), replace(IDEAL, smoothing=s), start).posed
        for s in (0.0, 300.0)
    )
    assert np.ptp(smooth[-1, :, 2]) < np.ptp(rough[-1, :, 2]) / 2
    assert smooth[-1].mean(axis=0) == pytest.approx(rough[-1].mean(axis=0), abs=2e-3)


# --- the body -------------------------------------------------------------------------


def test_a_sheet_comes_to_rest_on_a_ball():
    ball = sphere(3, 1)
    bones = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["ball"])
    ball = Head.create(
        0.2 * ball.vertices, ball.faces, bones, np.ones((len(ball.vertices), 1))
    )
    cloth = sheet(15, 0.4, at=(0, 0, 0.22))
    config = replace(AT_ONCE, damping=3, friction=0.6)
    posed = simulate(cloth, ball, still(60, ("ball",)), config).posed
    distance = signed_distance(posed[-1], ball.vertices, ball.faces)
    assert distance.min() > 0.8 * config.thickness
    assert np.median(distance) < 0.05
    assert posed[-1, :, 2].max() == pytest.approx(0.206, abs=3e-3)
    assert np.abs(posed[-1] - posed[-5]).max() < 0.01
    part = obstacle(cloth, ball)
    assert not inside(posed, still(60, ("ball",)), ball, part).any()
    deep = posed - np.array([0, 0, 0.1], np.float32)
    assert inside(deep[-1:], still(1, ("ball",)), ball, part)[0] > 0.3


@pytest.mark.parametrize(("friction", "holds"), [(0.0, False), (1.0, True)])
def test_friction_holds_a_tight_sleeve(head, friction, holds):
    tight = sleeve(0.104)
    config = replace(AT_ONCE, friction=friction)
    fallen = simulate(tight, head, still(9), config).posed[-1] - tight.vertices
    assert (fallen[:, 2].mean() > -0.03) == holds


def test_pinned_vertices_follow_the_bones(head):
    garment, motion = sleeve(0.115, pinned=True), swinging()
    posed = simulate(garment, head, motion, replace(AT_ONCE, settle=0.1)).posed
    weights = closest_point_weights(garment, head)
    transforms = motion.transforms(head.skeleton)
    carried = linear_blend_skinning(garment.vertices, weights, transforms)
    assert np.abs(posed - carried)[:, garment.pinned].max() < 1e-5
    assert np.abs(posed - carried)[:, ~garment.pinned].max() > 1e-3


def test_place_and_heading_of_the_first_frame_do_not_matter(head):
    garment, motion = sleeve(0.115, pinned=True), swinging()
    config = replace(AT_ONCE, settle=0.2, lead=0.2)
    turn, shift = Rotation.from_rotvec([0, 0, 2.5]), np.array([3, -1, 0.5])
    rotations = motion.rotations.copy()
    rotations[:, 0] = (turn * Rotation.from_rotvec(rotations[:, 0])).as_rotvec()
    moved = Motion.create(rotations, NAMES, np.tile(shift, (len(motion), 1)))
    here, there = (
        simulate(garment, head, each, config).posed for each in (motion, moved)
    )
    # Where cloth folds, rounding decides to which side.
    assert rms(there, here @ turn.as_matrix().T + shift) < 1e-3
    roots = [each.transforms(head.skeleton)[:, 0] for each in (motion, moved)]
    assert rms(root_frame(here, roots[0]), root_frame(there, roots[1])) < 1e-3


def test_a_skirt_touches_legs_and_spine_but_neither_arms_nor_head():
    body = read_body().head
    skirt = read_garment(sample("skirt.npz"))
    names = np.array(body.skeleton.names)
    touched = set(names[touched_bones(skirt, body)])
    assert {"pelvis.L", "upperleg01.R", "lowerleg02.L", "foot.R"} <= touched
    assert {"spine05", "spine01"} <= touched
    assert not {n for n in touched if n.startswith(("arm", "wrist", "clav", "head"))}
    shirt = read_garment(sample("t_shirt.npz"))
    assert {"wrist.L", "head"} <= set(names[touched_bones(shirt, body)])
    part = obstacle(skirt, body, ("foot.L",))
    assert 0 < len(part.vertices) < 1000 and part.points[:, 2].max() < -0.5


# --- the same again -------------------------------------------------------------------


def test_twice_the_same_bits(head):
    garment, config = sleeve(0.115, pinned=True), replace(AT_ONCE, settle=0.1)
    first, again = (simulate(garment, head, swinging(), config) for _ in range(2))
    assert isinstance(first, Simulation)
    assert np.array_equal(first.posed, again.posed)
    assert np.array_equal(first.rest, again.rest)
    known = simulate(garment, head, swinging(), config, first.rest)
    assert np.array_equal(first.posed, known.posed)


@pytest.fixture
def job(head) -> tuple:
    motions = [swinging(0), swinging(1), still(5)]
    return sleeve(0.115, pinned=True), head, motions, replace(AT_ONCE, settle=0.1)


def test_an_interrupted_data_set_goes_on_to_the_same_bits(job, tmp_path, monkeypatch):
    garment, head, motions, config = job
    whole = simulate_motions(garment, head, motions, tmp_path / "whole", config)
    frames = simulation.Simulator.frames

    def stopping(self, motion, start):
        for number, posed in enumerate(frames(self, motion, start)):
            if motion is motions[1] and number == 6:
                raise KeyboardInterrupt
            yield posed

    monkeypatch.setattr(simulation.Simulator, "frames", stopping)
    out = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        simulate_motions(garment, head, motions, out, config)
    kept = {p.name: p.stat().st_mtime_ns for p in out.iterdir()}
    assert set(kept) == {"simulation.json", "motion_0000.npz"}
    monkeypatch.undo()
    paths = simulate_motions(garment, head, motions, out, config)
    assert paths[0].stat().st_mtime_ns == kept["motion_0000.npz"]
    assert [p.read_bytes() for p in paths] == [p.read_bytes() for p in whole]

    simulated = read_simulated(paths[1])
    assert simulated.motion.name == "swing"
    assert np.array_equal(simulated.motion.rotations, motions[1].rotations)
    posed, rest = simulate(garment, head, motions[1], config)
    assert np.array_equal(simulated.posed, posed)
    assert np.array_equal(simulated.rest, rest)


@pytest.mark.slow
def test_two_processes_make_what_one_makes(job, tmp_path):
    garment, head, motions, config = job
    one = simulate_motions(garment, head, motions, tmp_path / "one", config)
    two = simulate_motions(garment, head, motions, tmp_path / "two", config, workers=2)
    assert [p.read_bytes() for p in one] == [p.read_bytes() for p in two]


POOL = """
import os, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from skinlib.garments.simulation import _end_with_parent

if __name__ == "__main__":
    with ProcessPoolExecutor(1, get_context("spawn"), _end_with_parent) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        time.sleep(60)
"""


def test_workers_end_with_a_killed_command(tmp_path):
    script = tmp_path / "pool.py"
    script.write_text(POOL)
    with subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as command:
        worker = Path("/proc", command.stdout.readline().decode().strip())
        if not worker.exists():
            pytest.skip("there is no /proc to look into")
        command.kill()
    end = time.monotonic() + 20
    while worker.exists() and time.monotonic() < end:
        time.sleep(0.1)
    assert not worker.exists()


def test_a_motion_that_does_not_fit_leaves_nothing_behind(job, tmp_path):
    garment, head, motions, config = job
    other = Motion.create(np.zeros((3, 1, 3)), ["alone"])
    with pytest.raises(HeadError, match="the motion has 'alone'"):
        simulate_motions(garment, head, [*motions, other], tmp_path / "new", config)
    assert not (tmp_path / "new").exists()


def test_a_folder_holds_one_data_set(job, tmp_path):
    garment, head, motions, config = job
    motions = motions[2:]
    (path,) = simulate_motions(garment, head, motions, tmp_path, config)
    with pytest.raises(HeadError, match="friction: another simulation"):
        simulate_motions(
            garment, head, motions, tmp_path, replace(config, friction=0.1)
        )
    with pytest.raises(HeadError, match="garment: another simulation"):
        simulate_motions(sleeve(0.12), head, motions, tmp_path, config)
    with pytest.raises(HeadError, match="motion: another one was simulated here"):
        simulate_motions(garment, head, [swinging()], tmp_path, config)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(HeadError, match="Delete the file"):
        simulate_motions(garment, head, motions, tmp_path, config)
    (tmp_path / "simulation.json").write_text(json.dumps([1]))
    with pytest.raises(HeadError, match="new folder"):
        simulate_motions(garment, head, motions, tmp_path, config)


# --- measures -------------------------------------------------------------------------


def test_simulations_of_another_garment_or_body_are_not_taken(job, tmp_path):
    garment, head, motions, config = job
    simulate_motions(garment, head, motions[2:], tmp_path, config)
    check_simulated(tmp_path, garment, head)
    with pytest.raises(HeadError, match="garment: it is another one"):
        check_simulated(tmp_path, sleeve(0.115, pinned=False), head)
    taller = Head.create(
        head.vertices * 1.01, head.faces, head.skeleton, weights=head.weights
    )
    with pytest.raises(HeadError, match="body: it is another one"):
        check_simulated(tmp_path, garment, taller)
    (tmp_path / "simulation.json").write_text("[")
    with pytest.raises(HeadError, match="simulation: it cannot be read"):
        check_simulated(tmp_path, garment, head)
    (tmp_path / "simulation.json").unlink()
    check_simulated(tmp_path, garment, taller)  # by another simulator


def test_strain_of_known_lengths():
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    posed = np.stack([rest, rest * [2, 1, 1]])
    measured = strain(posed, rest, np.array([[0, 1, 2]]))
    diagonal = np.sqrt(5 / 2) - 1
    assert measured.mean == pytest.approx((1 + diagonal) / 6)
    assert measured.largest == pytest.approx(1)


def test_predictability_of_a_wave_and_of_noise():
    phase = 2 * np.pi * np.arange(40) / 10
    wave = np.zeros((40, 5, 3))
    wave[..., 0] = np.sin(phase)[:, None]
    floor, deviation = predictability(wave, 10)
    assert floor == pytest.approx(0, abs=1e-12)
    assert deviation == pytest.approx(np.sqrt(1 / 2))
    noise = np.random.default_rng(0).normal(size=(400, 5, 3))
    floor, deviation = predictability(noise, 10)
    assert floor / deviation == pytest.approx(np.sqrt(2), rel=0.05)
    assert rms(wave, wave + np.array([3, 4, 0])) == pytest.approx(5)
    with pytest.raises(HeadError, match="period"):
        predictability(wave, 40)


def test_colours_share_no_vertex():
    rng = np.random.default_rng(0)
    pairs = np.unique(np.sort(rng.integers(0, 40, (200, 2)), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    colours = colour_pairs(pairs)
    for colour in range(colours.max() + 1):
        ends = pairs[colours == colour].ravel()
        assert len(ends) == len(set(ends.tolist())) > 0
    assert colours.max() < 2 * np.bincount(pairs.ravel()).max()


# --- bad input ------------------------------------------------------------------------


def test_what_nothing_holds_is_told(head):
    with pytest.raises(HeadError, match="pinned: nothing holds the garment"):
        simulate(sheet(), head, still(2), SimulationConfig(settle=0.5))


@pytest.mark.parametrize(
    ("name", "value"),
    [("rate", 0), ("density", 0), ("smoothing", -1), ("friction", float("nan"))],
)
def test_settings_out_of_range_are_told(name, value):
    with pytest.raises(HeadError, match=f"{name}: it is"):
        SimulationConfig(**{name: value})


def test_other_input_that_does_not_fit_is_told(head):
    garment = sleeve(0.115, pinned=True)
    with pytest.raises(HeadError, match="Use a motion made for this"):
        simulate(garment, head, still(2, ("a", "b", "c")), AT_ONCE)
    with pytest.raises(HeadError, match="NaN"):
        Motion.create(np.full((2, 3, 3), np.nan), NAMES)
    with pytest.raises(HeadError, match="start: "):
        start = np.full_like(garment.vertices, np.nan)
        simulate(garment, head, still(2), AT_ONCE, start)
    with pytest.raises(HeadError, match="no bone 'tail'"):
        simulate(garment, head, still(2), replace(AT_ONCE, bones=("tail",)))
    with pytest.raises(HeadError, match="weights"):
        simulate(garment, head.replace(weights=None), still(2), AT_ONCE)


def test_without_warp_it_says_what_to_install(head, monkeypatch):
    monkeypatch.setitem(sys.modules, "warp", None)
    simulation._kernels.cache_clear()
    with pytest.raises(HeadError, match="pip install warp-lang"):
        simulate(sheet(), head, still(2), AT_ONCE)


def test_quiet_hides_what_native_code_says(capfd):
    with quiet():
        os.write(2, b"nobody hears this")
    os.write(2, b"but this")
    assert capfd.readouterr().err == "but this"
    with pytest.raises(KeyError), quiet():
        raise KeyError
    os.write(2, b"and this")
    assert capfd.readouterr().err == "and this"
