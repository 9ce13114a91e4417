"""Networks of the learner: an ensemble of critics, and one squashed Gaussian per stage.

Actions and designs live in [-1, 1]; observations are expected to be of order one.
Initialisation and layer order follow RLPD (Ball et al. 2023, github.com/ikostrikov/rlpd).
"""

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

LOG_STD_RANGE = (-20.0, 2.0)  # RLPD


class CriticEnsemble(nn.Module):
    """E independent critics Q(o, a) whose weights are stacked, so that each layer is one product.

    Each hidden layer is Dense -> LayerNorm -> ReLU; the LayerNorm bounds what critics claim about
    actions far from the data (RLPD, section 4.2).
    """

    def __init__(
        self, members: int, inputs: int, hidden: tuple[int, ...], generator: torch.Generator
    ) -> None:
        """Args: E; size of observation and action together; widths; source of the weights."""
        super().__init__()
        sizes = [inputs, *hidden, 1]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        self.gains, self.shifts = nn.ParameterList(), nn.ParameterList()
        for size, width in pairwise(sizes):
            weight = torch.empty(members, size, width)
            for member in weight:
                nn.init.xavier_uniform_(member, generator=generator)
            self.weights.append(nn.Parameter(weight))
            self.biases.append(nn.Parameter(torch.zeros(members, 1, width)))
        for width in hidden:
            self.gains.append(nn.Parameter(torch.ones(members, 1, width)))
            self.shifts.append(nn.Parameter(torch.zeros(members, 1, width)))

    @property
    def members(self) -> int:
        """E."""
        return self.weights[0].shape[0]

    def forward(self, observation: Tensor, action: Tensor, members: Tensor | None = None) -> Tensor:
        """Values (E, B) of observations (B, o) and actions (B, a); `members` (M,) picks some."""

        def own(parameters: nn.ParameterList) -> list[Tensor]:
            return [p if members is None else p[members] for p in parameters]

        weights, biases = own(self.weights), own(self.biases)
        x = torch.cat([observation, action], dim=-1).expand(len(weights[0]), -1, -1)
        hidden = zip(weights[:-1], biases[:-1], own(self.gains), own(self.shifts), strict=True)
        for weight, bias, gain, shift in hidden:
            x = torch.baddbmm(bias, x, weight)
            x = torch.relu(torch.addcmul(shift, functional.layer_norm(x, x.shape[-1:]), gain))
        return torch.baddbmm(biases[-1], x, weights[-1]).squeeze(-1)


class ControlActor(nn.Module):
    """pi_C(a_C | o): a squashed Gaussian whose mean and spread a network answers."""

    def __init__(
        self, observation: int, control: int, hidden: tuple[int, ...], generator: torch.Generator
    ) -> None:
        """Args: sizes of observation and action; widths; source of the weights."""
        super().__init__()
        sizes = [observation, *hidden, 2 * control]
        self.layers = nn.ModuleList()
        for size, width in pairwise(sizes):
            layer = nn.Linear(size, width)
            nn.init.xavier_uniform_(layer.weight, generator=generator)
            nn.init.zeros_(layer.bias)
            self.layers.append(layer)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation before the tanh, (B, 7) each."""
        x = observation
        for layer in self.layers[:-1]:
            x = torch.relu(layer(x))
        mean, log_std = self.layers[-1](x).chunk(2, dim=-1)
        return mean, log_std.clamp(*LOG_STD_RANGE)


class DesignActor(nn.Module):
    """pi_D(a_D): a squashed Gaussian around one design, the same for every design observation.

    What the design stage observes says nothing about the trial that follows, so neither mean nor
    spread depends on it.
    """

    def __init__(self, start: Tensor, std: float, std_range: tuple[float, float]) -> None:
        """Args: design to start at, (D,) in [-1, 1]; spread before the tanh; its bounds."""
        super().__init__()
        inside = start.clamp(-0.99, 0.99)  # atanh(1) is infinite
        self.mean = nn.Parameter(torch.atanh(inside))
        self.log_std = nn.Parameter(torch.full_like(inside, math.log(std)))
        self.log_std_range = (math.log(std_range[0]), math.log(std_range[1]))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation before the tanh, (B, D) each, for B observations."""
        shape = (len(observation), len(self.mean))
        return self.mean.expand(shape), self.log_std.expand(shape)

    @torch.no_grad()
    def keep_in_range(self) -> None:
        """Puts the spread back between its bounds; call after each step of the optimizer."""
        self.log_std.clamp_(*self.log_std_range)


def sample_squashed(
    mean: Tensor, log_std: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Draws tanh(mean + std n) and gives its log density.

    Returns:
        Actions (B, a) in [-1, 1] and log densities (B,), both differentiable.
    """
    noise = torch.randn(mean.shape, generator=generator)
    raw = mean + log_std.exp() * noise
    # log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x)), which does not cancel for large x.
    squashing = 2.0 * (math.log(2.0) - raw - functional.softplus(-2.0 * raw))
    gaussian = -0.5 * noise.square() - log_std - 0.5 * math.log(2.0 * math.pi)
    return torch.tanh(raw), (gaussian - squashing).sum(-1)


class Temperature(nn.Module):
    """Weight of an actor's entropy in its objective: fixed, or driven towards a target entropy."""

    def __init__(
        self, start: float, target: float | None, limits: tuple[float, float] = (1e-8, 1e8)
    ) -> None:
        """Args: weight at the start; entropy to aim at [nats], None: fixed weight; its bounds."""
        super().__init__()
        log_start = torch.tensor(math.log(start))
        self.log_value = nn.Parameter(log_start, requires_grad=target is not None)
        self.target, self.limits = target, limits

    def value(self) -> float:
        """The weight."""
        return float(self.log_value.detach().exp())

    def loss(self, entropy: Tensor) -> Tensor:
        """Falls as the weight grows while `entropy` [nats] is below the target."""
        assert self.target is not None
        return self.log_value.exp() * (entropy - self.target)

    @torch.no_grad()
    def keep_in_range(self) -> None:
        """Puts the weight back between its bounds; call after each step of the optimizer."""
        low, high = self.limits
        self.log_value.clamp_(math.log(low), math.log(high))
