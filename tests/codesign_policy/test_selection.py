"""The choice of the final design, by a controller that does nothing."""

import math

import numpy as np
import pytest

from codesign_policy import selection
from codesign_policy.run import RunConfig, make_training, shown_rows
from codesign_policy.selection import Candidate, select_design


def test_candidates_are_judged_in_the_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selection, "FINE", 600)
    monkeypatch.setattr(selection, "EPISODES", 8)
    monkeypatch.setattr(selection, "KEPT", 1)
    shown = shown_rows("lip-12")
    start = shown.gentlest.parameters
    config = RunConfig(lanes=8, demonstrations=len(shown.rows), start=start)
    training = make_training(config, shown.rows)
    shares: list[float] = []
    judged = select_design(training, config, shares.append)
    origins = [candidate.origin for candidate in judged]
    assert origins.count("demonstrated") == 3
    assert origins.count("search") == 1
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
