"""Demonstrations: a round trip, a recorded grasp, and files that are refused."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from codesign_design.design_space import design_space
from codesign_policy import demonstrations
from codesign_policy.codesign_env import COMPONENTS, reward_weights
from codesign_policy.demonstrations import (
    DemonstrationError,
    Demonstrations,
    demonstrate,
    load_demonstrations,
)
from codesign_policy.replay import FIELDS, ReplayBuffer
from codesign_policy.task import TASK_VERSION, physical_observations

SPACE = "box-12"
COUNT = design_space(SPACE).parameter_count
HELD = COMPONENTS.index("held")


@pytest.fixture(scope="module")
def made() -> Demonstrations:
    """A flat pad, with a quick fit and few gaps."""
    patch = pytest.MonkeyPatch()
    patch.setattr(demonstrations, "RESTARTS", 4)
    patch.setattr(demonstrations, "GAPS", 4)
    patch.setattr(demonstrations, "TIGHTER", {2.5e-4: 4})
    try:
        return demonstrate(SPACE, experts=("flat_pad",))
    finally:
        patch.undo()


@pytest.fixture
def file(made: Demonstrations, tmp_path: Path) -> Path:
    path = tmp_path / "some.npz"
    made.save(path)
    return path


def test_a_demonstration_is_a_grasp_that_succeeds(made: Demonstrations) -> None:
    (episode,) = made.episodes
    assert episode.chamfer < 2e-4
    assert 0.026 < episode.width < 0.029
    assert 100.0 < episode.median_stress < episode.top10_stress < 1200.0
    assert episode.gaps_that_hold >= 3


def test_it_has_one_design_row_and_200_control_rows(made: Demonstrations) -> None:
    rows = made.rows.rows
    assert rows.in_control.tolist() == [False] + [True] * 200
    np.testing.assert_array_equal(made.rows.designs, made.designs.astype(np.float32))
    np.testing.assert_array_equal(rows.observation[1:, 8:], np.tile(made.rows.designs, (200, 1)))
    assert not rows.action[1:, :COUNT].any()
    assert rows.observation[0, 7] == 0.0
    assert rows.truncated.tolist() == [False] * 200 + [True]
    np.testing.assert_array_equal(rows.next_observation[:-1], rows.observation[1:])


def test_what_is_stored_is_the_grasp(made: Demonstrations) -> None:
    """The gap closes to the demonstration's, the block is up at the end and 20 steps before."""
    seen = physical_observations(made.rows.rows.next_observation)
    assert seen[-60:, 6].min() == pytest.approx(made.episodes[0].width, abs=2e-4)
    assert seen[-1, 5] - seen[0, 5] > 0.08
    assert made.rows.rows.components[-20:, HELD].all()
    assert made.rows.reward(reward_weights())[-20:].min() > 1.0


def test_a_round_trip_keeps_everything(made: Demonstrations, file: Path) -> None:
    loaded = load_demonstrations(file)
    assert loaded.space == made.space
    assert loaded.episodes == made.episodes
    for name in FIELDS:
        np.testing.assert_array_equal(
            getattr(loaded.rows.rows, name), getattr(made.rows.rows, name)
        )
    assert file.stat().st_size < 100_000
    other = ReplayBuffer(made.rows.spaces, COMPONENTS, 500)
    other.insert(loaded.rows.rows)
    assert len(other) == 201


def _about(change: Callable[[dict[str, Any]], None]) -> Callable[[dict[str, Any]], None]:
    def applied(arrays: dict[str, Any]) -> None:
        about = json.loads(str(arrays["about"]))
        change(about)
        arrays["about"] = np.array(json.dumps(about))

    return applied


def _set(name: str, value: float) -> Callable[[dict[str, Any]], None]:
    def applied(arrays: dict[str, Any]) -> None:
        arrays[name][7, 3] = value

    return applied


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (_set("observation", np.nan), r"observation\[7, 3\] is nan"),
        (_set("next_observation", 30.0), r"next_observation\[7, 3\] is 30.*within -20.0..20.0"),
        (_set("components", np.inf), r"components\[7, 3\] is inf"),
        (lambda a: a.update(action=a["action"] * 40.0), "action reaches"),
        (lambda a: a.update(action=a["action"][:, :9]), r"action has shape \(201, 9\)"),
        (lambda a: a.update(observation=a["observation"][:, :9]), "observation has shape"),
        (lambda a: a.update(truncated=np.ones(201)), "truncated is of type float64"),
        (lambda a: a.pop("terminated"), "not demonstrations"),
        (_about(lambda about: about.update(task_version=0)), f"task_version is 0.*{TASK_VERSION}"),
        (_about(lambda about: about.update(cage_version=0)), "cage_version is 0"),
        (_about(lambda about: about.update(components=["lift"])), "components is"),
        (_about(lambda about: about.update(space="cube-8")), "not demonstrations .*cube-8"),
        (_about(lambda about: about["episodes"][0].pop("width")), "not demonstrations"),
        (_about(lambda about: about["episodes"].clear()), "0 episodes for 1 designs"),
    ],
)
def test_bad_files_are_refused(
    file: Path, change: Callable[[dict[str, Any]], None], why: str
) -> None:
    with np.load(file) as stored:
        arrays = dict(stored)
    change(arrays)
    np.savez(file, **arrays)
    with pytest.raises(ValueError, match=why):
        load_demonstrations(file)


def test_files_that_are_none_are_refused(tmp_path: Path, file: Path) -> None:
    with pytest.raises(ValueError, match="No such file"):
        load_demonstrations(tmp_path / "none.npz")
    file.write_bytes(file.read_bytes()[:9000])
    with pytest.raises(ValueError, match=r"not demonstrations.*codesign policy demonstrate"):
        load_demonstrations(file)


def test_fingers_that_never_lift_are_an_error(
    made: Demonstrations, monkeypatch: pytest.MonkeyPatch
) -> None:
    parameters = np.array(made.episodes[0].parameters, np.float32)
    monkeypatch.setattr(demonstrations, "_fitted", lambda *given: (parameters, 0.0))
    monkeypatch.setattr(demonstrations, "GAPS", 4)
    monkeypatch.setattr(demonstrations, "TIGHTER", {2.5e-4: -6})  # all of them too wide
    with pytest.raises(DemonstrationError, match="flat_pad in box-12: no gap from"):
        demonstrate(SPACE, experts=("flat_pad",))
