"""Training on tiny heads: it learns, stops anywhere, goes on, repeats to the bit."""

import errno
import json
import os
import shutil
import signal
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, safe_open, save_file

from skinlib import HeadError, training
from skinlib.datasets.augment import AugmentConfig
from skinlib.datasets.synthetic import synthetic_heads
from skinlib.graph import GraphConfig
from skinlib.losses import LossWeights
from skinlib.model import ModelConfig, SkinningModel
from skinlib.training import (
    CONFIG,
    HISTORY,
    STATE,
    WEIGHTS,
    TrainConfig,
    Trainer,
    load_model,
    save_model,
    train,
)

TINY = ModelConfig(
    mesh_width=16,  # wide enough for Muon to take some of the matrices
    bone_width=16,
    blocks=1,
    points=2,
    tree_layers=1,
    pair_width=4,
    heads=2,
    graph=GraphConfig(neighbours=6, nearest=4),
)
CONFIG_OF_TESTS = TrainConfig(
    steps=8, warmup=2, model=TINY, threads=1, validations=2, save_seconds=1e9, ema=0.9
)
GENTLE = AugmentConfig(collapse=0, mirror=0, pose=0, warp=0.0, stretch=0.0, rotate=0.0)


@pytest.fixture(autouse=True)
def _interrupts_arrive():
    """A shell that starts the tests in the background has them ignore Ctrl-C."""
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, usual)


@pytest.fixture(scope="module")
def heads():
    return synthetic_heads(3, seed=1, vertices=600, bones=8)


@pytest.fixture(scope="module")
def finished(heads, tmp_path_factory):
    """A run of 8 steps, and its folder."""
    out = tmp_path_factory.mktemp("finished")
    train(CONFIG_OF_TESTS, heads[:2], out, validation=heads[2:])
    return out


def same_tensors(one, other) -> bool:
    a, b = load_file(one), load_file(other)
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def interrupt_at(monkeypatch, step: int) -> None:
    """Let a person press Ctrl+C during step `step` (counted from 0)."""
    original = Trainer.step

    def interrupted(trainer):
        if trainer.steps_done == step:
            monkeypatch.setattr(Trainer, "step", original)
            os.kill(os.getpid(), signal.SIGINT)
        return original(trainer)

    monkeypatch.setattr(Trainer, "step", interrupted)


# ---------------------------------------------------------------- copies


def test_copies_have_other_meshes_and_are_drawn_as_often_as_asked(heads, tmp_path):
    config = replace(CONFIG_OF_TESTS, remeshed=2, remeshed_share=0.75)
    trainer = Trainer(config, heads[:2], tmp_path, validation=[])
    own = {len(head.vertices) for head in heads[:2]}
    sizes = []
    for draw in range(80):
        head, graph, labelled, known = trainer._draw(draw, np.random.default_rng(draw))
        assert (
            labelled and known.all() and graph.node_of_vertex.size == len(head.vertices)
        )
        sizes.append(len(head.vertices))
    copied = np.mean([size not in own for size in sizes])
    assert 0.6 < copied < 0.9
    assert set(trainer.copies) == {(0, 0), (0, 1), (1, 0), (1, 1)}
    for (place, _), (head, _) in trainer.copies.items():
        assert head.skeleton is heads[place].skeleton
        np.testing.assert_allclose(head.weights.sum(axis=1), 1, atol=1e-5)


def test_a_run_with_copies_goes_on_to_the_same_bits(heads, tmp_path, monkeypatch):
    config = replace(CONFIG_OF_TESTS, remeshed=2)
    train(config, heads[:2], tmp_path / "whole", validation=[])
    interrupt_at(monkeypatch, 5)
    with pytest.raises(KeyboardInterrupt):
        train(config, heads[:2], tmp_path / "stopped", validation=[])
    train(config, heads[:2], tmp_path / "stopped", validation=[])
    assert same_tensors(*(tmp_path / n / WEIGHTS for n in ("whole", "stopped")))


def test_a_run_without_judges_says_so(heads, tmp_path, capsys):
    config = replace(CONFIG_OF_TESTS, steps=1)
    train(config, heads[:1], tmp_path / "none")
    assert "none is left to judge by" in capsys.readouterr().out
    train(config, heads[:1], tmp_path / "told", validation=[])
    train(config, heads[:1], tmp_path / "some", validation=heads[1:])
    assert "judge" not in capsys.readouterr().out


# ---------------------------------------------------------------- it learns


def test_the_error_falls(heads, tmp_path):
    config = replace(
        CONFIG_OF_TESTS, steps=60, learning_rate=1e-2, augment=GENTLE, validations=4
    )
    trainer = Trainer(config, heads[:1], tmp_path, validation=heads[:1])
    before = trainer.validate()
    trainer.run()
    assert before > 1.2
    assert trainer.best < 0.6 * before
    errors = [entry["validation_row_l1"] for entry in trainer.history]
    assert errors[-1] < errors[0]


@pytest.mark.parametrize(
    "loss", [LossWeights(1, 0, 0), LossWeights(0, 1, 0), LossWeights(0, 0, 1)]
)
def test_each_loss_alone_trains(heads, tmp_path, loss):
    config = replace(CONFIG_OF_TESTS, steps=2, loss=loss)
    model = train(config, heads[:2], tmp_path, validation=heads[2:])
    assert np.isfinite(model.predict(heads[0])).all()


def test_the_learning_rate_warms_up_and_cools_down(heads, tmp_path):
    config = replace(CONFIG_OF_TESTS, steps=100, warmup=10, cooldown=0.4)
    trainer = Trainer(config, heads[:1], tmp_path, validation=[])
    rates = []
    for trainer.steps_done in range(100):
        rates.append(trainer.learning_rate / config.learning_rate)
    assert rates[:3] == pytest.approx([0.1, 0.2, 0.3])
    assert rates[10:60] == pytest.approx([1.0] * 50)
    assert rates[80] == pytest.approx(0.5) and rates[99] == pytest.approx(1 / 40)


def test_unlabelled_heads_are_drawn_after_a_while(heads, tmp_path, monkeypatch):
    bare = [head.replace(weights=None) for head in heads[1:]]
    config = replace(
        CONFIG_OF_TESTS, unlabelled_share=1.0, unlabelled_start=0.5, pseudo=1.0
    )
    guessed = []
    original = Trainer._guess

    def guess(trainer, head, graph):
        guessed.append((trainer.steps_done, head.name))
        return original(trainer, head, graph)

    monkeypatch.setattr(Trainer, "_guess", guess)
    train(config, heads[:1], tmp_path, unlabelled=bare, validation=heads[:1])
    assert sorted({step for step, _ in guessed}) == [4, 5, 6, 7]
    assert {name for _, name in guessed} <= {head.name for head in bare}


def test_an_augmentation_that_changes_the_mesh(heads, tmp_path):
    augment = AugmentConfig(
        drop_islands=1.0, flip_edges=0.2, cut_seams=1.0, reorder_vertices=True
    )
    config = replace(CONFIG_OF_TESTS, steps=2, augment=augment)
    model = train(config, heads[:2], tmp_path, validation=heads[2:])
    assert np.isfinite(model.predict(heads[0])).all()


def test_few_or_more_judged_nodes_than_there_are(heads, tmp_path):
    for judged in (1, 10**6):
        config = replace(CONFIG_OF_TESTS, steps=1, judged_nodes=judged)
        train(config, heads[:1], tmp_path / str(judged), validation=[])


def test_the_average_follows_slowly(heads, tmp_path):
    config = replace(CONFIG_OF_TESTS, ema=0.05)
    trainer = Trainer(config, heads[:1], tmp_path, validation=[])
    names = [name for name, _ in trainer.model.named_parameters()]
    slow = {name: p.clone() for name, p in trainer.average.named_parameters()}
    for _ in range(3):
        trainer.step()
        # Early on the decay is less than `ema`: steps / (steps + 10).
        decay = min(0.05, trainer.steps_done / (trainer.steps_done + 10))
        for name in names:
            fast = trainer.model.get_parameter(name)
            slow[name] = decay * slow[name] + (1 - decay) * fast
            average = trainer.average.get_parameter(name)
            torch.testing.assert_close(average, slow[name].detach())
    assert not torch.equal(trainer.parameters[0], next(trainer.average.parameters()))


def test_every_draw_disturbs_a_head_in_its_own_way(heads, tmp_path):
    trainer = Trainer(CONFIG_OF_TESTS, heads[:1], tmp_path, validation=[])
    first, again, second = (trainer._gradient(draw)[0][0] for draw in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, second)


def test_every_head_is_drawn_once_an_epoch(heads, tmp_path):
    trainer = Trainer(CONFIG_OF_TESTS, heads, tmp_path, validation=[])
    rng = np.random.default_rng(0)
    for epoch in range(4):
        draws = range(3 * epoch, 3 * epoch + 3)
        names = {trainer._draw(draw, rng)[0].name for draw in draws}
        assert names == {head.name for head in heads}


def test_the_time_spent_is_kept(heads, tmp_path):
    trainer = Trainer(CONFIG_OF_TESTS, heads[:1], tmp_path, validation=[])
    trainer.seconds = 12.5
    trainer.save()
    resumed = Trainer(CONFIG_OF_TESTS, heads[:1], tmp_path, validation=[])
    assert resumed.seconds == 12.5


def test_muon_takes_the_matrices_and_adamw_the_rest(heads, tmp_path):
    trainer = Trainer(CONFIG_OF_TESTS, heads[:1], tmp_path, validation=[])
    muon, adamw = trainer.optimizers
    matrices, rest = (
        [p for group in o.param_groups for p in group["params"]] for o in (muon, adamw)
    )
    assert isinstance(muon, torch.optim.Muon) and matrices and rest
    assert all(p.ndim == 2 for p in matrices)
    every = {id(p) for p in matrices} | {id(p) for p in rest}
    assert every == {id(p) for p in trainer.model.parameters()}
    assert len(matrices) + len(rest) == len(every)


def test_an_unknown_optimizer_is_refused(heads, tmp_path):
    config = replace(CONFIG_OF_TESTS, optimizer="sgd")
    with pytest.raises(ValueError, match="muon or adamw"):
        Trainer(config, heads[:1], tmp_path, validation=[])


def test_graph_attention_trains_too(heads, tmp_path):
    config = replace(
        CONFIG_OF_TESTS, steps=2, model=replace(TINY, convolution="gat", pair_width=0)
    )
    assert train(config, heads[:1], tmp_path, validation=[]).config == config.model


# ---------------------------------------------------------------- to the bit


@pytest.mark.parametrize("step", [0, 1, 5, 7])
def test_an_interrupted_run_goes_on_to_the_same_bits(
    heads, finished, tmp_path, monkeypatch, step
):
    interrupt_at(monkeypatch, step)
    with pytest.raises(KeyboardInterrupt):
        train(CONFIG_OF_TESTS, heads[:2], tmp_path, validation=heads[2:])
    assert not list(tmp_path.glob("*.partial"))
    train(CONFIG_OF_TESTS, heads[:2], tmp_path, validation=heads[2:])
    assert same_tensors(tmp_path / STATE, finished / STATE)
    assert same_tensors(tmp_path / WEIGHTS, finished / WEIGHTS)
    history = [json.loads((f / HISTORY).read_text()) for f in (tmp_path, finished)]
    mine, theirs = ([h | {"minutes": 0} for h in run] for run in history)
    assert mine == theirs


@pytest.mark.parametrize("where", ["_optimizers", "predict", "save_model"])
def test_an_interrupt_inside_an_update_or_a_validation(
    heads, finished, tmp_path, monkeypatch, where
):
    pressed = []

    def pressing(function):
        def pressed_before(*args, **options):
            if len(pressed) == 0:
                pressed.append(True)
                os.kill(os.getpid(), signal.SIGINT)
            return function(*args, **options)

        return pressed_before

    with monkeypatch.context() as patch:
        trainer = Trainer(CONFIG_OF_TESTS, heads[:2], tmp_path, validation=heads[2:])
        if where == "predict":
            patch.setattr(trainer.average, where, pressing(trainer.average.predict))
        elif where == "save_model":
            patch.setattr(training.trainer, where, pressing(save_model))
        else:  # between two optimizers
            last = trainer.optimizers[-1]
            patch.setattr(last, "step", pressing(last.step))
        with pytest.raises(KeyboardInterrupt):
            trainer.run()
    train(CONFIG_OF_TESTS, heads[:2], tmp_path, validation=heads[2:])
    assert same_tensors(tmp_path / WEIGHTS, finished / WEIGHTS)
    assert same_tensors(tmp_path / STATE, finished / STATE)
    history = json.loads((tmp_path / HISTORY).read_text())
    assert [validated["step"] for validated in history] == [4, 8]


def test_a_run_with_unlabelled_heads_resumes_to_the_same_bits(
    heads, tmp_path, monkeypatch
):
    config = replace(
        CONFIG_OF_TESTS,
        unlabelled_share=0.5,
        unlabelled_start=0.2,
        pseudo=1.0,
        optimizer="adamw",
    )
    others = {"unlabelled": heads[1:2], "validation": heads[2:]}
    train(config, heads[:1], tmp_path / "whole", **others)
    interrupt_at(monkeypatch, 5)
    with pytest.raises(KeyboardInterrupt):
        train(config, heads[:1], tmp_path / "cut", **others)
    train(config, heads[:1], tmp_path / "cut", **others)
    assert same_tensors(tmp_path / "whole" / STATE, tmp_path / "cut" / STATE)


@pytest.mark.parametrize("threads", [2, 3])
def test_the_number_of_threads_does_not_change_the_bits(
    heads, finished, tmp_path, threads
):
    config = replace(CONFIG_OF_TESTS, threads=threads)
    train(config, heads[:2], tmp_path, validation=heads[2:])
    assert same_tensors(tmp_path / STATE, finished / STATE)


def test_another_seed_is_another_model(heads, finished, tmp_path):
    config = replace(CONFIG_OF_TESTS, seed=1)
    train(config, heads[:2], tmp_path, validation=heads[2:])
    assert not same_tensors(tmp_path / WEIGHTS, finished / WEIGHTS)


def test_a_finished_run_is_returned_at_once(heads, finished, monkeypatch):
    monkeypatch.setattr(Trainer, "step", None)
    before = (finished / WEIGHTS).read_bytes()
    model = train(CONFIG_OF_TESTS, heads[:2], finished, validation=heads[2:])
    assert (finished / WEIGHTS).read_bytes() == before
    expected = load_model(finished).predict(heads[0])
    np.testing.assert_array_equal(model.predict(heads[0]), expected)


def test_the_state_is_written_in_between(heads, tmp_path, monkeypatch):
    saves = []
    original = Trainer.save
    monkeypatch.setattr(
        Trainer, "save", lambda t: saves.append(t.steps_done) or original(t)
    )
    config = replace(CONFIG_OF_TESTS, steps=4, save_seconds=0.0)
    train(config, heads[:1], tmp_path, validation=[])
    assert saves == [1, 2, 3, 4, 4]


def test_minutes_end_about_in_time(heads, tmp_path):
    config = replace(CONFIG_OF_TESTS, steps=None, minutes=1.5 / 60, validations=1)
    began = time.monotonic()
    trainer = Trainer(config, heads[:1], tmp_path, validation=[])
    trainer.run()
    seconds = time.monotonic() - began
    assert trainer.seconds == pytest.approx(1.5, rel=0.6)
    assert seconds < 8
    assert trainer.finished and trainer.learning_rate == 0


def test_the_cooldown_keeps_to_the_time_when_steps_get_slower(heads, tmp_path):
    config = replace(CONFIG_OF_TESTS, steps=None, minutes=1, cooldown=0.5, warmup=1)
    trainer = Trainer(config, heads[:1], tmp_path, validation=[])
    rates = {}
    for trainer.seconds in (0.0, 29.0, 45.0, 59.0, 60.0):
        rates[trainer.seconds] = trainer.learning_rate / config.learning_rate
    assert rates == pytest.approx({0: 1, 29: 1, 45: 0.5, 59: 1 / 30, 60: 0})


# ---------------------------------------------------------------- another run


@pytest.mark.parametrize(
    "changes, field",
    [
        ({"learning_rate": 0.5}, "learning_rate"),
        ({"seed": 3}, "seed"),
        ({"model": replace(TINY, mesh_width=8)}, "model"),
        ({"loss": LossWeights(seed=1.0), "batch": 1}, "batch, loss"),
    ],
)
def test_resuming_with_other_settings_is_one_error(heads, finished, changes, field):
    before = {p.name: p.read_bytes() for p in finished.iterdir()}
    with pytest.raises(HeadError, match="new folder") as caught:
        config = replace(CONFIG_OF_TESTS, **changes)
        train(config, heads[:2], finished, validation=heads[2:])
    assert sorted(caught.value.field.split(", ")) == field.split(", ")
    assert caught.value.file == str(finished)
    assert before == {p.name: p.read_bytes() for p in finished.iterdir()}


def test_resuming_with_other_heads_is_one_error(heads, finished):
    with pytest.raises(HeadError, match="labelled"):
        train(CONFIG_OF_TESTS, heads[1:2], finished, validation=heads[2:])
    with pytest.raises(HeadError, match="validation"):
        train(CONFIG_OF_TESTS, heads[:2], finished, validation=heads[:1])


def test_threads_and_saving_may_change(heads, finished):
    config = replace(CONFIG_OF_TESTS, threads=2, save_seconds=5.0)
    train(config, heads[:2], finished, validation=heads[2:])


def test_heads_without_weights_are_refused(heads, tmp_path):
    bare = heads[0].replace(weights=None)
    with pytest.raises(HeadError, match=repr(bare.name)):
        train(CONFIG_OF_TESTS, [heads[1], bare], tmp_path)
    with pytest.raises(HeadError, match="at least one head"):
        train(CONFIG_OF_TESTS, [], tmp_path)
    assert not list(tmp_path.iterdir())


def test_whole_topology_groups_are_held_out(heads, tmp_path):
    twins = [h.replace(vertices=h.vertices * 2, name=h.name + "_twin") for h in heads]
    config = replace(CONFIG_OF_TESTS, validation_share=0.3)
    trainer = Trainer(config, heads + twins, tmp_path)
    held_out = {h.name.removesuffix("_twin") for h in trainer.validation}
    kept = {h.name.removesuffix("_twin") for h in trainer.labelled}
    assert len(held_out) == 1 and len(kept) == 2 and not held_out & kept


def test_one_head_alone_trains_without_validation(heads, tmp_path):
    model = train(replace(CONFIG_OF_TESTS, steps=2), heads[:1], tmp_path)
    assert np.isfinite(model.predict(heads[1])).all()


# ---------------------------------------------------------------- checkpoints


def test_a_checkpoint_round_trip(heads, tmp_path):
    model = SkinningModel(TINY)
    save_model(model, tmp_path, {"note": "x"})
    for name in (tmp_path, str(tmp_path), tmp_path / WEIGHTS):
        loaded = load_model(name)
        assert loaded.config == TINY and not loaded.training
        np.testing.assert_array_equal(loaded.predict(heads[0]), model.predict(heads[0]))
    config = json.loads((tmp_path / CONFIG).read_text())
    assert config["note"] == "x" and config["model"]["graph"]["neighbours"] == 6
    assert sorted(p.name for p in tmp_path.iterdir()) == [CONFIG, WEIGHTS]


def test_a_checkpoint_says_how_it_was_trained(finished):
    config = json.loads((finished / CONFIG).read_text())
    assert config["training"]["steps"] == 8
    assert config["training"]["augment"]["warp"] == AugmentConfig().warp


def test_the_best_model_is_kept_not_the_last(heads, tmp_path, monkeypatch):
    errors = iter([0.5, 0.3, 0.4, 0.9])
    config = replace(CONFIG_OF_TESTS, steps=4)
    trainer = Trainer(config, heads[:1], tmp_path, validation=heads[1:2])
    monkeypatch.setattr(
        "skinlib.training.trainer.row_l1", lambda *_: np.full(3, next(errors))
    )
    kept = []
    for _ in range(4):
        trainer.step()
        trainer.validate()
        kept.append((tmp_path / WEIGHTS).read_bytes())
    assert kept[0] != kept[1] == kept[2] == kept[3]
    assert trainer.best == 0.3 and len(trainer.history) == 4


def test_nothing_is_pickled(finished):
    for path in finished.iterdir():
        assert path.suffix in (".json", ".safetensors")
        assert path.read_bytes()[:2] not in (b"PK", b"\x80\x02", b"\x80\x04")


def test_going_on_from_a_trained_model(heads, finished, tmp_path):
    start = load_model(finished)
    config = replace(CONFIG_OF_TESTS, steps=1)
    trainer = Trainer(config, heads[:1], tmp_path, validation=[], start=start)
    for name, tensor in trainer.model.state_dict().items():
        assert torch.equal(tensor, start.state_dict()[name])


@pytest.mark.parametrize("name", ["there_is_none", "a/b", "a.safetensors"])
def test_a_checkpoint_that_is_not_there(name):
    with pytest.raises(HeadError, match=r"missing|there is no"):
        load_model(name)


def test_a_folder_named_like_a_shipped_checkpoint(finished, tmp_path, monkeypatch):
    shipped = tmp_path / "shipped"
    shutil.copytree(finished, shipped)
    monkeypatch.setattr(
        training.checkpoint, "checkpoint", lambda name: tmp_path / "shipped"
    )
    monkeypatch.chdir(tmp_path)
    (tmp_path / "heads").mkdir()
    assert load_model("heads").config == TINY
    with pytest.raises(HeadError, match=r"^heads.model\.safetensors: .* no such file"):
        load_model("./heads")
    (tmp_path / "heads" / STATE).touch()  # a run that has not validated yet
    with pytest.raises(HeadError, match="first validation"):
        load_model("heads")


def test_others_may_read_what_was_written(heads, tmp_path):
    save_model(SkinningModel(TINY), tmp_path, {})
    (tmp_path / "usual").touch()
    assert (tmp_path / WEIGHTS).stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_a_full_disk_is_one_error_and_leaves_nothing(finished, tmp_path, monkeypatch):
    out = shutil.copytree(finished, tmp_path / "run")
    before = {file.name: file.read_bytes() for file in out.iterdir()}

    def full(*names):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(HeadError, match="No space left"):
        save_model(SkinningModel(TINY), out, {})
    assert {file.name: file.read_bytes() for file in out.iterdir()} == before


def damaged(file, how: str) -> None:
    content = file.read_bytes()
    if how == "empty":
        file.write_bytes(b"")
    elif how == "half":
        file.write_bytes(content[: len(content) // 2])
    elif how == "pickle":
        torch.save({"a": 1}, file)
    elif how == "text":
        file.write_text("not a checkpoint")
    elif how == "no configuration":
        save_file(load_file(file), file)
    elif how == "other tensors":
        with safe_open(file, "pt") as opened:
            metadata = opened.metadata()
        save_file({"a": torch.zeros(3)}, file, metadata)


DAMAGE = ["empty", "half", "pickle", "text", "no configuration", "other tensors"]


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_model_is_one_error(finished, tmp_path, how):
    shutil.copy(finished / WEIGHTS, tmp_path)
    damaged(tmp_path / WEIGHTS, how)
    with pytest.raises(HeadError, match=WEIGHTS):
        load_model(tmp_path)


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_state_is_one_error(heads, finished, tmp_path, how):
    out = shutil.copytree(finished, tmp_path / "run")
    damaged(out / STATE, how)
    with pytest.raises(HeadError, match=STATE):
        train(CONFIG_OF_TESTS, heads[:2], out, validation=heads[2:])


@settings(
    max_examples=200,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    place=st.floats(0, 1, exclude_max=True),
    byte=st.integers(0, 255),
    header=st.booleans(),
)
def test_another_byte_is_one_error_or_a_model(finished, tmp_path, place, byte, header):
    content = bytearray((finished / WEIGHTS).read_bytes())
    span = 3000 if header else len(content)
    content[int(place * span)] = byte
    (tmp_path / WEIGHTS).write_bytes(content)
    try:
        load_model(tmp_path)
    except HeadError as error:
        assert error.file == str(tmp_path / WEIGHTS)


def test_a_gradient_that_is_not_finite_stops_the_run(heads, tmp_path):
    config = replace(CONFIG_OF_TESTS, learning_rate=1e-3)
    trainer = Trainer(config, heads[:1], tmp_path, validation=[])
    with torch.no_grad():
        trainer.parameters[0][:] = torch.inf
    with pytest.raises(FloatingPointError, match="step 0"):
        trainer.step()
