"""The error of skinned cloth without skinning it, against skinning it."""

import numpy as np
import pytest
import torch
from test_body import sleeve

from skinlib.garments.fitting import SkinningError
from skinlib.geometry import mesh_edges
from skinlib.skinning import linear_blend_skinning

CLOTH = sleeve(0.15)
RNG = np.random.default_rng(0)
WEIGHTS = RNG.dirichlet(np.full(5, 0.3), len(CLOTH.vertices)).astype(np.float32)
TRUTH = CLOTH.vertices + RNG.normal(0, 0.02, (7, *CLOTH.vertices.shape))


def moves(*shape: int) -> torch.Tensor:
    """Matrices near the identity."""
    around = RNG.normal(0, 0.1, (*shape, 5, 4, 4))
    around[..., 3, :] = 0
    return torch.tensor(np.eye(4) + around, dtype=torch.float32)


def slowly(posed: np.ndarray, truth: np.ndarray, edges: float) -> np.ndarray:
    off = posed - truth
    a, b = mesh_edges(CLOTH.faces).T
    along = np.square(off[..., a, :] - off[..., b, :]).sum(-1).mean(-1)
    return np.square(off).sum(-1).mean(-1) + edges * along


@pytest.mark.parametrize("edges", [0.0, 10.0])
def test_it_is_the_error_of_skinned_vertices_and_edges(edges):
    error = SkinningError(CLOTH.vertices, WEIGHTS, CLOTH.faces, TRUTH, edges)
    transforms, frames = moves(2, 3), torch.tensor([[0, 6, 2], [2, 2, 5]])
    posed = linear_blend_skinning(CLOTH.vertices, WEIGHTS, transforms.numpy())
    expected = slowly(posed, TRUTH[frames], edges)
    assert np.allclose(error(transforms, frames), expected, rtol=1e-4)


def test_its_derivative_is_that_of_the_error():
    error = SkinningError(CLOTH.vertices, WEIGHTS, CLOTH.faces, TRUTH, 3.0)
    transforms, frames = moves(1).double().requires_grad_(), torch.tensor([4])
    assert torch.autograd.gradcheck(lambda x: error.double()(x, frames), transforms)


def test_what_bones_can_do_is_no_error():
    transforms = moves(7)
    truth = linear_blend_skinning(CLOTH.vertices, WEIGHTS, transforms.numpy())
    error = SkinningError(CLOTH.vertices, WEIGHTS, CLOTH.faces, truth, 3.0)
    assert error(transforms, torch.arange(7)).max() < 1e-8


def test_a_bone_that_moves_nothing_does_no_harm():
    weights = np.concatenate([WEIGHTS, np.zeros((len(WEIGHTS), 1))], axis=1)
    more = SkinningError(CLOTH.vertices, weights, CLOTH.faces, TRUTH, 3.0)
    error = SkinningError(CLOTH.vertices, WEIGHTS, CLOTH.faces, TRUTH, 3.0)
    transforms, frames = moves(7), torch.arange(7)
    wider = torch.cat([transforms, 9 * transforms[:, :1]], dim=1)
    assert torch.allclose(more(wider, frames), error(transforms, frames), rtol=1e-3)


def test_more_bones_than_vertices():
    few, faces = CLOTH.vertices[:3], np.array([[0, 1, 2]])
    error = SkinningError(few, WEIGHTS[:3], faces, TRUTH[:, :3])
    transforms = moves(7)
    posed = linear_blend_skinning(few, WEIGHTS[:3], transforms.numpy())
    expected = np.square(posed - TRUTH[:, :3]).sum(-1).mean(-1)
    found = error(transforms, torch.arange(7))
    assert np.allclose(found, expected, rtol=1e-3, atol=1e-8)
