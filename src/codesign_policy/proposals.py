"""Who proposes the designs of a round: the design actor, as in the paper, or a search by outcome.

The search is the upper level of a bi-level view of co-design: one controller, told the design it
holds, learns across all of them while CMA-ES moves the designs by how well they did.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import cma
import numpy as np
from numpy.typing import NDArray

from codesign_policy.metrics import SUCCESS_LIFT
from codesign_policy.reward import ALPHA
from codesign_policy.rlpd import Agent

Array = NDArray[np.float32]
STRESS_SCALE = 1000.0  # Pa, at which stress costs half of what it can cost in `fitness`
RECENT = 2  # generations whose fitness still says something: the controller goes on learning
DESIGN_BOUND = 0.9  # designs stay within; demonstrations are fitted within 0.75


class Proposer(Protocol):
    """Proposes designs and is told what became of them."""

    def propose(self) -> Array:
        """Designs of the coming round, (E, D) in [-1, 1]."""

    def judge(self, metrics: Mapping[str, NDArray[np.float64]]) -> None:
        """Takes in how the proposed designs did: metrics by name, (E,) each."""

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs, as copies."""

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes over a `state()`."""


class ActorProposals:
    """The paper's: drawn from the design actor, which follows the critics' gradient."""

    def __init__(self, agent: Agent, observation: Array, lanes: int) -> None:
        """Args: whose actor; o_D (o,); designs per round."""
        self._agent, self._observations = agent, np.tile(observation, (lanes, 1))

    def propose(self) -> Array:
        """New designs every round."""
        return self._agent.propose_designs(self._observations)

    def judge(self, metrics: Mapping[str, NDArray[np.float64]]) -> None:
        """The actor learns from stored transitions instead."""

    def state(self) -> dict[str, Any]:
        """None of its own."""
        return {}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Nothing to do."""


@dataclass(frozen=True)
class SearchSettings:
    """How designs are searched for.

    Attributes:
        rounds: without exploration that judge a generation of designs, which is kept for as many
            with it: building fingers costs as much as an episode.
        practice: generations around the start alone, while the controller learns to grasp at all:
            outcomes say little about designs before it does.
        spread: standard deviation of the first designs [96 mm of a handle's way].
    """

    rounds: int = 2
    practice: int = 4
    spread: float = 0.003


@dataclass(frozen=True)
class Generation:
    """Designs (E, D) that were tried together, and the fitness of each, (E,)."""

    designs: Array
    fitness: NDArray[np.float64]


class DesignSearch:
    """Designs scattered around a start, then CMA-ES from there.

    Attributes:
        generations: that are over, in order.
    """

    def __init__(
        self, start: NDArray[np.floating], lanes: int, settings: SearchSettings, seed: int
    ) -> None:
        """
        Args:
            start: (D,) in [-1, 1], such as the best demonstrated design.
            lanes: designs per round, at least 2.
            settings: how.
            seed: of what it draws.
        """
        self._start = np.asarray(start, np.float64)
        self._lanes, self._settings, self._seed = lanes, settings, seed
        self._begin()

    def propose(self) -> Array:
        """The designs of the present generation."""
        return self._designs.copy()

    def judge(self, metrics: Mapping[str, NDArray[np.float64]]) -> None:
        """Adds a round to the generation; the last one ends it."""
        self._rounds.append(fitness(metrics))
        if len(self._rounds) == self._settings.rounds:
            self._advance(np.mean(self._rounds, axis=0))

    @property
    def centre(self) -> Array:
        """The design that the search is around now, (D,)."""
        return np.array(self._start if self._search is None else self._search.mean, np.float32)

    def best(self, count: int) -> list[Array]:
        """The designs of the highest fitness in the last generations, at most `count`."""
        recent = self.generations[-RECENT:]
        tried = [(f, d) for g in recent for f, d in zip(g.fitness, g.designs, strict=True)]
        return [design for _, design in sorted(tried, key=lambda each: -each[0])[:count]]

    def state(self) -> dict[str, Any]:
        """What was tried and found: drawing anew from the seed gives the rest."""
        return {
            "fitness": [generation.fitness.copy() for generation in self.generations],
            "rounds": [each.copy() for each in self._rounds],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Repeats the search up to the state."""
        self._begin()
        for found in state["fitness"]:
            self._advance(np.asarray(found))
        self._rounds.extend(np.asarray(each) for each in state["rounds"])

    # ---------------------------------------------------------------- inside

    def _begin(self) -> None:
        self._random = np.random.default_rng([self._seed, 2])
        self._search: cma.CMAEvolutionStrategy | None = None
        self.generations: list[Generation] = []
        self._draw()

    def _draw(self) -> None:
        """The next generation."""
        self._rounds: list[NDArray[np.float64]] = []
        if self._search is None and len(self.generations) >= self._settings.practice:
            self._search = self._from_the_start()
        self._asked = self._around_the_start() if self._search is None else self._search.ask()
        self._designs = np.asarray(self._asked, np.float32)

    def _around_the_start(self) -> NDArray[np.float64]:
        """The start itself, and with noise in the other lanes."""
        noise = self._random.normal(size=(self._lanes, len(self._start)))
        noise[0] = 0.0
        designs = self._start + self._settings.spread * noise
        return np.clip(designs, -DESIGN_BOUND, DESIGN_BOUND)

    def _from_the_start(self) -> cma.CMAEvolutionStrategy:
        options = {
            "popsize": self._lanes,
            "bounds": [-DESIGN_BOUND, DESIGN_BOUND],
            "randn": lambda *shape: self._random.normal(size=shape),
            "seed": np.nan,  # the library's own generator stays out of it
            "verbose": -9,
        }
        return cma.CMAEvolutionStrategy(self._start, self._settings.spread, options)

    def _advance(self, found: NDArray[np.float64]) -> None:
        self.generations.append(Generation(self._designs, found))
        if self._search is not None:
            self._search.tell(self._asked, -found)
        self._draw()


def fitness(metrics: Mapping[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """What a design's episode is worth: success, and little stress; a lift of some way counts half.

    Top-10 % and median stress count as top-10 % and mean do in equation 1, with a cost that goes on
    growing, ever more slowly, to 1.5: what success and lift together are worth.

    Args:
        metrics: "success", "peak_lift" [m], "top10_stress" and "median_stress" [Pa], (E,) each;
            NaN where there was nothing to measure.
    """
    success = np.nan_to_num(metrics["success"])
    lift = np.clip(np.nan_to_num(metrics["peak_lift"]) / SUCCESS_LIFT, 0.0, 1.0)
    stress = ALPHA * metrics["top10_stress"] + (1.0 - ALPHA) * metrics["median_stress"]
    # Fingers that never touch the block are worth no more than those that crush it.
    cost = np.where(np.isfinite(stress), stress / (stress + STRESS_SCALE), 1.0)
    return success + 0.5 * lift - 1.5 * cost
