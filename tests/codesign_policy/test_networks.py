"""Shapes, densities and bounds of the learner's networks, against known answers."""

import math

import numpy as np
import pytest
import torch

from codesign_policy.networks import (
    ControlActor,
    CriticEnsemble,
    DesignActor,
    Temperature,
    sample_squashed,
)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def one_critic(critics: CriticEnsemble, member: int, inputs: torch.Tensor) -> torch.Tensor:
    """Dense -> LayerNorm -> ReLU, written out for one member."""
    x = inputs
    for k, gain in enumerate(critics.gains):
        x = x @ critics.weights[k][member] + critics.biases[k][member]
        x = (x - x.mean(-1, keepdim=True)) / torch.sqrt(x.var(-1, False, keepdim=True) + 1e-5)
        x = torch.relu(x * gain[member] + critics.shifts[k][member])
    return (x @ critics.weights[-1][member] + critics.biases[-1][member])[:, 0]


def test_every_member_is_a_network_of_its_own() -> None:
    critics = CriticEnsemble(3, 5, (8, 6), generator())
    with torch.no_grad():
        for parameter in critics.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator(1)))
    inputs = torch.randn(4, 5, generator=generator(2))
    observation, action = inputs.split([3, 2], dim=1)
    values = critics(observation, action)
    assert values.shape == (3, 4)
    for member in range(3):
        alone = one_critic(critics, member, inputs)
        torch.testing.assert_close(values[member], alone, atol=1e-5, rtol=1e-5)
    some = critics(observation, action, torch.tensor([2, 0]))
    torch.testing.assert_close(some, values[[2, 0]], atol=1e-6, rtol=1e-6)


def test_weights_are_those_of_xavier() -> None:
    critics = CriticEnsemble(4, 30, (50,), generator())
    bound = math.sqrt(6.0 / (30 + 50))
    weight = critics.weights[0].detach()
    assert weight.abs().max() <= bound
    assert weight.std() == pytest.approx(bound / math.sqrt(3.0), rel=0.03)
    assert not torch.equal(weight[0], weight[1])
    assert all((bias == 0).all() for bias in critics.biases)


def test_log_density_is_that_of_a_squashed_gaussian() -> None:
    mean, log_std = torch.tensor([[0.3, -1.2]]), torch.tensor([[-0.5, 0.2]])
    action, log_density = sample_squashed(mean, log_std, generator())
    raw = torch.atanh(action.double())
    gaussian = torch.distributions.Normal(mean.double(), log_std.double().exp())
    expected = (gaussian.log_prob(raw) - torch.log(1.0 - action.double() ** 2)).sum(-1)
    torch.testing.assert_close(log_density.double(), expected, atol=1e-5, rtol=1e-5)


def test_log_density_stays_finite_where_tanh_saturates() -> None:
    action, log_density = sample_squashed(
        torch.full((1, 3), 40.0), torch.full((1, 3), -3.0), generator()
    )
    assert (action == 1.0).all()
    # log(1 - tanh(x)^2) = log 4 - 2 x for large x; the Gaussian's part is a few nats.
    assert log_density.item() == pytest.approx(3 * (80.0 - math.log(4.0)), rel=0.1)


def test_density_integrates_to_one() -> None:
    """Importance sampling: the mean of 1 / density over the draws is the volume, 2."""
    mean, log_std = torch.zeros(40_000, 1), torch.full((40_000, 1), 0.0)
    _, log_density = sample_squashed(mean, log_std, generator())
    assert torch.exp(-log_density).mean().item() == pytest.approx(2.0, abs=0.03)


def test_control_spread_is_bounded() -> None:
    actor = ControlActor(2, 3, (8,), generator())
    mean, log_std = actor(1e6 * torch.randn(16, 2, generator=generator()))
    assert mean.shape == log_std.shape == (16, 3)
    assert log_std.min() >= -20.0
    assert log_std.max() <= 2.0


def test_design_actor_starts_at_the_demonstration_and_keeps_its_bounds() -> None:
    start = torch.tensor([0.5, -0.25, 1.0])
    actor = DesignActor(start, std=0.05, std_range=(0.02, 0.1))
    mean, log_std = actor(torch.zeros(4, 7))
    torch.testing.assert_close(torch.tanh(mean[2]), start.clamp(-0.99, 0.99))
    torch.testing.assert_close(log_std.exp(), torch.full((4, 3), 0.05))
    with torch.no_grad():
        actor.log_std.copy_(torch.tensor([5.0, -9.0, math.log(0.07)]))
    actor.keep_in_range()
    expected = torch.tensor([0.1, 0.02, 0.07])
    torch.testing.assert_close(actor.log_std.detach().exp(), expected)


def test_temperature_rises_while_entropy_is_too_low() -> None:
    temperature = Temperature(0.5, target=-3.5, limits=(0.1, 2.0))
    assert temperature.value() == pytest.approx(0.5)
    for entropy, sign in ((-5.0, -1.0), (-1.0, 1.0)):
        temperature.zero_grad()
        temperature.loss(torch.tensor(entropy)).backward()
        # d/d log(alpha) of alpha (entropy - target)
        expected = 0.5 * (entropy + 3.5)
        assert temperature.log_value.grad == pytest.approx(expected)
        assert np.sign(expected) == sign
    with torch.no_grad():
        temperature.log_value.fill_(9.0)
    temperature.keep_in_range()
    assert temperature.value() == pytest.approx(2.0)


def test_layer_norm_bounds_values_far_from_the_data() -> None:
    """|Q| <= |w| |relu(normalised x)| + b, whatever the input: here below sqrt(width) |w|."""
    critics = CriticEnsemble(2, 4, (32,), generator())
    far = critics(1e6 * torch.randn(64, 2, generator=generator()), torch.zeros(64, 2))
    limit = math.sqrt(32) * critics.weights[-1].detach().norm(dim=1).max()
    assert 0.0 < far.abs().max() <= limit
