import json

import numpy as np
import pytest

from skinlib.datasets.synthetic import synthetic_heads
from skinlib.evaluate.compare import CLASSICAL, TEMPLATE, evaluate, format_table
from skinlib.head import HeadError

KEYS = {
    "row_l1_mean",
    "row_l1_p95",
    "row_l1_max",
    "precision",
    "recall",
    "dominant_bone_accuracy",
    "seconds",
}


class Perfect:
    """A model that knows the answer."""

    def predict(self, head):
        return np.array(head.weights)


@pytest.fixture(scope="module")
def heads():
    return synthetic_heads(3, seed=1, vertices=600, bones=9)


def test_the_json_the_issue_asks_for(heads):
    result = evaluate(heads[:2], heads[1:], Perfect(), progress=False)
    assert list(result) == ["methods"]
    assert set(result["methods"]) == {"skinlib", *CLASSICAL, *TEMPLATE}
    for method in result["methods"].values():
        assert set(method) == {"mean", "heads"}
        assert set(method["heads"]) == {heads[0].name, heads[1].name}
        for scores in [method["mean"], *method["heads"].values()]:
            assert KEYS <= scores.keys()
        values = [row["row_l1_mean"] for row in method["heads"].values()]
        assert method["mean"]["row_l1_mean"] == pytest.approx(np.mean(values))
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert result["methods"]["skinlib"]["mean"]["row_l1_max"] == 0
    ranked = [line.split()[0] for line in format_table(result).splitlines()]
    assert ranked[:2] == ["method", "skinlib"]
    assert len(ranked) == 9


def test_copies_appear_only_with_training_heads(heads):
    methods = evaluate(heads[:1], progress=False)["methods"]
    assert set(methods) == set(CLASSICAL)


def test_a_head_is_never_its_own_template(heads):
    # Loaded twice under another name: the positions tell.
    twin = heads[0].replace(name="twin")
    names = ["template_copy", "similar_template_copy"]
    both = evaluate(heads[:1], [twin, heads[1]], methods=names, progress=False)
    alone = evaluate(heads[:1], [heads[1]], methods=names, progress=False)
    for name in names:
        rows = [r["methods"][name]["mean"]["row_l1_mean"] for r in (both, alone)]
        assert rows[0] == rows[1] > 0.01
    itself = evaluate(heads[:1], [twin], progress=False)["methods"]
    assert set(itself) == set(CLASSICAL)


def test_heads_without_weights_are_skipped_aloud(heads, capsys):
    bare = heads[1].replace(weights=None)
    result = evaluate([heads[0], bare], methods=["nearest_bone"], progress=False)
    assert list(result["methods"]["nearest_bone"]["heads"]) == [heads[0].name]
    assert f"{bare.name}: no weights" in capsys.readouterr().err
    with pytest.raises(HeadError, match="none of 1 has weights"):
        evaluate([bare], progress=False)
    with pytest.raises(HeadError, match="none of 0 has weights"):
        evaluate([], progress=False)


def test_what_cannot_be_asked_for(heads):
    with pytest.raises(HeadError, match="'skinlib' is not available"):
        evaluate(heads, methods=["skinlib"], progress=False)
    with pytest.raises(HeadError, match="used twice"):
        evaluate([heads[0], heads[0]], progress=False)


def test_the_same_heads_give_the_same_numbers(heads):
    def rows(result):
        return {
            name: {k: v for k, v in method["mean"].items() if k != "seconds"}
            for name, method in result["methods"].items()
        }

    first = evaluate(heads[:1], heads[1:], progress=False)
    assert rows(first) == rows(evaluate(heads[:1], heads[1:], progress=False))
