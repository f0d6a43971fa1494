"""The network: blend skinning before it has learnt, and linear in its columns."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_body import bends, sleeve, small_body

from skinlib.garments.motion import Motion
from skinlib.garments.outfit import Outfit
from skinlib.garments.pbns import PBNS, PBNSConfig
from skinlib.skinning import linear_blend_skinning

SMALL = PBNSConfig(hidden=8, embedding=6, layers=3)
FIXED = PBNSConfig(hidden=8, embedding=6, layers=3, learn_weights=False)


@pytest.fixture(scope="module")
def outfit() -> Outfit:
    return Outfit(small_body(), (sleeve(0.115),))


@pytest.fixture
def network(outfit) -> PBNS:
    return outfit.network(SMALL, smoothing=2, shapes=False, seed=0)


@pytest.fixture
def shaped(outfit) -> PBNS:
    return outfit.network(SMALL, smoothing=2, shapes=True, seed=0)


def transforms(outfit, motion: Motion) -> torch.Tensor:
    return torch.from_numpy(motion.transforms(outfit.body.head.skeleton))


def learnt(network: PBNS, seed: int = 0) -> PBNS:
    """As after training: with offsets and other blend weights."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        network.columns.normal_(0, 0.02, generator=generator)
        if network.weight_change is not None:
            network.weight_change.normal_(0, 1, generator=generator)
    return network


# --- untrained ------------------------------------------------------------------------


@pytest.mark.parametrize("config", [SMALL, FIXED])
def test_untrained_it_is_linear_blend_skinning(outfit, config):
    network, motion = outfit.network(config, 2, False, 0), bends()
    bones = transforms(outfit, motion)
    posed, offsets = network(network.inputs(motion.rotations), bones)
    weights = outfit.blend_weights(2)
    expected = linear_blend_skinning(outfit.vertices, weights, bones.numpy())
    assert np.abs(posed.detach().numpy() - expected).max() < 1e-5
    assert not offsets.any() and offsets.shape == posed.shape == (12, 312, 3)


def test_the_columns_learn_from_the_first_step_on(outfit, network):
    motion = bends()
    bones = transforms(outfit, motion)
    posed, _ = network(network.inputs(motion.rotations), bones)
    posed[..., 2].square().sum().backward()
    for parameter in (network.columns, network.weight_change):
        assert parameter.grad.abs().max() > 1e-3
        assert parameter.grad.isfinite().all()


def test_the_same_seed_is_the_same_network(outfit, network):
    same = outfit.network(SMALL, 2, False, 0).state_dict()
    other = outfit.network(SMALL, 2, False, 1).state_dict()
    weight = "embed.0.weight"
    assert torch.equal(same[weight], network.state_dict()[weight])
    assert not torch.equal(other[weight], same[weight])


@pytest.mark.parametrize("source", [False, True])
def test_every_column_can_learn_unlike_those_of_the_source(outfit, source):
    """A ReLU that is off in all poses passes no gradient to its column, nor itself."""
    config = PBNSConfig(slope=0.0, rounding=0.0) if source else PBNSConfig()
    network, motion = outfit.network(config, 2, False, 0), bends(200)
    amounts = network.embed(network.inputs(motion.rotations))
    assert amounts.min() >= 0
    asleep = (amounts == 0).all(0)
    posed, _ = network(network.inputs(motion.rotations), transforms(outfit, motion))
    posed[..., 2].square().sum().backward()
    moved = network.columns.grad.any(dim=1)
    assert torch.equal(moved, ~asleep)
    assert asleep.any() == source


def test_the_last_unit_is_a_relu_with_a_round_corner():
    unit = outfit_units(PBNSConfig())[-1]
    far = torch.tensor([-2.0, 0, 2])
    # 0.05 ln 2 in the corner.
    assert unit(far).tolist() == pytest.approx([0, 0.03466, 2], abs=1e-4)
    assert unit(far).min() >= 0
    assert outfit_units(PBNSConfig())[1](far).tolist() == pytest.approx([-0.2, 0, 2])
    source = PBNSConfig(slope=0.0, rounding=0.0)
    assert {type(unit) for unit in outfit_units(source)[1::2]} == {torch.nn.ReLU}


def outfit_units(config: PBNSConfig) -> torch.nn.Sequential:
    none, one = np.zeros((0, 1, 3), np.float32), np.ones((1, 1), np.float32)
    return PBNS(np.zeros((1, 3), np.float32), one, np.array([0]), none, config).embed


# --- blend weights --------------------------------------------------------------------


def test_a_weight_of_0_stays_0_and_rows_sum_to_1(outfit):
    weights = np.array([[1, 0, 0], [0.5, 0.5, 0], [0.2, 0.3, 0.5]], np.float32)
    template = np.zeros((3, 3), np.float32)
    none = np.zeros((0, 3, 3), np.float32)
    network = PBNS(template, weights, np.array([1, 2]), none, SMALL)
    assert np.allclose(network.blend_weights.detach(), weights, atol=1e-6)
    with torch.no_grad():
        network.weight_change += torch.tensor(
            [[-5.0, 9, 9], [np.log(3), 0, 9], [1] * 3]
        )
    found = network.blend_weights
    expected = [[1, 0, 0], [0.75, 0.25, 0], [0.2, 0.3, 0.5]]
    assert np.allclose(found.detach(), expected, atol=1e-6)
    assert (found[weights == 0] == 0).all()
    (found * torch.tensor([1.0, 2, 3])).sum().backward()
    slope = network.weight_change.grad
    assert slope.isfinite().all() and not slope[weights == 0].any()
    assert slope[1, 0] == pytest.approx(-0.75 * 0.25)  # w_0 w_1 (1 - 2)


def test_weights_that_are_not_learnt_are_those_at_the_start(outfit):
    network = outfit.network(FIXED, 2, False, 0)
    assert torch.equal(network.blend_weights, torch.tensor(outfit.blend_weights(2)))
    assert "weight_change" not in dict(network.named_parameters())


def test_baked_it_moves_alike_and_learns_no_weights(outfit, network):
    motion = bends()
    bones, inputs = transforms(outfit, motion), network.inputs(motion.rotations)
    posed, _ = learnt(network)(inputs, bones)
    baked = network.baked()
    assert baked.weight_change is None and not baked.config.learn_weights
    assert (baked(inputs, bones)[0] - posed).abs().max() < 1e-6
    again = baked.baked()
    assert torch.equal(again(inputs, bones)[0], baked(inputs, bones)[0])


# --- what it reads --------------------------------------------------------------------


def turned(motion: Motion, axis, angle: float) -> np.ndarray:
    """The rotations of a body that is turned as a whole besides."""
    rotations = motion.rotations.copy()
    turn = Rotation.from_rotvec(np.array(axis, float) * angle)
    rotations[:, 0] = (turn * Rotation.from_rotvec(rotations[:, 0])).as_rotvec()
    return rotations


@pytest.mark.parametrize("angle", [0.3, 2.0, -3.1])
def test_inputs_are_the_same_however_the_body_faces(network, angle):
    motion = bends()
    inputs = network.inputs(motion.rotations)
    faced = network.inputs(turned(motion, [0, 0, 1], angle))
    assert (faced - inputs).abs().max() < 1e-5
    for axis in ([1, 0, 0], [0, 1, 0]):
        leant = network.inputs(turned(motion, axis, angle))
        assert (leant - inputs).abs().max() > 0.1


def test_inputs_by_hand(network):
    # A quarter turn about X puts the body on its back: its own -Z is down at rest, now
    # its own +Y is up.
    rotations = np.zeros((2, 3, 3), np.float32)
    rotations[1, 0] = [np.pi / 2, 0, 0]
    rotations[1, 1:] = [[1, 2, 3], [4, 5, 6]]
    inputs = network.inputs(rotations)
    assert inputs.dtype == torch.float32 and network.bones.tolist() == [1, 2]
    assert inputs[0].tolist() == [0, 0, 0, 0, 0, 0, 0, 0, 1]
    assert inputs[1].tolist() == pytest.approx([1, 2, 3, 4, 5, 6, 0, 1, 0], abs=1e-6)


def test_shapes_and_ease_are_read_too(network, shaped):
    rotations = bends(2).rotations
    plain = network.inputs(rotations)
    shape, ease = np.array([[0.5, -1], [0, 0.25]]), np.array([0.1, 0])
    inputs = shaped.inputs(rotations, shape, ease)
    assert torch.equal(inputs[:, :9], plain)
    assert np.allclose(inputs[:, 9:], [[0.5, -1, 1], [0, 0.25, 0]])
    assert torch.equal(shaped.inputs(rotations)[:, 9:], torch.zeros(2, 3))


# --- what it does ---------------------------------------------------------------------


def test_offsets_are_a_mixture_of_the_columns(network):
    inputs = network.inputs(bends().rotations)
    a, b = torch.randn(2, *network.columns.shape, generator=torch.manual_seed(0))

    def offsets(columns):
        network.columns.data = columns
        return network.offsets(inputs).detach()

    assert (offsets(2 * a - b) - (2 * offsets(a) - offsets(b))).abs().max() < 1e-5
    amounts = network.embed(inputs).detach()
    used = int(amounts.sum(dim=0).argmax())
    one = torch.zeros_like(a)
    one[used, 7] = 1  # y of vertex 2
    moved = offsets(one)
    assert torch.equal(moved[:, 2, 1], amounts[:, used])
    assert moved.count_nonzero() == moved[:, 2, 1].count_nonzero() > 0


def test_offsets_are_added_before_the_bones_move(outfit, network):
    motion = bends()
    bones = transforms(outfit, motion)
    posed, offsets = learnt(network)(network.inputs(motion.rotations), bones)
    weights = network.blend_weights.detach().numpy()
    for frame in range(len(motion)):
        rest = outfit.vertices + offsets[frame].detach().numpy()
        expected = linear_blend_skinning(rest, weights, bones[frame].numpy())
        assert np.abs(posed[frame].detach().numpy() - expected).max() < 1e-5


def test_a_garment_is_cut_for_the_shape(outfit, shaped):
    assert shaped.graded(None) is shaped.template
    cut = shaped.graded(torch.tensor([[0.5, -1], [0, 0]]))
    assert torch.equal(cut[1], shaped.template)
    # It goes with the skin below, 0.01 outwards and a tenth down, but smoother.
    away, height = shaped.template[:, :2].norm(dim=1), shaped.template[:, 2]
    around = cut[0, :, :2].norm(dim=1) - away
    assert 0.006 < around.min() and around.max() < 0.01
    assert (cut[0, :, 2] - 0.9 * height).abs().max() < 0.015  # the hems
    assert (cut[0, :, 2] - 0.9 * height).abs().median() < 0.005
    assert torch.equal(shaped.graded(torch.tensor([0.5, -1])), cut[0])
    motion = bends(2)
    posed, _ = shaped(
        shaped.inputs(motion.rotations),
        torch.eye(4).repeat(2, 3, 1, 1),
        torch.tensor([[0.5, -1], [0, 0]]),
    )
    assert (posed - cut).abs().max() < 1e-6


def test_the_configuration_and_the_buffers_make_the_same_network(outfit, shaped):
    learnt(shaped)
    buffers = [getattr(shaped, name).numpy() for name in PBNS.BUFFERS]
    same = PBNS(*buffers, PBNSConfig(**shaped.describe()))
    same.load_state_dict(shaped.state_dict())
    motion = bends()
    shape = torch.full((12, 2), 0.3)
    inputs = shaped.inputs(motion.rotations, shape.numpy())
    bones = transforms(outfit, motion)
    first, second = shaped(inputs, bones, shape), same(inputs, bones, shape)
    assert torch.equal(first[0], second[0]) and torch.equal(first[1], second[1])
