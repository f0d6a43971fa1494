"""The networks of pose transfer: against plain layers, any order, bad input."""

from math import inf, nan

import pytest
import torch
import torch.nn.functional as F
from torch import nn
from torch.autograd import gradcheck

from skinlib.head import HeadError
from skinlib.pose_transfer import networks
from skinlib.pose_transfer.networks import (
    NETWORKS,
    CoreNetConfig,
    DSFFNet,
    DSFFNetConfig,
    ElaIN,
    FFAdaIN,
    NPTConfig,
    SPAdaIN,
    cosine_correlation,
    instance_norm,
    optimal_transport,
    parameter_kb,
)

TINY = {
    "dsffnet": DSFFNetConfig(width=32, encoder=8, alpha_init=0.5, by_area=False),
    "npt": NPTConfig(width=32, encoder=8),
    "corenet": CoreNetConfig(width=32),
}


def network(name: str, seed: int = 0, **changes) -> nn.Module:
    torch.manual_seed(seed)
    make = NETWORKS[name][0]
    return make(type(TINY[name])(**vars(TINY[name]) | changes)).eval()


def points(batch: int, count: int, seed: int) -> torch.Tensor:
    return 2 * torch.rand(batch, count, 3, generator=torch.manual_seed(seed)) - 1


def shuffled(count: int, seed: int) -> torch.Tensor:
    return torch.randperm(count, generator=torch.manual_seed(seed))


@pytest.fixture
def source() -> torch.Tensor:
    return points(2, 50, seed=1)


@pytest.fixture
def identity() -> torch.Tensor:
    return points(2, 37, seed=2)


every_network = pytest.mark.parametrize("name", NETWORKS)


# --- size -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "published", "parameters"),
    [
        ("dsffnet", 36_631, 9_371_023),
        ("npt", 23_668, 6_054_941),
        ("corenet", 95_647, 24_455_303),
    ],
)
def test_the_published_size(name, published, parameters):
    make, config = NETWORKS[name]
    full = make(config())
    assert parameter_kb(full) == parameters * 4 / 1024
    assert parameter_kb(full) == pytest.approx(published, rel=0.01)


@pytest.mark.parametrize(
    ("name", "parameters"),
    [("dsffnet", 606_159), ("npt", 403_933), ("corenet", 1_535_015)],
)
def test_the_narrow_size(name, parameters):
    make, config = NETWORKS[name]
    assert parameter_kb(make(config.narrow())) == parameters * 4 / 1024


def test_narrow_takes_changes():
    config = DSFFNetConfig.narrow(alpha_init=0, target_side=False)
    assert config == DSFFNetConfig(256, 32, 0, target_side=False)
    assert NPTConfig.narrow(pool=False) == NPTConfig(256, 32, pool=False)
    assert CoreNetConfig.narrow(iterations=3) == CoreNetConfig(256, iterations=3)


@every_network
def test_the_description_makes_the_same_network(name, source, identity):
    first = network(name)
    make, config = NETWORKS[name]
    again = make(config(**first.describe())).eval()
    again.load_state_dict(first.state_dict())
    assert torch.equal(again(source, identity), first(source, identity))


# --- any counts, any order ------------------------------------------------------------


@every_network
@pytest.mark.parametrize(("m", "n"), [(2, 2), (50, 37), (9, 300), (300, 9)])
def test_any_counts(name, m, n):
    found = network(name)(points(2, m, 0), points(2, n, 1))
    assert found.shape == (2, n, 3)
    assert found.isfinite().all() and found.abs().max() <= 2


@every_network
def test_the_identity_keeps_its_order(name, source, identity):
    order = shuffled(37, seed=3)
    found = network(name)(source, identity)
    again = network(name)(source, identity[:, order])
    assert (again - found[:, order]).abs().max() < 1e-5
    assert (found - found[:, order]).abs().max() > 1e-2


@every_network
def test_the_order_of_the_source_does_not_matter(name, source, identity):
    found = network(name)(source, identity)
    again = network(name)(source[:, shuffled(50, seed=3)], identity)
    assert (again - found).abs().max() < 1e-5


@every_network
@pytest.mark.parametrize("index", [0, 1])
def test_one_of_a_batch_is_as_alone(name, index, source, identity):
    net = network(name)
    alone = net(source[index : index + 1], identity[index : index + 1])
    assert (net(source, identity)[index] - alone[0]).abs().max() < 1e-5


@every_network
def test_the_output_follows_source_and_identity(name, source, identity):
    net = network(name)
    found = net(source, identity)
    for other in (net(source.flip(0), identity), net(source, identity.flip(0))):
        assert (other - found).abs().max() > 1e-3


def test_the_code_is_a_maximum_not_a_sum(source):
    net = network("dsffnet")
    twice = torch.cat([source, source], dim=1)
    assert (net.encode(twice) - net.encode(source)).abs().max() < 1e-5


@every_network
def test_in_parts_as_at_once(name, source, identity, monkeypatch):
    net = network(name)
    found = net(source, identity)
    monkeypatch.setattr(networks, "COLUMNS", 10)
    with torch.no_grad():
        assert (net(source, identity) - found).abs().max() < 1e-5


# --- against the layers that repeat the code ------------------------------------------


def mixed_feature(code: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    return torch.cat([code.expand(-1, -1, v.shape[2]), v], dim=1)


def plain_ffadain(layer, h, v, code):
    mixed = mixed_feature(code, v)
    gamma, delta = layer.gamma_mix(mixed), layer.delta_mix(mixed)
    if layer.alpha is not None:
        gamma = layer.alpha * gamma + (1 - layer.alpha) * layer.gamma(v)
        delta = layer.beta * delta + (1 - layer.beta) * layer.delta(v)
    return gamma * nn.InstanceNorm1d(h.shape[1])(h) + delta


def plain_spadain(layer, h, v, code=None):
    if layer.normalise:
        h = nn.InstanceNorm1d(h.shape[1])(h)
    return layer.gamma(v) * h + layer.delta(v)


@pytest.fixture
def features() -> tuple[torch.Tensor, ...]:
    """h (2, 6, 21), v (2, 3, 21), code (2, 5, 1)."""
    torch.manual_seed(4)
    return torch.randn(2, 6, 21), torch.randn(2, 3, 21), torch.randn(2, 5, 1)


@pytest.mark.parametrize("target_side", [True, False])
def test_ffadain_is_the_repeated_form(features, target_side):
    h, v, code = features
    layer = FFAdaIN(6, 5, target_side=target_side)
    if target_side:
        layer.alpha.data, layer.beta.data = torch.tensor(0.3), torch.tensor(-0.7)
    found, plain = layer(h, v, code), plain_ffadain(layer, h, v, code)
    assert (found - plain).abs().max() < 1e-5
    weights = torch.randn(found.shape)
    parameters = list(layer.parameters())
    slopes = torch.autograd.grad((found * weights).sum(), parameters)
    for a, b in zip(
        slopes, torch.autograd.grad((plain * weights).sum(), parameters), strict=True
    ):
        assert (a - b).abs().max() < 1e-4


@pytest.mark.parametrize("normalise", [True, False])
def test_spadain_is_the_plain_form(features, normalise):
    h, v, code = features
    layer = SPAdaIN(6, normalise)
    found = layer(h, v, code)
    assert (found - plain_spadain(layer, h, v)).abs().max() < 1e-5


@pytest.mark.parametrize(
    "changes", [{}, {"spadain_first": True}, {"target_side": False}]
)
def test_dsffnet_is_the_repeated_form(changes, source, identity):
    net = network("dsffnet", **changes)
    v, code = identity.mT, net.encode(source)
    x = source.mT
    for conv in net.encoder.convs:
        x = F.relu(nn.InstanceNorm1d(conv.out_channels)(conv(x)))
    assert (x.amax(2, keepdim=True) - code).abs().max() < 1e-5
    h = v
    for conv, block in zip(net.convs, net.blocks, strict=False):
        h = conv(h)
        first = plain_spadain if changes.get("spadain_first") else plain_ffadain
        x1 = block.conv1(F.relu(first(block.first, h, v, code)))
        h = x1 + block.conv2(F.relu(plain_ffadain(block.second, x1, v, code)))
    plain = 2 * torch.tanh(net.convs[3](h)).mT
    assert (net(source, identity) - plain).abs().max() < 1e-5


@pytest.mark.parametrize("pool", [True, False])
def test_npt_is_the_repeated_form(pool, identity):
    net, source = network("npt", pool=pool), points(2, 37, 5)
    v = identity.mT
    h = mixed_feature(net.encode(source), v)
    for index, (conv, block) in enumerate(zip(net.convs, net.blocks, strict=False)):
        h = conv(h)
        assert all(n.normalise == (index > 0 or not pool) for n in block.norms)
        x = block.convs[0](F.relu(plain_spadain(block.norms[0], h, v)))
        x = block.convs[1](F.relu(plain_spadain(block.norms[1], x, v)))
        h = x + block.convs[2](F.relu(plain_spadain(block.norms[2], h, v)))
    plain = 2 * torch.tanh(net.convs[3](h)).mT
    assert (net(source, identity) - plain).abs().max() < 1e-5


def test_nothing_is_as_large_as_a_repeated_code(source, identity):
    """Of all arrays of a step only features of N vertices have N columns."""
    net = network("dsffnet", width=64)
    sizes = set()

    class Watch(torch.overrides.TorchFunctionMode):
        def __torch_function__(self, function, types, args=(), kwargs=None):
            out = function(*args, **(kwargs or {}))
            if isinstance(out, torch.Tensor) and out.dim() == 3:
                sizes.add(out.shape[1:])
            return out

    with Watch():
        net(source, identity)
    assert (64, 37) in sizes and (67, 37) not in sizes


# --- the surface counts, not the vertices ---------------------------------------------


def test_vertices_of_one_share_are_plain_instance_normalisation():
    h = torch.randn(2, 6, 40, generator=torch.manual_seed(0))
    plain = F.instance_norm(h, eps=networks.EPS)
    for share in (None, torch.full((2, 40), 1 / 40)):
        assert (instance_norm(h, share) - plain).abs().max() < 1e-5


def test_instance_norm_by_hand_and_by_differences():
    h = torch.tensor([[[0.0, 3, 6]]], dtype=torch.double)
    share = torch.tensor([[0.5, 0.25, 0.25]], dtype=torch.double)
    mean, variance = 2.25, 0.5 * 2.25**2 + 0.25 * 0.75**2 + 0.25 * 3.75**2
    expected = (h - mean) / (variance + networks.EPS) ** 0.5
    assert (instance_norm(h, share) - expected).abs().max() < 1e-12
    assert gradcheck(lambda x: instance_norm(x, share), h.requires_grad_())


@pytest.mark.parametrize("name", ["dsffnet", "npt"])
def test_a_vertex_in_pieces_counts_as_one(name, source, identity):
    """Seven copies that have a seventh each change nothing, and change the mean."""
    copies = [0] * 6 + [*range(37)]
    shares = torch.rand(2, 37, generator=torch.manual_seed(3)).softmax(dim=1)
    pieces = shares[:, copies]
    pieces[:, [0, 1, 2, 3, 4, 5, 6]] = shares[:, :1] / 7
    for by_area in (True, False):
        net = network(name, by_area=by_area)
        for give in (
            lambda p, s: (source, p, shares.new_full((2, 50), 0.02), s),
            lambda p, s: (p, identity, s, shares),
        ):
            one = net(*give(identity, shares))
            many = net(*give(identity[:, copies], pieces))[:, -37:]
            assert ((one - many).abs().max() < 1e-5) == by_area


@pytest.mark.parametrize("name", ["dsffnet", "npt"])
@pytest.mark.parametrize(
    ("share", "words"),
    [
        (None, "it is absent"),
        (torch.ones(2, 36), r"\(2, 36\) for the identity's \(2, 37, 3\)"),
    ],
)
def test_shares_that_are_not_there(name, share, words, source, identity):
    theirs = torch.full((2, 50), 0.02)
    with pytest.raises(HeadError, match=f"share: .*{words}"):
        network(name, by_area=True)(source, identity, theirs, share)


# --- what FFAdaIN is for --------------------------------------------------------------


def test_instance_normalisation_takes_a_shared_code_out(features):
    h, v, code = features
    moved = h + 5 * torch.randn(2, 6, 1)
    spadain, bare, ffadain = SPAdaIN(6), SPAdaIN(6, normalise=False), FFAdaIN(6, 5, 0.5)
    assert (spadain(moved, v, code) - spadain(h, v, code)).abs().max() < 1e-5
    assert (bare(moved, v, code) - bare(h, v, code)).abs().max() > 0.1
    assert (ffadain(h, v, 1 + code) - ffadain(h, v, code)).abs().max() > 0.1


def test_ffadain_by_hand():
    # One channel, two vertices at x = -1 and 1, a code of 1 number, 10.
    layer = FFAdaIN(1, 1)
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.zero_()
        layer.alpha.fill_(0.25)
        layer.beta.fill_(0.5)
        layer.gamma_mix.weight[0, :, 0] = torch.tensor([0.2, 4, 0, 0])  # 2 + 4 x
        layer.gamma.bias.fill_(4)
        layer.delta_mix.weight[0, 0, 0] = 1  # 10
        layer.delta.weight[0, 0, 0] = 2  # 2 x
    v = torch.tensor([[[-1.0, 1], [0, 0], [0, 0]]])
    h = torch.tensor([[[100.0, 300]]])  # normalised: -1, 1
    # gamma: .25 (-2, 6) + .75 * 4 = (2.5, 4.5); delta: .5 * 10 + .5 (-2, 2) = (4, 6)
    found = layer(h, v, torch.tensor([[[10.0]]]))
    assert found.flatten().tolist() == pytest.approx([1.5, 10.5])


def test_alpha_and_beta_start_where_they_are_told():
    assert (network("dsffnet").mixing() == 0.5).all()
    assert network("dsffnet", alpha_init=0).mixing().tolist() == [[0, 0]] * 6
    assert network("dsffnet", spadain_first=True).mixing().shape == (3, 2)
    assert network("dsffnet", target_side=False).mixing().shape == (0, 2)


@pytest.mark.parametrize("alpha_init", [0, 0.5])
def test_only_alpha_0_keeps_the_gradient_from_the_encoder(alpha_init, source, identity):
    net = network("dsffnet", alpha_init=alpha_init)
    net(source, identity).square().mean().backward()
    slope = max(p.grad.abs().max() for p in net.encoder.convs[2].parameters())
    assert (slope == 0) == (alpha_init == 0)
    assert net.blocks[0].first.alpha.grad != 0


def test_a_mixed_side_of_share_0_is_spadain(features):
    h, v, code = features
    layer, plain = FFAdaIN(6, 5, alpha_init=0), SPAdaIN(6)
    plain.gamma, plain.delta = layer.gamma, layer.delta
    assert torch.equal(layer(h, v, code), plain(h, v, code))


@every_network
def test_it_learns(name, source, identity):
    """A few steps towards a target that depends on both."""
    net = network(name).train()
    target = 0.5 * identity + 0.5 * source.mean(1, keepdim=True)
    optimiser = torch.optim.AdamW(net.parameters(), 3e-3)
    losses = []
    for _ in range(60):
        loss = (net(source, identity) - target).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.2 * losses[0]
    for parameter_name, parameter in net.named_parameters():
        assert parameter.grad.isfinite().all(), parameter_name


# --- 3D-CoreNet -----------------------------------------------------------------------


def test_cosines_of_columns():
    torch.manual_seed(0)
    a, b = torch.randn(2, 7, 4), torch.randn(2, 7, 5)
    found = cosine_correlation(a, b)
    plain = F.cosine_similarity(a[..., None], b[:, :, None], dim=1)
    assert (found - plain).abs().max() < 1e-6
    assert cosine_correlation(torch.zeros(1, 2, 1), b[:1, :2]).abs().max() == 0


def test_transport_by_hand():
    """Two by two there is a closed form: odds of the square root of the odds ratio."""
    likes = torch.tensor([[[1.0, 0.9], [1.0, 0.7]]], dtype=torch.float64)
    kernel = ((likes - 1) / 0.1).exp()[0]
    odds = (kernel[0, 0] * kernel[1, 1] / kernel[0, 1] / kernel[1, 0]).sqrt()
    expected = torch.tensor([[odds, 1], [1, odds]]) / (1 + odds)
    found = optimal_transport(likes, 0.1, iterations=200)
    assert (found[0] - expected).abs().max() < 1e-6
    softmax = optimal_transport(likes, 0.1, iterations=0)
    assert (softmax - (likes / 0.1).softmax(-1)).abs().max() < 1e-12


def test_transport_shares_the_mass():
    correlation = 2 * torch.rand(2, 6, 9, generator=torch.manual_seed(0)) - 1
    plan = optimal_transport(correlation, 0.3, iterations=200)
    assert (plan >= 0).all()
    assert (plan.sum(2) - 1).abs().max() < 1e-5
    assert (plan.sum(1) - 6 / 9).abs().max() < 1e-3
    rough = optimal_transport(correlation, 0.3, iterations=1)
    assert (rough.sum(1) - 6 / 9).abs().max() > 1e-2
    assert (rough.sum(2) - 1).abs().max() < 1e-5


def test_transport_finds_a_permutation():
    features = torch.randn(1, 16, 12, generator=torch.manual_seed(0))
    order = shuffled(12, seed=1)
    plan = optimal_transport(cosine_correlation(features, features[..., order]))
    assert (plan[0][:, order.argsort()] - torch.eye(12)).abs().max() < 1e-3


def test_transport_is_finite_where_nothing_is_alike():
    correlation = torch.full((1, 3, 4), -1.0, requires_grad=True)
    plan = optimal_transport(correlation)
    assert (plan - 0.25).abs().max() < 1e-6
    plan.square().sum().backward()
    assert correlation.grad.isfinite().all()
    lonely = torch.ones(1, 3, 4)
    lonely[:, 0], lonely[:, :, 0] = -1, -1
    lonely.requires_grad_()
    plan = optimal_transport(lonely)
    assert (plan.sum(2) - 1).abs().max() < 1e-5
    plan.square().sum().backward()
    assert lonely.grad.isfinite().all()


def test_transport_has_the_right_derivative():
    correlation = torch.rand(1, 3, 4, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda c: optimal_transport(c, 0.5, 3), correlation)


@pytest.mark.parametrize("epsilon", [0, 0.02, -1, nan, inf])
def test_an_epsilon_out_of_range(epsilon):
    with pytest.raises(HeadError, match="epsilon"):
        optimal_transport(torch.ones(1, 2, 2), epsilon)
    with pytest.raises(HeadError, match="epsilon"):
        CoreNetConfig(epsilon=epsilon)


def test_a_plan_too_large_is_refused_before_it_is_made(source, identity):
    net = network("corenet")
    with pytest.raises(HeadError, match=r"1 x 200000 x 200000.*fewer"):
        net(torch.zeros(1, 200_000, 3), torch.zeros(1, 200_000, 3))


def test_the_warped_points_are_means_of_the_source(source, identity):
    plan, features = network("corenet").correspond(source, identity)
    assert plan.shape == (2, 37, 50) and features.shape == (2, 8, 37)
    warped = plan @ source
    assert (warped <= source.amax(1, keepdim=True) + 1e-5).all()
    assert (warped >= source.amin(1, keepdim=True) - 1e-5).all()


def test_elain_by_hand():
    layer = ElaIN(1, 1)
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.zero_()
        layer.align.weight.fill_(1)
        layer.gamma.weight.fill_(2)
        layer.delta.bias.fill_(7)
    h = torch.tensor([[[10.0, 14]]])  # mean 12, deviation 2, normalised -1 and 1
    side = torch.tensor([[[1.0, 3]]])
    # w = 0: (1 + 2) h' + 12
    assert layer(h, side).flatten().tolist() == pytest.approx([9, 15], abs=1e-4)
    layer.weigh.bias.data.fill_(1)  # w = 1: (1 + 2 f) h' + 7
    assert layer(h, side).flatten().tolist() == pytest.approx([4, 14], abs=1e-4)
    layer.weigh.bias.data.fill_(0)
    layer.weigh.weight.data[0, :, 0] = torch.tensor([1.0, -0.125])  # 2 - 1.5
    # w = 1/2: (1 + f + 1) h' + 3.5 + 6
    assert layer(h, side).flatten().tolist() == pytest.approx([6.5, 14.5], abs=1e-4)


def test_corenet_is_the_plain_form(source, identity):
    net = network("corenet")

    def norm(x):
        return nn.InstanceNorm1d(x.shape[1])(x)

    def embed(points):
        x = norm(net.features[0](points.mT))
        for index in (3, 6):
            x = norm(net.features[index](F.leaky_relu(x, 0.2)))
        x = x / x.norm(dim=1, keepdim=True)
        for block in net.refine:
            y = norm(block.conv2(block.act(norm(block.conv1(x)))))
            x = block.act(x + y)
        return x

    side = embed(identity)
    a, b = net.match_identity(side), net.match_source(embed(source))
    plan, found = net.correspond(source, identity)
    assert (found - side).abs().max() < 1e-5
    cosines = F.cosine_similarity(a[..., None], b[:, :, None], dim=1)
    assert (plan - optimal_transport(cosines)).abs().max() < 1e-4

    h = net.start((plan @ source).mT)
    for conv, block in zip(net.convs, net.blocks, strict=False):

        def step(index, x, block=block):
            x = F.leaky_relu(block.norms[index](x, side), 0.2)
            return block.convs[index](x)

        h = conv(h)
        h = step(1, step(0, h)) + step(2, h)
    plain = 2 * torch.tanh(net.convs[3](h)).mT
    assert (net(source, identity) - plain).abs().max() < 1e-4


def test_the_convolutions_of_corenet_stretch_nothing(source, identity):
    net = network("corenet").train()
    for _ in range(30):
        net(source, identity)
    net.eval()
    for block in net.blocks:
        for conv in block.convs:
            largest = torch.linalg.svdvals(conv.weight.detach()[..., 0])[0]
            assert largest == pytest.approx(1, abs=0.02)


# --- bad input ------------------------------------------------------------------------


@every_network
@pytest.mark.parametrize(("m", "n"), [(1, 5), (5, 1), (0, 5), (5, 0)])
def test_one_vertex_cannot_be_normalised(name, m, n):
    with pytest.raises(HeadError, match=r"[01] vertices.*two or more"):
        network(name)(torch.zeros(1, m, 3), torch.zeros(1, n, 3))


@every_network
@pytest.mark.parametrize("value", [nan, inf])
@pytest.mark.parametrize("which", [0, 1])
def test_a_coordinate_that_is_no_number(name, value, which, source, identity):
    bad = [source, identity]
    bad[which][1, 3, 2] = value
    field = ("source", "identity")[which]
    with pytest.raises(HeadError, match=f"{field}: 1 coordinates are NaN or infinite"):
        network(name)(*bad)


@every_network
def test_shapes_that_do_not_fit(name, source, identity):
    net = network(name)
    with pytest.raises(HeadError, match=r"source: shape \(50, 3\)"):
        net(source[0], identity)
    with pytest.raises(HeadError, match=r"identity: shape \(2, 3, 37\)"):
        net(source, identity.mT)
    with pytest.raises(HeadError, match="batch of 1 for 2"):
        net(source[:1], identity)
    with pytest.raises(HeadError, match="batch of 0 for 0"):
        net(source[:0], identity[:0])


@every_network
def test_all_vertices_at_one_place(name, identity):
    found = network(name)(torch.zeros(2, 5, 3), identity)
    assert found.isfinite().all()
    assert network(name)(identity, torch.ones(2, 5, 3)).isfinite().all()


def test_codes_of_vertices_need_as_many_vertices(source, identity):
    net = network("npt", pool=False)
    with pytest.raises(HeadError, match="50 vertices for 37"):
        net(source, identity)
    assert net(source[:, :37], identity).shape == (2, 37, 3)


@pytest.mark.parametrize(
    "make",
    [
        lambda: DSFFNetConfig(width=0),
        lambda: DSFFNetConfig(width=30),
        lambda: NPTConfig(width=2),
        lambda: CoreNetConfig(width=24),
    ],
)
def test_a_width_that_cannot_be_divided(make):
    with pytest.raises(HeadError, match="width"):
        make()


def test_an_encoder_without_channels():
    for make in (DSFFNetConfig, NPTConfig):
        with pytest.raises(HeadError, match="encoder"):
            make(encoder=0)


def test_an_alpha_that_is_no_number():
    with pytest.raises(HeadError, match="alpha_init"):
        DSFFNetConfig(alpha_init=nan)


@every_network
def test_half_precision_and_double(name, source, identity):
    net = network(name)
    exact = net.double()(source.double(), identity.double())
    assert (net.float()(source, identity) - exact).abs().max() < 1e-4
    with torch.autocast("cpu", torch.bfloat16):
        assert (net(source, identity) - exact).abs().max() < 0.2


@pytest.mark.slow
def test_two_hundred_thousand_vertices():
    net = DSFFNet().eval()
    with torch.inference_mode():
        found = net(points(1, 5000, 0), points(1, 200_000, 1))
    assert found.shape == (1, 200_000, 3) and found.isfinite().all()
