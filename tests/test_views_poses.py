"""Pictures of pose transfer: the order of vertices, shares of the pose, labs."""

import functools

import numpy as np
import pytest
import torch

from skinlib.datasets.remesh import halve
from skinlib.garments.body import read_body
from skinlib.pose_transfer.data import Cast, drawn_bodies, on_mesh, vertex_shares
from skinlib.pose_transfer.networks import NPT, DSFFNet, DSFFNetConfig, NPTConfig
from skinlib.pose_transfer.population import npt_poses, pairs
from skinlib.views import poses, scenes

SMALL = (60, 64)


@functools.cache
def bodies() -> list:
    """The same two bodies on each of two meshes."""
    heads = drawn_bodies(read_body(), 2)
    meshes = [halve(heads[0], 0, count / len(heads[0].vertices)) for count in (120, 90)]
    return [on_mesh(heads, heads[0], mesh) for mesh in meshes]


@functools.cache
def casts() -> list[Cast]:
    motion = npt_poses(bodies()[0][0].skeleton, 3, seed=0)
    return [Cast(group, motion) for group in bodies()]


def mesh(which: int = 0):
    return bodies()[which][0]


@functools.cache
def network(kind: str = "dsffnet"):
    torch.manual_seed(0)
    if kind == "npt":
        return NPT(NPTConfig(width=32, encoder=8)).eval()
    return DSFFNet(DSFFNetConfig(width=32, encoder=8, alpha_init=0.5)).eval()


@functools.cache
def given():
    """Three sources, and an identity in the order of its mesh."""
    cast = casts()[0]
    points = cast.posed([0, 0, 0, 1], [0, 1, 2, -1])
    points = points / points.abs().amax()
    return points[:3], points[3]


@pytest.fixture(autouse=True)
def fallback(monkeypatch):
    """The painter that runs everywhere."""
    monkeypatch.setenv("SKINLIB_3D", "matplotlib")
    scenes.backend.cache_clear()
    yield
    scenes.backend.cache_clear()


# ---- one mesh, and pairs


def test_the_mesh_of_a_cast():
    found, wanted = poses.mesh_of(casts()[1], who=1), bodies()[1][1]
    assert (found.faces == wanted.faces).all() and found.weights is None
    assert np.allclose(found.vertices, wanted.vertices)


def test_the_camera_stays_where_the_rest_pose_put_it():
    points = poses.stage(mesh()).vertices
    assert np.abs(points).max() == pytest.approx(1)
    still = poses.draw(mesh(), points, size=SMALL)
    low = poses.draw(mesh(), points - [0, 0, 0.5], size=SMALL)
    assert still.shape == (64, 60, 3)
    assert ink_rows(low).mean() > ink_rows(still).mean() + 5


def ink_rows(image: np.ndarray) -> np.ndarray:
    return np.flatnonzero((image < 250).any(axis=(1, 2)))


def test_values_are_painted():
    points, far = poses.stage(mesh()).vertices, np.full(len(mesh().vertices), 15.0)
    near, off = (poses.draw(mesh(), points, v, size=SMALL) for v in (0 * far, far))
    assert off[off < 250].mean() < near[near < 250].mean() - 40


def test_points_go_back_to_the_order_of_the_mesh():
    some = pairs(casts()[:1], 4)[0].batch(range(4))
    truth = poses.in_mesh_order(some.truth, some.order)
    ordered = pairs(casts()[:1], 4, shuffle=False)[0].batch(range(4))
    assert np.abs(truth - ordered.truth.numpy()).max() < 1e-6


def test_a_strip_has_a_row_for_each_way():
    some = pairs(casts(), 4, seed=1)[1].batch([0])
    sources, targets = mesh(0), mesh(1)
    ways = {"copy": some.identity, "truth again": some.truth}
    clay = poses.strip(sources, targets, some, ways, title="rows", size=SMALL)
    off = poses.strip(sources, targets, some, ways, paint="error", size=SMALL)
    rows = [image.image.shape[0] for image in (clay, off)]
    assert rows[0] > 5 * 64 and 2 * 64 < rows[1] < 3 * 64 + 40
    with pytest.raises(ValueError, match="clay or error"):
        poses.strip(sources, targets, some, ways, paint="gold")


# ---- what is left of the pose


def test_a_share_by_hand():
    """Two poses, two vertices: normalised they are (-1, 1) and (-1, 1), or swapped."""
    same = torch.tensor([[[0.0, 2]], [[5.0, 25]]])
    swapped = torch.tensor([[[0.0, 2]], [[25.0, 5]]])
    assert poses.pose_share(same) == pytest.approx(0, abs=1e-4)
    assert poses.pose_share(swapped) == pytest.approx(1, abs=1e-4)
    both = torch.cat([same, swapped], dim=1)
    assert poses.pose_share(both) == pytest.approx(0.5, abs=1e-4)


@pytest.mark.parametrize("kind", ["dsffnet", "npt"])
def test_shares_see_the_pose(kind):
    sources, identity = given()
    shares = poses.pose_shares(network(kind), sources, identity, mesh().faces)
    assert shares.shape == (len(poses.LAYERS),)
    assert (shares > 0).all() and (shares < 1).all()
    one = sources[:1].expand(3, -1, -1)
    assert poses.pose_shares(network(kind), one, identity, mesh().faces).max() < 1e-6


def test_a_code_that_nobody_is_told():
    sources, identity = given()
    net = network()
    assert poses.pose_shares(net, sources, identity, mesh().faces, told=0).max() < 1e-6
    first = poses.pose_shares(net, sources, identity, mesh().faces, told=1)
    every = poses.pose_shares(net, sources, identity, mesh().faces, told=6)
    assert first[0] == every[0] and (first[1:] < every[1:]).all()
    assert (every == poses.pose_shares(net, sources, identity, mesh().faces)).all()


def test_hooks_are_taken_off():
    sources, identity = given()
    poses.pose_shares(network(), sources, identity, mesh().faces, told=1)
    assert not any(m._forward_hooks for m in network().modules())
    assert not any(m._forward_pre_hooks for m in network().modules())


def test_one_pose_is_not_enough():
    sources, identity = given()
    with pytest.raises(ValueError, match="two or more"):
        poses.pose_shares(network(), sources[:1], identity, mesh().faces)


def test_shares_are_plotted():
    lines = {"DSFFNet": np.linspace(0.1, 0.4, 7), "NPT": np.full(7, 0.2)}
    assert np.asarray(poses.shares_plot(lines, title="shares")).shape[2] == 3


# ---- poses between poses


@torch.no_grad()
def test_the_ends_of_a_mix_are_the_poses():
    sources, identity = given()
    ends = poses.mixed(
        network(), identity, sources[0], sources[2], mesh().faces, [0, 1, 0.5]
    )
    faces = torch.tensor(mesh().faces)
    for source, posed in zip(sources[[0, 2]], ends, strict=False):
        both = source[None], identity[None]
        theirs = network()(*both, *(vertex_shares(p, faces) for p in both))[0].numpy()
        assert np.abs(posed - theirs).max() < 1e-4
    assert np.abs(ends[2] - ends[0]).max() > 1e-4


def test_every_end_of_the_sliders_draws():
    sources, identity = given()
    lab = poses.mix_lab(network(), mesh(), identity, sources)
    shapes = set()
    for name, control in lab.controls.items():
        for value in (control.min, control.max):
            picture = lab.function(**{**lab.values, name: value})
            shapes.add(np.asarray(picture).shape)
    assert shapes == {(230, 200, 3)}
    assert np.asarray(lab.twin({"mix": 0.0}, {"mix": 1.0})).shape[1] > 400


def test_a_panel_for_each_run():
    values = np.random.default_rng(0).uniform(0, 1, (5, 6, 2))
    one = poses.mixing_plot({"from 0.5": values}, range(5), "learnt")
    two = poses.mixing_plot({"from 0.5": values, "from 0": values[:3]}, range(5))
    assert np.asarray(one).shape == np.asarray(two).shape
