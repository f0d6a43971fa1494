"""The adversarial terms: values by hand, derivatives, and who pulls where."""

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from skinlib.losses import (
    critic_loss,
    generator_loss,
    gradient_penalty,
    unsupervised_critic_loss,
    unsupervised_generator_loss,
)

REAL, FAKE = torch.tensor([4.0, 2.0]), torch.tensor([1.0, -1.0, 3.0])


def test_values_by_hand():
    # Means 3 and 1.
    assert critic_loss(REAL, FAKE).item() == -2
    assert critic_loss(REAL, FAKE, signs="source").item() == 2
    assert generator_loss(FAKE).item() == -1
    assert unsupervised_critic_loss(FAKE).item() == -1
    assert unsupervised_critic_loss(FAKE, REAL).item() == -2
    assert unsupervised_generator_loss(FAKE).item() == 1
    assert unsupervised_generator_loss(FAKE, as_written=False).item() == -1


def test_a_score_is_a_batch_of_one():
    real, fake = torch.tensor(3.0), torch.tensor(1.0)
    assert critic_loss(real, fake).item() == -2
    assert critic_loss(real, FAKE).item() == -2
    for loss in (generator_loss, unsupervised_critic_loss, unsupervised_generator_loss):
        assert loss(fake) == loss(FAKE) and loss(fake).shape == ()


def test_other_signs_are_refused():
    with pytest.raises(ValueError, match="signs is 'lsgan'"):
        critic_loss(REAL, FAKE, signs="lsgan")


@pytest.mark.parametrize(
    "term",
    [
        critic_loss,
        lambda real, fake: critic_loss(real, fake, signs="source"),
        lambda real, fake: unsupervised_critic_loss(fake, real),
        lambda real, fake: generator_loss(fake),
        lambda real, fake: unsupervised_critic_loss(fake),
        lambda real, fake: unsupervised_generator_loss(fake, as_written=True),
    ],
)
def test_derivatives_of_the_scores(term):
    scores = [x.double().requires_grad_() for x in (REAL, FAKE)]
    assert gradcheck(term, scores)
    assert gradgradcheck(term, scores)


# ---------------------------------------------------------------- gradient penalty


def linear(slope):
    """A critic that is a mean over vertices, with the same slope everywhere."""
    return lambda weights: (weights * slope).sum(dim=1).mean()


def weights(vertices: int, bones: int = 2) -> torch.Tensor:
    return torch.rand(vertices, bones, dtype=torch.float64).softmax(dim=1)


@pytest.mark.parametrize("vertices", [1, 4, 900])
def test_penalty_by_hand_for_any_number_of_vertices(vertices):
    slope, table = torch.tensor([3.0, 4.0]), weights(vertices).float()
    # Per vertex the slope is 5; over all numbers it is 5 / sqrt(V).
    penalty = gradient_penalty(linear(slope), table, table, 0.5)
    assert penalty.item() == pytest.approx(16, rel=1e-5)
    penalty = gradient_penalty(linear(slope), table, table, 0.5, per_vertex=False)
    assert penalty.item() == pytest.approx((5 / vertices**0.5 - 1) ** 2, rel=1e-5)


def test_a_slope_of_one_costs_nothing_and_none_costs_one():
    table = weights(7)
    one = torch.tensor([0.6, -0.8], dtype=torch.float64)
    assert gradient_penalty(linear(one), table, table, 0.1).item() < 1e-20
    flat = gradient_penalty(linear(0 * one), table, table, 0.1)
    assert flat.item() == 1


def test_slope_one_is_the_distance_between_tables_of_weights():
    # The critic of slope 1 that tells two tables apart best reaches their distance,
    # which does not change when each vertex is there five times.
    real, fake = weights(6, 3), weights(6, 3)
    for copies in (1, 5):
        p, q = real.repeat(copies, 1), fake.repeat(copies, 1)
        distance = (p - q).square().sum(dim=1).mean().sqrt()
        best = linear((p - q) / distance)
        torch.testing.assert_close(best(p) - best(q), distance)
        assert gradient_penalty(best, p, q, 0.5).item() < 1e-20
    expected = (real - fake).square().sum(dim=1).mean().sqrt()
    torch.testing.assert_close(distance, expected)


def test_the_slope_is_taken_between_real_and_fake():
    real, fake = torch.tensor([[2.0]]), torch.tensor([[0.0]])

    def critic(x):
        return x.square().sum() / 2  # its slope is x

    for mix in (0.0, 0.25, 1.0, torch.tensor(0.75)):
        expected = (2 * float(mix) - 1) ** 2
        assert gradient_penalty(critic, real, fake, mix).item() == expected


def smooth_critic(x, a, b):
    return ((x @ a).tanh() @ b).mean()


@pytest.mark.parametrize("per_vertex", [True, False])
def test_derivatives_of_the_penalty(per_vertex):
    torch.manual_seed(0)
    real, fake = weights(4, 3), weights(4, 3)
    parameters = [
        torch.randn(shape, dtype=torch.float64, requires_grad=True)
        for shape in ((3, 5), (5,))
    ]

    def penalty(a, b):
        def critic(x):
            return smooth_critic(x, a, b)

        return gradient_penalty(critic, real, fake, 0.3, per_vertex)

    assert gradcheck(penalty, parameters)
    assert gradgradcheck(penalty, parameters)


def test_a_flat_critic_has_a_finite_gradient():
    slope = torch.zeros(2, requires_grad=True)
    table = weights(3).float()
    gradient_penalty(linear(slope), table, table, 0.5).backward()
    assert slope.grad.tolist() == [0, 0]


def test_nothing_flows_back_into_the_weights_and_no_grad_may_measure():
    real = weights(3).requires_grad_()
    slope = torch.ones(2, dtype=torch.float64, requires_grad=True)
    penalty = gradient_penalty(linear(slope), real, real, 0.5)
    assert torch.autograd.grad(penalty, real, allow_unused=True) == (None,)
    with torch.no_grad():
        again = gradient_penalty(linear(slope), real, real, 0.5)
    assert again == penalty and not again.requires_grad


# ---------------------------------------------------------------- who pulls where


def play(signs: str, rounds: int = 100, lambda_gp: float = 0.1):
    """A 1-D toy: 32 real numbers around 1, and as many fake ones that begin around -1.

    Returns, round by round, where the middle of the fake is, and by how much its score
    is higher than that of the real.
    """
    torch.manual_seed(0)
    shape = torch.linspace(-0.2, 0.2, 32)[:, None]
    real, middle = 1 + shape, torch.tensor(-1.0, requires_grad=True)
    line = torch.nn.Sequential(
        torch.nn.Linear(1, 16), torch.nn.Softplus(), torch.nn.Linear(16, 1)
    )
    optimizer = torch.optim.Adam(line.parameters(), lr=0.02, betas=(0.5, 0.9))
    way, lead = [], []

    def critic(x):
        return line(x).mean()

    for _ in range(rounds):
        for _ in range(5):
            fake = (middle + shape).detach()
            loss = critic_loss(critic(real), critic(fake), signs)
            penalty = gradient_penalty(critic, real, fake, torch.rand(()))
            loss = loss + lambda_gp * penalty
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        opinion = generator_loss(critic(middle + shape))
        (gradient,) = torch.autograd.grad(opinion, middle)
        with torch.no_grad():
            middle -= 0.05 * gradient
            way.append(middle.item())
            lead.append((critic(middle + shape) - critic(real)).item())
    return torch.tensor(way), torch.tensor(lead)


def test_with_the_right_signs_the_fake_goes_to_the_real_one():
    way, lead = play("wgan")
    assert (way[-30:] - 1).abs().max() < 0.5
    assert lead.max() < 0.5


def test_with_the_sources_signs_the_fake_runs_away_and_its_score_only_grows():
    way, lead = play("source")
    assert way[-1] < -4 and lead[-1] > 4
    assert (way[10:].diff() < 0).all() and (lead[::10].diff() > 0).all()


def test_a_heavy_penalty_keeps_a_critic_in_one_dimension_from_turning():
    # A slope of the other sign lies behind a slope of 0, which the penalty forbids.
    way, _ = play("wgan", lambda_gp=10.0)
    assert way[-1] > 2


def test_one_step_of_either_player_raises_the_fake_with_the_sources_signs():
    real, fake = torch.tensor(1.0), torch.tensor(-1.0, requires_grad=True)
    slope = torch.tensor(0.5, requires_grad=True)
    for signs, expected in (("source", 1), ("wgan", -1)):
        loss = critic_loss(slope * real, slope * fake, signs)
        (by_critic,) = torch.autograd.grad(loss, slope)
        assert torch.sign(-by_critic * fake) == expected
    (by_generator,) = torch.autograd.grad(generator_loss(slope * fake), fake)
    assert -by_generator * slope > 0


@pytest.mark.parametrize("positives", [False, True])
def test_both_forms_of_d_u_are_a_contest(positives):
    # What the critic's step does to the fake's score, the generator's undoes.
    score = torch.tensor(0.3, requires_grad=True)
    real = torch.tensor(0.5) if positives else None
    critic = torch.autograd.grad(unsupervised_critic_loss(score, real), score)[0]
    opinion = unsupervised_generator_loss(score, as_written=not positives)
    assert critic == -torch.autograd.grad(opinion, score)[0]


def test_d_u_as_written_says_nothing_of_painted_weights():
    # At the painted weights the generator is pushed on just as anywhere else.
    slope = torch.tensor(1.0, requires_grad=True)
    painted = torch.tensor(2.0)
    for place in (painted - 1, painted, painted + 1):
        fake = place.clone().requires_grad_()
        opinion = unsupervised_generator_loss(slope * fake)
        assert torch.autograd.grad(opinion, fake)[0] == slope
