"""The choice of the final design, by a controller that does nothing."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from toy_task import BEST, COMPONENTS, SPACES, WEIGHTS, ToyEnv

from codesign_policy import selection
from codesign_policy.presets import FAST
from codesign_policy.rlpd import Agent
from codesign_policy.rounds import Episodes
from codesign_policy.run import METRICS, RunConfig, make_training, shown_rows
from codesign_policy.selection import Candidate, refine, select_design
from codesign_policy.training import Training, TrainingConfig


@pytest.mark.timeout(600)
def test_candidates_are_judged_in_the_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selection, "FINE", 600)
    monkeypatch.setattr(selection, "EPISODES", 8)
    monkeypatch.setattr(selection, "KEPT", 1)
    monkeypatch.setattr(selection, "GENERATIONS", 1)
    shown = shown_rows("wide-12")
    start = shown.gentlest.parameters
    config = RunConfig(lanes=8, demonstrations=len(shown.rows), start=start)
    training = make_training(config, shown.rows)
    shares: list[float] = []
    judged = select_design(training, config, shares.append)
    origins = [candidate.origin for candidate in judged]
    assert origins.count("demonstrated") == 3
    assert origins.count("search") == 1
    assert origins.count("refined") == 2
    fitness = [candidate.fitness for candidate in judged]
    assert fitness == sorted(fitness, reverse=True)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    observation = training.episodes.design_observation
    assert observation is not None
    designs = np.array([candidate.design for candidate in judged], np.float32)
    bounds = training.agent.choose_design(designs, observation).lower_bound
    np.testing.assert_allclose([c.lower_bound for c in judged], bounds, rtol=1e-5)
    assert {candidate.success for candidate in judged} == {0.0}


def test_what_was_not_measured_is_null() -> None:
    nothing = Candidate("search", (0.0,), 1.0, 0.0, math.nan, math.nan, -1.0).as_json()
    assert (nothing["top10_stress"], nothing["fitness"]) == (None, -1.0)


class GradedToy(ToyEnv):
    """Knows the metrics of a grasp: 1 kPa per unit that a design is away from the best one."""

    def step(self, actions: np.ndarray) -> Any:
        *rest, info = super().step(actions)
        if "final_info" in info:
            stress = 1000.0 * np.linalg.norm(self._designs - BEST, axis=1)
            lifted = np.ones(self.num_envs)
            info["final_info"] = dict(zip(METRICS, (lifted, stress, stress, lifted), strict=True))
        return *rest, info


def test_refining_walks_towards_the_best_design() -> None:
    episodes = Episodes(GradedToy(8), COMPONENTS, METRICS, np.zeros(5, np.float32))
    start = np.array([0.2, -0.1])
    config = TrainingConfig(transitions=40, reward_weights=WEIGHTS)
    training = Training(Agent(SPACES, replace(FAST, encoding=False), 0, start), episodes, config)
    shares: list[float] = []
    refined = refine(training, episodes, shares.append, generations=10)
    assert np.linalg.norm(refined.best(1)[0] - BEST) < 0.5 * np.linalg.norm(start - BEST)
    assert len(training.experience) == 0  # nothing is learned from it
    assert shares[-1] == 1.0
