"""The losses of pose transfer: values by hand, derivatives, bad input."""

from math import sqrt

import pytest
import torch
from torch.autograd import gradcheck

from skinlib.head import HeadError
from skinlib.pose_transfer.losses import (
    EDGE_WEIGHT,
    pose_edge,
    pose_loss,
    pose_reconstruction,
)

# A triangle with the sides 3, 4, 5, and the same with its second vertex moved.
TRUTH = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [0, 4, 0]]], dtype=torch.float64)
EDGES = torch.tensor([[0, 1], [1, 2], [2, 0]])
MOVED = TRUTH.clone()
MOVED[0, 1] = torch.tensor([6.0, 0, 8])  # sides 10, sqrt(36 + 16 + 64), 4


def batch(seed: int, count: int = 2) -> torch.Tensor:
    generator = torch.manual_seed(seed)
    return torch.randn(count, 5, 3, generator=generator, dtype=torch.float64)


def test_reconstruction_by_hand():
    assert pose_reconstruction(MOVED, TRUTH).item() == pytest.approx(73 / 3)
    assert pose_reconstruction(TRUTH, TRUTH) == 0
    both = torch.cat([MOVED, TRUTH])
    assert pose_reconstruction(both, TRUTH.repeat(2, 1, 1)).item() == pytest.approx(
        73 / 6
    )


def test_the_mean_over_coordinates_is_a_third():
    a, b = batch(0), batch(1)
    third = torch.nn.functional.mse_loss(a, b)
    assert pose_reconstruction(a, b).item() == pytest.approx(3 * third.item())


def test_edges_by_hand():
    expected = (10 / 3 - 1 + sqrt(116) / 5 - 1) / 3
    assert pose_edge(MOVED, TRUTH, EDGES).item() == pytest.approx(expected)
    squared = (100 / 9 - 1 + 116 / 25 - 1) / 3
    assert pose_edge(MOVED, TRUTH, EDGES, "squared").item() == pytest.approx(squared)
    shrunk = 0.5 * TRUTH
    assert pose_edge(shrunk, TRUTH, EDGES).item() == pytest.approx(0.5)
    assert pose_edge(shrunk, TRUTH, EDGES, "squared").item() == pytest.approx(0.75)


def test_right_lengths_cost_nothing():
    turned = TRUTH[..., [1, 2, 0]] + 7
    for form in ("length", "squared"):
        assert pose_edge(turned, TRUTH, EDGES, form).item() == pytest.approx(0)
    assert pose_edge(turned.float(), TRUTH.float(), EDGES).item() < 1e-6


def test_each_mesh_may_have_its_own_edges():
    order = torch.tensor([2, 0, 1])
    renamed = torch.tensor([1, 2, 0])[EDGES]  # where each vertex went
    truth = torch.cat([TRUTH, TRUTH[:, order]])
    moved = torch.cat([MOVED, MOVED[:, order]])
    own = torch.stack([EDGES, renamed])
    expected = pose_edge(MOVED, TRUTH, EDGES).item()
    assert pose_edge(moved, truth, own).item() == pytest.approx(expected)
    assert pose_edge(moved, truth, EDGES).item() == pytest.approx(expected)
    once = own[:, :1]  # the same side by other ids
    assert pose_edge(moved, truth, once).item() == pytest.approx(10 / 3 - 1)


def test_an_edge_without_a_right_length_is_left_out():
    truth = TRUTH.clone()
    truth[0, 1] = truth[0, 0]
    only = pose_edge(MOVED, truth, EDGES[1:]).item()
    assert pose_edge(MOVED, truth, EDGES).item() == pytest.approx(only)
    predicted = MOVED.clone().requires_grad_()
    none = pose_edge(predicted, torch.zeros_like(TRUTH), EDGES)
    assert none == 0
    none.backward()
    assert not predicted.grad.any()
    assert pose_edge(MOVED, TRUTH, EDGES[:0]) == 0


@pytest.mark.parametrize("form", ["length", "squared"])
def test_a_collapsed_edge_has_a_finite_derivative(form):
    for dtype in (torch.float32, torch.float64):
        predicted = torch.zeros(1, 3, 3, dtype=dtype, requires_grad=True)
        loss = pose_edge(predicted, TRUTH.to(dtype), EDGES, form)
        assert loss.item() == pytest.approx(1, abs=1e-5)
        loss.backward()
        assert predicted.grad.isfinite().all()


def test_the_sum_by_hand():
    expected = 73 / 3 + 0.0005 * pose_edge(MOVED, TRUTH, EDGES).item()
    assert EDGE_WEIGHT == 0.0005
    assert pose_loss(MOVED, TRUTH, EDGES).item() == pytest.approx(expected)
    unread = torch.tensor([[0, 99]])
    assert pose_loss(MOVED, TRUTH, unread, 0).item() == pytest.approx(73 / 3)


def test_the_derivatives():
    predicted, truth = batch(0).requires_grad_(), batch(1)
    edges = torch.tensor([[0, 1], [1, 2], [2, 3], [3, 4], [4, 0]])
    assert gradcheck(pose_reconstruction, (predicted, truth))
    for form in ("length", "squared"):
        assert gradcheck(lambda p, f=form: pose_edge(p, truth, edges, f), predicted)
    assert gradcheck(lambda p: pose_loss(p, truth, edges, 0.5), predicted)


def test_bad_input():
    with pytest.raises(HeadError, match="same vertices"):
        pose_reconstruction(TRUTH, TRUTH[:, :1])
    with pytest.raises(HeadError, match="not empty"):
        pose_reconstruction(TRUTH[:, :0], TRUTH[:, :0])
    with pytest.raises(HeadError, match="reference"):
        pose_edge(TRUTH, TRUTH.repeat(2, 1, 1), EDGES)
    with pytest.raises(HeadError, match="int64"):
        pose_edge(TRUTH, TRUTH, EDGES.int())
    with pytest.raises(HeadError, match=r"Give \(E, 2\)"):
        pose_edge(TRUTH, TRUTH, EDGES.T[:, :1])
    with pytest.raises(HeadError, match=r"\(2, 3, 2\)"):
        pose_edge(TRUTH, TRUTH, EDGES.repeat(2, 1, 1))
    for wrong in (-1, 3):
        with pytest.raises(HeadError, match=f"ids from .*{wrong}.* for 3 vertices"):
            pose_edge(TRUTH, TRUTH, torch.tensor([[0, wrong]]))
