"""Demonstrations as Minari datasets: the shipped one, round trips, and what is refused."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from codesign_design.design_space import design_space
from codesign_policy.codesign_env import COMPONENTS, reward_weights
from codesign_policy.demonstrations import (
    ABOUT,
    SHIPPED,
    Demonstrations,
    demonstrations_path,
    load_demonstrations,
)
from codesign_policy.replay import FIELDS, ReplayBuffer
from codesign_policy.task import TASK_VERSION, physical_observations

SPACE = "wide-12"
COUNT = design_space(SPACE).parameter_count
HELD = COMPONENTS.index("held")


@pytest.fixture(scope="module")
def shipped() -> Demonstrations:
    return load_demonstrations(demonstrations_path(SPACE))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the shipped dataset."""
    return Path(shutil.copytree(demonstrations_path(SPACE), tmp_path / "some"))


# --- the shipped dataset


def test_the_shipped_demonstrations_are_three_designs_and_600_control_steps(
    shipped: Demonstrations,
) -> None:
    assert shipped.space == SPACE
    assert shipped.made_by.startswith("codesign policy demonstrate --space wide-12")
    assert [episode.expert for episode in shipped.episodes] == ["flat_pad", "cupped_pad", "scoop"]
    rows = shipped.rows.rows
    assert rows.in_control.tolist() == ([False] + [True] * 200) * 3
    assert rows.truncated.tolist() == ([False] * 200 + [True]) * 3
    assert not rows.terminated.any()
    np.testing.assert_array_equal(shipped.rows.designs, shipped.designs.astype(np.float32))
    assert sum(path.stat().st_size for path in SHIPPED.rglob("*")) < 1_000_000


def test_every_shipped_demonstration_lifts_and_holds_the_block(shipped: Demonstrations) -> None:
    for episode, rows in zip(shipped.episodes, shipped.transitions(), strict=True):
        assert len(rows.in_control) == 201
        assert not rows.action[0, COUNT:].any()
        assert not rows.action[1:, :COUNT].any()
        np.testing.assert_array_equal(rows.next_observation[:-1], rows.observation[1:])
        seen = physical_observations(rows.next_observation)
        assert seen[-60:, 6].min() == pytest.approx(episode.width, abs=2e-4)
        assert seen[-1, 5] - seen[0, 5] > 0.08
        assert rows.components[-20:, HELD].all()
        assert 100.0 < episode.median_stress < episode.top10_stress < 1200.0
    reward = shipped.rows.reward(reward_weights())
    assert np.isfinite(reward).all()
    assert reward.reshape(3, 201)[:, -20:].min() > 1.0


def test_minari_opens_it_by_its_id(
    monkeypatch: pytest.MonkeyPatch, shipped: Demonstrations
) -> None:
    """As somebody would who knows nothing of this package."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(SHIPPED))
    assert list(minari.list_local_datasets()) == ["codesign/wide-12/experts-v0"]
    dataset = minari.load_dataset("codesign/wide-12/experts-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (3, 603)
    for episode, rows in zip(dataset.iterate_episodes(), shipped.transitions(), strict=True):
        assert episode.observations.shape == (202, 8 + COUNT)
        assert all(dataset.observation_space.contains(each) for each in episode.observations)
        assert all(dataset.action_space.contains(each) for each in episode.actions)
        np.testing.assert_array_equal(episode.observations[:-1], rows.observation)
        np.testing.assert_array_equal(episode.actions, rows.action)
        assert episode.truncations[-1]
        # What a step's info says stands beside its next observation.
        lift = episode.infos["reward_lift"]
        np.testing.assert_array_equal(lift[1:], rows.components[:, COMPONENTS.index("lift")])
        assert episode.infos["stage"].tolist() == [0.0] + [1.0] * 201
    weights = dataset.storage.metadata[ABOUT]["weights"]
    total = sum(weight * episode.infos[f"reward_{name}"] for name, weight in weights.items())
    np.testing.assert_allclose(total[1:], episode.rewards, atol=1e-5)
    (first, *_) = dataset.storage.get_episode_metadata([0])
    assert first["expert"] == "flat_pad"


def test_a_name_that_is_not_shipped_is_a_path() -> None:
    assert demonstrations_path("runs/mine") == Path("runs/mine")


# --- round trips


def test_a_round_trip_keeps_everything(
    shipped: Demonstrations, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shipped.save(Path("again"), "copied-v3")
    loaded = load_demonstrations(Path("again"))
    assert (loaded.space, loaded.episodes) == (shipped.space, shipped.episodes)
    assert loaded.made_by == shipped.made_by
    for name in FIELDS:
        np.testing.assert_array_equal(
            getattr(loaded.rows.rows, name), getattr(shipped.rows.rows, name)
        )
    assert minari.MinariDataset("again").id == "codesign/wide-12/copied-v3"


def test_saving_replaces_a_dataset_and_nothing_else(
    shipped: Demonstrations, folder: Path, tmp_path: Path
) -> None:
    one = Demonstrations(SPACE, shipped.episodes[:1], _rows(shipped, slice(0, 201)))
    one.save(folder)
    assert len(load_demonstrations(folder).episodes) == 1
    assert sorted(path.name for path in folder.iterdir()) == ["0", "metadata.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["some"]
    (tmp_path / "diary.txt").write_text("dear")
    with pytest.raises(ValueError, match="has other content"):
        one.save(tmp_path)
    assert (tmp_path / "diary.txt").read_text() == "dear"


def _rows(demonstrations: Demonstrations, which: slice) -> ReplayBuffer:
    rows = demonstrations.rows
    some = ReplayBuffer(rows.spaces, rows.components, 603)
    some.insert(rows.rows.pick(which))
    return some


# --- what is refused


def _about(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    def applied(folder: Path) -> None:
        metadata = json.loads((folder / "metadata.json").read_text())
        change(metadata[ABOUT])
        (folder / "metadata.json").write_text(json.dumps(metadata))

    return applied


def _episode(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    """Of the second episode's metadata."""

    def applied(folder: Path) -> None:
        metadata = json.loads((folder / "1" / "metadata.json").read_text())
        change(metadata)
        (folder / "1" / "metadata.json").write_text(json.dumps(metadata))

    return applied


def _column(name: str, change: Callable[[Any], Any]) -> Callable[[Path], None]:
    """Of the second episode's table."""

    def applied(folder: Path) -> None:
        path = folder / "1" / "part-0.parquet"
        table = pq.read_table(path)
        values = np.stack(table[name].to_numpy()).copy()
        values = change(values)
        flat = pa.array(values.ravel())
        if values.ndim == 2:
            flat = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        pq.write_table(table.set_column(table.column_names.index(name), name, flat), path)

    return applied


def _set(name: str, value: float, row: int = 7, column: int = 3) -> Callable[[Path], None]:
    def change(values: Any) -> Any:
        values[row, column] = value
        return values

    return _column(name, change)


def _component(name: str, value: float) -> Callable[[Path], None]:
    def applied(folder: Path) -> None:
        path = folder / "1" / "part-0.parquet"
        table = pq.read_table(path)
        infos = table["infos"].combine_chunks()
        names = [field.name for field in infos.type]
        arrays = [infos.field(each).to_numpy().copy() for each in names]
        arrays[names.index(f"reward_{name}")][9] = value
        changed = pa.StructArray.from_arrays([pa.array(each) for each in arrays], names)
        pq.write_table(table.set_column(table.column_names.index("infos"), "infos", changed), path)

    return applied


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (_set("observations", np.nan), r"episode 1: observations\[7, 3\] is nan"),
        (_set("observations", 30.0), r"observations\[7, 3\] is 30.*within -20.0..20.0"),
        (_set("observations", 0.0, row=9, column=7), "one design step and then control steps"),
        (_set("observations", 0.5, row=0), "does not begin with the design stage"),
        (_set("observations", 0.01, column=20), "design of 'cupped_pad' differs"),
        (_set("actions", np.nan, column=COUNT), rf"action\[7, {COUNT}\] is nan"),
        (_set("actions", 3.0, column=COUNT), "action reaches 3.0"),
        (_component("lift", np.inf), r"components\[8, 0\] is inf"),
        (_component("lift", 0.5), "rewards are not the weighted sum"),
        (_column("observations", lambda v: v[:, :9]), "not demonstrations"),
        (_column("truncations", lambda v: v.astype(float)), "not demonstrations.*truncations"),
        (lambda folder: (folder / "1" / "part-0.parquet").unlink(), "steps of 2 episodes, 3 are"),
        (_episode(lambda about: about.pop("width")), "not demonstrations.*width"),
        (_episode(lambda about: about["parameters"].pop()), r"parameters have shape \(35,\)"),
        (_about(lambda about: about.update(task_version=0)), f"task_version is 0.*{TASK_VERSION}"),
        (_about(lambda about: about.update(cage_version=0)), "cage_version is 0"),
        (_about(lambda about: about.update(components=["lift"])), "components is"),
        (_about(lambda about: about.update(space="cube-8")), "not demonstrations .*cube-8"),
        (_about(lambda about: about.pop("space")), "not demonstrations"),
    ],
)
def test_bad_datasets_are_refused(folder: Path, change: Callable[[Path], None], why: str) -> None:
    load_demonstrations(folder)
    change(folder)
    with pytest.raises(ValueError, match=why):
        load_demonstrations(folder)


def test_folders_that_are_none_are_refused(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(ValueError, match=r"doesn't exist.*codesign policy demonstrate"):
        load_demonstrations(tmp_path / "none")
    table = folder / "0" / "part-0.parquet"
    table.write_bytes(table.read_bytes()[:4000])
    with pytest.raises(ValueError, match=r"not demonstrations.*codesign policy demonstrate"):
        load_demonstrations(folder)
    (folder / "metadata.json").write_text("{")
    with pytest.raises(ValueError, match="not demonstrations"):
        load_demonstrations(folder)
