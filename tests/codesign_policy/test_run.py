"""Settings of runs, and what is made of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from codesign_policy.codesign_env import COMPONENTS
from codesign_policy.control_demonstrations import (
    expert_rows,
    fine_tuning_rows,
    nominal_rows,
    own_rows,
)
from codesign_policy.expert_plan import DemonstrationError
from codesign_policy.presets import FAST
from codesign_policy.replay import ReplayBuffer, Spaces
from codesign_policy.reward import RewardWeights
from codesign_policy.rlpd import Agent
from codesign_policy.run import (
    RunConfig,
    fingers_of,
    load_run,
    make_training,
    principal_direction,
    shown_rows,
)

STOCK = RunConfig(space="", lanes=4, transitions=800)


def test_settings_are_kept(tmp_path: Path) -> None:
    config = RunConfig(
        design=(0.1, -0.2), start=(0.3,), friction=(0.3, 0.7), command="x", commit="y"
    )
    config.save(tmp_path)
    assert load_run(tmp_path) == config


def test_a_folder_without_a_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no run of this release"):
        load_run(tmp_path)


def test_sizes_and_stages() -> None:
    assert RunConfig(space="lip-12").spaces == Spaces(44, 36, 7)
    assert RunConfig(space="lip-12").learns_design
    assert not RunConfig(space="lip-12", design=(0.0,) * 36).learns_design
    assert STOCK.spaces == Spaces(8, 0, 7)
    assert not STOCK.learns_design


def test_stress_weighs_more_in_fine_tuning() -> None:
    plain, tuned = RunConfig().weights, RunConfig(stress_factor=5.0).weights
    assert tuned.pop("stress") == 5.0 * plain.pop("stress") == 5.0 * RewardWeights().stress
    assert tuned == plain
    assert set(RunConfig().weights) == set(COMPONENTS)


def test_less_time_pressure_in_fine_tuning() -> None:
    plain, tuned = RunConfig().weights, RunConfig(lift_factor=0.5).weights
    assert tuned.pop("lift") == 0.5 * plain.pop("lift")
    assert tuned.pop("held") == 0.5 * plain.pop("held")
    assert tuned == plain


def test_the_stock_fingers_are_demonstrated_by_the_expert() -> None:
    rows = nominal_rows(STOCK)
    assert len(rows) == 600
    assert rows.rows.in_control.all()
    assert rows.rows.truncated.sum() == 3
    lift = rows.rows.components[-3:, COMPONENTS.index("lift")]
    assert_allclose(lift, 1.0)  # the last step of each: up by more than 90 mm
    training = make_training(STOCK, rows)
    assert training.proposer is None
    assert training.agent.preset == FAST


def test_a_policy_that_fails_demonstrates_nothing() -> None:
    agent = Agent(STOCK.spaces, FAST, 0)
    with pytest.raises(DemonstrationError, match="none of 4 episodes"):
        own_rows(agent, STOCK)


def test_fine_tuning_learns_from_policy_and_expert(monkeypatch: pytest.MonkeyPatch) -> None:
    """The expert's part is left out where it cannot use the fingers."""
    config = replace(STOCK, tetrahedra=600)
    shown = expert_rows(config, 4)

    def expert_as_policy(agent: Agent, config: RunConfig) -> ReplayBuffer:
        return shown

    monkeypatch.setattr("codesign_policy.control_demonstrations.own_rows", expert_as_policy)
    agent = Agent(STOCK.spaces, FAST, 0)
    rows = fine_tuning_rows(agent, config)
    assert len(rows) == 2 * len(shown)
    assert_array_equal(rows.rows.action[: len(shown)], shown.rows.action)

    def none(fingers: object, tetrahedra: int, seed: int) -> None:
        raise DemonstrationError("no gap")

    monkeypatch.setattr("codesign_policy.control_demonstrations.best_plan", none)
    assert fine_tuning_rows(agent, config) is shown


def test_designs_start_at_the_gentlest_demonstration() -> None:
    shown = shown_rows("lip-12")
    assert shown.gentlest.expert == "scoop"
    start = shown.gentlest.parameters
    config = RunConfig(lanes=8, demonstrations=len(shown.rows), start=start)
    training = make_training(config, shown.rows)
    assert training.proposer is not None
    assert_allclose(training.proposer.propose()[0], start, atol=1e-6)
    by_actor = make_training(replace(config, search=False), shown.rows)
    assert by_actor.proposer is not None
    spread = by_actor.proposer.propose() - start
    assert 0.0 < np.abs(spread).max() < 5.0 * FAST.design_std


def test_demonstrations_of_another_space_are_refused() -> None:
    with pytest.raises(ValueError, match=r"demonstrations of lip-12, the run is of box-12"):
        shown_rows("box-12", shown_path())


def shown_path() -> Path:
    from codesign_policy.demonstrations import demonstrations_path

    return demonstrations_path("lip-12")


def test_fixed_designs_must_be_usable() -> None:
    with pytest.raises(ValueError, match="design of lip-12"):
        fingers_of("lip-12", np.zeros(36))  # the base mesh touches the knuckle
    assert fingers_of("lip-12", shown_rows("lip-12").designs[0]).cage == "lip-12"


def test_the_scalar_d_is_where_demonstrated_designs_differ() -> None:
    line = np.array([0.1, 0.0, -0.2]) + np.outer([-1.0, 0.2, 0.7], [3.0, 0.0, 4.0])
    np.testing.assert_allclose(principal_direction(line), [0.6, 0.0, 0.8], atol=1e-12)
    with pytest.raises(ValueError, match="none different"):
        principal_direction(np.ones((3, 4)))
