"""RLPD (Ball et al. 2023) for the two-stage task: soft actor-critic with a critic ensemble.

What two stages change, against one joint action of 3N + 7 numbers:
- Each stage has its own actor, temperature and entropy target, and a log density counts only the
  numbers that act. Under one target the idle ones would supply the entropy and the active ones
  would have none.
- The value of the first control observation comes back to the design stage undiscounted.
- Idle numbers are zero in stored actions, in targets and in the actors' losses.
Nothing leads back into the design stage, so every target needs the control actor alone.
"""

import copy
import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from codesign_policy.networks import (
    ControlActor,
    CriticEnsemble,
    DesignActor,
    Temperature,
    sample_squashed,
)
from codesign_policy.policy_file import TrainedPair
from codesign_policy.presets import Preset
from codesign_policy.replay import Batch, Spaces
from codesign_policy.task import ENCODED, encoded

Stage = Literal["design", "control"]


UNIT_ENTROPY = 0.5 * math.log(2.0 * math.pi * math.e)  # nats, of a normal number of spread 1
CLONING_RATE = 1e-3  # of Adam
SPREAD_WEIGHT = 0.1  # against the distance of means
# Of the values that imitation is weighed against, while critics still answer nearly nothing.
LEAST_VALUE = 3.0


class LearningError(RuntimeError):
    """Learning left the range of numbers: a loss that is not finite."""


@dataclass(frozen=True)
class DesignChoice:
    """The design that the critics vouch for most.

    Attributes:
        index: of the chosen candidate.
        design: (D,) in [-1, 1].
        lower_bound: of the candidates' values: mean minus standard deviation over critics, (n,).
        mean: over the critics, (n,).
    """

    index: int
    design: NDArray[np.float32]
    lower_bound: NDArray[np.float32]
    mean: NDArray[np.float32]


class Agent:
    """Critics, an actor and a temperature per stage, and how they learn.

    Attributes:
        spaces, preset: as given.
        updates: of the critics so far.
        acts: whether the control actor has learned anything yet.
        cloned: whether it started from demonstrations.
    """

    def __init__(
        self,
        spaces: Spaces,
        preset: Preset,
        seed: int,
        start_design: NDArray[np.floating] | None = None,
        design_direction: NDArray[np.floating] | None = None,
    ) -> None:
        """
        Args:
            spaces: sizes.
            preset: settings.
            seed: of weights and exploration.
            start_design: where the design actor starts, (D,) in [-1, 1], such as a demonstration;
                None: at zero, the base mesh as it is.
            design_direction: (D,), makes d the paper's scalar: of the design in an observation
                networks see its component in this direction alone. None: all of it.

        Raises:
            ValueError: a start design or direction of another size, or a start outside [-1, 1].
        """
        self.spaces, self.preset = spaces, preset
        self.updates, self.acts, self.cloned, self._actor_from = 0, False, False, 0
        self._random = torch.Generator().manual_seed(seed)
        start = np.zeros(spaces.design) if start_design is None else np.asarray(start_design)
        if start.shape != (spaces.design,) or not (np.abs(start) <= 1.0).all():
            raise ValueError(f"start design {start}: must be {spaces.design} numbers in [-1, 1]")
        self._start = torch.as_tensor(start, dtype=torch.float32)
        self._direction = None
        if design_direction is not None:
            self._direction = torch.as_tensor(np.asarray(design_direction), dtype=torch.float32)
            if self._direction.shape != (spaces.design,) or not spaces.design:
                raise ValueError(
                    f"design direction {design_direction}: must be {spaces.design} numbers, at "
                    "least one"
                )
        seen = spaces.observation + (ENCODED if preset.encoding else 0)
        seen -= 0 if self._direction is None else spaces.design - 1
        inputs = seen + spaces.action
        self.critics = CriticEnsemble(preset.critics, inputs, preset.hidden, self._random)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.actors: dict[Stage, nn.Module] = {
            "design": DesignActor(
                self._start,
                preset.design_std,
                preset.design_std_range,
            ),
            "control": ControlActor(seen, spaces.control, preset.hidden, self._random),
        }
        self.averaged = copy.deepcopy(self.actors["control"]).requires_grad_(False)
        self.clone_actor = copy.deepcopy(self.averaged)
        self.best_actor = copy.deepcopy(self.averaged)
        per_parameter = preset.design_entropy_per_parameter
        self.temperatures: dict[Stage, Temperature] = {
            "design": Temperature(
                preset.design_temperature,
                None if per_parameter is None else per_parameter * spaces.design,
                preset.design_temperature_range,
            ),
            "control": Temperature(preset.control_temperature, preset.control_entropy),
        }
        self._networks = {
            "critics": self.critics,
            "target_critics": self.target_critics,
            "averaged_actor": self.averaged,
            "clone_actor": self.clone_actor,
            "best_actor": self.best_actor,
            **{f"{stage}_actor": actor for stage, actor in self.actors.items()},
            **{f"{stage}_temperature": value for stage, value in self.temperatures.items()},
        }
        self._optimizers = {
            "critics": self._adam(self.critics),
            "actors": self._adam(*self.actors.values(), *self.temperatures.values()),
        }

    def _adam(self, *networks: nn.Module) -> torch.optim.Adam:
        parameters = [p for net in networks for p in net.parameters() if p.requires_grad]
        return torch.optim.Adam(parameters, lr=self.preset.learning_rate, fused=True)

    def _seen(self, observation: NDArray[np.floating] | Tensor) -> Tensor:
        """What networks see of observations (..., o): encoded, d from the start and enlarged, and
        a scalar d if there is one."""
        whole = torch.as_tensor(observation, dtype=torch.float32)
        if self.preset.encoding:
            whole = torch.from_numpy(encoded(whole.numpy()))
        split = whole.shape[-1] - self.spaces.design
        d = (whole[..., split:] - self._start) * self.preset.design_scale
        if self._direction is not None:
            d = (d @ self._direction).unsqueeze(-1)
        return torch.cat([whole[..., :split], d], dim=-1)

    @torch.no_grad()
    def act(
        self,
        observation: NDArray[np.floating],
        *,
        explore: bool,
        snapshot: nn.Module | None = None,
    ) -> NDArray[np.float32]:
        """Control actions (n, 7) in [-1, 1] for observations (n, o).

        Drawn from the control actor, or the mean of the averaged one, or of a snapshot of that:
        single updates sway what a grasp at the edge of slipping does.
        """
        if not explore:
            actor = self.averaged if snapshot is None else snapshot
            return torch.tanh(actor(self._seen(observation))[0]).numpy()
        mean, log_std = self.actors["control"](self._seen(observation))
        return sample_squashed(mean, log_std, self._random)[0].numpy()

    @torch.no_grad()
    def propose_designs(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """Designs (n, D) in [-1, 1], drawn for design observations (n, o)."""
        mean, log_std = self.actors["design"](self._seen(observation))
        return sample_squashed(mean, log_std, self._random)[0].numpy()

    @torch.no_grad()
    def design_values(
        self, designs: NDArray[np.floating], observation: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """What each critic expects of designs (n, D) seen from one design observation (o,), (E, n).

        The value is the discounted return of the control stage.
        """
        action = self._joint("design", _tensor(designs))
        return self.critics(self._seen(observation).expand(len(action), -1), action).numpy()

    def choose_design(
        self, candidates: NDArray[np.floating], observation: NDArray[np.floating]
    ) -> DesignChoice:
        """The candidate (n, D) with the highest lower-confidence bound over the critics.

        Where critics disagree they have seen little. What is chosen is to be judged by simulation.
        """
        values = self.design_values(candidates, observation)
        mean = values.mean(axis=0)
        bound = mean - values.std(axis=0)
        best = int(bound.argmax())
        return DesignChoice(best, np.asarray(candidates[best], np.float32), bound, mean)

    def clone(self, observation: NDArray[np.floating], action: NDArray[np.floating]) -> float:
        """Starts the control actor from demonstrations: `preset.cloning` steps of regression.

        Its spread becomes the one of the entropy that is aimed at. Then it rests for
        `preset.actor_rest` updates, until the critics know what the clone is worth.

        Args:
            observation: (n, o) of the control stage.
            action: what was demonstrated there, (n, 7) in [-1, 1].

        Returns:
            Mean squared distance of its means to the actions, over the last batch.

        Raises:
            LearningError: a distance that is not finite.
        """
        actor = self.actors["control"]
        seen, shown = self._seen(observation), _tensor(action)
        log_std = self.preset.control_entropy / self.spaces.control - UNIT_ENTROPY
        optimizer = torch.optim.Adam(actor.parameters(), lr=CLONING_RATE)
        distance = torch.zeros(())
        for _ in range(self.preset.cloning):
            rows = torch.randint(len(seen), (self.preset.batch_size,), generator=self._random)
            mean, spread = actor(seen[rows])
            distance = (torch.tanh(mean) - shown[rows]).square().sum(-1).mean()
            loss = distance + SPREAD_WEIGHT * (spread - log_std).square().mean()
            if not math.isfinite(loss.item()):
                raise LearningError(f"cloning: loss is {loss.item()}: look at the demonstrations")
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        self.averaged.load_state_dict(actor.state_dict())
        self.clone_actor.load_state_dict(actor.state_dict())
        self.cloned = self.acts = True
        self._actor_from = self.updates + self.preset.actor_rest
        return distance.item()

    def snapshot(self) -> nn.Module:
        """The averaged actor as it is now, for `act` and `remember`."""
        return copy.deepcopy(self.averaged)

    def remember(self, actor: nn.Module) -> None:
        """Keeps a snapshot that has done better than any before."""
        self.best_actor.load_state_dict(actor.state_dict())

    def recall(self) -> None:
        """Goes back to the averaged actor that was kept."""
        for actor in (self.averaged, self.actors["control"]):
            actor.load_state_dict(self.best_actor.state_dict())

    def update(self, batch: Batch) -> dict[str, float]:
        """One update of the critics; every `actor_period`-th time of actors and temperatures too,
        unless these rest after a `clone`.

        Returns:
            Losses, values, entropies and temperatures by name, of what was updated.

        Raises:
            LearningError: a loss that is not finite.
        """
        batch = replace(
            batch,
            observation=self._seen(batch.observation),
            next_observation=self._seen(batch.next_observation),
        )
        log = self._update_critics(batch)
        self.updates += 1
        self.acts = True
        if self.updates > self._actor_from and self.updates % self.preset.actor_period == 0:
            log |= self._update_actors(batch)
        return log

    @torch.no_grad()
    def targets(self, batch: Batch) -> Tensor:
        """What the critics should answer, (B,): reward and the value of what follows.

        The value is the minimum over a random subset of the target critics. It is discounted
        within the control stage, not across the design boundary, and bootstrapped at time limits.
        """
        mean, log_std = self.actors["control"](batch.next_observation)
        control, log_density = sample_squashed(mean, log_std, self._random)
        members = torch.randperm(self.preset.critics, generator=self._random)
        value = self.target_critics(
            batch.next_observation,
            self._joint("control", control),
            members[: self.preset.critic_subset],
        ).amin(dim=0)
        if self.preset.backup_entropy:
            value = value - self.temperatures["control"].value() * log_density
        discount = torch.where(batch.in_control, self.preset.discount, 1.0)
        return batch.reward + discount * ~batch.terminated * value

    def _update_critics(self, batch: Batch) -> dict[str, float]:
        targets = self.targets(batch)
        values = self.critics(batch.observation, batch.action)
        error = self._descend("critics", ((values - targets).square() * batch.weight).mean())
        _follow(self.target_critics, self.critics, self.preset.target_rate)
        return {"critic_loss": error, "value": values.detach().mean().item()}

    def _update_actors(self, batch: Batch) -> dict[str, float]:
        """Actors towards what all critics together value, temperatures towards their targets."""
        log: dict[str, float] = {}
        losses = [
            self._actor_loss("control", batch, batch.in_control, log),
            self._actor_loss("design", batch, ~batch.in_control, log),
        ]
        self._descend("actors", torch.stack([loss for loss in losses if loss is not None]).sum())
        _follow(self.averaged, self.actors["control"], self.preset.actor_average)
        for network in (self.actors["design"], *self.temperatures.values()):
            network.keep_in_range()  # type: ignore[operator]
        return log

    def _actor_loss(
        self, stage: Stage, batch: Batch, rows: Tensor, log: dict[str, float]
    ) -> Tensor | None:
        """Of one stage's actor and temperature, over the rows of that stage; None without any."""
        if not rows.any():
            return None
        observation, weight = batch.observation[rows], batch.weight[rows]
        weight = weight / weight.sum()
        mean, log_std = self.actors[stage](observation)
        action, log_density = sample_squashed(mean, log_std, self._random)
        value = self.critics(observation, self._joint(stage, action)).mean(dim=0)
        temperature = self.temperatures[stage]
        loss = (weight * (temperature.value() * log_density - value)).sum()
        if stage == "control" and self.cloned:
            loss = loss + self._imitation_loss(batch, rows, mean, value)
        entropy = -(weight * log_density.detach()).sum()
        log[f"{stage}_entropy"] = entropy.item()
        log[f"{stage}_temperature"] = temperature.value()
        return loss if temperature.target is None else loss + temperature.loss(entropy)

    def _imitation_loss(self, batch: Batch, rows: Tensor, mean: Tensor, value: Tensor) -> Tensor:
        """Squared distance to what the clone would do, in units of the values' size.

        The scale is that of TD3+BC (Fujimoto and Gu 2021). Held near demonstrated actions alone,
        the actor follows critics astray wherever it was not demonstrated what to do.
        """
        with torch.no_grad():
            wanted = torch.tanh(self.clone_actor(batch.observation[rows])[0])
        distance = (torch.tanh(mean) - wanted).square().sum(-1).mean()
        scale = value.detach().abs().mean().clamp(min=LEAST_VALUE)
        halvings = (self.updates - self._actor_from) / self.preset.imitation_half_life
        return self.preset.imitation * 0.5**halvings * scale * distance

    def _descend(self, name: str, loss: Tensor) -> float:
        """One step of an optimizer down this loss; gradients of other parameters are not made."""
        value = loss.item()
        if not math.isfinite(value):
            raise LearningError(
                f"loss of {name} is {value} at update {self.updates}: look for outliers in the "
                "reward's components, or lower the learning rate"
            )
        optimizer = self._optimizers[name]
        optimizer.zero_grad()
        loss.backward(inputs=optimizer.param_groups[0]["params"])
        optimizer.step()
        return value

    def _joint(self, stage: Stage, part: Tensor) -> Tensor:
        """[a_D, a_C] (B, a) from the part that acts in this stage; the idle part is zero."""
        if stage == "design":
            return functional.pad(part, (0, self.spaces.control))
        return functional.pad(part, (self.spaces.design, 0))

    def pair(self, design: NDArray[np.floating], about: dict[str, Any]) -> TrainedPair:
        """The averaged control actor and a design, to be served.

        Args:
            design: (D,) in [-1, 1], such as that of `choose_design`; empty for given fingers.
            about: where it comes from, plain values.
        """
        layers = list(self.averaged.layers)  # type: ignore[arg-type]
        weights = [layer.weight.detach().numpy().T.copy() for layer in layers]
        biases = [layer.bias.detach().numpy().copy() for layer in layers]
        if self.spaces.design:  # what is seen of a design is linear in it: it goes into the weights
            split = len(weights[0]) - (self.spaces.design if self._direction is None else 1)
            d = weights[0][split:]
            d = d if self._direction is None else np.outer(self._direction, d)
            d = d * self.preset.design_scale
            biases[0] -= self._start.numpy() @ d
            weights[0] = np.vstack([weights[0][:split], d])
        return TrainedPair(
            tuple(weights),
            tuple(biases),
            np.array(design, np.float32),
            {**about, "encoding": self.preset.encoding},
        )

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs to go on bit for bit, as copies."""
        state = {
            "updates": self.updates,
            "acts": self.acts,
            "cloned": self.cloned,
            "actor_from": self._actor_from,
            "random": self._random.get_state(),
            "networks": {name: net.state_dict() for name, net in self._networks.items()},
            "optimizers": {name: opt.state_dict() for name, opt in self._optimizers.items()},
        }
        return copy.deepcopy(state)

    def restore(self, state: dict[str, Any]) -> None:
        """Takes over a `state()`.

        Raises:
            ValueError: weights of other shapes than this agent's.
        """
        for name, network in self._networks.items():
            require_same_shapes(name, state["networks"][name], network.state_dict())
        for name, network in self._networks.items():
            network.load_state_dict(state["networks"][name])
        for name, optimizer in self._optimizers.items():
            optimizer.load_state_dict(copy.deepcopy(state["optimizers"][name]))
        self._random.set_state(state["random"])
        self.updates, self.acts, self.cloned = (state[n] for n in ("updates", "acts", "cloned"))
        self._actor_from = state["actor_from"]


@torch.no_grad()
def _follow(follower: nn.Module, leader: nn.Module, rate: float) -> None:
    """Moves the follower's parameters by this share of the way to the leader's."""
    torch._foreach_lerp_(list(follower.parameters()), list(leader.parameters()), rate)


def require_same_shapes(name: str, stored: dict[str, Tensor], mine: dict[str, Tensor]) -> None:
    """Raises: ValueError: the stored weights of a network do not fit; names the first."""
    for key in sorted(stored.keys() | mine.keys()):
        shapes = [tuple(d[key].shape) if key in d else "missing" for d in (stored, mine)]
        if shapes[0] != shapes[1]:
            raise ValueError(
                f"{name}.{key}: stored {shapes[0]}, this agent's {shapes[1]}; use the preset and "
                "the design space it was trained with"
            )


def _tensor(array: NDArray[Any]) -> Tensor:
    return torch.from_numpy(np.asarray(array, np.float32))
