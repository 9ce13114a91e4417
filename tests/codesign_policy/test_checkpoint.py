"""Checkpoints: whole or not at all, and what does not fit is named."""

from pathlib import Path

import numpy as np
import pytest
import torch

from codesign_policy import checkpoint as module
from codesign_policy.checkpoint import (
    load_checkpoint,
    random_state,
    require_same_configuration,
    restore_random,
    save_checkpoint,
)

STATE = {
    "tensors": {"a": torch.arange(3.0)},
    "arrays": [np.arange(4, dtype=np.int64), np.array([True, False])],
    "pair": (1, "text"),
    "nothing": None,
}


def test_round_trip(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "run", STATE, {"preset": {"hidden": (8, 8)}, "seed": 3})
    loaded = load_checkpoint(tmp_path / "run")
    assert loaded.configuration == {"preset": {"hidden": (8, 8)}, "seed": 3}
    torch.testing.assert_close(loaded.state["tensors"]["a"], torch.arange(3.0))
    np.testing.assert_array_equal(loaded.state["arrays"][0], np.arange(4))
    assert loaded.state["arrays"][1].dtype == torch.bool
    assert loaded.state["pair"] == (1, "text")
    assert loaded.state["nothing"] is None
    assert '"seed": 3' in (tmp_path / "run" / "configuration.json").read_text()


def test_an_interruption_while_saving_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_checkpoint(tmp_path, {"value": 1}, {})

    def interrupted(content: object, file: object) -> None:
        file.write(b"half of it")  # type: ignore[attr-defined]
        raise KeyboardInterrupt

    monkeypatch.setattr(module.torch, "save", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(tmp_path, {"value": 2}, {})
    monkeypatch.undo()
    assert load_checkpoint(tmp_path).state == {"value": 1}
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["checkpoint.pt", "configuration.json"]


def test_random_states_continue(tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    random.integers(100, size=3, dtype=np.int32)  # leaves half a word in store
    save_checkpoint(tmp_path, {"random": random_state(random)}, {})
    twin = np.random.default_rng(0)
    restore_random(twin, load_checkpoint(tmp_path).state["random"])
    assert random.integers(100, size=9).tolist() == twin.integers(100, size=9).tolist()


def test_unreadable_checkpoints_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds no checkpoint\.pt"):
        load_checkpoint(tmp_path)
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(b"not a checkpoint")
    with pytest.raises(ValueError, match="cannot be read"):
        load_checkpoint(tmp_path)
    save_checkpoint(tmp_path, {"value": torch.zeros(1000)}, {})
    path.write_bytes(path.read_bytes()[:1500])
    with pytest.raises(ValueError, match="cannot be read"):
        load_checkpoint(tmp_path)
    torch.save({"version": 0}, path)
    with pytest.raises(ValueError, match="version 0, this is 1"):
        load_checkpoint(tmp_path)


def test_a_file_that_would_run_code_is_refused(tmp_path: Path) -> None:
    torch.save({"version": 1, "state": Path}, tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match="cannot be read"):
        load_checkpoint(tmp_path)


def test_configurations_are_compared_by_value() -> None:
    stored = {"preset": {"hidden": [8, 8], "name": "fast"}, "seed": 1}
    require_same_configuration(stored, {"preset": {"hidden": (8, 8), "name": "fast"}, "seed": 1})
    with pytest.raises(ValueError, match=r"preset\.hidden was \[8, 8\] .* is \[16\] now"):
        require_same_configuration(stored, {"preset": {"hidden": (16,), "name": "fast"}, "seed": 1})
    with pytest.raises(ValueError, match=r"seed was 1 .* is missing now"):
        require_same_configuration(stored, {"preset": stored["preset"]})
