"""A garment on virtual bones: bound, learnt, streamed, exported, kept and judged."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_animation import Player, upright
from test_body import NAMES, sleeve, small_body
from test_virtual_bones import smoothly

from skinlib.garments import loose
from skinlib.garments.binding import closest_point_weights, smooth
from skinlib.garments.body import read_body
from skinlib.garments.garment import write_garment
from skinlib.garments.loose import (
    KIND,
    LooseConfig,
    LooseTrainer,
    bind,
    errors,
    fading_heat,
    is_loose,
    load_loose,
    random_walks,
    read_simulations,
    save_loose,
    simulation_motions,
    train,
)
from skinlib.garments.motion import Motion
from skinlib.garments.outfit import load_outfit
from skinlib.garments.simulation import Simulated, inside, obstacle
from skinlib.garments.virtual_bones import VirtualBonesConfig, heat_weights
from skinlib.geometry import mesh_edges
from skinlib.head import HeadError
from skinlib.skinning import linear_blend_skinning
from skinlib.training.checkpoint import read_tensors, write_tensors

BODY, CLOTH = small_body(), sleeve(0.15, pinned=True)
SMALL = VirtualBonesConfig(hidden=8)
CONFIG = LooseConfig(
    bones=6,
    influences=3,
    steps=6,
    batch=3,
    window=8,
    unscored=2,
    collision=0,  # the sleeve swings as if there were no body
    threads=1,
    network=SMALL,
)
STATE, MODEL = "training.safetensors", "model.safetensors"


def swaying(frames: int = 24, seed: int = 0) -> Simulated:
    """As if simulated: skinned, and its lower hem swings sideways."""
    motion = smoothly(frames, seed)
    weights = smooth(closest_point_weights(CLOTH, BODY.head), CLOTH.faces, 5)
    rest = CLOTH.vertices.copy()
    below = (0.8 - rest[:, 2:]) ** 2
    swing = 0.3 * np.sin(np.arange(frames) / 4 + seed)[:, None, None] * below
    points = rest + swing * [1, 0, 0]
    transforms = motion.transforms(BODY.head.skeleton)
    posed = map(linear_blend_skinning, points, [weights] * frames, transforms)
    return Simulated(motion, np.stack(list(posed)).astype(np.float32), rest)


@pytest.fixture(scope="module")
def simulated() -> list[Simulated]:
    return [swaying(24, 0), swaying(30, 1), swaying(24, 2)]


@pytest.fixture(autouse=True)
def one_thread():
    """Sums in several threads may differ in their last bits."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def trained(simulated, tmp_path_factory):
    """A folder and what was trained into it, long enough to move."""
    folder = tmp_path_factory.mktemp("loose")
    config = replace(CONFIG, steps=100, learning_rate=1e-2)
    return folder, train(config, BODY, CLOTH, simulated, folder)


def same(a, b) -> bool:
    """Whether two garments are the same to the bit."""
    one, two = a.network.state_dict(), b.network.state_dict()
    return all(torch.equal(one[key], two[key]) for key in one) and all(
        np.array_equal(getattr(a, name), getattr(b, name)) for name in a.ARRAYS
    )


# --- binding --------------------------------------------------------------------------


def test_virtual_bones_have_what_is_loose_and_joints_the_rest(simulated):
    garment = bind(replace(CONFIG, threshold=0.04), BODY, CLOTH, simulated)
    assert np.abs(garment.weights.sum(axis=1) - 1).max() < 1e-6
    share = garment.weights[:, :6].sum(axis=1)
    height = CLOTH.vertices[:, 2]
    assert share[height < 0.3].min() > 0.9 and share[height > 0.75].mean() < 0.2
    alone = bind(replace(CONFIG, hybrid=False), BODY, CLOTH, simulated)
    assert len(alone.joints) == 0 and alone.weights.shape == (len(height), 6)
    stiff = bind(replace(CONFIG, threshold=9.0), BODY, CLOTH, simulated)
    assert np.abs(stiff.weights[:, :6]).max() == 0


def test_bones_sit_on_what_is_loose(simulated):
    garment = bind(replace(CONFIG, threshold=0.04), BODY, CLOTH, simulated)
    share = garment.weights[:, :6].sum(axis=1)
    assert share[garment.bones].min() > 0.5 > share.min()
    alone = bind(replace(CONFIG, hybrid=False), BODY, CLOTH, simulated)
    assert alone.rest[alone.bones, 2].max() > garment.rest[garment.bones, 2].max()
    stiff = bind(replace(CONFIG, threshold=9.0), BODY, CLOTH, simulated)
    assert np.array_equal(stiff.bones, alone.bones)  # nowhere else to be


def test_without_joints_the_root_carries_the_bones(simulated):
    garment = bind(replace(CONFIG, hybrid=False, carry=False), BODY, CLOTH, simulated)
    motion = simulated[1].motion
    rigid = garment.baselines(motion)["rigid"]
    assert np.abs(garment.pose(motion) - rigid).max() < 1e-5


def test_where_nothing_is_loose_the_garment_is_skinned(simulated):
    stiff = bind(replace(CONFIG, threshold=9.0, least=0), BODY, CLOTH, simulated)
    motion = simulated[1].motion
    expected = stiff.baselines(motion)["skinning alone"]
    assert np.abs(stiff.pose(motion) - expected).max() < 1e-5


def test_the_mean_drape_is_a_mean_in_the_frame_of_the_root(simulated):
    garment = bind(CONFIG, BODY, CLOTH, simulated[:1])
    motion, posed, _ = simulated[0]
    roots = motion.transforms(BODY.head.skeleton)[:, 0].astype(np.float64)
    points = np.concatenate([posed, np.ones((*posed.shape[:2], 1))], axis=-1)
    local = points @ np.linalg.inv(roots).swapaxes(1, 2)
    assert np.abs(garment.drape - local[..., :3].mean(axis=0)).max() < 1e-5
    found = garment.baselines(motion)
    assert (
        np.abs(
            found["rigid"]
            - (CLOTH.vertices @ roots[:, :3, :3].swapaxes(1, 2) + roots[:, None, :3, 3])
        ).max()
        < 1e-5
    )
    assert found["mean drape"].shape == posed.shape


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: [], "simulated: there is nothing"),
        (lambda s: [s[0]._replace(posed=s[0].posed[:, 1:])], "311 vertices, and 312"),
        (lambda s: [s[0], s[1]._replace(rest=s[1].rest + 1)], "does not hang alike"),
        (
            lambda s: [s[0], s[1]._replace(motion=replace(s[1].motion, fps=15.0))],
            "15 and 30|30 and 15",
        ),
        (lambda s: [swaying(7)], "a motion of 7 frames"),
        (
            lambda s: [s[0]._replace(motion=Motion.create(np.zeros((24, 1, 3)), "a"))],
            "bone_names",
        ),
        (lambda s: [s[0]._replace(posed=s[0].posed * np.nan)], "simulated: .*NaN"),
    ],
)
def test_simulations_that_do_not_fit_are_refused(simulated, tmp_path, change, message):
    with pytest.raises(HeadError, match=message):
        train(CONFIG, BODY, CLOTH, change(simulated), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"steps": 0}, "steps"),
        ({"batch": 0}, "batch"),
        ({"unscored": -1}, "unscored"),
        ({"unscored": 8}, "unscored"),
        ({"bones": 0}, "bones"),
        ({"edges": -1.0}, "edges"),
        ({"collision": float("nan")}, "collision"),
        ({"alpha": -1.0}, "alpha"),
        ({"kernel": "box"}, "kernel"),
        ({"reduce": "max"}, "reduce"),
    ],
)
def test_settings_out_of_range_are_told(simulated, changes, field):
    with pytest.raises(HeadError, match=f"^{field}: "):
        bind(replace(CONFIG, **changes), BODY, CLOTH, simulated)


def test_bones_fade_out_before_others_take_their_place():
    """Along a line with a bone at each whole number, weights are continuous."""
    places = np.linspace(0, 9, 2001)[:, None]
    distances = np.abs(places - np.arange(10))
    steps = {}
    for shares in (fading_heat, heat_weights):
        weights = shares(distances, 1.0, 3)
        assert np.abs(weights.sum(axis=1) - 1).max() < 1e-6
        assert (weights > 0).sum(axis=1).max() <= 3
        steps[shares] = np.abs(np.diff(weights, axis=0)).max()
    assert steps[fading_heat] < 0.01 and steps[heat_weights] > 0.04
    # All bones that there are, and bones that are all as far away.
    assert np.array_equal(
        fading_heat(distances, 1.0, 10), heat_weights(distances, 1.0, 10)
    )
    even = fading_heat(np.ones((1, 4)), 1.0, 2)
    assert sorted(even[0].tolist()) == [0, 0, 0.5, 0.5]


# --- training -------------------------------------------------------------------------


def test_the_same_call_gives_the_same_bits(simulated, tmp_path):
    first = train(CONFIG, BODY, CLOTH, simulated, tmp_path / "a")
    assert same(first, train(CONFIG, BODY, CLOTH, simulated, tmp_path / "b"))
    other = replace(CONFIG, seed=1)
    assert not same(first, train(other, BODY, CLOTH, simulated, tmp_path / "c"))
    again = train(CONFIG, BODY, CLOTH, simulated, tmp_path / "a")
    assert same(first, again) and same(first, load_loose(tmp_path / "a"))


@pytest.mark.parametrize(("steps", "collision"), [(0, 0), (1, 30), (4, 0)])
def test_an_interrupted_run_ends_in_the_same_bits(
    simulated, tmp_path, monkeypatch, steps, collision
):
    config = replace(CONFIG, collision=collision)
    whole = train(config, BODY, CLOTH, simulated, tmp_path / "whole")
    step = LooseTrainer.step

    def stopping(self):
        if self.steps_done == steps:
            raise KeyboardInterrupt
        return step(self)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(LooseTrainer, "step", stopping)
        train(config, BODY, CLOTH, simulated, tmp_path / "run")
    with pytest.raises(HeadError, match="its training has not ended"):
        load_loose(tmp_path / "run")
    trainer = LooseTrainer(config, BODY, CLOTH, simulated, tmp_path / "run")
    assert trainer.steps_done == steps
    trainer.run()
    assert same(trainer.garment, whole)
    states = [read_tensors(tmp_path / name / STATE)[0] for name in ("whole", "run")]
    assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 1}, "^[^:]*: seed: another run"),
        ({"hybrid": False}, "hybrid: another run"),
        ({"network": replace(SMALL, rotate=False)}, "network: another run"),
    ],
)
def test_another_run_is_kept_from_the_folder(trained, simulated, changes, message):
    folder, _ = trained
    before = (folder / STATE).read_bytes()
    config = replace(CONFIG, steps=100, learning_rate=1e-2)
    with pytest.raises(HeadError, match=message):
        train(replace(config, **changes), BODY, CLOTH, simulated, folder)
    with pytest.raises(HeadError, match=r"motions.*simulated: another run"):
        train(config, BODY, CLOTH, simulated[:2], folder)
    train(replace(config, threads=2), BODY, CLOTH, simulated, folder)
    assert (folder / STATE).read_bytes() == before


def test_it_learns(trained, simulated):
    _, garment = trained
    found = errors(garment, simulated)
    untrained = errors(bind(CONFIG, BODY, CLOTH, simulated), simulated, False)
    assert list(untrained) == [KIND]
    assert found[KIND] < 0.5 * untrained[KIND]
    assert found[KIND] < 0.6 * min(v for k, v in found.items() if k != KIND)


def test_errors_by_hand(trained, simulated):
    _, garment = trained
    motion = simulated[0].motion
    posed = garment.pose(motion) + np.array([0.003, 0, 0.004])
    shifted = [Simulated(motion, posed, garment.rest)]
    few = motion.rotations[:8], NAMES, motion.translations[:8], 30.0
    few = Motion.create(*few)
    shifted.append(Simulated(few, garment.pose(few), garment.rest))
    # 24 frames are 5 mm off and 8 frames are right.
    assert errors(garment, shifted, False)[KIND] == pytest.approx(5 * 0.75**0.5, 1e-3)


def test_errors_of_edges_keep_the_cloth_whole(simulated, tmp_path):
    torn = {}
    for weight in (0.0, 30.0):
        config = replace(CONFIG, steps=200, learning_rate=1e-2, edges=weight)
        folder = tmp_path / str(weight)
        garment = train(config, BODY, CLOTH, simulated, folder)
        off = garment.pose(simulated[1].motion) - simulated[1].posed
        a, b = mesh_edges(CLOTH.faces).T
        torn[weight] = np.square(off[:, a] - off[:, b]).mean()
    assert torn[30.0] < 0.95 * torn[0.0]


def test_cloth_is_kept_off_the_body(simulated, tmp_path):
    deep = {}
    part = obstacle(CLOTH, BODY.head)
    for weight in (0, 30):
        config = replace(CONFIG, steps=100, learning_rate=1e-2, collision=weight)
        garment = train(config, BODY, CLOTH, simulated, tmp_path / str(weight))
        motion = simulated[1].motion
        deep[weight] = inside(garment.pose(motion), motion, BODY.head, part).mean()
    assert deep[30] < 0.5 * deep[0]


def test_an_error_of_nan_stops_before_it_does_harm(simulated, tmp_path):
    trainer = LooseTrainer(CONFIG, BODY, CLOTH, simulated, tmp_path)
    trainer.loss.goals[:] = torch.nan
    before = [p.clone() for p in trainer.parameters]
    with pytest.raises(FloatingPointError, match="step 0 is not finite"):
        trainer.step()
    assert all(map(torch.equal, before, trainer.parameters))


def test_windows_never_reach_into_the_next_motion(simulated, tmp_path):
    starts = LooseTrainer(CONFIG, BODY, CLOTH, simulated, tmp_path).starts
    expected = [*range(0, 17), *range(24, 47), *range(54, 71)]
    assert starts.tolist() == expected


# --- posing ---------------------------------------------------------------------------


def test_a_stream_equals_the_batch(trained):
    _, garment = trained
    motion = smoothly(90, 5)
    frames = motion.transforms(BODY.head.skeleton)
    streamed = []
    for posed in garment.stream(iter(frames), motion.fps):
        streamed.append(posed)
        assert not torch.is_inference_mode_enabled()
    assert np.abs(streamed - garment.pose(motion)).max() < 1e-5


def test_where_the_body_stands_and_faces_makes_no_difference(trained):
    _, garment = trained
    motion = smoothly(40, 6)
    shift = np.array([3, -2, 0])
    moved = Motion.create(motion.rotations, NAMES, motion.translations + shift, 30)
    posed, other = garment.pose(motion), garment.pose(moved)
    assert np.abs(posed + shift - other).max() < 1e-5


def test_a_glb_moves_by_its_bones_as_the_network_says(trained, tmp_path):
    _, garment = trained
    motion = smoothly(9, 3)
    garment.export(tmp_path / "a.glb", motion)
    posed = garment.pose(motion)
    player = Player(tmp_path / "a.glb")
    assert {"virtual_00", "virtual_05", *NAMES} <= player.nodes.keys()
    assert not player.primitive("sleeve").targets
    transforms = motion.transforms(BODY.head.skeleton)
    head = BODY.head
    skin = linear_blend_skinning(head.vertices, head.weights, transforms)
    for frame in range(9):
        found = player.vertices("sleeve", frame)
        assert np.abs(found - upright(posed[frame])).max() < 1e-4
        found = player.vertices("body", frame)
        assert np.abs(found - upright(skin[frame])).max() < 1e-4
    assert np.abs(player.vertices("sleeve", None) - upright(garment.rest)).max() < 1e-6


def test_names_of_bones_are_never_taken():
    assert loose._bone_names(["a"], 2) == ["virtual_00", "virtual_01"]
    assert loose._bone_names(["virtual_00"], 1) == ["virtual__00"]


def test_a_motion_of_other_bones_is_refused(trained, tmp_path):
    _, garment = trained
    motion = Motion.create(np.zeros((2, 1, 3)), ["root"])
    for call in (
        garment.pose,
        garment.baselines,
        lambda motion: garment.export(tmp_path / "a.glb", motion),
    ):
        with pytest.raises(HeadError, match="bone_names"):
            call(motion)
    with pytest.raises(HeadError, match=r"no.a\.glb"):
        garment.export(tmp_path / "no" / "a.glb", smoothly(3))
    assert not list(tmp_path.iterdir())


# --- folders --------------------------------------------------------------------------


def test_a_folder_holds_all_of_it(trained, tmp_path):
    folder, garment = trained
    assert is_loose(folder) and not is_loose(tmp_path)
    found = load_loose(folder)
    motion = smoothly(12, 4)
    assert np.array_equal(found.pose(motion), garment.pose(motion))
    assert found.garment.name == "sleeve"
    assert np.array_equal(found.garment.pinned, CLOTH.pinned)
    config = json.loads((folder / "config.json").read_text())
    assert config["training"]["bones"] == 6 and config["kind"] == KIND
    history = json.loads((folder / "history.json").read_text())
    assert [entry["step"] for entry in history] == [100] and history[0]["mm"] > 0
    save_loose(tmp_path / "again", found, {})
    assert same(load_loose(tmp_path / "again"), garment)
    with pytest.raises(HeadError, match="no outfit"):
        load_outfit(folder)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", "model.safetensors: garment: there is no such file"),
        ("cut off", "model.safetensors: checkpoint: it cannot be read"),
        ("no configuration", "no garment on virtual bones"),
        ("a tensor less", "no garment on virtual bones"),
        ("another garment", "do not belong together"),
        ("another bone", "do not belong together"),
    ],
)
def test_a_damaged_folder_is_one_error(trained, tmp_path, kind, message):
    _, garment = trained
    save_loose(tmp_path, garment, {})
    path = tmp_path / MODEL
    tensors, metadata = read_tensors(path)
    if kind == "missing":
        path.unlink()
    elif kind == "cut off":
        path.write_bytes(path.read_bytes()[:100])
    elif kind == "no configuration":
        write_tensors(path, tensors, {})
    elif kind == "a tensor less":
        write_tensors(path, {k: v for k, v in tensors.items() if k != "rest"}, metadata)
    elif kind == "another garment":
        short = sleeve(0.15)
        used = short.faces[:200].max() + 1
        faces = short.faces[(short.faces < used).all(axis=1)]
        short = type(short).create(short.vertices[:used], faces)
        write_garment(tmp_path / "garment.npz", short)
    elif kind == "another bone":
        tensors["read"] = tensors["read"] + 7
        write_tensors(path, tensors, metadata)
    with pytest.raises(HeadError, match=message):
        load_loose(tmp_path)


def test_a_folder_without_simulations(tmp_path):
    with pytest.raises(HeadError, match="simulated: there is no simulation in it"):
        read_simulations(tmp_path)


# --- motions --------------------------------------------------------------------------


def test_motions_to_simulate_grow_without_changing():
    skeleton = read_body().head.skeleton
    few, more = (simulation_motions(skeleton, 3, count) for count in (6, 9))
    assert [m.name for m in more] == [*["walk"] * 7, "turn", "walk"]
    for one, two in zip(few, more, strict=False):
        assert np.array_equal(one.rotations, two.rotations)
    walks = random_walks(skeleton, 4, 2)
    assert not np.array_equal(walks[0].rotations[1], walks[1].rotations[1])
    assert all(80 < len(motion) < 130 for motion in walks)
