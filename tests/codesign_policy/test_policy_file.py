"""The file that is served: small, safe to read, and the same policy."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from codesign_policy import policy_file
from codesign_policy.policy_file import load_pair
from codesign_policy.presets import FAST, PUBLISHED, Preset
from codesign_policy.replay import Spaces
from codesign_policy.rlpd import Agent

SPACES = Spaces(observation=29, design=21, control=7)


@pytest.mark.parametrize("preset", [FAST, PUBLISHED], ids=["fast", "published"])
def test_the_saved_pair_acts_as_the_agent(tmp_path: Path, preset: Preset) -> None:
    agent, random = Agent(SPACES, preset, 0), np.random.default_rng(0)
    design = random.uniform(-1.0, 1.0, 21).astype(np.float32)
    path = tmp_path / "pair.npz"
    agent.pair(design, {"seed": 4, "preset": preset.name}).save(path)
    pair = load_pair(path)
    observation = random.normal(size=(6, 29))
    # The same sums in another order: single precision.
    np.testing.assert_allclose(
        pair.act(observation), agent.act(observation, explore=False), atol=2e-6
    )
    np.testing.assert_array_equal(pair.design, design)
    assert pair.about == {"seed": 4, "preset": preset.name, "encoding": preset.encoding}
    assert (pair.observation_size, pair.control_size) == (29, 7)
    assert pair.act(observation[0]).shape == (7,)
    assert path.stat().st_size < 5e6


def test_the_saved_pair_keeps_its_weights_while_the_agent_learns() -> None:
    agent = Agent(SPACES, FAST, 0)
    pair = agent.pair(np.zeros(21), {})
    before = pair.act(np.ones((1, 29)))
    for parameter in agent.actors["control"].parameters():
        parameter.data += 1.0
    np.testing.assert_array_equal(pair.act(np.ones((1, 29))), before)


def test_a_pair_of_another_task_is_refused(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "pair.npz"
    Agent(SPACES, FAST, 0).pair(np.zeros(21), {}).save(path)
    monkeypatch.setattr(policy_file, "TASK_VERSION", 99)
    with pytest.raises(ValueError, match=r"task_version is \d+, this program's is 99"):
        load_pair(path)


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "pair.npz"
    with pytest.raises(ValueError, match="not a trained pair"):
        load_pair(path)
    path.write_bytes(b"something else")
    with pytest.raises(ValueError, match="not a trained pair"):
        load_pair(path)
    np.savez(path, design=np.array([{"code": 1}], dtype=object))
    with pytest.raises(ValueError, match="not a trained pair"):
        load_pair(path)


def test_layers_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "pair.npz"
    pair = Agent(SPACES, FAST, 0).pair(np.zeros(21), {})
    replace(pair, weights=(pair.weights[0][:, :5], *pair.weights[1:])).save(path)
    with pytest.raises(ValueError, match=r"layer 0 has shape \(40, 5\), .* \(40, 128\)"):
        load_pair(path)
    pair.biases[0][3] = np.nan
    pair.save(path)
    with pytest.raises(ValueError, match="not finite"):
        load_pair(path)
