"""Making demonstrations: one grasp with a fitted finger, and a finger that never lifts."""

from pathlib import Path

import numpy as np
import pytest

from codesign_design.design_space import design_space
from codesign_policy import expert_demonstrations, expert_plan
from codesign_policy.codesign_env import COMPONENTS
from codesign_policy.control_env import ControlConfig
from codesign_policy.demonstrations import Demonstrations, load_demonstrations
from codesign_policy.expert_demonstrations import demonstrate, practise
from codesign_policy.expert_plan import DemonstrationError
from codesign_policy.task import physical_observations

SPACE = "box-12"
COUNT = design_space(SPACE).parameter_count


@pytest.fixture(scope="module")
def made() -> Demonstrations:
    """A flat pad twice, with a quick fit and few gaps."""
    patch = pytest.MonkeyPatch()
    patch.setattr(expert_demonstrations, "RESTARTS", 4)
    patch.setattr(expert_plan, "GAPS", 6)
    patch.setattr(expert_plan, "TIGHTER", {2.5e-4: 9})
    try:
        return demonstrate(SPACE, experts=("flat_pad", "flat_pad"), tetrahedra=600)
    finally:
        patch.undo()


def test_a_demonstration_is_a_grasp_that_succeeds(made: Demonstrations) -> None:
    episode, again = made.episodes
    assert episode == again
    assert episode.chamfer is not None
    assert episode.chamfer < 2e-4
    assert 0.026 < episode.width < 0.029
    assert 100.0 < episode.median_stress < episode.top10_stress < 1300.0
    assert episode.gaps_that_hold is not None
    assert episode.gaps_that_hold >= 2


def test_episodes_follow_one_another(made: Demonstrations) -> None:
    """One design row and 200 control rows each, that end with the block up."""
    for rows in made.transitions():
        assert rows.in_control.tolist() == [False] + [True] * 200
        np.testing.assert_array_equal(rows.action[0, :COUNT], made.rows.designs[0])
        np.testing.assert_array_equal(
            rows.observation[1:, 8:], np.tile(made.rows.designs[0], (200, 1))
        )
        np.testing.assert_array_equal(rows.next_observation[:-1], rows.observation[1:])
        assert rows.truncated.tolist() == [False] * 200 + [True]
        seen = physical_observations(rows.next_observation)
        assert seen[-60:, 6].min() == pytest.approx(made.episodes[0].width, abs=2e-4)
        assert rows.components[-20:, COMPONENTS.index("held")].all()


def test_what_was_made_can_be_stored(made: Demonstrations, tmp_path: Path) -> None:
    made.save(tmp_path / "made")
    assert load_demonstrations(tmp_path / "made").episodes == made.episodes


def test_fingers_that_never_lift_are_an_error(
    made: Demonstrations, monkeypatch: pytest.MonkeyPatch
) -> None:
    parameters = np.array(made.episodes[0].parameters, np.float32)
    monkeypatch.setattr(expert_demonstrations, "_fitted", lambda *given: (parameters, 0.0))
    monkeypatch.setattr(expert_plan, "GAPS", 4)
    monkeypatch.setattr(expert_plan, "TIGHTER", {2.5e-4: -6})  # all of them too wide
    with pytest.raises(DemonstrationError, match=r"flat_pad in box-12: fingers .*no gap from"):
        demonstrate(SPACE, experts=("flat_pad",), tetrahedra=600)


def test_practice_is_with_other_fingers_and_blocks(made: Demonstrations) -> None:
    config = ControlConfig(tetrahedra=600, friction=(0.45, 0.55), pose_error=0.0005)
    rows = practise(made, 4, config, spread=0.005, seed=1)
    again = practise(made, 4, config, spread=0.005, seed=1)
    np.testing.assert_array_equal(rows.action, again.action)
    episodes = int((~rows.in_control).sum())
    assert 1 <= episodes <= 4
    assert len(rows.in_control) == 201 * episodes
    designs = rows.action[~rows.in_control, :COUNT]
    assert 0.0 < np.abs(designs - made.rows.designs[0]).max() < 0.05
    assert len(np.unique(designs, axis=0)) == episodes
    starts = rows.observation[1::201]
    np.testing.assert_array_equal(starts[:, 8:], designs)
    held = rows.components[200::201, COMPONENTS.index("held")]
    assert held.all()  # those that fail are left out
