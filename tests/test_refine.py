"""A result made locally stiff: the pose stays, the target's shape comes back."""

import time

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from skinlib.geometry import mesh_edges
from skinlib.head import HeadError
from skinlib.pose_transfer.metrics import edge_error
from skinlib.pose_transfer.refine import as_rigid_as_possible

BALL = trimesh.creation.icosphere(3)
POINTS, EDGES = np.asarray(BALL.vertices), mesh_edges(np.asarray(BALL.faces))
TURN = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()


def test_what_is_only_turned_and_moved_stays():
    moved = POINTS @ TURN.T + [1, 2, 3]
    np.testing.assert_allclose(
        as_rigid_as_possible(moved, POINTS, EDGES), moved, atol=1e-9
    )


def test_noise_goes_and_the_pose_stays():
    rng = np.random.default_rng(0)
    posed = POINTS * [1, 1, 1.3] @ TURN.T
    noisy = posed + rng.normal(0, 0.03, posed.shape)
    found = as_rigid_as_possible(noisy, POINTS * [1, 1, 1.3], EDGES)
    assert np.abs(found - posed).mean() < 0.4 * np.abs(noisy - posed).mean()
    off = [edge_error(points, posed, EDGES) for points in (found, noisy)]
    assert off[0] < 0.15 * off[1]


def test_it_lowers_what_it_says():
    """Against a minimum over rotations and positions found by torch's LBFGS."""
    import torch

    ball = trimesh.creation.icosphere(1)
    target = np.asarray(ball.vertices)
    edges = mesh_edges(np.asarray(ball.faces))
    points = target + np.random.default_rng(1).normal(0, 0.1, target.shape)
    found = as_rigid_as_possible(points, target, edges, reach=0.4, rounds=200)
    a, b = np.concatenate([edges, edges[:, ::-1]]).T
    rest = torch.tensor(target[a] - target[b])
    size = np.ptp(target, axis=0).max()
    stiffness = (0.4 * size / rest.norm(dim=1).mean()) ** 2
    x = torch.tensor(points, requires_grad=True)
    turns = torch.zeros(len(target), 3, dtype=torch.float64, requires_grad=True)

    def energy(x, turns):
        cross = torch.zeros(len(target), 3, 3, dtype=torch.float64)
        for axis, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
            cross[:, i, j], cross[:, j, i] = turns[:, axis], -turns[:, axis]
        turned = (torch.matrix_exp(cross)[a] @ rest[:, :, None])[..., 0]
        bent = (x[a] - x[b] - turned).square().sum()
        return (x - torch.tensor(points)).square().sum() + stiffness / 2 * bent

    optimizer = torch.optim.LBFGS([x, turns], max_iter=500, tolerance_grad=1e-10)

    def closure():
        optimizer.zero_grad()
        value = energy(x, turns)
        value.backward()
        return value

    optimizer.step(closure)
    np.testing.assert_allclose(found, x.detach().numpy(), atol=1e-4)


def test_a_finer_mesh_is_as_stiff():
    dent = [0, 0, 1.0]
    results = []
    for mesh in (BALL, trimesh.creation.icosphere(4)):
        points = np.asarray(mesh.vertices)
        near = np.exp(-20 * ((points - dent) ** 2).sum(1))[:, None]
        dented = points - 0.3 * near * dent
        found = as_rigid_as_possible(dented, points, mesh_edges(np.asarray(mesh.faces)))
        results.append(np.abs(found - points).max() / 0.3)
    assert results[0] == pytest.approx(results[1], rel=0.15)


def test_seams_stay_closed():
    points = POINTS[BALL.faces.reshape(-1)]
    edges = mesh_edges(np.arange(len(points)).reshape(-1, 3))
    noisy = POINTS + np.random.default_rng(0).normal(0, 0.03, POINTS.shape)
    torn = as_rigid_as_possible(noisy[BALL.faces.reshape(-1)], points, edges)
    whole = as_rigid_as_possible(noisy, POINTS, EDGES)
    np.testing.assert_allclose(torn, whole[BALL.faces.reshape(-1)], atol=1e-9)


def test_a_shirt_stays_on_the_body():
    """Two balls, one round the other, whose distance no edge of the mesh keeps."""
    points = np.concatenate([POINTS, 1.02 * POINTS])
    edges = np.concatenate([EDGES, EDGES + len(POINTS)])
    rng = np.random.default_rng(0)
    posed = points * [1, 1, 1.3]
    noisy = posed + rng.normal(0, 0.05, posed.shape)
    found = as_rigid_as_possible(noisy, points, edges)
    inner, outer = np.split(found, 2)
    gap = np.linalg.norm(outer, axis=1) - np.linalg.norm(inner, axis=1)
    raw = np.linalg.norm(np.split(noisy, 2), axis=-1)
    assert (gap > 0).mean() > 0.9 > 0.7 > (raw[1] > raw[0]).mean()


def test_without_reach_or_edges_nothing_happens():
    noisy = POINTS + 0.1
    for edges, reach in ((EDGES, 0), (EDGES[:0], 0.1)):
        found = as_rigid_as_possible(noisy, POINTS, edges, reach)
        np.testing.assert_array_equal(found, noisy)


def test_many_small_pieces_are_quick():
    places = np.random.default_rng(0).uniform(-1, 1, (3000, 1, 3))
    corners = np.eye(3) * 0.01
    points = (places + corners).reshape(-1, 3)
    edges = mesh_edges(np.arange(len(points)).reshape(-1, 3))
    began = time.monotonic()
    found = as_rigid_as_possible(points, points, edges)
    assert time.monotonic() - began < 30
    np.testing.assert_allclose(found, points, atol=1e-9)


def test_bad_input():
    with pytest.raises(HeadError, match="reach"):
        as_rigid_as_possible(POINTS, POINTS, EDGES, -1.0)
    with pytest.raises(HeadError, match="points: 3 for a target of 642"):
        as_rigid_as_possible(POINTS[:3], POINTS, EDGES)
