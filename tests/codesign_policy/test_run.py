"""Settings of runs, and what is made of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from codesign_policy import control_demonstrations
from codesign_policy.codesign_env import COMPONENTS
from codesign_policy.control_demonstrations import (
    expert_rows,
    gentlest_rows,
    nominal_rows,
    own_rows,
)
from codesign_policy.expert_plan import DemonstrationError
from codesign_policy.presets import FAST
from codesign_policy.replay import Spaces
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
    assert RunConfig(space="wide-12").spaces == Spaces(44, 36, 7)
    assert RunConfig(space="wide-12").learns_design
    assert not RunConfig(space="wide-12", design=(0.0,) * 36).learns_design
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


def test_fine_tuning_learns_from_the_gentlest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of policy and expert; of the policy alone where the expert cannot use the fingers."""
    config = replace(STOCK, tetrahedra=600)
    shown = expert_rows(config, 4)
    episode = [shown.rows.pick(slice(k, None, 4)) for k in range(4)]

    def played(*stresses: float) -> list[control_demonstrations._Episode]:
        rows = episode[: len(stresses)]
        return [control_demonstrations._Episode(r, s) for r, s in zip(rows, stresses, strict=True)]

    agent = Agent(STOCK.spaces, FAST, 0)
    monkeypatch.setattr(control_demonstrations, "_own_episodes", lambda *_: played(900.0, 500.0))
    monkeypatch.setattr(control_demonstrations, "_expert_episodes", lambda *_: played(600.0))
    kept = gentlest_rows(agent, config).rows.action
    assert_array_equal(kept, np.concatenate([episode[1].action, episode[0].action]))

    def none(*_: object) -> None:
        raise DemonstrationError("no gap")

    monkeypatch.setattr(control_demonstrations, "_expert_episodes", none)
    assert len(gentlest_rows(agent, config)) == sum(len(e.action) for e in episode[:2])


def test_designs_start_at_the_gentlest_demonstration() -> None:
    shown = shown_rows("wide-12")
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
    with pytest.raises(ValueError, match=r"demonstrations of wide-12, the run is of box-12"):
        shown_rows("box-12", shown_path())


def shown_path() -> Path:
    from codesign_policy.demonstrations import demonstrations_path

    return demonstrations_path("wide-12")


def test_fixed_designs_must_be_usable() -> None:
    with pytest.raises(ValueError, match="design of lip-12"):
        fingers_of("lip-12", np.zeros(36))  # the base mesh touches the knuckle
    assert fingers_of("wide-12", shown_rows("wide-12").designs[0]).cage == "wide-12"


def test_the_scalar_d_is_where_demonstrated_designs_differ() -> None:
    line = np.array([0.1, 0.0, -0.2]) + np.outer([-1.0, 0.2, 0.7], [3.0, 0.0, 4.0])
    np.testing.assert_allclose(principal_direction(line), [0.6, 0.0, 0.8], atol=1e-12)
    with pytest.raises(ValueError, match="none different"):
        principal_direction(np.ones((3, 4)))
