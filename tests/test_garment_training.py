"""Training a garment: it goes on to the bit, it lowers its energies, it can be told."""

import json
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from test_body import bends, sleeve, small_body
from test_outfit import band

from skinlib.garments import training
from skinlib.garments.binding import signed_distance
from skinlib.garments.collision import vertex_normals
from skinlib.garments.energies import EnergyWeights, total_energy
from skinlib.garments.garment import Garment
from skinlib.garments.motion import Motion, mirrored
from skinlib.garments.outfit import Outfit, load_outfit
from skinlib.garments.pbns import PBNSConfig
from skinlib.garments.training import (
    GarmentConfig,
    Trainer,
    layer_energy,
    train,
    training_poses,
)
from skinlib.head import HeadError
from skinlib.skinning import linear_blend_skinning

SMALL = PBNSConfig(hidden=8, embedding=6, layers=3)
CONFIG = GarmentConfig(steps=6, batch=4, smoothing=2, threads=1, network=SMALL)
STATE, MODEL = "training.safetensors", "model.safetensors"


@pytest.fixture(scope="module")
def outfit() -> Outfit:
    return Outfit.create(small_body(), [sleeve(0.115)])


@pytest.fixture(scope="module")
def layers() -> Outfit:
    return Outfit.create(small_body(), [sleeve(0.115), band(0.13)])


@pytest.fixture(autouse=True)
def one_thread():
    """Sums in several threads may differ in their last bits."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def same(a, b) -> bool:
    """Whether two networks are the same to the bit."""
    a, b = a.state_dict(), b.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def stop_after(monkeypatch, steps: int) -> None:
    """Ctrl-C, when so many steps are done."""
    step = Trainer.step

    def stopping(self):
        if self.steps_done == steps:
            raise KeyboardInterrupt
        return step(self)

    monkeypatch.setattr(Trainer, "step", stopping)


# --- the same run ---------------------------------------------------------------------


def test_the_same_call_gives_the_same_bits(outfit, tmp_path):
    first = train(CONFIG, outfit, tmp_path / "a", bends())
    assert same(first, train(CONFIG, outfit, tmp_path / "b", bends()))
    other = replace(CONFIG, seed=1)
    assert not same(first, train(other, outfit, tmp_path / "c", bends()))
    # After its end, a run is only told again.
    again = train(CONFIG, outfit, tmp_path / "a", bends())
    assert same(first, again)


@pytest.mark.parametrize("steps", [0, 1, 4])
@pytest.mark.parametrize("shapes", [False, True])
def test_an_interrupted_run_ends_in_the_same_bits(
    layers, tmp_path, monkeypatch, steps, shapes
):
    config = replace(CONFIG, shapes=shapes)
    whole = train(config, layers, tmp_path / "whole", bends())
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        stop_after(patch, steps)
        train(config, layers, tmp_path / "run", bends())
    assert (tmp_path / "run" / STATE).is_file()
    with pytest.raises(HeadError, match="its training has not ended"):
        load_outfit(tmp_path / "run")
    trainer = Trainer(config, layers, tmp_path / "run", bends())
    assert trainer.steps_done == steps
    assert same(trainer.run(), whole)
    states = [load_file(tmp_path / name / STATE) for name in ("whole", "run")]
    assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])


def test_a_killed_run_goes_on_from_what_it_had_saved(outfit, tmp_path):
    whole = train(CONFIG, outfit, tmp_path / "whole", bends())
    killed = Trainer(CONFIG, outfit, tmp_path / "run", bends())
    (tmp_path / "run").mkdir()
    for _ in range(3):
        killed.step()
    killed.save()
    killed.step()  # lost
    for file in (tmp_path / "run").iterdir():
        if file.name != STATE:
            file.unlink()
    trainer = Trainer(CONFIG, outfit, tmp_path / "run", bends())
    assert trainer.steps_done == 3 and trainer.recent
    assert same(trainer.run(), whole)


def test_the_state_is_saved_again_and_again(outfit, tmp_path, monkeypatch):
    saved = []
    monkeypatch.setattr(Trainer, "save", lambda self: saved.append(self.steps_done))
    train(replace(CONFIG, save_seconds=0), outfit, tmp_path, bends())
    assert saved == [1, 2, 3, 4, 5, 6, 6]
    saved.clear()
    train(CONFIG, outfit, tmp_path, bends())
    assert saved == [6]


def test_a_signal_waits_for_the_end_of_an_update(outfit, tmp_path, monkeypatch):
    trainer = Trainer(CONFIG, outfit, tmp_path, bends())
    step = torch.optim.Adam.step

    def struck(self, *args):
        signal.raise_signal(signal.SIGINT)
        return step(self, *args)

    monkeypatch.setattr(torch.optim.Adam, "step", struck)
    # Where tests run in the background, the signal is ignored.
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            trainer.step()
    finally:
        signal.signal(signal.SIGINT, usual)
    assert trainer.steps_done == 1 and trainer.recent
    assert trainer.network.columns.abs().max() > 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 1}, "seed: another run, with other settings or data"),
        ({"steps": 7}, "steps: another run"),
        ({"shapes": True}, "shapes: another run"),
        ({"energies": EnergyWeights(bend=1)}, "energies: another run"),
        ({"network": PBNSConfig(hidden=9)}, "network: another run"),
    ],
)
def test_another_run_is_kept_from_the_folder(outfit, tmp_path, change, message):
    train(CONFIG, outfit, tmp_path, bends())
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(HeadError, match=message):
        train(replace(CONFIG, **change), outfit, tmp_path, bends())
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def backwards(garment: Garment) -> Garment:
    """The same cloth with its faces in another order."""
    return Garment.create(garment.vertices, garment.faces[::-1], name=garment.name)


def moved_joints(body):
    bones = body.head.skeleton
    joints = bones.joints + np.float32([0, 0, 0.01])
    bones = bones.from_heads_and_tails(joints, None, bones.parents, bones.names)
    return replace(body, head=body.head.replace(skeleton=bones))


@pytest.mark.parametrize(
    "change",
    [
        lambda o, p: (Outfit(o.body, (sleeve(0.116),)), p),
        lambda o, p: (Outfit(o.body, (sleeve(0.115, pinned=True),)), p),
        lambda o, p: (Outfit(o.body, (sleeve(0.115), band())), p),
        lambda o, p: (Outfit(o.body, (backwards(o.garments[0]),)), p),
        lambda o, p: (o, Motion.create(-p.rotations, p.bone_names, p.translations)),
        lambda o, p: (o, Motion.create(p.rotations, p.bone_names)),
        lambda o, p: (Outfit(moved_joints(o.body), o.garments), p),
        lambda o, p: (
            Outfit(
                replace(
                    o.body,
                    head=o.body.head.replace(weights=o.body.head.weights[:, ::-1]),
                ),
                o.garments,
            ),
            p,
        ),
    ],
    ids="garment pins garments faces poses path joints weights".split(),
)
def test_other_meshes_are_another_run(outfit, tmp_path, change):
    train(CONFIG, outfit, tmp_path, bends())
    with pytest.raises(HeadError, match="another run"):
        other, poses = change(outfit, bends())
        train(CONFIG, other, tmp_path, poses)


def test_machine_settings_may_change(outfit, tmp_path):
    train(CONFIG, outfit, tmp_path, bends())
    again = replace(CONFIG, threads=2, save_seconds=1.0)
    assert train(again, outfit, tmp_path, bends()) is not None


@pytest.mark.parametrize("content", [b"", b"no state", None])
def test_a_damaged_state_is_one_error(outfit, tmp_path, content):
    train(CONFIG, outfit, tmp_path, bends())
    whole = (tmp_path / STATE).read_bytes()
    if content is None:  # that of a network
        content = (tmp_path / MODEL).read_bytes()
    (tmp_path / STATE).write_bytes(content)
    with pytest.raises(HeadError, match=r"training\.safetensors: checkpoint"):
        train(CONFIG, outfit, tmp_path, bends())
    (tmp_path / STATE).write_bytes(whole[:-100])
    with pytest.raises(HeadError, match="cannot be read"):
        train(CONFIG, outfit, tmp_path, bends())


# --- poses ----------------------------------------------------------------------------


@pytest.fixture
def drawn(monkeypatch) -> list:
    """The counts of poses that were drawn."""
    counts = []

    def random_poses(skeleton, count, seed, *_):
        counts.append(count)
        return bends(count, seed)

    monkeypatch.setattr(training, "random_poses", random_poses)
    return counts


def test_random_poses_are_kept_and_used_again(outfit, tmp_path, monkeypatch, drawn):
    config = replace(CONFIG, poses=9)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        stop_after(patch, 2)
        train(config, outfit, tmp_path / "run")
    assert drawn == [9] and (tmp_path / "run" / "poses.npz").is_file()
    found = train(config, outfit, tmp_path / "run")
    assert drawn == [9]
    assert same(found, train(config, outfit, tmp_path / "whole"))
    both = training_poses(outfit.body.head, 9, 0, 0.0)
    assert len(both) == 18 and np.array_equal(both.rotations[:9], bends(9).rotations)
    assert np.array_equal(both.translations[9:], mirrored(bends(9)).translations)
    assert same(found, train(config, outfit, tmp_path / "given", both))


def test_another_count_of_poses_is_another_run(outfit, tmp_path, drawn):
    train(replace(CONFIG, poses=9), outfit, tmp_path)
    with pytest.raises(HeadError, match="poses: another run"):
        train(replace(CONFIG, poses=10), outfit, tmp_path)


# --- energies -------------------------------------------------------------------------


def test_energies_fall(layers, tmp_path):
    config = replace(CONFIG, steps=30, batch=8, learning_rate=5e-3)
    trainer = Trainer(config, layers, tmp_path, bends())
    everything = np.arange(12)

    def total():
        with torch.no_grad():
            terms = trainer.energies(everything)
        return total_energy(terms, config.energies).mean().item()

    before = total()
    trainer.run()
    assert total() < before - 0.02  # joules


def test_steps_tell_weighted_means_and_remember_them(outfit, tmp_path, monkeypatch):
    monkeypatch.setattr("skinlib.training.run.RECORD", 2)
    config = replace(CONFIG, steps=5, energies=EnergyWeights(bend=1e-4, gravity=0.5))
    trainer = Trainer(config, outfit, tmp_path, bends())
    ids = np.random.default_rng((0, 2, 0)).integers(0, 12, 4)
    with torch.no_grad():
        terms = {key: term.mean().item() for key, term in trainer.energies(ids).items()}
    first = trainer.step()
    assert first.keys() == {"edge", "bend", "collision", "gravity", "pin"}
    assert first["bend"] == pytest.approx(1e-4 * terms["bend"])
    assert first["gravity"] == pytest.approx(0.5 * terms["gravity"])
    assert trainer.recent == first
    second = trainer.step()
    expected = 0.98 * first["edge"] + 0.02 * second["edge"]
    assert trainer.recent["edge"] == pytest.approx(expected)
    trainer.run()
    assert [entry["step"] for entry in trainer.history] == [2, 4]
    assert json.loads((tmp_path / "history.json").read_text()) == trainer.history


def test_the_learning_rate_falls_to_a_hundredth(outfit, tmp_path):
    trainer = Trainer(replace(CONFIG, steps=2), outfit, tmp_path, bends())
    trainer.step()
    rates = [group["lr"] for group in trainer.optimizer.param_groups]
    assert rates == pytest.approx([2e-3, 2e-2])  # of the blend weights: ten times
    trainer.step()
    rates = [group["lr"] for group in trainer.optimizer.param_groups]
    assert rates == pytest.approx([2e-3 * 0.505, 2e-2 * 0.505])


def test_layers_have_a_term_of_their_own(outfit, layers, tmp_path):
    ids = np.arange(3)

    def terms(worn, **weights):
        config = replace(CONFIG, energies=EnergyWeights(**weights))
        return Trainer(config, worn, tmp_path, bends()).energies(ids)

    assert "layer" not in terms(outfit)
    assert "layer" not in terms(layers, layer=0)
    assert terms(layers)["layer"].shape == (3,)


def test_layer_energy_by_hand(layers):
    """A band 3 mm inside the sleeve, that should keep 4 mm: 7 mm a vertex."""
    inner, outer = layers.parts
    vertices = torch.tensor(layers.vertices)[None]
    assert layer_energy(vertices, layers.cloth, layers.overlaps, 0.004) == 0
    vertices[0, outer, :2] *= 0.112 / 0.130
    vertices.requires_grad_()
    energy = layer_energy(vertices, layers.cloth, layers.overlaps, 0.004)
    count = len(layers.garments[1].vertices)
    assert energy.item() == pytest.approx(count * 0.007**2, rel=1e-3)
    energy.backward()
    slope, normals = vertices.grad[0], vertex_normals(vertices, layers.cloth.faces)[0]
    away = (slope * normals).sum(-1)
    assert away[outer].max() < 0 < away[inner].max()  # out, and in


def test_an_energy_of_nan_stops_before_it_does_harm(outfit, tmp_path):
    trainer = Trainer(CONFIG, outfit, tmp_path / "run", bends())
    with torch.no_grad():
        trainer.network.embed[0].bias.fill_(float("nan"))
    with pytest.raises(
        FloatingPointError, match=r"step 0 is not finite.*lower learning"
    ):
        trainer.run()
    assert not list((tmp_path / "run").iterdir())
    assert not trainer.optimizer.state and trainer.steps_done == 0


def test_a_rate_that_is_too_high_is_told(layers, tmp_path):
    config = replace(CONFIG, steps=40, learning_rate=1e18)
    with pytest.raises(FloatingPointError, match="learning_rate"):
        train(config, layers, tmp_path / "run", bends())
    assert not (tmp_path / "run" / MODEL).exists()
    assert not (tmp_path / "run" / STATE).exists()


@pytest.mark.parametrize(("drop", "falls"), [(0.2, True), (0.1, False)])
def test_a_garment_that_slides_off_is_told(layers, tmp_path, monkeypatch, drop, falls):
    monkeypatch.setattr("skinlib.training.run.RECORD", 1)
    trainer = Trainer(CONFIG, layers, tmp_path / "run", bends())
    with torch.no_grad():
        trainer.network.embed[-2].weight.zero_()
        trainer.network.embed[-2].bias.fill_(1)  # an embedding of six ones
        columns = trainer.network.columns.unflatten(-1, (-1, 3))
        columns[:, layers.parts[1], 2] = -drop / 6
    if falls:
        with pytest.raises(HeadError, match=r"pinned: band has slid down by 0\.\d+ m"):
            trainer.run()
        assert not (tmp_path / "run" / STATE).exists()
    else:
        trainer.run()
        assert trainer.steps_done == CONFIG.steps


@pytest.mark.parametrize("raised", [None, KeyboardInterrupt, FloatingPointError])
def test_the_number_of_threads_is_as_before(outfit, tmp_path, monkeypatch, raised):
    before = torch.get_num_threads()
    seen = []

    def step(self):
        seen.append(torch.get_num_threads())
        self.steps_done += 1
        if raised:
            raise raised

    monkeypatch.setattr(Trainer, "step", step)
    config = replace(CONFIG, threads=before + 1)
    if raised:
        with pytest.raises(raised):
            train(config, outfit, tmp_path, bends())
    else:
        train(config, outfit, tmp_path, bends())
    assert set(seen) == {before + 1} and torch.get_num_threads() == before


def test_a_wide_hoop_collides_with_nothing(tmp_path):
    hoop = Outfit.create(small_body(), [sleeve(0.375)])
    trainer = Trainer(CONFIG, hoop, tmp_path, bends())
    assert trainer.step()["collision"] == 0


# --- what is learnt -------------------------------------------------------------------


def test_blend_weights_are_learnt_only_if_asked(outfit, tmp_path):
    start = torch.tensor(outfit.blend_weights(CONFIG.smoothing))
    config = replace(CONFIG, steps=20)
    learnt = train(config, outfit, tmp_path / "a", bends()).blend_weights
    assert (learnt - start).abs().max() > 0.01
    assert ((learnt == 0) == (start == 0)).all()
    fixed = replace(config, network=replace(SMALL, learn_weights=False))
    found = train(fixed, outfit, tmp_path / "b", bends())
    assert torch.equal(found.blend_weights, start)
    assert found.columns.abs().max() > 1e-3


def test_what_is_trained_is_what_is_loaded(layers, tmp_path):
    network = train(CONFIG, layers, tmp_path, bends())
    outfit, loaded = load_outfit(tmp_path)
    assert same(network, loaded)
    poses = layers.pose(network, bends(seed=1))
    assert np.array_equal(outfit.pose(loaded, bends(seed=1)), poses)
    stored = json.loads((tmp_path / "config.json").read_text())
    assert stored["training"]["steps"] == 6 and stored["seconds"] >= 0


def test_shapes_are_learnt(outfit, tmp_path):
    config = replace(CONFIG, steps=10, shapes=True)
    trainer = Trainer(config, outfit, tmp_path, bends(200))
    assert trainer.shapes.abs().max() <= 0.6 and trainer.shapes.abs().max() > 0.5
    assert -0.05 <= trainer.ease.min() < -0.04 and 0.09 < trainer.ease.max() <= 0.1
    # The springs are as long as the cloth is cut for each body, times the ease.
    lengths = trainer._rest_lengths(torch.tensor([[0.0, 0]]), torch.tensor([0.1]))
    expected = outfit.cloth.rest_lengths * 1.1
    assert torch.allclose(lengths[0], expected)
    network = trainer.run()
    wide, thin = (outfit.pose(network, bends(), {"wide": x}) for x in (0.6, -0.6))
    assert np.abs(wide - thin).max() > 0.005
    loose = outfit.pose(network, bends(), ease=0.1)
    assert np.abs(loose - outfit.pose(network, bends())).max() > 1e-6


def test_shapes_of_a_body_without_any(outfit, tmp_path):
    body = outfit.body
    plain = replace(
        body,
        shape_names=(),
        shape_vertices=body.shape_vertices[:0],
        shape_joints=body.shape_joints[:0],
    )
    with pytest.raises(HeadError, match="shapes: the body has none"):
        config = replace(CONFIG, shapes=True)
        train(config, Outfit(plain, outfit.garments), tmp_path / "run", bends())
    assert not list(tmp_path.iterdir())


def test_the_body_grows_below_a_garment_that_learns_shapes(outfit, tmp_path):
    """Each pose has a body of its own shape, posed by bones of its own length."""
    config = replace(CONFIG, shapes=True)
    trainer = Trainer(config, outfit, tmp_path, bends())
    seen = []
    pose = trainer.collider.pose
    trainer.collider.pose = lambda *args: seen.append(pose(*args)) or seen[-1]
    try:
        trainer.energies(np.arange(2))
    finally:
        del trainer.collider.pose
    for frame in range(2):
        amounts = dict(
            zip(("wide", "tall"), trainer.shapes[frame].tolist(), strict=True)
        )
        head = outfit.body.shaped(amounts)
        motion = bends()
        moved = outfit.body.transforms(motion, trainer.shapes.numpy())[frame]
        expected = linear_blend_skinning(head.vertices, head.weights, moved)
        found = seen[0][0][frame].numpy()
        below = expected[trainer.collider.vertices]
        assert np.abs(found - below).max() < 1e-5


def inside(outfit: Outfit, network, motion: Motion) -> float:
    """The share of the cloth that is inside the body."""
    head = outfit.body.head
    bones = motion.transforms(head.skeleton)
    skins = linear_blend_skinning(head.vertices, head.weights, bones)
    posed = outfit.pose(network, motion)
    pairs = zip(posed, skins, strict=True)
    return np.mean([signed_distance(p, skin, head.faces) < 0 for p, skin in pairs])


def test_the_collision_term_keeps_cloth_outside(tmp_path):
    tight = Outfit.create(small_body(), [sleeve(0.102)])
    motion = bends(16, angle=0.9)
    config = replace(CONFIG, steps=60, batch=8, learning_rate=1e-2)
    free = replace(config, energies=EnergyWeights(collision=0))
    kept = inside(tight, train(config, tight, tmp_path / "a", motion), motion)
    lost = inside(tight, train(free, tight, tmp_path / "b", motion), motion)
    assert kept < 0.5 * lost


def test_a_path_that_is_a_file(outfit, tmp_path):
    (tmp_path / "run").write_text("kept")
    with pytest.raises(OSError, match="run"):
        train(CONFIG, outfit, tmp_path / "run", bends())
    assert Path(tmp_path / "run").read_text() == "kept"
