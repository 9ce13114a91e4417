"""Checkpoint folders: found by name, written whole, and what they hold fits together."""

from pathlib import Path

import numpy as np
import pytest

from codesign_design.finger_files import load_finger_pair
from codesign_policy import shipped
from codesign_policy.learned import mismatch
from codesign_policy.policy_file import load_pair
from codesign_policy.shipped import checkpoint_names, checkpoint_path, ship
from tests.codesign_policy.random_pair import PARAMETERS, random_pair


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(shipped, "CHECKPOINTS", tmp_path)
    return tmp_path


def test_a_shipped_pair_is_found_by_its_name(folder: Path) -> None:
    ship(random_pair(seed=4), folder / "original")
    assert checkpoint_names() == ["original"]
    path = checkpoint_path("original")
    assert path == folder / "original" / "policy.npz"
    assert checkpoint_path(path) == checkpoint_path(path.parent) == path
    assert load_pair(path).about == {"space": "", "seed": 4}
    assert [p.name for p in folder.iterdir()] == ["original"]
    with pytest.raises(ValueError, match="'nobody': unknown; there are original; or give"):
        checkpoint_path("nobody")


def test_the_finger_files_are_the_pairs_own(folder: Path) -> None:
    pair = random_pair(np.zeros(PARAMETERS))
    ship(pair, folder / "codesign")
    finger = folder / "codesign" / "finger"
    assert mismatch(pair, load_finger_pair(finger)) == ""
    names = {path.name for path in finger.iterdir()}
    assert names >= {"left.stl", "right.stl", "parameters.json", "report.json", "finger.png"}
    assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) < 2e6


def test_a_new_pair_replaces_the_old_one_whole(folder: Path) -> None:
    target = folder / "codesign"
    ship(random_pair(np.zeros(PARAMETERS)), target)
    ship(random_pair(seed=5), target)
    assert [path.name for path in target.iterdir()] == ["policy.npz"]
    assert load_pair(target / "policy.npz").about["seed"] == 5
    assert [path.name for path in folder.iterdir()] == ["codesign"]


def test_what_cannot_be_built_leaves_the_old_pair(folder: Path) -> None:
    target = folder / "codesign"
    ship(random_pair(seed=5), target)
    crumpled = np.random.default_rng(0).uniform(-1.0, 1.0, PARAMETERS)
    for pair, words in (
        (random_pair(crumpled), "'codesign' cannot be used"),
        (random_pair(np.zeros(3)), "parameters"),
        (random_pair(np.zeros(PARAMETERS), space=""), "21 numbers, but about names no space"),
    ):
        with pytest.raises(ValueError, match=words):
            ship(pair, target)
        assert load_pair(target / "policy.npz").about["seed"] == 5
        assert [path.name for path in folder.iterdir()] == ["codesign"]


@pytest.mark.parametrize("name", checkpoint_names())
def test_shipped_pairs_load_and_know_their_fingers(name: str) -> None:
    path = checkpoint_path(name)
    pair = load_pair(path)
    assert pair.observation_size == 8 + len(pair.design)
    finger = path.parent / shipped.FINGER
    assert finger.is_dir() == bool(pair.space)
    if pair.space:
        assert mismatch(pair, load_finger_pair(finger)) == ""


@pytest.mark.parametrize(("name", "space"), [("codesign", "wide-12"), ("original", "")])
def test_what_comes_with_the_package_says_what_made_it(name: str, space: str) -> None:
    pair = load_pair(checkpoint_path(name))
    assert pair.space == space
    assert str(pair.about["command"]).startswith("codesign policy finetune ")
    assert len(str(pair.about["commit"])) >= 7
    assert "dirty" not in str(pair.about["commit"])
    seen = np.zeros((1, 8 + len(pair.design)), np.float32)
    assert np.abs(pair.act(seen)).max() <= 1.0
    folder = checkpoint_path(name).parent
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    assert size < 5e6
    if space:
        assert mismatch(pair, load_finger_pair(folder / "finger")) == ""
