import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from skinlib.datasets.synthetic import synthetic_heads
from skinlib.evaluate.metrics import row_l1
from skinlib.head import HeadError
from skinlib.headbench import bench as headbench
from skinlib.headbench.bench import OTHERS, Bench, collect, run
from skinlib.headbench.networks import OURS, RECIPES
from skinlib.headbench.suites import vary
from skinlib.headbench.targets import Target, targets
from skinlib.training import load_model
from skinlib.views.headbench import markdown, methods_table, suites_table, write_page

METHODS = (OURS, "template copy", "nearest bone")
SUITES = ("untouched", "halved", "collapsed", OTHERS)


@pytest.fixture(scope="module")
def contest():
    heads = synthetic_heads(8, 0, vertices=620, bones=10)
    return Bench(
        heads=heads,
        unlabelled=synthetic_heads(1, 50, vertices=620, bones=10),
        others=synthetic_heads(1, 90, vertices=620, bones=12),
        folds=(0, 1),
        minutes=0.01,
        suites=SUITES,
        methods=METHODS,
    )


@pytest.fixture(scope="module")
def out(contest, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    run(contest, folder)
    return folder


def test_every_network_is_trained_in_every_fold(out):
    for number in (0, 1):
        folders = {path.name for path in (out / "networks" / f"fold{number}").iterdir()}
        assert folders == set(RECIPES)


def test_the_numbers_are_those_of_the_method_on_the_variant(contest, out):
    cell = out / "cells" / "fold1" / "halved" / f"{OURS}.json"
    scores = json.loads(cell.read_text())["heads"]
    _, held_out = headbench.fold(contest.heads, 1)
    assert set(scores) == {head.name for head in held_out}
    head = vary("halved", held_out[0], 1)
    network = load_model(out / "networks" / "fold1" / OURS)
    expected = row_l1(network.predict(head), head.weights).mean()
    assert scores[head.name]["row_l1_mean"] == pytest.approx(expected, abs=1e-5)


def test_results_are_means_over_heads_and_spreads_over_folds(out):
    results = collect(out)
    assert json.loads((out / "results.json").read_text()) == results
    assert set(results) == set(SUITES)
    assert all(set(methods) == set(METHODS) for methods in results.values())
    files = sorted(out.glob("cells/*/untouched/nearest bone.json"))
    folds = [
        [row["row_l1_mean"] for row in json.loads(file.read_text())["heads"].values()]
        for file in files
    ]
    number = results["untouched"]["nearest bone"]["row_l1_mean"]
    assert number["mean"] == pytest.approx(np.mean([*folds[0], *folds[1]]), abs=1e-5)
    assert number["spread"] == pytest.approx(
        abs(np.mean(folds[0]) - np.mean(folds[1])) / np.sqrt(2), abs=1e-5
    )
    assert number["heads"] == len(folds[0]) + len(folds[1])
    halved = results["halved"]["nearest bone"]
    ratio = halved["row_l1_mean"]["mean"] / number["mean"]
    assert halved["row_l1_ratio"]["mean"] == pytest.approx(ratio, abs=1e-3)
    assert results[OTHERS]["nearest bone"]["row_l1_ratio"]["mean"] is None
    if sys.platform == "linux":
        memory = {m: results["untouched"][m]["peak_mb"]["mean"] for m in METHODS}
        assert memory[OURS] > memory["nearest bone"] >= 0


def test_what_is_there_is_not_computed_again(contest, out, monkeypatch):
    lost = out / "cells" / "fold0" / "halved" / "nearest bone.json"
    before = json.loads(lost.read_text())["heads"]
    lost.unlink()
    asked = []

    def nearest_bone(head, templates):
        asked.append(head.name)
        return headbench.baselines.nearest_bone(head)

    def fails(head, templates):
        raise AssertionError("is there already")

    methods = {name: fails for name in METHODS} | {"nearest bone": nearest_bone}
    monkeypatch.setattr(headbench, "available", lambda networks: methods)
    run(contest, out)
    assert sorted(asked) == sorted(before)
    again = json.loads(lost.read_text())["heads"]
    assert {k: v["row_l1_mean"] for k, v in again.items()} == {
        k: v["row_l1_mean"] for k, v in before.items()
    }


def test_a_method_that_fails_is_told(contest, out, tmp_path, monkeypatch):
    def fails(head, templates):
        raise HeadError("Blender", "it was not found", "install it")

    monkeypatch.setattr(headbench, "available", lambda networks: {"broken": fails})
    monkeypatch.setattr(headbench, "_peak_memory", lambda *_: 1.0)
    (tmp_path / "networks").symlink_to(out / "networks")
    bench = replace(contest, methods=(), suites=("untouched",), folds=(0,))
    assert run(bench, tmp_path) == {}
    cell = json.loads((tmp_path / "cells/fold0/untouched/broken.json").read_text())
    assert not cell["heads"] and "it was not found" in str(cell["failed"])


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"suites": ("upside down",)}, "'upside down' is unknown"),
        ({"methods": ("magic",)}, "'magic' is unknown"),
        ({"folds": (4,)}, "Give 0 to 3"),
        ({"heads": []}, "make no fold"),
    ],
)
def test_bad_input_is_told(contest, out, changes, words):
    with pytest.raises(HeadError, match=words):
        run(replace(contest, **changes), out)


def test_heads_need_weights(contest, out):
    bare = contest.heads[0].replace(weights=None)
    with pytest.raises(HeadError, match="has none"):
        run(replace(contest, heads=[bare, *contest.heads[1:]]), out)


def test_a_bench_without_results_is_told(tmp_path):
    with pytest.raises(HeadError, match="no method"):
        write_page({}, [], tmp_path)


def test_targets_say_what_is_met():
    assert Target("error", 0.05, 0.05).row()[1:] == ("≤ 0.05", "0.05", "met")
    assert not Target("error", 0.05, 0.06).met
    assert Target("ratio", 4, 5, at_least=True).met
    assert Target("ratio", 4, float("nan"), at_least=True).row()[2:] == (
        "not measured",
        "missed",
    )


def test_targets_of_a_bench(out):
    found = {target.text: target for target in targets(collect(out), OURS)}
    row = found["halved: row-L1 over the untouched head's"]
    ratio = collect(out)["halved"][OURS]["row_l1_ratio"]["mean"]
    assert (row.bound, row.measured) == (1.25, ratio)
    ours, copy = (
        collect(out)["untouched"][name]["row_l1_mean"]["mean"]
        for name in (OURS, "template copy")
    )
    best = found["times better than the best template copy"]
    assert best.measured == pytest.approx(copy / ours)


def test_the_page(out, tmp_path):
    results = collect(out)
    page = write_page(results, targets(results, OURS), tmp_path / "page")
    text = page.read_text()
    for name in (*METHODS, *SUITES, "methods.png", "suites.png", "cost.png"):
        assert name in text.replace("&#39;", "'")
    for name in ("methods.png", "suites.png", "cost.png"):
        assert (page.parent / name).read_bytes().startswith(b"\x89PNG")
    rows = methods_table(results)
    numbers = results["untouched"][rows[1][0]]["row_l1_mean"]
    assert rows[1][2] == f"{numbers['mean']:.3f} ± {numbers['spread']:.3f}"
    assert [row[0] for row in suites_table(results)[1:]] == list(results)
    assert markdown(rows).count("\n") == len(rows)
